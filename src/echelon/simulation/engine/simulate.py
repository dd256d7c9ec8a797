"""A run of the closed loop: parts in, one `Result` out, whatever drives the agents."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias, final

import jax
import numpy as np

from echelon.core.errors import Outcome, SimulationError
from echelon.core.numerics import precision
from echelon.core.trace import shared_traces
from echelon.core.types import Array
from echelon.simulation.engine.chunk_grid import ChunkGrid, advance_until_lost
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared, prepare
from echelon.simulation.engine.record import Record, Recorder, Segment, join
from echelon.simulation.engine.result import Result
from echelon.simulation.step.drive import Stepper, Stopped
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats


@final
class RunSoFar:
    """A run in progress, as passed to callbacks: `done` of so many `steps` were taken."""

    def __init__(self, prepared: Prepared, recorder: Recorder, stepper: Stepper) -> None:
        self._prepared, self._recorder, self._stepper = prepared, recorder, stepper
        self.done, self.steps = recorder.done, recorder.grid.steps

    @property
    def time(self) -> float:
        """Simulated time so far, s."""
        return self.done * self._prepared.problem.settings.dt

    @property
    def states(self) -> Array:
        """The states (N, n) of the newest stored frame."""
        return next(x.states[-1] for x in reversed(self._recorder.segments) if len(x.states))

    def result(self) -> Result:
        """Return the run so far as a result, such as for `metrics`."""
        result = _result(self._prepared, self._recorder, self._stepper, Outcome.INTERRUPTED)
        if result.outcome is not Outcome.INTERRUPTED:
            return result
        message = f"The run goes on, and this is all of it until t = {self.time:.6g} s."
        return dataclasses.replace(result, message=message)


Progress: TypeAlias = Callable[[RunSoFar], None]
"""Called between chunks with the run so far."""
Keep: TypeAlias = Callable[[Segment], None]
"""Called with every stretch of a run in order, as soon as it is computed.

