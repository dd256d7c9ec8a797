"""The verb: all runs of a sweep, batch by batch."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, final

from echelon.core.errors import EchelonError, Outcome
from echelon.engine.many import Fleet
from echelon.engine.result import Result
from echelon.kernels import is_installed
from echelon.promises.promise import Promise, promises
from echelon.scenario.build import Built, build
from echelon.scenario.scenario import Scenario
from echelon.sweeps.axes import axes_of
from echelon.sweeps.dataset import dataset_of
from echelon.sweeps.numbers import Columns, columns_of, numbers_of, refused
from echelon.sweeps.plan import Run, Sweep

if TYPE_CHECKING:
    import xarray as xr

_AGENT_STEPS, _MOST, _LEAST = 20_000_000, 2_500, 16
"""Of a batch: a second or two of native code, and as many runs as a vector has lanes."""
_SLOWER = 20
"""How many times slower JAX is."""
_FRAMES = 20
"""That a run is looked at: for what is not finite, or beyond the range of native code."""


class Batch(NamedTuple):
    """Some runs of a sweep, one after the other: the number of the first, and what they came to."""

    first: int
    columns: Columns

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return len(self.columns["outcome"])


Progress: TypeAlias = Callable[[int, int], None]
"""Called between two stretches of computing, with the runs done and the runs in all."""
Keep: TypeAlias = Callable[[Batch], None]
"""Called with every batch as soon as it is there."""


def sweep(
    scenario: Scenario, over: Mapping[str, Iterable[Any]], threads: int | None = None
) -> "xr.Dataset":
    """Run a scenario with all combinations of values of some of its keys.

    Args:
        scenario: what does not vary.
        over: the values of each key, such as `{"seed": range(100), "follower.gain.coupling": [1,
            2]}`; a key's parts are joined by dots.
        threads: on which native code runs; one for each processor when left out. No number depends
            on it.

    Returns:
        A dataset with a dimension for each key, and `agent`: outcomes, errors, settling times,
        saturation, and what is promised of each run.

    Raises:
        ScenarioError: a key is unknown, a value is no value of it, or there are too many runs.
    """
    plan = Sweep(scenario, axes_of(over))
    batches = list[Batch]()
    compute(plan, batches.append, threads=threads)
    return dataset_of(plan, batches)


def compute(
    plan: Sweep,
    keep: Keep,
    progress: Progress | None = None,
    before: Sequence[Batch] = (),
    threads: int | None = None,
) -> None:
    """Compute the runs of a sweep that no batch holds yet.

    Args:
        plan: the sweep.
        keep: takes every batch.
        progress: called several times a second; what it raises ends the sweep.
        before: batches that are there already.
        threads: as in `sweep`.

    Raises:
        KeyboardInterrupt: Ctrl-C; all batches that were kept are whole.
    """
    cases, fleet = _Cases(plan), Fleet(threads)
    done = sum(batch.runs for batch in before)

    def told(_: int = 0, __: int = 0) -> None:
        if progress is not None:
            progress(done, plan.count)

    told()
    for first, count in _missing(plan.count, before, cases.size, plan.seeds):
        keep(Batch(first, columns_of(_rows(fleet, cases, first, count, told))))
        done += count
        told()


def _missing(
    runs: int, before: Sequence[Batch], size: int, seeds: int = 1
) -> Iterator[tuple[int, int]]:
    """Yield the batches (first, count) that are to do, of so many runs.

    Of more seeds than a batch holds none shares a batch with another case's; else all of a case
    are in one.
    """
    whole = seeds if seeds > size else size - size % seeds
    at = 0
    for first, end in [*sorted((b.first, b.first + b.runs) for b in before), (runs, runs)]:
        while at < first:
            # Cut where batches begin, so that the same runs are computed together as without a
            # break, to the same bits.
            begun = at - at % whole
            inner = at - (at - begun) % size + size
            count = min(first, inner, begun + whole) - at
            yield at, count
            at += count
        at = max(at, end)


@final
class _Cases:
    """The scenarios of a sweep but for their seeds, each built once."""

    def __init__(self, plan: Sweep) -> None:
        self.plan = plan
        self.last: tuple[int, Built | str] = 0, build(plan.case((0,) * len(plan.axes)))
        settings, graph = self.last[1].settings, self.last[1].parts.graph
        fast = settings.engine != "jax" and is_installed()
        most, least = (_AGENT_STEPS, _LEAST) if fast else (_AGENT_STEPS // _SLOWER, 1)
        self.size = max(least, min(_MOST, most // (settings.steps * graph.agents)))

    def built(self, run: Run) -> Built | str:
        """Return the parts and settings of a run, or why they cannot be made."""
        if self.last[0] != run.case:
            try:
                made: Built | str = build(self.plan.case(run.place))
            except EchelonError as error:
                made = str(error)
            self.last = run.case, made
        made = self.last[1]
        if isinstance(made, str):
            return made
        settings = made.settings
        settings = settings if run.seed is None else settings._replace(seed=run.seed)
        return Built(made.parts, settings._replace(store_every=-(-settings.steps // _FRAMES)))


def _rows(
    fleet: Fleet, cases: _Cases, first: int, count: int, told: Callable[..., None]
) -> list[dict[str, Any]]:
    """Return what some runs came to."""
    built = [cases.built(run) for run in cases.plan.runs(first, count)]
    flown = [each for each in built if not isinstance(each, str)]
    results, told_of = fleet.fly(flown, told), _promised(flown)
    rows = list[dict[str, Any]]()
    for each in built:
        found = each if isinstance(each, str) else next(results)
        before = None if isinstance(each, str) else next(told_of)
        if isinstance(found, Result) and isinstance(before, Promise):
            if found.outcome in (Outcome.INTERRUPTED, Outcome.STOPPED):
                raise KeyboardInterrupt
            rows.append(numbers_of(found, before))
        else:
            rows.append(refused(str(before if isinstance(found, Result) else found)))
        told()
    return rows


def _promised(built: Sequence[Built]) -> Iterator[Promise | EchelonError]:
    """Yield what is promised of runs, of which neighbours often differ in the seed alone."""
    for _, alike in groupby(built, key=lambda each: id(each.parts)):
        runs = list(alike)
        try:
            yield from promises(runs[0].parts, [each.settings for each in runs])
        except EchelonError as error:
            yield from [error] * len(runs)
