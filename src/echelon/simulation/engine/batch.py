"""Many runs at once, each as `simulate` would have it.

Runs that are alike but for numbers are stepped together, by native code with a formation a lane, or
by JAX, where states may differ from those of a run alone by rounding; the others run one after the
other.
"""

import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeAlias, final
from weakref import WeakKeyDictionary

import equinox as eqx
import numpy as np

from echelon.core.errors import EchelonError, Outcome, SimulationError
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.grid import ChunkGrid
from echelon.simulation.engine.initial import Starts
from echelon.simulation.engine.jax_stepper import JaxFormations
from echelon.simulation.engine.law_drive import Laws, choose_engine, is_long, worth_native
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared, prepare
from echelon.simulation.engine.record import Record, Recorder, Stretch, completed, inside_at_last
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import result_of, sample_reference, simulate
from echelon.simulation.native.kernel_cache import KERNELS
from echelon.simulation.native.program_key import ProgramKeys
from echelon.simulation.native.stepper import NativeStepper, beyond
from echelon.simulation.native.threads import processors
from echelon.simulation.step.drive import Chunk, Stepper
from echelon.simulation.step.loop import Loop, assemble
from echelon.simulation.step.meter import ALWAYS, Sums, on_host
from echelon.simulation.step.motion import Motion
from echelon.simulation.step.settings import Settings

Run: TypeAlias = tuple[Parts, Settings]
Told: TypeAlias = Callable[[int, int], None]
_SMALL = 64
"""Agents of a formation that is stepped beside others though they do not fill a vector."""


class _SharedRun(NamedTuple):
    """What runs share that differ in the seed alone."""

    prepared: Prepared
    starts: Starts
    loop: Loop | None
    family: Hashable


class _BatchJob(NamedTuple):
    """A run with all that its steps rest on."""

    place: int
    case: _SharedRun
    prepared: Prepared
    loop: Loop


@final
class Batch:
    """Flies many runs; what is prepared and compiled for one is there for the next.

    Args:
        threads: on which native code runs; one for each processor when left out. No number depends
            on it.
    """

    def __init__(self, threads: int | None = None) -> None:
        """Begin with nothing prepared."""
        self.threads = threads or processors()
        self.pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self.kinds = ProgramKeys()
        self._cases: WeakKeyDictionary[Parts, dict[Settings, _SharedRun]] = WeakKeyDictionary()

    def fly(self, runs: Sequence[Run], told: Told | None = None) -> Iterator[Result | EchelonError]:
        """Yield what each run comes to, in their order, as `simulate` would have it.

        Args:
            runs: parts and settings of each.
            told: called several times a second; what it raises ends the flight.
        """
        found: dict[int, Result | EchelonError] = {}
        for jobs in self._families(runs):
            found |= self._together(jobs, told)
        for place, (parts, settings) in enumerate(runs):
            yield found.pop(place) if place in found else _alone(parts, settings, told)

    # ---- what belongs together ----

    def _families(self, runs: Sequence[Run]) -> list[list[_BatchJob]]:
        """Return the runs that can be stepped together, family by family."""
        cases: dict[int, tuple[_SharedRun, list[int]]] = {}
        for place, (parts, settings) in enumerate(runs):
            try:
                case = self._case(parts, settings)
            except EchelonError:
                continue  # `simulate` says it again
            if case.loop is not None and settings.devices == 1:
                cases.setdefault(id(case), (case, []))[1].append(place)
        families: dict[Hashable, list[_BatchJob]] = {}
        for case, places in cases.values():
            jobs = _jobs(case, places, [runs[place][1] for place in places])
            families.setdefault(case.family, []).extend(jobs)
        return [jobs for jobs in families.values() if jobs and _fit(jobs)]

    def _case(self, parts: Parts, settings: Settings) -> _SharedRun:
        known, alike = self._cases.setdefault(parts, {}), settings._replace(seed=0)
        if alike not in known:
            prepared = prepare(parts, settings, to_store=True)
            drive = prepared.parts.drive
            with precision("float64"):
                loop = family = None
                if isinstance(drive, Laws):
                    loop = assemble(prepared.problem, drive.leader, drive.follower)
                    family = self.kinds.of(loop, alike)
                known[alike] = _SharedRun(prepared, Starts(prepared.parts), loop, family)
        return known[alike]

    # ---- flights ----

    def _together(
        self, jobs: list[_BatchJob], told: Told | None
    ) -> dict[int, Result | EchelonError]:
        """Return what a family comes to; nothing where its runs cannot go together."""
        settings = jobs[0].prepared.problem.settings
        states = np.concatenate([job.prepared.problem.states for job in jobs])
        bits, pool = int(settings.precision[5:]), (self.pool, KERNELS.of)
        loops, began = [job.loop for job in jobs], time.perf_counter()
        with precision(settings.precision):
            try:
                stepper = choose_engine(
                    settings,
                    len(states),
                    lambda: NativeStepper(loops, states, bits, None, *pool),
                    lambda why: JaxFormations(loops, states, why),
                )
                record = _BatchRecord(
                    len(jobs), ChunkGrid(settings, stepper.longest), jobs[0].prepared, bits
                )
                record.fly(stepper, told)
            except (SimulationError, TypeError):
                # A model that wants its numbers as numbers is traced for each of them.
                return {}
        seconds = (time.perf_counter() - began) / len(jobs)
        made = record.results([job.prepared for job in jobs], stepper, seconds)
        # Each by itself then goes on by JAX.
        return {job.place: r for job, r, far in zip(jobs, made, record.far, strict=True) if not far}


