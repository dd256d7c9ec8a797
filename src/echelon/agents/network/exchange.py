"""The seam of the network: what an agent learns from the values that its neighbours sent."""

import operator
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp

from echelon.core.types import Array, States

Difference: TypeAlias = Callable[[States, States], States]


class Exchange(eqx.Module):
    """What agents learn from their neighbours: directed copies of the edges, as arrays for JAX.

    The agents' own values and the values that they sent are separate arguments, since on a real
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

    def __call__(self, own: States, sent: States, difference: Difference = operator.sub) -> States:
        """Return z (N, n), z_i = sum_j A_ij (own_i - sent_j).

        Args:
            own: (N, n) states of the agents.
            sent: (N, n) what was sent of each.
            difference: of states (K, n) and (K, n), where it is another: of angles, which wind.
        """
        weights = jnp.asarray(self.weights, own.dtype)[:, None]
        # Differences before sums: at consensus they vanish exactly, while sums of positions would
        # leave rounding.
        differences = weights * difference(own[self.receivers], sent[self.senders])
        return jax.ops.segment_sum(differences, self.receivers, num_segments=len(own))
