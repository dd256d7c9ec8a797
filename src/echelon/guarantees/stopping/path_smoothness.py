"""Whether a leader's path has the derivatives that T5 asks of it."""

from collections.abc import Callable
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import Chains
from echelon.agents.references.reference import COORDINATES, Guide, Reference
from echelon.core.digits import about
from echelon.core.enclosure.taylor import enclose_derivatives, enclose_finely
from echelon.core.errors import GainError
from echelon.core.memoize import memoize
from echelon.core.numerics import derivatives, precision

_TIMES = 8
"""At which handwritten derivatives are compared."""
_SAME = 1e-6
"""Relative; far more than floats leave of a derivative."""


def path_fault(reference: Guide | None, chains: Chains, horizon: float) -> str:
    """Return why a path is not known to have bounded derivatives; empty where it has.

    An output with a chain of r integrators needs r - 1 continuous derivatives until the horizon (s)
    and a bounded one more. A path has all of them if every function in its equations is smooth on
    the values that it takes there, which are enclosed, span by span.
    """
    if not isinstance(reference, Reference):
        return ""
    try:
        _check(reference, chains.outputs, max(chains.degrees), horizon)
    except GainError as error:
        name, order = type(reference).__name__, max(chains.degrees)
        why = str(error).rstrip(".")
        return f"`{name}` is not known to have {order} bounded derivatives, since {why}"
    return ""


@memoize
def _check(reference: Reference, outputs: tuple[str, ...], order: int, horizon: float) -> None:
    """Check a path.

    Raises:
        GainError: it may lack a derivative.
    """
    if type(reference).derivatives is not Reference.derivatives:
        raise GainError("a path replaces `derivatives`, which may be those of another path")
    picked = np.array([COORDINATES.index(name) for name in outputs])
    begin, parts = 0.0, reference.parts(horizon)
    if len(parts) > 1:
        _check_joints(reference, order)
    for until, part in parts:

        def path(t: jax.Array, part: Callable[[jax.Array], jax.Array] = part) -> jax.Array:
            return part(t)[picked]

        list(enclose_finely(path, (Fraction(begin), Fraction(until)), 0))
        compare_derivatives(path, order, begin, until)
        begin = until


def _check_joints(reference: Reference, order: int) -> None:
    """Check that the class of a path says that its parts fit together.

    Raises:
        GainError: it does not.
    """
    kinds = type(reference).__mro__
    joined, parts, path = (
        next(k for k, kind in enumerate(kinds) if name in vars(kind))
        for name in ("joined", "parts", "__call__")
    )
    if max(joined, parts) > path:
        raise GainError("a path is joined of parts of which nothing says how they fit together")
    if reference.joined < order - 1:
        raise GainError(
            f"its parts meet with {reference.joined} continuous derivatives, and {order - 1} are "
            "needed"
        )


def compare_derivatives(
    path: Callable[[jax.Array], jax.Array], order: int, begin: float, end: float
) -> None:
    """Check handwritten derivatives in a path, which the law uses, at a few times.

    Raises:
        GainError: they are not those of its values.
    """
    with precision("float64"):
        if "custom_" not in str(jax.make_jaxpr(path)(jnp.zeros(()))):
            return
        for t in np.linspace(begin, end, _TIMES):
            values = np.asarray(derivatives(path, jnp.asarray(t), order)).ravel().tolist()
            [rows] = enclose_derivatives(path, (Fraction(t), Fraction(t)), order)
            for x, value in zip(sum(rows, []), values, strict=True):
                slack = Fraction(_SAME) * (1 + max(abs(x.lo), abs(x.hi)))
                if not (np.isfinite(value) and x.lo - slack <= Fraction(value) <= x.hi + slack):
                    when = f"at {about(t)} s"
                    raise GainError(f"a path has a derivative {when} that is not of its values")