@final
class _BatchRecord:
    """What is kept of formations that fly together."""

    def __init__(self, count: int, grid: ChunkGrid, first: Prepared, bits: int) -> None:
        self.count, self.grid, self.first, self.bits = count, grid, first, bits
        self.times, self._states = list[Array](), list[Array]()
        self._inputs, self._references = list[Array](), list[Array]()
        nothing = on_host(first.problem.meter.nothing(np))
        self.sums = Sums(*(np.stack([part] * count) for part in nothing))
        self.finite, self.far = np.ones(count, bool), np.zeros(count, bool)

    def fly(self, stepper: Stepper, told: Told | None) -> None:
        """Take all steps."""
        now, done, frames = stepper.start(), 0, 0
        self.native = stepper.engine == "native"
        while frames < self.grid.frames:
            reference = sample_reference(self.first, done, self.grid.longest + 1)
            made = stepper.advance(now, self.grid.counts(done), reference)
            frames += self._keep(made, reference, done)
            now, done = made.now, done + int(made.sums.steps[0])
            if told is not None:
                told(done, self.grid.steps)

    def _keep(self, made: Chunk, reference: Array | None, first: int) -> int:
        """Keep a chunk; return how many of its frames were stored."""
        counts = self.grid.counts(first)
        points = first + np.cumsum(counts) - counts
        frames, agents = len(made.states), made.states.shape[1] // self.count
        x, u = (part.reshape(frames, self.count, agents, -1) for part in (made.states, made.inputs))
        # The sums of one that was lost stay what they were when it was, as in a run of its own.
        self.sums = _where(self.finite, self.sums.plus(_split(made.sums, self.count)), self.sums)
        finite = np.isfinite(x).all(axis=(2, 3)) & np.isfinite(u).all(axis=(2, 3))
        stored = self.grid.stored(points)
        # Frames between those that are stored tell of a loss too, and of states too large.
        self.finite &= finite.all(axis=0)
        if self.native:
            self.far |= beyond(x, self.bits).any(axis=(0, 2, 3))
        self.times.append(self.first.problem.settings.dt * points[stored])
        self._states.append(x[stored])
        self._inputs.append(u[stored])
        if reference is not None:
            self._references.append(reference[points - first][stored])
        return int(stored.sum())

    def results(
        self, prepared: Sequence[Prepared], stepper: Stepper, seconds: float
    ) -> Iterator[Result]:
        """Yield the runs, each of which took so many seconds."""
        states, inputs = (
            np.ascontiguousarray(np.concatenate(parts).swapaxes(0, 1))
            for parts in (self._states, self._inputs)
        )
        usual = self._usual(states, inputs)
        reference = np.concatenate(self._references) if self._references else None
        engine, warnings, times = stepper.engine, stepper.warnings, np.concatenate(self.times)
        for k, (each, parts) in enumerate(zip(prepared, zip(*self.sums, strict=True), strict=True)):
            frames, sums = (times, states[k], inputs[k], reference), Sums._make(parts)
            whole = Stretch(0, self.grid.steps, *frames, sums, (), None, seconds)
            record = completed(whole) if usual[k] else self._closed(each, whole)
            yield result_of(each, record, engine, warnings)

    def _closed(self, prepared: Prepared, whole: Stretch) -> Record:
        recorder = Recorder(prepared.problem, self.grid, whole.sums, [whole])
        return recorder.close(Outcome.INTERRUPTED)

    def _usual(self, states: Array, inputs: Array) -> Array:
        """Return which runs (K,) end as most do: finite and in their chart."""
        meter = self.first.problem.meter
        inside = inside_at_last(meter, self.sums.inside, states[:, -1], self.grid.steps)
        finite = [np.isfinite(part).all(axis=(1, 2, 3)) for part in (states, inputs)]
        return np.all([*finite, (inside >= ALWAYS).all(axis=(1, 2))], axis=0)


