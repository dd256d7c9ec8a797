"""Compares methods over many seeds: quantiles of their numbers, and paired differences."""

import contextlib
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from echelon.core.errors import EchelonError, LawError, Outcome
from echelon.core.files import notebook_page
from echelon.core.limits import excess_runs
from echelon.core.types import Array
from echelon.experiments.results.metrics import RunNumbers, arrived, metrics
from echelon.experiments.results.run_numbers import ERROR, RUN_NUMBERS, Appearance, shown_in
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import ScenarioLike, as_scenario
from echelon.experiments.studies.compare import (
    INTERRUPTED,
    DriveOf,
    conditions_of,
    known_labels,
    run_each,
    with_starts,
)
from echelon.simulation.engine.batch import FRAMES, Batch, Run, batch_size
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings

LEVELS = (0.05, 0.5, 0.95)
"""The quantiles that are stated."""
NUMBERS = tuple(shown_in(RUN_NUMBERS, Appearance.SEEDS))
_COMPLETED, _REFUSED = Outcome.COMPLETED.name.lower(), "refused"
_STOPPED = tuple(end.name.lower() for end in (Outcome.INTERRUPTED, Outcome.STOPPED))


class MethodSeeds(NamedTuple):
    """The runs of a method, one for each seed; fewer if an interruption ended them.

    Attributes:
        label: of the method.
        outcomes: (K,) how each run ended, in one word; `refused` if it could not start.
        numbers: (K,) by name; NaN where a run has none, as if it diverged.
        reason: why there are no runs, fewer than seeds, or refused ones; empty otherwise.
        unit: of the errors; empty without a position.
    """

    label: str
    outcomes: Sequence[str] = ()
    numbers: Mapping[str, Array] = {}
    reason: str = ""
    unit: str = ""

    @property
    def settled(self) -> int:
        """How many runs completed with all followers settled."""
        completed = np.array(self.outcomes) == _COMPLETED
        return int(arrived(completed, self.numbers["worst_settling_time"]).sum())

    @property
    def ended(self) -> Counter[str]:
        """How many runs ended in which way."""
        return Counter(self.outcomes)

    def ranked(self, name: str) -> Array:
        """Return a number (K,) of all runs; infinitely bad where it does not exist."""
        worst = -np.inf if RUN_NUMBERS[name].more_is_better else np.inf
        return np.where(np.isnan(self.numbers[name]), worst, self.numbers[name])

    def quantiles(self, name: str) -> list[float]:
        """Return the quantiles of `LEVELS`; infinite where too many runs have no number."""
        return quantiles(self.ranked(name), LEVELS)


class SeedRun(NamedTuple):
    """A run of a method: how it ended, in one word; its `NUMBERS`; why it was refused; its unit."""

    outcome: str
    numbers: Sequence[float]
    reason: str = ""
    unit: str = ""


class SeedStore(NamedTuple):
    """Keeps the runs of a comparison, from which it can be continued.

    Attributes:
        read: returns the runs that were kept under a number; None if there are none.
        write: keeps runs under a number.
    """

    read: Callable[[int], Sequence[SeedRun] | None] = lambda number: None
    write: Callable[[int, Sequence[SeedRun]], None] = lambda number, runs: None

    def after(self, first: int) -> "SeedStore":
        """Return it with its numbers counted from another one on."""
        return SeedStore(
            lambda number: self.read(first + number),
            lambda number, runs: self.write(first + number, runs),
        )


class PairedDifference(NamedTuple):
    """A number of a method minus that of another, seed by seed.

    Attributes:
        number: its name.
        first, second: the labels of the methods.
        median: of the differences; NaN if no seed has one.
        interval: contains the median of all seeds with 95 %, by the sign test; None for fewer than
            6 differences.
        better: on how many seeds the first and the second is better; neither on the others.
    """

    number: str
    first: str
    second: str
    median: float
    interval: tuple[float, float] | None
    better: tuple[int, int]


