"""What of a trace depends on the step and the agent's number alone, computed ahead by JAX."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

from echelon.core.types import Array
from echelon.simulation.scalars.scalar_graph import ScalarGraph
from echelon.simulation.scalars.traced_entries import array_type


@final
class HostPart:
    """Numbers that depend on keys, the step and the agent alone, of traces of one agent's step.

    What depends on the step alone is left in the traces: it is the same for all agents.

    Attributes:
        size: how many numbers there are of each agent and step.
    """

    def __init__(self) -> None:
        self.size, self._traces = 0, list[ClosedJaxpr]()

    def __getstate__(self) -> dict[str, Any]:
        """Return what is stored on disk: nothing that was traced, which no other process knows."""
        if self._traces:
            raise TypeError("a trace is known in its own process alone")
        return {"size": self.size, "_traces": []}

    def split(
        self, closed: ClosedJaxpr, count: int, step: int, graph: ScalarGraph
    ) -> tuple[Jaxpr, list[np.ndarray]]:
        """Return the rest of a trace, and the leaves of its first arguments, for what was taken.

        Args:
            closed: the trace, of which the host knows the first arguments.
            count: how many these are.
            step: the place of the step among all arguments.
            graph: of the leaves.
        """
        jaxpr = closed.jaxpr
        known, steps = jaxpr.invars[:count], jaxpr.invars[step]
        ahead, equations = _ahead(jaxpr, {*known}, {steps, *jaxpr.constvars})
        rest = [equation for equation in jaxpr.eqns if not ahead.issuperset(_outputs(equation))]
        read = [v for equation in rest for v in equation.invars] + list(jaxpr.outvars)
        taken = list(dict.fromkeys(v for v in read if isinstance(v, Var) and v in ahead))
        if taken:
            part = jaxpr.replace(
                invars=[steps, *known], outvars=taken, eqns=equations, debug_info=None
            )
            self._traces.append(ClosedJaxpr(part, closed.consts))
        entries = [self._leaves(variable, graph) for variable in taken]
        inputs = [*taken, *jaxpr.invars[count:]]
        rest = jaxpr.replace(invars=inputs, eqns=rest)
        return rest, entries

    def _leaves(self, variable: Var, graph: ScalarGraph) -> np.ndarray:
        kind, shape = np.dtype(array_type(variable).dtype), array_type(variable).shape
        first, self.size = self.size, self.size + int(np.prod(shape))
        entries = np.empty(self.size - first, object)
        for k in range(len(entries)):
            leaf = graph.leaf("ahead", first + k)
            if kind.kind in "iu":
                graph.ranges[leaf] = float(np.iinfo(kind).min), float(np.iinfo(kind).max)
            entries[k] = graph.make("ne", leaf, 0.0) if kind.kind == "b" else leaf
        return entries.reshape(shape)

    @cached_property
    def _all(self) -> Any:
        def one(keys: list[jax.Array], step: jax.Array, number: jax.Array) -> jax.Array:
            parts = list[jax.Array]()
            for trace in self._traces:
                steps, numbers = trace.jaxpr.invars[0], trace.jaxpr.invars[-1]
                first = step.astype(array_type(steps).dtype)
                rows = first, *keys, number.astype(array_type(numbers).dtype)
                parts += [jnp.ravel(x).astype(float) for x in jaxpr_as_fun(trace)(*rows)]
            return jnp.concatenate(parts)

        agents = jax.vmap(one, (None, None, 0))
        return jax.jit(jax.vmap(jax.vmap(agents, (0, None, None)), (None, 0, None)))

    def numbers(self, keys: Sequence[Array], steps: Array, agents: Array) -> Array:
        """Return them (T, F, A, size) at steps (T,) of agents (A,) with keys (F, ...) each."""
        return np.asarray(self._all(list(keys), steps, agents))


def _ahead(jaxpr: Jaxpr, known: set[Var], free: set[Var]) -> tuple[set[Var], list[JaxprEqn]]:
    """Return what depends on what is known, and on what is free or plain, alone; and how."""
    free, equations = {*free}, list[JaxprEqn]()
    for equation in jaxpr.eqns:
        read = {v for v in equation.invars if not isinstance(v, Literal)}
        if read <= free or read <= known | free:
            (free if read <= free else known).update(_outputs(equation))
            equations.append(equation)
    return known, equations


def _outputs(equation: JaxprEqn) -> list[Var]:
    return list(equation.outvars)
