"""The seam of the network: what an agent learns from the values that its neighbours sent."""

import operator
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from echelon.core.types import Array, States

Difference: TypeAlias = Callable[[States, States], States]


class Exchange(eqx.Module):
    """What agents learn from their neighbours: directed copies of the edges, as arrays for JAX.

    The agents' own values and the values that they received are separate arguments, since on a real
    network the second may be old or lost.

    Attributes:
        receivers, senders: (K,) who hears whom.
        weights: (K,); of a graph that switches (S, K), a row for each stretch of time.
    """

    receivers: Array
    senders: Array
    weights: Array | jax.Array

    def during(self, row: jax.Array | int) -> "Exchange":
        """Return the computation during one of the stretches."""
        return Exchange(self.receivers, self.senders, jnp.asarray(self.weights)[row])

    def along_edges(self, values: Float[jax.Array, "N s"]) -> Float[jax.Array, "K s"]:
        """Return what is sent along each edge, of values (N, s) that all agents send."""
        return values[self.senders]

    def __call__(
        self,
        own: Float[jax.Array, "N s"],
        received: Float[jax.Array, "K s"],
        difference: Difference = operator.sub,
    ) -> Float[jax.Array, "N s"]:
        """Return z (N, s), z_i = sum_j A_ij (own_i - received_ij).

        Args:
            own: (N, s) values of the agents.
            received: (K, s) what was received along each edge.
            difference: of values (K, s) and (K, s); another one for angles, which wind.
        """
        weights = jnp.asarray(self.weights, own.dtype)[:, None]
        # Differences before sums: at consensus they vanish exactly, while sums of positions would
        # leave rounding.
        differences = weights * difference(own[self.receivers], received)
        return jax.ops.segment_sum(differences, self.receivers, num_segments=len(own))