def _split(sums: Sums, count: int) -> Sums:
    """Return the sums of formations that follow each other, each of a formation a row."""
    twice = {
        name: getattr(sums, name).reshape(2, count, -1).transpose(1, 0, 2)
        for name in ("errors", "tracking")
    }
    each = {
        name: part.reshape(count, len(part) // count, *part.shape[1:])
        for name, part in sums._asdict().items()
        if name not in ("steps", *twice)
    }
    return Sums(steps=np.stack([sums.steps] * count), **twice, **each)


def _where(which: Array, new: Sums, old: Sums) -> Sums:
    shaped = (which.reshape(-1, *[1] * (np.ndim(part) - 1)) for part in new)
    return Sums(*(np.where(w, a, b) for w, a, b in zip(shaped, new, old, strict=True)))


def _alone(parts: Parts, settings: Settings, told: Told | None) -> Result | EchelonError:
    try:
        return simulate(parts, settings, told and (lambda run: told(run.done, run.steps)))
    except EchelonError as error:
        return error


def _jobs(case: _SharedRun, places: Sequence[int], chosen: Sequence[Settings]) -> list[_BatchJob]:
    """Return the runs of a case whose starts the laws take."""
    parts = case.prepared.parts
    assert isinstance(parts.drive, Laws)
    try:
        states = case.starts.of([settings.seed for settings in chosen])
    except EchelonError:
        return []  # `simulate` says it again
    with precision("float64"):
        refused = {k for k, _, _ in parts.drive.refusals(parts.model, parts.graph, states)}
        each = zip(places, chosen, states, strict=True)
        return [_job(case, *its) for k, its in enumerate(each) if k not in refused]


def _job(case: _SharedRun, place: int, settings: Settings, states: Array) -> _BatchJob:
    prepared, loop = case.prepared, case.loop
    assert loop is not None
    problem = prepared.problem._replace(settings=settings, states=states)
    if prepared.parts.world.disturbance is not None:
        motion = Motion.of(problem.model, prepared.parts.world, settings)
        problem = problem._replace(motion=motion)
        loop = eqx.tree_at(lambda x: x.motion, loop, motion)
    return _BatchJob(place, case, prepared._replace(problem=problem), loop)


def _fit(jobs: list[_BatchJob]) -> bool:
    """Tell whether runs are worth stepping together: long enough, and filling their vectors."""
    problem = jobs[0].prepared.problem
    agents, settings = len(problem.states), problem.settings
    if len(jobs) == 1:
        # By itself, but by code that was made for others.
        return worth_native(settings, agents)
    if agents > _SMALL and len(jobs) < 8:
        return False
    return is_long(settings, len(jobs) * agents)
