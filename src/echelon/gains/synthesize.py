"""The verb that turns a model, a graph and a method into a gain."""

from echelon.core.errors import GainError
from echelon.core.numerics import precision
from echelon.gains.gain import Gain, Method
from echelon.models.check import check_model
from echelon.models.model import ControlAffine
from echelon.network.graph import Graph


def synthesize(model: ControlAffine, graph: Graph, method: Method) -> Gain:
    """Return the gain of the consensus law for agents `model` on `graph`, with its certificate.

    The computation is in float64.

    Raises:
        ModelError: the model is malformed.
        GainError: the method does not apply, with the reason.
    """
    if not isinstance(method, Method):
        got = f"the class `{method.__name__}`" if isinstance(method, type) else f"{method!r}"
        raise GainError(f"`method` is {got}, and must be a gain method such as `Riccati()`.")
    with precision("float64"):
        check_model(model)
        return method.solve(model, graph)
