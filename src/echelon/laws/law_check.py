"""The checks that a law passes once, when it enters a run."""

from typing import Any

import jax
import jax.numpy as jnp

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.references.demand import reference_warnings
from echelon.agents.references.reference import Reference
from echelon.core.errors import LawError
from echelon.core.memoize import memoize
from echelon.core.numerics import precision
from echelon.core.trace import check_array, checked_trace
from echelon.core.words import Feedforward
from echelon.laws.law import Law, LocalView, reference_of

_ADVICE = "it must be written with `jax.numpy` and take what one agent knows"


def prepare_law(law: Law, model: ControlAffine, graph: Graph) -> Law:
    """Return a law completed for a checked model and a graph, after checking what it returns.

    Raises:
        LawError: it does not fit the model, or returns something else than the interface says.
    """
    with precision("float64"):
        ready = law.prepared(model, graph)
        if not isinstance(ready, Law):
            raise LawError(
                f"`prepared` of `{type(law).__name__}` returns a `{type(ready).__name__}`, and "
                "must return the completed law."
            )
        _check_law(ready, model)
    return ready


def leader_warnings(
    law: Law, model: ControlAffine, horizon: float, limits: bool
) -> tuple[str, ...]:
    """Return what of its reference a leader cannot do over a horizon (s), a sentence each."""
    reference = reference_of(law)
    # By flatness it is an exact motion, and without limits there is nothing to look for.
    exact = isinstance(reference, Reference) and not (limits and model.input_limits)
    if reference is None or exact:
        return ()
    return reference_warnings(model, reference, horizon, limits)


@memoize
def _check_law(law: Law, model: ControlAffine) -> None:
    """Trace one agent of a law, and check what it returns; once for a law and a model."""
    name, m = type(law).__name__, len(model.input_names)
    if not isinstance(law.feedforward, Feedforward):
        raise LawError(
            f"`feedforward` of `{name}` is {law.feedforward!r}, and must be a member of "
            "`Feedforward`, such as `Feedforward.RELAY`."
        )
    memory = _memory(law)
    found = checked_trace(
        LawError,
        f"`update` of `{name}`",
        lambda view, memory: law.update(model, view, memory),
        _view(law, model),
        memory,
        advice=_ADVICE,
    ).result
    if not isinstance(found, tuple) or len(found) != 2:
        raise LawError(
            f"`update` of `{name}` returns one thing, and must return two, the input and the next "
            "memory: `return u, memory`."
        )
    check_array(LawError, f"the input of `{name}`", found[0], (m,))
    if _form(memory) != _form(found[1]):
        raise LawError(
            f"the memory of `{name}` is {_in_words(memory)} at first and {_in_words(found[1])} "
            "after a step, and must keep its form."
        )


def _memory(law: Law) -> Any:
    """Return the memory of one agent at the beginning, arrays all."""
    begun = law.init()
    try:
        return jax.tree.map(jnp.asarray, begun)
    except TypeError as error:
        raise LawError(
            f"`init` of `{type(law).__name__}` returns {begun!r}, and must return arrays, numbers "
            "or nothing."
        ) from error


def _view(law: Law, model: ControlAffine) -> LocalView:
    """Return what an agent may know, zeros all, with what it is sent in the shape it is sent in."""
    x, sent = jnp.zeros(len(model.state_names)), jnp.zeros(len(model.input_names))
    signal = jax.eval_shape(lambda: law.signal(model, x, x, _memory(law)))
    z = x if signal is None else jnp.zeros(signal.shape)
    if law.feedforward is not Feedforward.NONE:
        said = checked_trace(
            LawError,
            f"`broadcast` of `{type(law).__name__}`",
            lambda x, v: law.message(model, x, v, _memory(law)),
            x,
            sent,
            advice=_ADVICE,
        ).result
        sent = jnp.zeros(said.shape)
    return LocalView(jnp.zeros(()), x, x, z, sent)


def _form(memory: Any) -> Any:
    leaves, structure = jax.tree.flatten(memory)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def _in_words(memory: Any) -> str:
    """Return what a memory is made of, such as `float64 (3,), float64 ()`."""
    leaves = jax.tree.leaves(memory)
    return ", ".join(f"{leaf.dtype} {leaf.shape}" for leaf in leaves) or "nothing"
