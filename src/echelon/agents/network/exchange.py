"""The exchange between neighbours, and what an agent knows of others that may come near it."""

import operator
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from echelon.core.types import Array, States

Difference: TypeAlias = Callable[[States, States], States]


class Exchange(eqx.Module):
    """The disagreement of agents with their neighbours: directed edges as arrays for JAX.

    The agents' own values and the values that they received are separate arguments, since on a real
    network the second may be old or lost.

    Attributes:
        receivers, senders: (K,) the ends of each directed edge.
        weights: (K,); of a graph that switches (S, K), a row for each stretch of time.
    """

    receivers: Array | jax.Array
    senders: Array | jax.Array
    weights: Array | jax.Array

    def during(self, row: jax.Array | int) -> "Exchange":
        """Return the computation during one of the stretches."""
        return Exchange(self.receivers, self.senders, jnp.asarray(self.weights)[row])

    def along_edges(self, values: Float[jax.Array, "N s"]) -> Float[jax.Array, "K s"]:
        """Return the value sent along each edge, of values (N, s) that all agents send."""
        return values[self.senders]

    def __call__(
        self,
        values: Float[jax.Array, "N s"],
        received: Float[jax.Array, "K s"],
        difference: Difference = operator.sub,
    ) -> Float[jax.Array, "N s"]:
        """Return z (N, s), z_i = sum_j A_ij (values_i - received_ij).

        Args:
            values: (N, s) values of the agents.
            received: (K, s) values that were received along each edge.
            difference: of values (K, s) and (K, s), which for angles is not plain subtraction.
        """
        weights = jnp.asarray(self.weights, values.dtype)[:, None]
        # Differences before sums: at consensus they vanish exactly, while sums of positions would
        # leave rounding.
        differences = weights * difference(values[self.receivers], received)
        return jax.ops.segment_sum(differences, self.receivers, num_segments=len(values))

    def least(self, values: jax.Array, agents: int) -> jax.Array:
        """Return the least of the values (K,) that each of the agents receives."""
        return jax.ops.segment_min(values, jnp.asarray(self.receivers), agents)

    def most(self, values: jax.Array, agents: int) -> jax.Array:
        """Return the largest of the values (K,) that each of the agents receives."""
        return jax.ops.segment_max(values, jnp.asarray(self.receivers), agents)

    def mean(
        self,
        values: Float[jax.Array, "N s"],
        received: Float[jax.Array, "K s"],
        used: Bool[jax.Array, " K"],
        alone: Float[jax.Array, "N s"],
        difference: Difference = operator.sub,
    ) -> Float[jax.Array, "N s"]:
        """Return the mean differences (N, s) along used links (K,); `alone` (N, s) without any."""
        weights, total = self._of_used(used, len(values), values.dtype)
        total = total[:, None]
        z = Exchange(self.receivers, self.senders, weights)(values, received, difference)
        return jnp.where(total > 0.0, z / jnp.where(total > 0.0, total, 1.0), alone)

    def shares(
        self, used: Bool[jax.Array, " K"], agents: int
    ) -> tuple[Float[jax.Array, " K"], Bool[jax.Array, " N"]]:
        """Return the weights (K,) of links in that mean, and which agents (N,) use no link."""
        weights, total = self._of_used(used, agents, float)
        alone = total <= 0.0
        return weights / jnp.where(alone, 1.0, total)[jnp.asarray(self.receivers)], alone

    def _of_used(
        self, used: Bool[jax.Array, " K"], agents: int, dtype: jax.typing.DTypeLike
    ) -> tuple[Float[jax.Array, " K"], Float[jax.Array, " N"]]:
        """Return the weights (K,) of used links, 0 of others, and their sums (N,)."""
        weights = jnp.where(used, jnp.asarray(self.weights, dtype), 0.0)
        return weights, jax.ops.segment_sum(weights, self.receivers, num_segments=agents)


class Near(NamedTuple):
    """K others as one agent knows them: of each the r points in whose hull its position stays.

    Attributes:
        gaps: own points less theirs, in d coordinates, m.
        leads: which of them lead, and do not give way.
        known: which of them are known; the gaps of the others mean nothing.
    """

    gaps: Float[jax.Array, "K r d"]
    leads: Bool[jax.Array, " K"]
    known: Bool[jax.Array, " K"]
