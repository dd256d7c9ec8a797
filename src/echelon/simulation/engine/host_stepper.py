"""Steps agents whose inputs are computed on the host every few steps and held between."""

from collections.abc import Callable, Sequence
from typing import TypeAlias, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import SimulationError
from echelon.core.types import Array, Input
from echelon.laws.law import Law, LocalView
from echelon.simulation.step.drive import Chunk, Problem, Stepper, Stopped
from echelon.simulation.step.loop import Moment, assemble
from echelon.simulation.step.meter import Sums, on_host
from echelon.simulation.step.sequence import advance, begin
from echelon.simulation.step.solver_stats import SolverStats

Pilot: TypeAlias = Callable[[int, Array], Array]
"""(step, states (N, n)) -> desired physical inputs (N, m) from that step on."""

_PLANS = 64
"""Plans of one agent per chunk; a solver takes about 20 ms for each."""


@final
class HeldInput(Law):
    """u = the input (m,) in the agent's memory, which the pilot writes.

    Args:
        size: m.
    """

    size: int = eqx.field(static=True)

    def init(self) -> Input:
        """Return no input, before the pilot gives one."""
        return jnp.zeros(self.size)

    def update(self, model: ControlAffine, view: LocalView, memory: Input) -> tuple[Input, Input]:
        """Return the input in the memory."""
        return memory, memory


@final
class HostStepper(Stepper):
    """The closed loop under the inputs of a pilot, which gives them every `hold` steps.

    Args:
        problem: the agents and how they move.
        pilot: gives the inputs.
        hold: steps for which they are held.
        work: returns what solving took so far.
    """

    def __init__(
        self,
        problem: Problem,
        pilot: Pilot,
        hold: int,
        work: Callable[[], SolverStats],
    ) -> None:
        """Assemble the loop."""
        law = HeldInput(len(problem.model.input_names))
        self.loop, self.states = assemble(problem, law, law), problem.states
        self.pilot, self.hold, self._work = pilot, hold, work
        self._queried = -1

    @property
    def work(self) -> SolverStats:
        """The work of the solvers so far."""
        return self._work()

    @property
    def repeats(self) -> bool:
        """Whether steps can be taken again: no, since a pilot's plans are not part of a moment."""
        return False

    @property
    def longest(self) -> int:
        """Steps in which a few dozen plans are made."""
        return self.hold * max(1, _PLANS // len(self.states))

    def recall(self, leaves: Sequence[Array]) -> Moment:
        """Raise an error, since the plans of a pilot are not part of a moment.

        Raises:
            SimulationError: always.
        """
        raise SimulationError(
            "a run with planned inputs cannot be continued from stored data; start it again."
        )

    def start(self) -> Moment:
        """Return the moment at which the run begins, before the pilot gives any input."""
        self._queried = -1
        return begin(self.loop, self.states)

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps, until a pilot stops or a state is not finite."""
        chunk = _HeldChunk(now, self.loop.meter.zero_sums(), reference)
        try:
            for count in counts:
                self._frame(chunk, int(count))
                if not np.isfinite(chunk.states[-1]).all():
                    break
        except Stopped as reason:
            return chunk.close(f"The run was stopped, since {reason}")
        except KeyboardInterrupt:
            return chunk.close("The run was interrupted")
        return chunk.close(None)

    def _frame(self, chunk: "_HeldChunk", count: int) -> None:
        """Store a frame and take `count` steps; query the pilot wherever a hold begins."""
        end = chunk.step + count
        try:
            # The last frame has no steps after it, and needs no plan.
            if count:
                self._query_pilot(chunk)
        finally:
            # If the pilot stops the run here, the frame has the inputs that led to it.
            if chunk.step or self._queried == 0:
                self._take(chunk, 0, store=True)
        while chunk.step < end:
            self._query_pilot(chunk)
            # Up to the next frame or the next plan, whichever is first.
            self._take(chunk, min(end, (chunk.step // self.hold + 1) * self.hold) - chunk.step)
            if not np.isfinite(np.asarray(chunk.now.states)).all():
                return

    def _query_pilot(self, chunk: "_HeldChunk") -> None:
        """Put the pilot's inputs into the agents' memories where a hold begins, once."""
        if chunk.step % self.hold or chunk.step == self._queried:
            return
        # Solvers work in float64, and so are the states that they start from.
        states = chunk.now.states
        start = np.asarray(states, np.float64)
        if not np.isfinite(start).all():
            # Solvers fail on such states, which must not count as their failures.
            return
        desired = jnp.asarray(self.pilot(chunk.step, start))
        desired = desired.astype(states.dtype)
        self._queried = chunk.step
        chunk.now = chunk.now._replace(
            leader_memory=desired[self.loop.leaders], follower_memory=desired[self.loop.followers]
        )

    def _take(self, chunk: "_HeldChunk", count: int, store: bool = False) -> None:
        """Take steps, or store a frame."""
        # As an array, so that another count does not compile again.
        counts = np.array([count], np.int32)
        chunk.now, frames, sums = advance(
            self.loop, chunk.now, counts, chunk.reference, chunk.first
        )
        chunk.step += count
        chunk.sums = chunk.sums.plus(sums)
        if store:
            for stored, frame in zip((chunk.states, chunk.inputs), frames[:2], strict=True):
                stored.append(np.asarray(frame[0], np.float64))


@final
class _HeldChunk:
    """The frames and sums of a chunk while it is computed."""

    def __init__(self, now: Moment, sums: Sums, reference: Array | None) -> None:
        self.now, self.step, self.first = now, int(now.step), now.step
        self.sums, self.reference = sums, reference
        self.states: list[Array] = []
        self.inputs: list[Array] = []

    def close(self, stopped: str | None) -> Chunk:
        """Return what was computed, and why it ended early."""
        shapes = self.now.states.shape, self.now.cut.shape
        states, inputs = (
            np.array(rows).reshape(len(rows), *shape)
            for rows, shape in zip((self.states, self.inputs), shapes, strict=True)
        )
        return Chunk(self.now, states, inputs, on_host(self.sums).split(1), stopped)
