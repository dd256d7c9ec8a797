"""The checks of a law before its first run, and whether it is one that the theorems are about."""

import dataclasses
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.unlike import UnlikeAgents
from echelon.agents.network.graph import Graph
from echelon.agents.references.flatness import reference_warnings, stop_warnings
from echelon.agents.references.reference import LeaderPath, Reference
from echelon.core.cache import memoize
from echelon.core.errors import LawError, listing
from echelon.core.numerics import precision
from echelon.core.trace import check_array, checked_trace, form_in_words, form_of, place_of
from echelon.core.types import PyTree
from echelon.core.words import Feedforward, amount
from echelon.laws.law import Feeds, Law, LocalView, Memory, Speaks, reference_of
from echelon_ranges.jaxpr import used_leaves

_ADVICE = "it must be written with `jax.numpy` and take what one agent knows"


def prepare_law(law: Law, model: ControlAffine, graph: Graph) -> Law:
    """Return a law completed for a checked model and a graph, after checking what it returns.

    Raises:
        LawError: it does not fit the model, or returns something else than the interface requires.
    """
    if isinstance(model, UnlikeAgents) and not law.unlike:
        raise LawError(
            f"`{type(law).__name__}` is a law of agents of one model, and these are "
            f"{listing(model.names)}; use `stopping-point` for leader and followers."
        )
    with precision("float64"):
        complete = law.prepared(model, graph)
        if not isinstance(complete, Law):
            raise LawError(
                f"`prepared` of `{type(law).__name__}` returns a `{type(complete).__name__}`, and "
                "must return the completed law."
            )
        _check_law(complete, model)
    return complete


def leader_warnings(
    law: Law, model: ControlAffine, horizon: float, limits: bool
) -> tuple[str, ...]:
    """Return what a leader cannot follow of its reference over a horizon (s), a sentence each."""
    reference = reference_of(law)
    # A flat reference is an exact motion, which only limits can make infeasible.
    exact = isinstance(reference, Reference) and not (limits and model.input_limits)
    if reference is None:
        return ()
    if exact:
        return (*reference.remarks(), *stop_warnings(model, reference, horizon))
    return reference_warnings(model, reference, horizon, limits)


@memoize
def _check_law(law: Law, model: ControlAffine) -> None:
    name, m = type(law).__name__, len(model.input_names)
    if not isinstance(law.feedforward, Feedforward):
        raise LawError(
            f"`feedforward` of `{name}` is {law.feedforward!r}, and must be a member of "
            "`Feedforward`, such as `Feedforward.RELAY`."
        )
    memory, x = _memory(law), jnp.zeros(len(model.state_names))
    begun = checked_trace(
        LawError, f"`begin` of `{name}`", lambda x: law.begin(model, x), x, advice=_ADVICE
    )
    if form_of(memory) != form_of(begun):
        raise LawError(
            f"{place_of(type(law))}: the memory of `{name}` is {form_in_words(memory)} by `init` "
            f"and {form_in_words(begun)} by `begin`, and both must have the same form."
        )
    view = _view(law, model)
    output = checked_trace(
        LawError,
        f"`update` of `{name}`",
        lambda view, memory: law.update(model, view, memory),
        view,
        memory,
        advice=_ADVICE,
    )
    if not isinstance(output, tuple) or len(output) != 2:
        raise LawError(
            f"`update` of `{name}` returns one thing, and must return two, the input and the next "
            "memory: `return u, memory`."
        )
    check_array(LawError, f"the input of `{name}`", output[0], (m,))
    # A compiled loop carries the memory, whose shapes and types cannot change.
    if form_of(memory) != form_of(output[1]):
        raise LawError(
            f"{place_of(type(law))}: the memory of `{name}` is {form_in_words(memory)} at first "
            f"and {form_in_words(output[1])} after a step, and must keep its form."
        )


def traced_arguments(law: Law, model: ControlAffine) -> tuple[LocalView, Memory]:
    """Return a view of zeros and the memory at the beginning, in the shapes that a law uses."""
    return _view(law, model), _memory(law)


def _memory(law: Law) -> Memory:
    memory = law.init()
    try:
        return jax.tree.map(jnp.asarray, memory)
    except TypeError as error:
        raise LawError(
            f"`init` of `{type(law).__name__}` returns {memory!r}, and must return arrays, numbers "
            "or nothing."
        ) from error


@memoize
def signal_size(law: Law, model: ControlAffine) -> int | None:
    """Return how many numbers a law's signal has; None where agents send x - offset."""
    if not Speaks.may(law, "signal"):
        return None
    x = jnp.zeros(len(model.state_names))
    signal = checked_trace(
        LawError,
        f"`signal` of `{type(law).__name__}`",
        lambda x: Speaks.of(law).signal(model, x, x, _memory(law)),
        x,
        advice=_ADVICE,
    )
    return None if signal is None else signal.size


def check_signals(leader: Law, follower: Law, model: ControlAffine) -> None:
    """Check that a leader sends what its followers take differences of.

    Raises:
        LawError: followers send signals, and the leader sends none, or others.
    """
    sizes = signal_size(leader, model), signal_size(follower, model)
    if sizes[1] is not None and sizes[0] != sizes[1]:
        sent = "none" if sizes[0] is None else f"{sizes[0]}"
        raise LawError(
            f"followers under the law `{type(follower).__name__}` send a signal of "
            f"{amount(sizes[1], 'number')}, and a leader under `{type(leader).__name__}` sends "
            f"{sent}; give the leader a law with the same `signal`."
        )


def _view(law: Law, model: ControlAffine) -> LocalView:
    x, forward = jnp.zeros(len(model.state_names)), jnp.zeros(len(model.input_names))
    size = signal_size(law, model)
    z = x if size is None else jnp.zeros(size)
    if law.feedforward is not Feedforward.NONE:
        message = checked_trace(
            LawError,
            f"`broadcast` of `{type(law).__name__}`",
            lambda x, v: Feeds.of(law).message(model, x, v, _memory(law)),
            x,
            forward,
            advice=_ADVICE,
        )
        forward = jnp.zeros(message.shape)
    return LocalView(jnp.zeros(()), x, x, z, forward)


# ---- known laws ----------------------------------------------------------------------------------

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
    if dataclasses.is_dataclass(part) and not isinstance(part, type | LeaderPath | ControlAffine):
        yield part
        for value in vars(part).values():
            yield from _parts(value)


def _is_unknown(kind: type) -> bool:
    """Tell whether code of a class differs from that of echelon's class of which it is a kind."""
    order, ours = kind.__mro__, [c for c in kind.__mro__ if c.__module__.startswith("echelon.")]
    known = {base for cls in ours for base in cls.__mro__}
    names = {name for cls in ours for name in vars(cls) if not name.startswith("__")} | _LOOKUPS
    firsts = {name: next((c for c in order if name in vars(c)), object) for name in names - _WORDS}
    others = (vars(cls)[name] for name, cls in firsts.items() if cls not in known)
    return any(callable(value) or hasattr(type(value), "__get__") for value in others)


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
    signal = signal_size(law, model) is not None
    reads = [f"neighbours' {'signals' if signal else 'states'}"] * z
    reads += [law.feedforward.value] * (sent and law.feedforward is not Feedforward.NONE)
    return tuple(dict.fromkeys([*reads, *law.information]))
