"""Many runs at once, each with the result that `simulate` would return.

Runs that differ in numbers alone are stepped together, by native code with a formation in each
lane, or by JAX, where states may differ from those of a single run by rounding. The others run one
after the other.
"""

import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeAlias, final
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool

from echelon.core.errors import EchelonError, Outcome, SimulationError
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.chunk_grid import ChunkGrid, advance_until_lost
from echelon.simulation.engine.jax_stepper import JaxFormations
from echelon.simulation.engine.law_drive import Laws, choose_engine, is_long, worth_native
from echelon.simulation.engine.parts import Parts, Starts
from echelon.simulation.engine.prepare import Prepared, channel_of, prepare, sensors_of
from echelon.simulation.engine.record import Recorder
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import result_of, sample_reference, simulate
from echelon.simulation.native import is_installed
from echelon.simulation.native.stepper import NativeStepper
from echelon.simulation.native.threads import processors
from echelon.simulation.native.varying import ProgramKeys
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.drive import Stepper
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.settings import Settings

Run: TypeAlias = tuple[Parts, Settings]
StepCount: TypeAlias = Callable[[int, int], None]
"""Called with the steps that were taken, and those of the run."""
_SMALL = 64
"""Agents of a formation that is stepped with others even if they do not fill a vector."""
_AGENT_STEPS, _MOST, _LEAST = 20_000_000, 2_500, 16
"""Size of a batch: one or two seconds of native code, and at least one run for each vector lane."""
_SLOWER = 20
"""Factor by which JAX is slower than native code."""
_NUMBERS = 32 * 2**20
"""Most numbers of the frames in a batch, where frames are stored."""
FRAMES = 20
"""Frames of a run checked for numbers that are not finite or exceed native code's range."""


