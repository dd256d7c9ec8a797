"""Which states are flat outputs of an agent, and which of them move nothing else (T5)."""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import numpy as np

from echelon.agents.models.chains import Chains, flat_output, flatten
from echelon.agents.models.model import ControlAffine
from echelon.core.cache import memoize
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, lower, nodes


class FlatStates(NamedTuple):
    """States by name, as traces of the equations show them; what has no trace is left out.

    Attributes:
        outputs: states that are flat outputs themselves, in the same unit.
        free: those of them on which no derivative of an output depends, nor another output: agents
            that differ in these alone have all other states in common.
    """

    outputs: tuple[str, ...]
    free: tuple[str, ...]


@memoize
def flat_states_of(model: ControlAffine, chains: Chains) -> FlatStates:
    """Return which states of a model are flat outputs."""
    graph, n = ScalarGraph(), len(model.state_names)
    leaves = [graph.leaf("row", place) for place in range(n + chains.size)]
    x, e = (np.array(part, object) for part in (leaves[:n], leaves[n:]))

    def above(x: jax.Array, e: jax.Array) -> jax.Array:
        return flatten(model, chains, x, e).values[1:]

    try:
        [found] = lower(lambda x: flat_output(model, chains.outputs, x), graph, [x])
        place = nodes(graph, found)
    except Unsupported:
        return FlatStates((), ())
    pairs = zip(chains.outputs, place, strict=True)
    same = tuple(
        name
        for name, node in pairs
        if name in model.state_names and node is leaves[model.state_names.index(name)]
    )
    try:
        [higher] = lower(above, graph, [x, e])
    except Unsupported:
        return FlatStates(same, ())
    others = [node for name, node in zip(chains.outputs, place, strict=True) if name not in same]
    used = _leaves_of([*nodes(graph, higher), *others])
    free = (name for name in same if leaves[model.state_names.index(name)].number not in used)
    return FlatStates(same, tuple(free))


def _leaves_of(results: Iterable[Node]) -> set[int]:
    """Return the numbers of the nodes that results depend on, but for products with 0."""
    reached, todo = set[int](), list(results)
    while todo:
        node = todo.pop()
        zero = node.op == "mul" and any(a.op == "constant" and a.value == 0.0 for a in node.args)
        if node.number not in reached and not zero:
            reached.add(node.number)
            todo += node.args
    return reached
