"""Compares methods over many seeds: quantiles of their numbers, and paired differences."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, final

import equinox as eqx
import numpy as np

from echelon.core.errors import EchelonError, LawError, Outcome
from echelon.core.limits import excess_runs
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.experiments.results.metrics import RunNumbers, metrics
from echelon.experiments.results.run_numbers import ERROR, RUN_NUMBERS, Appearance, shown_in
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import ScenarioLike, as_scenario
from echelon.experiments.studies.compare import (
    INTERRUPTED,
    DriveOf,
    conditions_of,
    known_labels,
    run_each,
)
from echelon.simulation.engine.batch import Batch, Run
from echelon.simulation.engine.parts import Parts, Starts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings

if TYPE_CHECKING:
    import xarray as xr

LEVELS = (0.05, 0.5, 0.95)
"""The quantiles that are stated."""
NUMBERS = tuple(shown_in(RUN_NUMBERS, Appearance.SEEDS))
REFUSED = "refused"
"""In place of an outcome: of a run that could not start."""
_FRAMES, _AGENT_STEPS = 20, 20_000_000
"""Frames of a run, and agents times steps that are simulated together."""


class MethodSeeds(NamedTuple):
    """The runs of a method, one for each seed.

    Attributes:
        label: of the method.
        numbers: (K,) by name; NaN where a run has none, as after it diverged.
        outcomes: (K,) how each run ended, in one word.
        reason: why runs were refused, or why there are none; empty otherwise.
    """

    label: str
    numbers: Mapping[str, Array] = {}
    outcomes: tuple[str, ...] = ()
    reason: str = ""

    @property
    def ended(self) -> Counter[str]:
        """How many runs ended in which way."""
        return Counter(self.outcomes)

    @property
    def settled(self) -> int:
        """How many runs completed with all followers settled."""
        times = self.numbers["worst_settling_time"]
        return int(np.sum((np.array(self.outcomes) == _COMPLETED) & np.isfinite(times)))

    def ranked(self, name: str) -> Array:
        """Return a number of all runs; one that does not exist counts as worse than any."""
        worst = -np.inf if RUN_NUMBERS[name].more_is_better else np.inf
        return np.where(np.isnan(self.numbers[name]), worst, self.numbers[name])

    def quantiles(self, name: str) -> tuple[float, ...]:
        """Return the quantiles of `LEVELS`, each the number of some run."""
        return observed_quantiles(self.ranked(name), LEVELS)


class PairedDifference(NamedTuple):
    """A number of a method less that of another, seed by seed.

    Attributes:
        number: its name.
        first, second: the labels of the methods.
        median: of the differences; NaN if no seed has one.
        interval: contains the median of all seeds with 95 %, by the sign test; None for too few.
        better: on how many seeds the first and the second is better; neither on the others.
        seeds: how many there are.
    """

    number: str
    first: str
    second: str
    median: float
    interval: tuple[float, float] | None
    better: tuple[int, int]
    seeds: int


class SeedComparison(NamedTuple):
    """Methods on the same seeds: the same starts, and the same draws of noise and network.

    Attributes:
        scenario: its name.
        seeds: (K,).
        rows: one for each method.
        horizon: s, the same for all.
        conditions: wind and plant, in words.
        length_unit: of the errors; empty without a position.
    """

    scenario: str
    seeds: tuple[int, ...]
    rows: tuple[MethodSeeds, ...]
    horizon: float
    conditions: tuple[str, ...]
    length_unit: str

    @property
    def compared(self) -> list[MethodSeeds]:
        """The methods that ran."""
        return [row for row in self.rows if row.outcomes]

    @property
    def names(self) -> list[str]:
        """The numbers that some run has."""
        return [
            name
            for name in NUMBERS
            if any(np.isfinite(row.numbers[name]).any() for row in self.compared)
        ]

    def unit(self, name: str) -> str:
        """Return the unit of a number."""
        return RUN_NUMBERS[name].unit.replace(ERROR, self.length_unit)

    def differences(self) -> Iterator[PairedDifference]:
        """Yield the differences of all pairs of methods in all numbers."""
        for name, pair in itertools.product(self.names, itertools.combinations(self.compared, 2)):
            yield _paired(name, *pair)

    def dataset(self) -> "xr.Dataset":
        """Return the numbers and outcomes of all runs, with the dimensions method and seed."""
        import xarray as xr

        rows, over = self.compared, ("method", "seed")
        variables = {
            name: (
                over,
                np.stack([row.numbers[name] for row in rows]),
                {"long_name": RUN_NUMBERS[name].meaning, "units": self.unit(name)},
            )
            for name in self.names
        }
        outcomes = np.array([row.outcomes for row in rows], object)
        labels = np.array([row.label for row in rows], object)
        coordinates = {"method": labels, "seed": list(self.seeds)}
        about = {"scenario": self.scenario, "horizon_s": self.horizon}
        return xr.Dataset({**variables, "outcome": (over, outcomes)}, coordinates, about)


_COMPLETED = Outcome.COMPLETED.name.lower()


def observed_quantiles(values: Array, levels: Sequence[float]) -> tuple[float, ...]:
    """Return quantiles that are members of `values`, infinite ones too; NaN of no values."""
    ordered = np.sort(values)
    if not len(ordered):
        return (np.nan,) * len(levels)
    places = np.maximum(np.ceil(np.multiply(levels, len(ordered)) - 1e-9).astype(int), 1) - 1
    return tuple(ordered[places].tolist())


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
    """Return a number less that of another method on each seed, without those that neither has."""
    mine, other = first.ranked(name), second.ranked(name)
    some = np.isfinite(mine) | np.isfinite(other)
    return mine[some] - other[some]


def _paired(name: str, first: MethodSeeds, second: MethodSeeds) -> PairedDifference:
    mine, other = first.ranked(name), second.ranked(name)
    sign = -1.0 if RUN_NUMBERS[name].more_is_better else 1.0
    better = int(np.sum(sign * mine < sign * other)), int(np.sum(sign * mine > sign * other))
    found = differences(name, first, second)
    (median,) = observed_quantiles(found, [0.5])
    interval = median_interval(found)
    return PairedDifference(name, first.label, second.label, median, interval, better, len(mine))


def compare_seeds(
    scenario: ScenarioLike,
    seeds: Iterable[int],
    built: Experiment | None = None,
    only: Sequence[str] | None = None,
    progress: Callable[[str, float, int], None] = lambda label, done, methods: None,
) -> SeedComparison:
    """Run each method on a scenario with the same seeds: the same starts, noise and messages.

    Args:
        scenario: as in `compare`.
        seeds: of the runs.
        built: its parts and settings; built if None.
        only: as in `compare`; by default the laws, without methods that optimize.
        progress: as in `compare`.

    A run that diverges or is refused has no errors, and counts as worse than all that have.

    Raises:
        ScenarioError: a part cannot be built.
        LawError: no seed is given, one twice, or too many for the memory.
    """
    scenario, seeds = as_scenario(scenario), tuple(map(int, seeds))
    only = known_labels(None, slow=False) if only is None else only
    _check(seeds, len(only))
    parts, settings = build(scenario) if built is None else built
    settings = settings._replace(store_every=-(-settings.steps // _FRAMES))
    drawn = _Drawn(parts, settings, seeds)
    rows = list[MethodSeeds]()

    def fly(label: str, drive: DriveOf) -> Controller | None:
        def part(done: float) -> None:
            progress(label, len(rows) + done, len(only))

        try:
            part(0.0)
            row, flown = drawn.row(label, drive, part)
        except EchelonError as error:
            row, flown = MethodSeeds(label, reason=str(error)), None
        except KeyboardInterrupt:
            row, flown = MethodSeeds(label, reason=INTERRUPTED), None
        rows.append(row)
        return flown

    run_each(scenario, parts, only, fly)
    about = settings.horizon, conditions_of(parts), drawn.unit
    return SeedComparison(scenario.name, seeds, tuple(rows), *about)


def _check(seeds: Sequence[int], methods: int) -> None:
    if not seeds or len({*seeds}) < len(seeds) or min(seeds) < 0:
        raise LawError("`--seeds` must be one or more different whole numbers from 0 on.")
    excess = excess_runs(len(seeds) * methods)
    if excess is not None:
        raise LawError(f"`--seeds`: {excess}.")


@final
class _Drawn:
    """The starts of a scenario's drive for each seed, which all methods have in common."""

    def __init__(self, parts: Parts, settings: Settings, seeds: Sequence[int]) -> None:
        self.parts, self.seeds, self.batch, self.unit = parts, seeds, Batch(), ""
        self.settings = [settings._replace(seed=seed) for seed in seeds]
        self.states = self._starts(parts)
        each = _AGENT_STEPS // (settings.steps * parts.graph.agents)
        self.size = int(np.clip(each, 16, 1000))

    def _starts(self, parts: Parts) -> Array:
        with precision("float64"):
            drive = parts.drive.prepare(parts.model, parts.graph.before)
            return Starts(parts.replace(drive=drive)).of(self.seeds)

    def _at(self, k: int) -> Parts:
        # The states contain the leader's error already.
        return self.parts.replace(initial=self.states[k], start_error={})

    def _runs(self, drive: DriveOf) -> list[Run]:
        """Return the runs of a method; of the same parts where neither drive nor start differs."""
        ends = [drive(self._at(k), self.settings[k]) for k in (0, -1)]
        whole = self.parts.replace(drive=ends[0])
        if eqx.tree_equal(*ends) and np.array_equal(self._starts(whole), self.states):
            return [(whole, settings) for settings in self.settings]
        return [
            (self._at(k).replace(drive=drive(self._at(k), settings)), settings)
            for k, settings in enumerate(self.settings)
        ]

    def row(
        self, label: str, drive: DriveOf, part: Callable[[float], None]
    ) -> tuple[MethodSeeds, Controller | None]:
        """Return the runs of a method, and the drive that flew, of the first if they differ."""
        runs, flown = self._runs(drive), None
        numbers: dict[str, list[float]] = {name: [] for name in NUMBERS}
        outcomes, reason = list[str](), ""
        for first in range(0, len(runs), self.size):
            some = runs[first : first + self.size]

            def report(done: int, steps: int, before: int = first, of: int = len(some)) -> None:
                part((before + of * done / steps) / len(runs))

            for result in self.batch.fly(some, report):
                if isinstance(result, EchelonError):
                    reason = reason or str(result)
                elif result.outcome in (Outcome.INTERRUPTED, Outcome.STOPPED):
                    raise KeyboardInterrupt
                else:
                    flown, self.unit = flown or result.drive, result.length_unit
                for name, number in _numbers(result):
                    numbers[name].append(number)
                outcomes.append(_ended(result))
        if flown is None:
            return MethodSeeds(label, reason=reason), None
        arrays = {name: np.array(values) for name, values in numbers.items()}
        return MethodSeeds(label, arrays, tuple(outcomes), reason), flown


def _ended(result: Result | EchelonError) -> str:
    return REFUSED if isinstance(result, EchelonError) else result.outcome.name.lower()


def _numbers(result: Result | EchelonError) -> Iterator[tuple[str, float]]:
    run = None if isinstance(result, EchelonError) else RunNumbers(result, metrics(result))
    for name in NUMBERS:
        number = None if run is None else run.number(name)
        yield name, np.nan if number is None else float(number)
