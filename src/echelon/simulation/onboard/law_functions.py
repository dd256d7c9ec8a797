"""What one agent computes on board, as functions on graphs of scalars.

They are traced from what `Agent` runs, as native code is.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from echelon.core.types import PyTree
from echelon.simulation.engine.own_step import (
    OwnLaw,
    OwnState,
    begin_alone,
    gap_of,
    signal_of,
    step_with,
)
from echelon.simulation.native.agent_step import (
    check_information,
    leaves_of,
    memory_size,
    single,
    unflatten,
)
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, needed, nodes


class LawFunction(NamedTuple):
    """A function of numbers.

    Attributes:
        name: of the function.
        about: what it does, a sentence.
        inputs: name -> how many numbers it has; None for a number that is no array.
        outputs: name -> its numbers.
        valid: whether all that the outputs rest on is finite and accurate; None if not computed.
    """

    name: str
    about: str
    inputs: Mapping[str, int | None]
    outputs: Mapping[str, list[Node]]
    valid: Node | None = None

    @property
    def results(self) -> list[Node]:
        """All outputs, and whether they are valid."""
        valid = [] if self.valid is None else [self.valid]
        return sum(self.outputs.values(), start=valid)

    @property
    def operations(self) -> int:
        """How many operations a call takes at most."""
        return sum(node.op not in ("constant", "leaf") for node in needed(self.results))


def law_functions(own: OwnLaw) -> tuple[LawFunction, ...]:
    """Return what an agent computes: `begin`, `hello`, `difference` and `tick`.

    Raises:
        Unsupported: the agent needs more than them, or its law has no scalar operations; with the
            file and line of a user's code.
    """
    check_information(own.loop)
    if len(own.weights) > 1:
        raise Unsupported("a graph that switches")
    loop, law, memory = own.loop, own.law, memory_size(own.law)
    n, s, k = len(loop.model.state_names), len(own.signal_names), len(own.forward_names)

    def state(x: jax.Array, flat: jax.Array) -> OwnState:
        return OwnState(x, jnp.asarray(own.offset), unflatten(law.init(), flat))

    def gap(x: jax.Array, flat: jax.Array, received: jax.Array) -> tuple[jax.Array]:
        return (gap_of(loop, own.leads, state(x, flat), received),)

    def tick(
        t: jax.Array, x: jax.Array, z: jax.Array, forward: jax.Array, flat: jax.Array
    ) -> tuple[jax.Array, ...]:
        step = step_with(loop, own.leads, t, state(x, flat), z, forward, None)
        action = step.action
        return action.input, _flat(action.memory), step.signal, action.message, step.finite

    begin = _function(
        "begin",
        "the memory of an agent that begins at x",
        lambda x: (_flat(begin_alone(loop, law, x)),),
        ("memory",),
        {"x": n},
    )
    hello = _function(
        "hello",
        "what the agent sends to its neighbours before it acts",
        lambda x, flat: (signal_of(loop, law, state(x, flat)),),
        ("signal",),
        {"x": n, "memory": memory},
    )
    heard = {"x": n, "memory": memory, "received": s}
    difference = _function(
        "difference",
        "the difference of the own signal from a received one, 0 where that is NaN",
        gap,
        ("gap",),
        heard,
    )
    sizes = {"t": None, "x": n, "z": len(difference.outputs["gap"])}
    return (
        begin,
        hello,
        difference,
        _function(
            "tick",
            "a step at t (s), with z, the sum of weights times `difference`, and the feed-forward "
            "that was received, NaN if none was",
            tick,
            ("u", "memory", "signal", "message"),
            {**sizes, "feed_forward": k, "memory": memory},
        ),
    )


def _function(
    name: str,
    about: str,
    compute: Callable[..., PyTree],
    outputs: tuple[str, ...],
    sizes: Mapping[str, int | None],
) -> LawFunction:
    """Return a function whose leaves have the names of its inputs."""
    graph = ScalarGraph()
    leaves = [
        single(graph.leaf(key)) if size is None else leaves_of(graph, key, range(size))
        for key, size in sizes.items()
    ]
    parts = [nodes(graph, part) for part in lower(compute, graph, leaves)]
    named = dict(zip(outputs, parts, strict=False))
    if len(parts) == len(outputs):
        return LawFunction(name, about, sizes, named)
    [valid] = parts[-1]
    for truth in graph.exceptions_of(sum(parts, start=[])):
        valid = graph.make("and", valid, graph.make("not", truth))
    return LawFunction(name, about, sizes, named, valid)


def _flat(tree: PyTree) -> jax.Array:
    """Return the numbers of a tree, one after the other."""
    return jnp.concatenate([jnp.zeros(0), *map(jnp.ravel, jax.tree.leaves(tree))])
