"""Records a run while it is computed: frames, sums, and its outcome."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float

from echelon.core.errors import Outcome
from echelon.core.types import Array
from echelon.simulation.engine.chunk_grid import ChunkGrid, finite_formations
from echelon.simulation.step.drive import Chunk, Problem, numbers
from echelon.simulation.step.meter import ALWAYS, RunStatistics, Sums, on_host, outside

_BY_FRAME = ("times", "states", "inputs", "reference")
"""What a stretch has of each frame."""
_VERBS = {Outcome.INTERRUPTED: "interrupted", Outcome.STOPPED: "ended from outside"}


class Segment(NamedTuple):
    """A part of a run in NumPy; a run can be continued from its last stretch alone.

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
        """Whether every number of its frames is finite."""
        return bool(np.isfinite(self.states).all() and np.isfinite(self.inputs).all())

    def rows(self, rows: Array | slice) -> "Segment":
        """Return some of its frames."""
        names = [name for name in _BY_FRAME if getattr(self, name) is not None]
        return self._replace(**{name: getattr(self, name)[rows] for name in names})

    def record(self, outcome: Outcome, message: str) -> "Record":
        """Return the stretch as the record of a run with this outcome."""
        frames = self.times, self.states, self.inputs, self.reference
        return Record(*frames, self.sums, outcome, message, self.seconds)


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
    """Collects the stretches of a run, or of many formations that are stepped together.

    Args:
        problems: of each formation; they differ in numbers alone.
        grid: how the run is cut into chunks.
        before: the stretches of one formation that were computed before.
    """

    def __init__(
        self, problems: Sequence[Problem], grid: ChunkGrid, before: Sequence[Segment] = ()
    ) -> None:
        """Begin after the stretches of an earlier session, if any."""
        self.problems, self.grid, self.segments = problems, grid, list(before)
        nothing = on_host(problems[0].meter.zero_sums(np))
        sums = [segment.sums for segment in before[-1:]] or [nothing] * len(problems)
        self.sums = Sums(*map(np.stack, zip(*sums, strict=True)))
        self.frames = sum(len(segment.times) for segment in before)
        self._finite = np.full(len(problems), all(segment.finite for segment in before))

    @property
    def done(self) -> int:
        """The number of steps so far."""
        return self.segments[-1].done if self.segments else 0

    @property
    def complete(self) -> bool:
        """Whether all frames are recorded."""
        return self.frames == self.grid.frames

    @property
    def ended(self) -> bool:
        """Whether no further step is to be taken."""
        stopped = bool(self.segments) and self.segments[-1].stopped is not None
        return self.complete or stopped or not self._finite.any()

    def keep(self, chunk: Chunk, counts: Array, reference: Array | None, seconds: float) -> None:
        """Keep the stretch of a chunk with steps after its points, along a reference (S, n)."""
        first = self.done
        # One that stopped has fewer points.
        points = (first + np.cumsum(counts) - counts)[: len(chunk.states)]
        frames = self.grid.stored(points)
        finite = finite_formations(chunk, len(self.problems))
        # The point where a formation diverges is kept, also between frames: it gives the time.
        stored = frames | (~finite & self._finite).any(axis=1)
        sums = self.sums.plus(chunk.sums)
        # A formation that diverged keeps the sums up to then.
        self.sums = sums if self._finite.all() else sums.where(self._finite, self.sums)
        self._finite &= finite.all(axis=0)
        self.frames += int(frames.sum())
        alone = len(self.problems) == 1
        rows = None if reference is None else reference[points[stored] - first]
        if self.segments:
            # Only the last one's are read, and those of all stretches would fill the memory.
            self.segments[-1] = self.segments[-1]._replace(moment=(), sums=self.sums)
        self.segments.append(
            Segment(
                first,
                first + int(chunk.sums.steps[0, 0]),
                self.problems[0].settings.dt * points[stored],
                chunk.states[stored],
                chunk.inputs[stored],
                rows,
                self.sums.of(0) if alone else self.sums,
                numbers(chunk.now) if alone else (),
                chunk.stopped,
                seconds,
            )
        )

    def stop(self, reason: str) -> None:
        """Store the reason why the run stops."""
        self.segments[-1] = self.segments[-1]._replace(stopped=reason)

    def close(self, unfinished: Outcome) -> Iterator[Record]:
        """Yield the record of each formation, cut at its first frame that is not finite.

        `unfinished` is the outcome of a run that neither reached its horizon nor diverged.
        """
        whole = join(self.segments) or self._nothing()
        states, inputs = (
            np.ascontiguousarray(self._by_formation(part).swapaxes(0, 1))
            for part in (whole.states, whole.inputs)
        )
        inside = self._inside(whole, states)
        steps = np.rint(whole.times / self.problems[0].settings.dt).astype(int)
        # There are points besides frames if a formation diverged between two frames.
        frames = self.grid.stored(steps)
        for k, problem in enumerate(self.problems):
            mine = whole._replace(states=states[k], inputs=inputs[k], sums=self.sums.of(k))
            rows = frames if self._finite[k] else frames | ~_finite(mine).all(axis=1)
            mine = mine if rows.all() else mine.rows(rows)
            if inside[k]:
                yield mine.record(Outcome.COMPLETED, Outcome.COMPLETED.value)
            else:
                yield self._closed(problem, mine, unfinished)

    def _by_formation(self, rows: Float[np.ndarray, "T FN k"]) -> Float[np.ndarray, "T F N k"]:
        count = len(self.problems)
        return rows.reshape(len(rows), count, rows.shape[1] // count, rows.shape[2])

    def _inside(
        self, whole: Segment, states: Float[np.ndarray, "F T N n"]
    ) -> Bool[np.ndarray, " F"]:
        """Return which formations reached the horizon, finite and in their chart."""
        if not self.complete or whole.stopped is not None:
            return np.zeros(len(self.problems), bool)
        meter, steps = self.problems[0].meter, self.grid.steps
        inside = inside_at_last(meter, self.sums.inside, states[:, -1], steps)
        return self._finite & (inside >= ALWAYS).all(axis=(1, 2))

    def _nothing(self) -> Segment:
        states = np.concatenate([problem.states for problem in self.problems])
        m = len(self.problems[0].model.input_names)
        empty = np.zeros((0, *states.shape)), np.zeros((0, len(states), m))
        return Segment(0, 0, np.zeros(0), *empty, None, self.sums, (), None, 0.0)

    def _closed(self, problem: Problem, whole: Segment, unfinished: Outcome) -> Record:
        # In the order of frames, then agents: the first row is the first to be lost.
        lost = np.argwhere(~_finite(whole))
        outcome, message = self._verdict(problem, whole, lost, unfinished)
        rows = slice(int(lost[0, 0]) if len(lost) else None)
        return whole.rows(rows).record(outcome, message)

    def _verdict(
        self, problem: Problem, whole: Segment, lost: Array, unfinished: Outcome
    ) -> tuple[Outcome, str]:
        if len(lost):
            frame, agent = lost[0]
            role, when = _role(problem, agent).lower(), f"by t = {whole.times[frame]:.6g} s"
            return Outcome.DIVERGED, f"The state of {role} {agent} stopped being finite {when}."
        if whole.stopped is None and self.complete:
            return self._completed(problem, whole)
        reached = float(whole.times[-1]) if len(whole.times) else 0.0
        # One that stopped did so between two frames; the steps themselves were counted.
        if whole.stopped:
            reached = whole.done * problem.settings.dt
        what = whole.stopped or f"The run was {_VERBS[unfinished]}"
        return unfinished, f"{what} at t = {reached:.6g} s; what was computed is kept."

    def _completed(self, problem: Problem, whole: Segment) -> tuple[Outcome, str]:
        last, meter, model = whole.states[-1], problem.meter, problem.model
        inside = inside_at_last(meter, whole.sums.inside, last, self.grid.steps)
        if not inside.size or inside.min() >= ALWAYS:
            return Outcome.COMPLETED, Outcome.COMPLETED.value
        agent, k = divmod(int(inside.argmin()), inside.shape[1])
        name = [*model.chart][k]
        unit = model.state_units[model.state_names.index(name)]
        low, high = (f"{bound:.4g}" for bound in model.chart[name])
        return Outcome.LEFT_CHART, (
            f"{_role(problem, agent)} {agent} left the chart of its equations at "
            f"t = {inside.min() * problem.settings.dt:.6g} s: `{name}` is not between {low} "
            f"and {high} {unit}".rstrip()
            + ", and what follows is not the agent's motion."
        )


def _role(problem: Problem, agent: int) -> str:
    return "Leader" if agent in problem.graph.leaders else "Follower"


def inside_at_last(meter: RunStatistics, inside: Array, last: Array, steps: int) -> Array:
    """Return `Sums.inside` (..., N, k) with the last moment, which begins no step."""
    beyond = outside(last[..., meter.charted], *meter.chart.T)
    return np.minimum(inside, np.where(beyond, steps, ALWAYS))


def join(segments: Sequence[Segment]) -> Segment | None:
    """Return stretches that follow each other as one; None where there is none."""
    if len(segments) < 2:
        return segments[0] if segments else None
    rows = dict[str, Array | None]()
    for name in _BY_FRAME:
        parts = [getattr(segment, name) for segment in segments]
        rows[name] = None if any(part is None for part in parts) else np.concatenate(parts)
    return segments[-1]._replace(first=segments[0].first, **rows)


def _finite(segment: Segment) -> Bool[np.ndarray, "T N"]:
    states, inputs = (np.isfinite(part).all(axis=2) for part in (segment.states, segment.inputs))
    return np.logical_and(states, inputs)
