"""What is kept of a run while it goes on, and how it ended."""

from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.types import Array
from echelon.simulation.engine.grid import ChunkGrid
from echelon.simulation.step.drive import Chunk, Problem, numbers
from echelon.simulation.step.meter import ALWAYS, Meter, Sums, outside

_VERBS = {Outcome.INTERRUPTED: "interrupted", Outcome.STOPPED: "ended from outside"}


class Stretch(NamedTuple):
    """A part of a run, all in NumPy; the last one is all that going on from there needs.

    Attributes:
        first: the step at which it begins.
        done: the step at which it ends.
        times: (T,) s, of the stored frames in it.
        states: (T, N, n) of these.
        inputs: (T, N, m) delivered from each of them on.
        reference: (T, n) what the leaders follow at each; None where they follow nothing.
        sums: over all steps of the run up to its end.
        moment: the numbers of the moment at its end.
        stopped: why no further step can be taken, in words; None where one can.
        seconds: of computing, since the run began.
    """

    first: int
    done: int
    times: Array
    states: Array
    inputs: Array
    reference: Array | None
    sums: Sums
    moment: tuple[Array, ...]
    stopped: str | None
    seconds: float

    @property
    def finite(self) -> bool:
        """Whether every number of its frames is."""
        return bool(np.isfinite(self.states).all() and np.isfinite(self.inputs).all())


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
        seconds: of computing.
    """

    times: Array
    states: Array
    inputs: Array
    reference: Array | None
    sums: Sums
    outcome: Outcome
    message: str
    seconds: float


@final
class Recorder:
    """Collects the stretches of a run, after those that were computed before."""

    def __init__(
        self, problem: Problem, grid: ChunkGrid, nothing: Sums, before: Sequence[Stretch] = ()
    ) -> None:
        """Begin; `nothing` are the sums of no step."""
        self.problem, self.grid, self.stretches = problem, grid, list(before)
        self.sums = before[-1].sums if before else nothing
        self.frames = sum(len(each.times) for each in before)

    @property
    def done(self) -> int:
        """How many steps were taken."""
        return self.stretches[-1].done if self.stretches else 0

    @property
    def complete(self) -> bool:
        """Whether every frame is there."""
        return self.frames == self.grid.frames

    @property
    def ended(self) -> bool:
        """Whether no further step is to be taken."""
        last = self.stretches[-1] if self.stretches else None
        return self.complete or not (last is None or last.stopped is None and last.finite)

    def keep(self, chunk: Chunk, reference: Array | None, seconds: float) -> Stretch:
        """Keep and return the stretch of a chunk that followed a reference (S, n) step by step."""
        first, counts = self.done, self.grid.counts(self.done)
        # One that stopped has fewer points.
        points = (first + np.cumsum(counts) - counts)[: len(chunk.states)]
        # One that is not finite is kept wherever it stands: it says when the run was lost.
        stored = self.grid.stored(points) | ~_finite(chunk.states, chunk.inputs).all(axis=1)
        self.sums = self.sums.plus(chunk.sums)
        self.frames += int(stored.sum())
        if self.stretches:
            # Only the last one's are ever asked for, and many would fill the memory.
            self.stretches[-1] = self.stretches[-1]._replace(moment=(), sums=self.sums)
        self.stretches.append(
            Stretch(
                first,
                first + int(chunk.sums.steps[0]),
                self.problem.settings.dt * points[stored],
                chunk.states[stored],
                chunk.inputs[stored],
                None if reference is None else reference[points - first][stored],
                self.sums,
                numbers(chunk.now),
                chunk.stopped,
                seconds,
            )
        )
        return self.stretches[-1]

    def stop(self, reason: str) -> None:
        """Note why the run goes no further."""
        self.stretches[-1] = self.stretches[-1]._replace(stopped=reason)

    def close(self, unfinished: Outcome) -> Record:
        """Return the record, cut at the first frame that is not finite.

        `unfinished` is how a run ended that neither reached its horizon nor was lost.
        """
        whole = join(self.stretches) or self._nothing()
        lost = np.zeros((0, 2), int)
        if not whole.finite:
            lost = np.argwhere(~_finite(whole.states, whole.inputs))
        # In the order of frames, then agents: the first row is the first to be lost.
        cut = slice(int(lost[0, 0]) if len(lost) else None)
        return Record(
            whole.times[cut],
            whole.states[cut],
            whole.inputs[cut],
            None if whole.reference is None else whole.reference[cut],
            self.sums,
            *self._verdict(whole, lost, unfinished),
            whole.seconds,
        )

    def _nothing(self) -> Stretch:
        """Return a stretch without a frame, its arrays of the right shape all the same."""
        agents, m = self.problem.graph.agents, len(self.problem.model.input_names)
        states, inputs = np.zeros((0, *self.problem.states.shape)), np.zeros((0, agents, m))
        return Stretch(0, 0, np.zeros(0), states, inputs, None, self.sums, (), None, 0.0)

    def _completed(self, whole: Stretch) -> tuple[Outcome, str]:
        """Return how a run ended that reached its horizon: whether all stayed in their chart."""
        last, meter = whole.states[-1], self.problem.meter
        inside = inside_at_last(meter, self.sums.inside, last, self.grid.steps)
        if not inside.size or inside.min() >= ALWAYS:
            return Outcome.COMPLETED, Outcome.COMPLETED.value
        model = self.problem.model
        agent, k = divmod(int(inside.argmin()), inside.shape[1])
        name = [*model.chart][k]
        unit = model.state_units[model.state_names.index(name)]
        low, high = (f"{bound:.4g}" for bound in model.chart[name])
        return Outcome.LEFT_CHART, (
            f"{self._role(agent)} {agent} left the chart of its equations at "
            f"t = {inside.min() * self.problem.settings.dt:.6g} s: `{name}` is not between {low} "
            f"and {high} {unit}".rstrip()
            + ", and what follows is not the agent's motion."
        )

    def _role(self, agent: int) -> str:
        return "Leader" if agent in self.problem.graph.leaders else "Follower"

    def _verdict(self, whole: Stretch, lost: Array, unfinished: Outcome) -> tuple[Outcome, str]:
        """Return how the run ended; `lost` are the frames and agents that are not finite."""
        if len(lost):
            frame, agent = lost[0]
            role, when = self._role(agent).lower(), f"by t = {whole.times[frame]:.6g} s"
            return Outcome.DIVERGED, f"The state of {role} {agent} stopped being finite {when}."
        if whole.stopped is None and self.complete:
            return self._completed(whole)
        reached = float(whole.times[-1]) if len(whole.times) else 0.0
        # One that stopped did so between two frames; the steps themselves were counted.
        if whole.stopped:
            reached = whole.done * self.problem.settings.dt
        said = whole.stopped or f"The run was {_VERBS[unfinished]}"
        return unfinished, f"{said} at t = {reached:.6g} s; what was computed is kept."


def completed(whole: Stretch) -> Record:
    """Return the record of a run that reached its horizon, finite and in its chart."""
    ended = Outcome.COMPLETED, Outcome.COMPLETED.value
    frames = whole.times, whole.states, whole.inputs, whole.reference
    return Record(*frames, whole.sums, *ended, whole.seconds)


def inside_at_last(meter: Meter, inside: Array, last: Array, steps: int) -> Array:
    """Return `Sums.inside` (..., N, k) with the moment of the last step's end, which begins none.

    Args:
        meter: of the run.
        inside: as it was counted at the beginning of each step.
        last: the states (..., N, n) at the end.
        steps: of the run.
    """
    beyond = outside(last[..., meter.charted], *meter.chart.T)
    return np.minimum(inside, np.where(beyond, steps, ALWAYS))


def join(stretches: Sequence[Stretch]) -> Stretch | None:
    """Return stretches that follow each other as one; None where there is none."""
    if len(stretches) < 2:
        return stretches[0] if stretches else None
    times, states, inputs = (
        np.concatenate([getattr(each, name) for each in stretches])
        for name in ("times", "states", "inputs")
    )
    followed = [each.reference for each in stretches if each.reference is not None]
    reference = np.concatenate(followed) if followed else None
    return stretches[-1]._replace(
        first=stretches[0].first, times=times, states=states, inputs=inputs, reference=reference
    )


def _finite(states: Array, inputs: Array) -> Array:
    """Return which agents are finite in which frames, (T, N)."""
    return np.logical_and(np.isfinite(states).all(axis=2), np.isfinite(inputs).all(axis=2))
