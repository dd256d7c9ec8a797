"""Whether a law is one that the theorems are about, and what an unknown law uses of others."""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.references.reference import Guide
from echelon.core.jaxpr import used_leaves
from echelon.core.memoize import memoize
from echelon.core.numerics import precision
from echelon.core.types import PyTree
from echelon.core.words import Feedforward
from echelon.laws.law import Law
from echelon.laws.law_check import prepare_law, traced_arguments

_WORDS = {"information", "warnings", "refusals"}
"""What a class may replace without a change of what the law does."""
_LOOKUPS = {"__getattribute__", "__getattr__"}


def unknown_class(law: Law) -> str:
    """Return the class in a law whose code echelon does not know; empty without any.

    It is a user's own, or replaces a method of one of echelon's classes. Numbers that a subclass
    sets are read by what is computed of the law; a reference is a function of time alone.
    """
    return next((type(part).__name__ for part in _parts(law) if _is_unknown(type(part))), "")


def _parts(part: object) -> Iterator[object]:
    """Yield a law and all that is made of fields in it: its gain, for example."""
    if dataclasses.is_dataclass(part) and not isinstance(part, type | Guide | ControlAffine):
        yield part
        for value in vars(part).values():
            yield from _parts(value)


def _is_unknown(kind: type) -> bool:
    """Tell whether code of a class is another than that of echelon's class of which it is a kind.

    Of a name, the first class of the order of resolution counts.
    """
    order, ours = kind.__mro__, [c for c in kind.__mro__ if c.__module__.startswith("echelon.")]
    known = {base for cls in ours for base in cls.__mro__}
    names = {name for cls in ours for name in vars(cls) if not name.startswith("__")} | _LOOKUPS
    firsts = {name: next((c for c in order if name in vars(c)), object) for name in names - _WORDS}
    return any(cls not in known and _is_code(vars(cls)[name]) for name, cls in firsts.items())


def _is_code(value: object) -> bool:
    return callable(value) or hasattr(type(value), "__get__")


@memoize
def information_of(law: Law, model: ControlAffine, graph: Graph) -> tuple[str, ...]:
    """Return what a law needs from others, in words: of an unknown law what its trace reads."""
    words = next(kind for kind in type(law).__mro__ if "information" in vars(kind))
    if words.__module__.startswith("echelon.") and not unknown_class(law):
        return law.information
    with precision("float64"):
        law = prepare_law(law, model, graph)
        view, memory = traced_arguments(law, model)

        def update(z: jax.Array, sent: jax.Array) -> PyTree:
            known = eqx.tree_at(lambda v: (v.disagreement, v.feedforward), view, (z, sent))
            u, after = law.update(model, known, memory)
            return u, law.settle(model, known, u, u, after)

        z, sent = used_leaves(update, view.disagreement, view.feedforward)
    signal = type(law).signal is not Law.signal
    reads = [f"neighbours' {'signals' if signal else 'states'}"] * z
    reads += [law.feedforward.value] * (sent and law.feedforward is not Feedforward.NONE)
    return tuple(dict.fromkeys([*reads, *law.information]))