Raising `Stopped`, with the reason in words, ends the run there.
"""

_ROWS = 512
"""Steps of a reference that cost as much as one."""
_SECONDS = 2.0
"""Wall time of a stretch, s: the most that is lost when the process is killed."""


@shared_traces()
def simulate(
    parts: Parts,
    settings: Settings,
    progress: Progress | None = None,
    keep: Keep | None = None,
    before: Sequence[Segment] = (),
) -> Result:
    """Simulate the closed loop and return its result.

    Args:
        parts: agents, graph, formation, what drives them, starts and world.
        settings: horizon, step and the like.
        progress: called a hundred times or more with the run so far: steps, states, and the result
            so far on request.
        keep: called with what was computed, every two seconds and at the end.
        before: all that an earlier run of the same parts and settings gave to `keep`; the run
            continues from there, to the same bits.

    Raises:
        EchelonError: a part is malformed or does not fit the others. A run that diverges or is
            interrupted by Ctrl-C is no error: the result says so and holds what was computed.
    """
    began = time.perf_counter()
    prepared = prepare(parts, settings, to_store=True)
    with precision("float64"):
        # Before a solver plans, which may take minutes.
        prepared.parts.drive.check_engine(prepared.problem)
        # Plans and solvers need float64, also in a float32 run.
        stepper = prepared.parts.drive.stepper(prepared.problem)
    if settings.devices != stepper.devices:
        raise SimulationError(
            f"`devices` is {settings.devices}, and must be 1 where a solver drives the agents."
        )
    with precision(settings.precision), _mixed_tables():
        recorder = _recorder(prepared, stepper, before)
        _ChunkLoop(stepper, prepared, recorder, began).run(progress, keep)
    return _result(prepared, recorder, stepper, Outcome.INTERRUPTED)


@contextlib.contextmanager
def _mixed_tables() -> Iterator[None]:
    """JAX keeps one converted copy of an array of NumPy, by its identity and not the precision."""
    try:
        yield
    except ValueError as error:
        if "Cannot lower jaxpr with verifier errors" not in str(error):
            raise
        raise SimulationError(
            "JAX keeps one precision of each NumPy array that a model or law passes to a function "
            "such as `jnp.interp`, and uses it in both; write `jnp.asarray(array)` there."
        ) from error


def reassemble(parts: Parts, settings: Settings, segments: Sequence[Segment]) -> Result:
    """Return the result of a run, ended from outside, from all stretches that it gave to `keep`."""
    prepared = prepare(parts, settings)
    with precision("float64"):
        stepper = prepared.parts.drive.stepper(prepared.problem)
    return _result(prepared, _recorder(prepared, stepper, segments), stepper, Outcome.STOPPED)


def _recorder(prepared: Prepared, stepper: Stepper, before: Sequence[Segment]) -> Recorder:
    problem = prepared.problem
    return Recorder([problem], ChunkGrid(problem.settings, stepper.longest), before)


def _result(
    prepared: Prepared, recorder: Recorder, stepper: Stepper, unfinished: Outcome
) -> Result:
    [record] = recorder.close(unfinished)
    return result_of(prepared, record, stepper.engine, stepper.warnings, stepper.work)


def result_of(
    prepared: Prepared,
    record: Record,
    engine: str,
    warnings: tuple[str, ...] = (),
    work: SolverStats | None = None,
) -> Result:
    """Return a run as its result, from its record."""
    fields = record._asdict()
    return Result(
        wall_time=fields.pop("seconds"),
        **fields,
        warnings=prepared.warnings + warnings,
        engine=engine,
        parts=prepared.parts,
        settings=prepared.problem.settings,
        work=work,
    )


@final
class _ChunkLoop:
    """Computes a run chunk by chunk, so that Ctrl-C loses at most one chunk."""

    def __init__(
        self, stepper: Stepper, prepared: Prepared, recorder: Recorder, began: float
    ) -> None:
        self.stepper, self.prepared, self.recorder = stepper, prepared, recorder
        self.reference = _ReferenceRows(prepared)
        last = recorder.segments[-1] if recorder.segments else None
        self.now = stepper.start() if last is None else stepper.recall(last.moment)
        # Shifted into the past by the time of earlier sessions, which counts too.
        self.began = began - (0.0 if last is None else last.seconds)
        self.handed_over, self.last_time = len(recorder.segments), time.perf_counter()

    def run(self, progress: Progress | None, keep: Keep | None) -> None:
        """Take all remaining steps, until the run ends or is stopped."""
        try:
            # Between chunks, or within one of JAX's: that chunk is lost, the others are kept.
            with contextlib.suppress(KeyboardInterrupt):
                while not self.recorder.ended:
                    self._advance()
                    if time.perf_counter() - self.last_time > _SECONDS:
                        self._hand_over(keep)
                    if progress is not None:
                        progress(RunSoFar(self.prepared, self.recorder, self.stepper))
            self._hand_over(keep)
        except Stopped as reason:
            self.recorder.stop(f"The run was stopped, since {reason}")

    def _advance(self) -> None:
        first, grid = self.recorder.done, self.recorder.grid
        # One more row, for a frame at a chunk's end, which no step follows. As many rows for the
        # last chunks, which have fewer steps, keep them from compiling anew.
        reference = self.reference.rows(first, grid.longest + 1)
        planned = self.now, grid.counts(first), reference, 1
        chunk, counts = advance_until_lost(self.stepper, *planned)
        self.recorder.keep(chunk, counts, reference, time.perf_counter() - self.began)
        self.now = chunk.now

    def _hand_over(self, keep: Keep | None) -> None:
        new = join(self.recorder.segments[self.handed_over :])
        if keep is not None and new is not None:
            keep(new)
        self.handed_over, self.last_time = len(self.recorder.segments), time.perf_counter()


@final
class _ReferenceRows:
    """The leaders' reference states, sampled for more steps at once than a short chunk has."""

    def __init__(self, prepared: Prepared) -> None:
        self.prepared, self.first = prepared, 0
        self.states: Array | None = None

    def rows(self, first: int, count: int) -> Array | None:
        """Return the states for `count` steps; None if the leaders have no reference."""
        if self.states is None or first + count > self.first + len(self.states):
            self.first = first
            self.states = sample_reference(self.prepared, first, max(count, _ROWS))
        start = first - self.first
        return None if self.states is None else self.states[start : start + count]


def sample_reference(prepared: Prepared, first: int, steps: int) -> Array | None:
    """Return the leaders' reference states from a step on, (steps, n) in float64."""
    with precision("float64"):
        # In float64: after three hours float32 has a millisecond between two times.
        times = jax.device_put(prepared.problem.settings.dt * np.arange(first, first + steps))
        reference = prepared.parts.drive.reference_states(prepared.parts.model, times)
        return None if reference is None else np.asarray(reference, np.float64)
