"""Where the numbers of an agent are not what JAX computes, so that JAX repeats the chunk."""

import functools
from collections.abc import Iterator

from echelon.simulation.codegen import Body
from echelon.simulation.scalars import Node, ScalarGraph, Unsupported, may_be_exception, needed

_SIZES = (1e9, 1e6, 1e3)
"""Sizes of what neighbours read, of which the first is taken for which a difference is right."""


def exceptions_of(graph: ScalarGraph, body: Body) -> list[Node]:
    """Return where the numbers of an agent are not what JAX computes.

    Raises:
        Unsupported: nothing is known of the angles in a difference.
    """
    truths, false = graph.exceptions_of(body.results()), graph.constant(False)
    truths += _between(graph, body)
    uniform = [truth for truth in truths if truth.uniform]
    truths = [truth for truth in truths if not truth.uniform]
    # One truth of a step for all agents.
    return [*truths, functools.reduce(functools.partial(graph.make, "or"), uniform, false)]


def _between(graph: ScalarGraph, body: Body) -> Iterator[Node]:
    """Yield where what neighbours read of an agent is too large for the differences of two."""
    inside = [node for node in needed(body.difference) if node in graph.exceptions]
    if not inside:
        return
    for size in _SIZES:
        if not any(may_be_exception(graph, node, size) for node in inside):
            break
    else:
        raise Unsupported("a `difference` with angles of which no bound is known")
    for mine in body.mirror_before:
        yield graph.make("lt", size, graph.make("abs", mine))
