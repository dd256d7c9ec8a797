"""The closed loop stepped by JAX: what a law and a model mean, on whatever device there is."""

from functools import partial
from typing import final

import jax.numpy as jnp

from echelon.core.types import Array
from echelon.engine.devices import advance_parted, mesh_of
from echelon.engine.drive import Chunk, Stepper
from echelon.engine.loop import Loop, Moment, advance, begin
from echelon.engine.sums import on_host

_AGENT_STEPS, _FEWEST = 100_000, 4
"""Steps of one agent each in a chunk, and the fewest of all agents.

A quadrotor's take 1.4 to 7 us, and a model may take longer. A chunk computes the inputs at each of
its frames once more, so that one of a single step would take twice the time.
"""


@final
class JaxStepper(Stepper):
    """Moves agents under laws.

    Args:
        loop: of the run.
        states: (N, n) at its beginning.
        instead: why it stands where native code was wanted; empty where it was not.
        devices: among how many the agents are parted.

    Raises:
        SimulationError: so many are not there, or the agents are no multiple of them.
    """

    def __init__(self, loop: Loop, states: Array, instead: str = "", devices: int = 1) -> None:
        """Keep what the steps need."""
        self.loop, self.states, self.instead = loop, states, instead
        self.mesh = mesh_of(devices, len(states)) if devices > 1 else None

    @property
    def devices(self) -> int:
        """Among how many devices the agents are parted."""
        return 1 if self.mesh is None else self.mesh.size

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the run takes longer than it might."""
        return (f"JAX steps the agents, since {self.instead}.",) * bool(self.instead)

    @property
    def longest(self) -> int:
        """Steps that take some tenths of a second, or a few of very many agents."""
        return max(_FEWEST, _AGENT_STEPS // len(self.states))

    def start(self) -> Moment:
        """Return the moment at which the run begins."""
        return begin(self.loop, jnp.asarray(self.states))

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; what happens on the way is seen afterwards."""
        step = advance if self.mesh is None else partial(advance_parted, self.mesh)
        now, (states, inputs), sums = step(self.loop, now, jnp.asarray(counts), reference)
        return Chunk(now, *on_host((states, inputs, sums)))