class SeedComparison(NamedTuple):
    """Methods on the same seeds: the same starts, and the same draws of noise and network.

    Attributes:
        scenario: its name.
        seeds: (K,).
        rows: one for each method.
        horizon: s, the same for all.
        conditions: wind and plant, in words.
    """

    scenario: str
    seeds: Sequence[int]
    rows: Sequence[MethodSeeds]
    horizon: float
    conditions: Sequence[str]

    def _repr_html_(self) -> str:
        return notebook_page("report", self)

    @property
    def length_unit(self) -> str:
        """The unit of errors; empty without a position."""
        return next((row.unit for row in self.rows if row.unit), "")

    @property
    def compared(self) -> list[MethodSeeds]:
        """The methods that ran on all seeds."""
        return [row for row in self.rows if len(row.outcomes) == len(self.seeds)]

    @property
    def names(self) -> list[str]:
        """The numbers that some run has."""
        rows = self.compared
        return [x for x in NUMBERS if any(np.isfinite(row.numbers[x]).any() for row in rows)]

    @property
    def equal(self) -> bool:
        """Whether all seeds give the same numbers, as where nothing is random."""
        rows = [(row, x) for x in self.names for row in self.compared]
        return bool(rows) and all(len({*row.ranked(x)}) < 2 for row, x in rows)

    def unit(self, name: str) -> str:
        """Return the unit of a number."""
        return RUN_NUMBERS[name].unit.replace(ERROR, self.length_unit)

    def differences(self) -> Iterator[PairedDifference]:
        """Yield the differences of all pairs of methods in all numbers."""
        for name, pair in itertools.product(self.names, itertools.combinations(self.compared, 2)):
            yield _paired(name, *pair)


def quantiles(values: Array, levels: Sequence[float]) -> list[float]:
    """Return quantiles of values (K,) as numpy does, of infinite values too; NaN of no values."""
    if not len(values):
        return [np.nan] * len(levels)
    # Between a finite number and a huge one, numpy interpolates to a huge one.
    found = np.quantile(np.clip(values, -1e300, 1e300), levels)
    return np.where(np.abs(found) > 1e200, np.copysign(np.inf, found), found).tolist()


def median_interval(values: Array) -> tuple[float, float] | None:
    """Return the 95 % interval of the median by the sign test; None of fewer than 6 values.

    It holds for any distribution: the median lies below the k-th smallest of n independent values
    with the probability of fewer than k heads in n throws of a coin.
    """
    from scipy.stats import binom

    rank = int(binom.ppf(0.025, len(values), 0.5))
    ordered = np.sort(values)
    return None if rank < 1 else (float(ordered[rank - 1]), float(ordered[-rank]))


def differences(name: str, first: MethodSeeds, second: MethodSeeds) -> Array:
    """Return a number minus that of another method on each seed, without those that neither has."""
    mine, other = first.ranked(name), second.ranked(name)
    some = np.isfinite(mine) | np.isfinite(other)
    return mine[some] - other[some]


def _paired(name: str, first: MethodSeeds, second: MethodSeeds) -> PairedDifference:
    found = differences(name, first, second)
    less, more = int(np.sum(found < 0.0)), int(np.sum(found > 0.0))
    better = (more, less) if RUN_NUMBERS[name].more_is_better else (less, more)
    (median,), interval = quantiles(found, [0.5]), median_interval(found)
    return PairedDifference(name, first.label, second.label, median, interval, better)


def compare_seeds(
    scenario: ScenarioLike,
    seeds: Iterable[int],
    built: Experiment | None = None,
    only: Sequence[str] = known_labels(None, slow=False),
    progress: Callable[[str, float, int], None] = lambda label, done, methods: None,
    store: SeedStore = SeedStore(),
) -> SeedComparison:
    """Run each method on a scenario with the same seeds: the same starts, noise and messages.

    Args:
        scenario: as in `compare`.
        seeds: of the runs.
        built: its parts and settings; built if None.
        only: as in `compare`; by default the laws, without methods that optimize.
        progress: as in `compare`; the runs before an interruption are kept.
        store: keeps runs, and gives those of an interrupted comparison of the same inputs.

    A run that diverges or is refused has no numbers, and counts as worse than all others.

    Raises:
        ScenarioError: a part cannot be built.
        LawError: no seed is given, one twice, or too many for the memory.
    """
    scenario, seeds = as_scenario(scenario), tuple(map(int, seeds))
    parts, settings = build(scenario) if built is None else built
    scenes, rows, batch = _scenes(parts, settings, seeds, len(only)), list[MethodSeeds](), Batch()

    def fly(label: str, drive: DriveOf) -> Controller | None:
        def part(done: float) -> None:
            progress(label, len(rows) + done / len(seeds), len(only))

        flown, mine = list[Controller](), store.after(len(rows) * len(seeds))
        rows.append(_row(label, _results(batch, parts, scenes, drive, part, mine, flown)))
        return flown[0] if rows[-1].outcomes and flown else None

    run_each(scenario, parts, only, fly)
    return SeedComparison(scenario.name, seeds, rows, settings.horizon, conditions_of(parts))


