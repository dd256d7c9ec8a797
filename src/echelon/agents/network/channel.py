"""What a real network does to messages: the seam for delays and losses; an ideal one has none."""

import abc
from typing import Any

import equinox as eqx
import jax
from jaxtyping import Float


class Channel(eqx.Module):
    """Carries messages along the edges, from step to step.

    It knows neither models nor laws. Its state holds the messages that are in flight, as arrays
    that keep their shapes, so that a run can be stored and resumed between any two steps.
    """

    @abc.abstractmethod
    def begin(self, sent: Float[jax.Array, "K s"]) -> Any:
        """Return what is in flight when a run begins, of what is sent along each edge."""

    @abc.abstractmethod
    def carry(
        self, in_flight: Any, sent: Float[jax.Array, "K s"], step: jax.Array
    ) -> tuple[Float[jax.Array, "K s"], Any]:
        """Return what is received along each edge in a step, and what is in flight after it."""
