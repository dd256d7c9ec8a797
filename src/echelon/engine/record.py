"""What is kept of a run while it goes on, and how it ended."""

from typing import NamedTuple, final

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.types import Array
from echelon.engine.drive import Chunk, Problem
from echelon.engine.settings import Settings
from echelon.engine.sums import Sums

_INTERRUPTED = "The run was interrupted"


def frame_counts(settings: Settings) -> Array:
    """Return the number of steps after each stored frame; zero after the last."""
    whole, rest = divmod(settings.steps, settings.store_every)
    return np.array([settings.store_every] * whole + [rest] * (rest > 0) + [0], dtype=np.int32)


class Record(NamedTuple):
    """The stored frames that are finite, the sums over the steps, and how the run ended.

    Attributes:
        times: (T,) s.
        states: (T, N, n).
        inputs: (T, N, m).
        reference: (T, n) what the leaders follow; None where they follow nothing.
        sums: over all steps.
        outcome: how it ended.
        message: the same with time and agent.
    """

    times: Array
    states: Array
    inputs: Array
    reference: Array | None
    sums: Sums
    outcome: Outcome
    message: str


@final
class Recorder:
    """Collects the chunks of a run."""

    def __init__(self, problem: Problem) -> None:
        """Begin with nothing."""
        self.problem = problem
        self.chunks: list[Chunk] = []
        self.followed: list[Array] = []

    def keep(self, chunk: Chunk, counts: Array, reference: Array | None) -> bool:
        """Keep a chunk and what was followed at its frames; tell whether the run can go on.

        `counts` are the steps after each of its frames, `reference` (S, n) is for each step.
        """
        self.chunks.append(chunk)
        if reference is not None:
            # The row of a frame is the number of steps before it; a stopped chunk has fewer.
            self.followed.append(reference[np.cumsum(counts) - counts][: len(chunk.states)])
        finite = np.isfinite(chunk.states).all() and np.isfinite(chunk.inputs).all()
        return chunk.stopped is None and bool(finite)

    def close(self, nothing: Sums) -> Record:
        """Return the record, cut at the first frame that is not finite.

        `nothing` are the sums of no step.
        """
        settings, m = self.problem.settings, len(self.problem.model.input_names)
        counts, agents = frame_counts(settings), self.problem.graph.agents
        # So that a run without a frame has arrays of the right shape all the same.
        none = np.zeros((0, *self.problem.states.shape)), np.zeros((0, agents, m))
        states = np.concatenate([none[0], *(c.states for c in self.chunks)])[: len(counts)]
        inputs = np.concatenate([none[1], *(c.inputs for c in self.chunks)])[: len(counts)]
        times = settings.dt * np.concatenate([[0], np.cumsum(counts[:-1])])[: len(states)]
        sums = nothing
        for chunk in self.chunks:
            sums = sums.plus(chunk.sums)
        # In the order of frames, then agents: the first row is the first to be lost.
        lost = np.argwhere(~(np.isfinite(states).all(axis=2) & np.isfinite(inputs).all(axis=2)))
        cut = int(lost[0, 0]) if len(lost) else len(times)
        reached = float(times[-1]) if len(times) else 0.0
        # One that stopped did so between two frames; the steps themselves were counted.
        if self.chunks and self.chunks[-1].stopped:
            reached = float(sums.steps[0]) * settings.dt
        complete = len(states) == len(counts)
        outcome, message = self._verdict(times, lost, complete, reached)
        followed = np.concatenate(self.followed)[:cut] if self.followed else None
        return Record(times[:cut], states[:cut], inputs[:cut], followed, sums, outcome, message)

    def _verdict(
        self, times: Array, lost: Array, complete: bool, reached: float
    ) -> tuple[Outcome, str]:
        """Return how the run ended; `lost` are the frames and agents that are not finite."""
        if len(lost):
            frame, agent = lost[0]
            role = "leader" if agent in self.problem.graph.leaders else "follower"
            return (
                Outcome.DIVERGED,
                f"The state of {role} {agent} stopped being finite by t = {times[frame]:.6g} s.",
            )
        stopped = self.chunks[-1].stopped if self.chunks else None
        if complete and stopped is None:
            return Outcome.COMPLETED, Outcome.COMPLETED.value
        return (
            Outcome.INTERRUPTED,
            f"{stopped or _INTERRUPTED} at t = {reached:.6g} s; what was computed is kept.",
        )