def _scenes(parts: Parts, settings: Settings, seeds: Sequence[int], methods: int) -> list[Run]:
    """Return what the methods have in common on each seed."""
    if not seeds or len({*seeds}) < len(seeds) or min(seeds) < 0:
        raise LawError("`seeds` must be one or more different whole numbers from 0 on.")
    excess = excess_runs(len(seeds) * methods)
    if excess is not None:
        raise LawError(f"`seeds`: {excess}.")
    settings = settings._replace(store_every=-(-settings.steps // FRAMES))
    drawn = (settings._replace(seed=seed) for seed in seeds)
    return [*zip(with_starts(parts, seeds), drawn, strict=True)]


def _results(
    batch: Batch,
    parts: Parts,
    scenes: Sequence[Run],
    drive: DriveOf,
    part: Callable[[float], None],
    store: SeedStore,
    flown: list[Controller],
) -> Iterator[SeedRun]:
    """Yield the runs of a method, those that are kept without a computation; `flown` is its drive.

    Batches are those of a comparison without an interruption, so that numbers agree to the bit.
    """
    part(0)
    runs, size = _runs(parts, scenes, drive), batch_size(parts, scenes[0][1])
    with contextlib.suppress(EchelonError):  # of a drive that each run refuses
        flown.append(runs[0][0].drive.prepare(parts.model, parts.graph.before))
    for first in range(0, len(runs), size):
        kept, found = store.read(first), list[SeedRun]()
        mine = runs[first : first + size], lambda *_: part(first + len(found))
        for run in map(_seed_run, batch.fly(*mine)) if kept is None else kept:
            found.append(run)
            yield run
            part(first + len(found))
        if kept is None:
            store.write(first, found)


def _runs(parts: Parts, scenes: Sequence[Run], drive: DriveOf) -> Sequence[Run]:
    """Return the runs of a method; of the same parts, if neither its drive nor starts differ."""
    first, last = (drive(*scenes[k]) for k in (0, -1))
    whole = parts.replace(drive=first)
    starts = with_starts(whole, [settings.seed for _, settings in scenes])
    alike = (eqx.tree_equal(a.initial, b.initial) for a, (b, _) in zip(starts, scenes, strict=True))
    if eqx.tree_equal(first, last) and all(alike):
        return [(whole, settings) for _, settings in scenes]
    return [(own.replace(drive=drive(own, settings)), settings) for own, settings in scenes]


def _row(label: str, runs: Iterator[SeedRun]) -> MethodSeeds:
    """Return the runs of a method, as many as there are before an interruption."""
    found, failed = list[SeedRun](), ""
    try:
        for run in runs:
            if run.outcome in _STOPPED:
                raise KeyboardInterrupt
            found.append(run)
    except EchelonError as error:
        failed = str(error)
    except KeyboardInterrupt:
        failed = INTERRUPTED
    reason = failed or next((run.reason for run in found if run.reason), "")
    ran = [run for run in found if run.outcome != _REFUSED]
    if not ran:
        return MethodSeeds(label, reason=reason)
    columns = dict(zip(NUMBERS, np.array([run.numbers for run in found]).T, strict=True))
    return MethodSeeds(label, [run.outcome for run in found], columns, reason, ran[0].unit)


def _seed_run(result: Result | EchelonError) -> SeedRun:
    if isinstance(result, EchelonError):
        return SeedRun(_REFUSED, _numbers(result), str(result))
    return SeedRun(result.outcome.name.lower(), _numbers(result), "", result.length_unit)


def _numbers(result: Result | EchelonError) -> list[float]:
    # Of a run that diverged, distances until then would look like those of a whole run.
    if isinstance(result, EchelonError) or not result.outcome.reached:
        return [np.nan] * len(NUMBERS)
    run = RunNumbers(result, metrics(result))
    found = (run.number(name) for name in NUMBERS)
    return [np.nan if number is None else float(number) for number in found]