def batch_size(parts: Parts, settings: Settings, stored: int | None = None) -> int:
    """Return how many runs to step together; `stored` is how many numbers each run stores."""
    fast = settings.engine != "jax" and is_installed()
    most, least = (_AGENT_STEPS, _LEAST) if fast else (_AGENT_STEPS // _SLOWER, 1)
    most = min(_MOST, most // (settings.steps * parts.graph.agents), _NUMBERS // (stored or 1))
    return max(least if stored is None else 1, most)


class _SharedRun(NamedTuple):
    prepared: Prepared
    starts: Starts
    loop: Loop | None
    group: Hashable


class _BatchJob(NamedTuple):
    place: int
    prepared: Prepared
    loop: Loop


@final
class Batch:
    """Computes many runs; what is prepared and compiled for one is used again for the next.

    Args:
        threads: of native code; one for each processor when left out. No result depends on it.
    """

    def __init__(self, threads: int | None = None) -> None:
        self.threads = threads or processors()
        self.pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self.kinds = ProgramKeys()
        self._shared: WeakKeyDictionary[Parts, dict[Settings, _SharedRun]] = WeakKeyDictionary()

    def fly(
        self, runs: Sequence[Run], progress: StepCount | None = None
    ) -> Iterator[Result | EchelonError]:
        """Yield the result of each run in their order, as `simulate` would return it.

        Args:
            runs: parts and settings of each.
            progress: called several times a second; what it raises ends all runs.
        """
        results: dict[int, Result | EchelonError] = {}
        for jobs in self._groups(runs):
            results |= self._together(jobs, progress)
        for place, (parts, settings) in enumerate(runs):
            yield results.pop(place) if place in results else _run_alone(parts, settings, progress)

    def _groups(self, runs: Sequence[Run]) -> list[list[_BatchJob]]:
        cases: dict[int, tuple[_SharedRun, list[int]]] = {}
        for place, (parts, settings) in enumerate(runs):
            try:
                case = self._share(parts, settings)
            except EchelonError:
                continue  # `simulate` raises it again
            if case.loop is not None and settings.devices == 1:
                cases.setdefault(id(case), (case, []))[1].append(place)
        groups: dict[Hashable, list[_BatchJob]] = {}
        for case, places in cases.values():
            jobs = _jobs(case, places, [runs[place][1] for place in places])
            groups.setdefault(case.group, []).extend(jobs)
        return [jobs for jobs in groups.values() if jobs and _fit(jobs)]

    def _share(self, parts: Parts, settings: Settings) -> _SharedRun:
        # Runs that differ only in their seeds share everything but their starts.
        shared, unseeded = self._shared.setdefault(parts, {}), settings._replace(seed=0)
        if unseeded not in shared:
            prepared = prepare(parts, settings, to_store=True)
            drive = prepared.parts.drive
            with precision("float64"):
                loop = group = None
                if isinstance(drive, Laws):
                    loop = assemble(prepared.problem, drive.leader, drive.follower)
                    group = self.kinds.of(loop, unseeded)
                shared[unseeded] = _SharedRun(prepared, Starts(prepared.parts), loop, group)
        return shared[unseeded]

    def _together(
        self, jobs: list[_BatchJob], progress: StepCount | None
    ) -> dict[int, Result | EchelonError]:
        """Return the results of a group; none where its runs cannot be stepped together."""
        settings = jobs[0].prepared.problem.settings
        states = np.concatenate([job.prepared.problem.states for job in jobs])
        bits = int(settings.precision[5:])
        loops, began = [job.loop for job in jobs], time.perf_counter()
        with precision(settings.precision):
            try:
                stepper = choose_engine(
                    settings,
                    len(states),
                    lambda: NativeStepper(loops, states, bits, None, self.pool),
                    lambda why: JaxFormations(loops, states, why),
                )
                problems = [job.prepared.problem for job in jobs]
                recorder = Recorder(problems, ChunkGrid(settings, stepper.longest))
                far = _fly(stepper, jobs[0].prepared, recorder, progress)
            except (SimulationError, TypeError):
                # A model that needs its numbers as numbers is traced for each of them.
                return {}
        seconds = (time.perf_counter() - began) / len(jobs)
        engine, warnings = stepper.engine, stepper.warnings
        return {
            job.place: result_of(job.prepared, record._replace(seconds=seconds), engine, warnings)
            for job, record, lost in zip(
                jobs, recorder.close(Outcome.INTERRUPTED), far, strict=True
            )
            # Those others are run again, each by itself.
            if not lost
        }


def _fly(
    stepper: Stepper, first: Prepared, recorder: Recorder, progress: StepCount | None
) -> Bool[np.ndarray, " F"]:
    """Take all steps; return for which formations native code does not compute what JAX does."""
    now, far = stepper.start(), np.zeros(len(recorder.problems), bool)
    while not recorder.ended:
        done, grid = recorder.done, recorder.grid
        reference = sample_reference(first, done, grid.longest + 1)
        planned = now, grid.counts(done), reference, len(far)
        chunk, counts = advance_until_lost(stepper, *planned)
        recorder.keep(chunk, counts, reference, 0.0)
        far |= chunk.inexact
        now = chunk.now
        if progress is not None:
            progress(recorder.done, grid.steps)
    return far


def _run_alone(
    parts: Parts, settings: Settings, progress: StepCount | None
) -> Result | EchelonError:
    try:
        return simulate(parts, settings, progress and (lambda run: progress(run.done, run.steps)))
    except EchelonError as error:
        return error


def _jobs(case: _SharedRun, places: Sequence[int], chosen: Sequence[Settings]) -> list[_BatchJob]:
    parts = case.prepared.parts
    assert isinstance(parts.drive, Laws)
    try:
        states = case.starts.of([settings.seed for settings in chosen])
    except EchelonError:
        return []  # `simulate` raises it again
    with precision("float64"):
        refused = {k for k, _, _ in parts.drive.refusals(parts.model, parts.graph, states)}
        runs = zip(places, chosen, states, strict=True)
        return [_job(case, *run) for k, run in enumerate(runs) if k not in refused]


def _job(case: _SharedRun, place: int, settings: Settings, states: Array) -> _BatchJob:
    prepared, loop = case.prepared, case.loop
    assert loop is not None
    problem = prepared.problem._replace(settings=settings, states=states)
    world = prepared.parts.world
    if not world.ideal:
        # Draws of a seed of its own.
        motion = PlantStep.of(problem.model, world, settings, len(states))
        channel = channel_of(prepared.parts, settings)
        sensors = sensors_of(prepared.parts, settings)
        problem = problem._replace(motion=motion, channel=channel, sensors=sensors)
        loop = loop.replace(motion=motion, sensing=sensors)
        loop = loop if channel is None else loop.with_medium(channel)
        if world.parts:
            drive: Any = prepared.parts.drive
            loop = assemble(problem, drive.leader, drive.follower)
    return _BatchJob(place, prepared._replace(problem=problem), loop)


def _fit(jobs: list[_BatchJob]) -> bool:
    """Tell whether stepping runs together pays: they are long enough, and fill their vectors."""
    problem = jobs[0].prepared.problem
    agents, settings = len(problem.states), problem.settings
    if len(jobs) == 1:
        # A single run, but by code that was compiled for others.
        return worth_native(settings, agents)
    if agents > _SMALL and len(jobs) < 8:
        return False
    return is_long(settings, len(jobs) * agents)
