"""The verb: all runs of a sweep, batch by batch."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.sweeps.axes import axes_of
from echelon.experiments.sweeps.plan import Sweep
from echelon.experiments.sweeps.sweep_dataset import dataset_of
from echelon.experiments.sweeps.workers import SweepBatch, Workers

if TYPE_CHECKING:
    import xarray as xr

Progress: TypeAlias = Callable[[int, int], None]
"""Called between two stretches of computing, with the runs done and the runs in all."""
Keep: TypeAlias = Callable[[SweepBatch], None]
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
    batches = list[SweepBatch]()
    compute(plan, batches.append, threads=threads)
    return dataset_of(plan, batches)


def compute(
    plan: Sweep,
    keep: Keep,
    progress: Progress | None = None,
    before: Sequence[SweepBatch] = (),
    threads: int | None = None,
    cluster: str | None = None,
) -> None:
    """Compute the runs of a sweep that no batch holds yet.

    Args:
        plan: the sweep.
        keep: takes every batch.
        progress: called several times a second; what it raises ends the sweep.
        before: batches that are there already.
        threads: as in `sweep`.
        cluster: address of a dask scheduler, whose workers compute the batches; this process does
            when left out.

    Raises:
        KeyboardInterrupt: Ctrl-C; all batches that were kept are whole.
        EchelonError: the cluster cannot be reached, or gives up.
    """
    crew, done = Workers(plan, threads), sum(batch.runs for batch in before)

    def told(_: int = 0, __: int = 0) -> None:
        if progress is not None:
            progress(done, plan.count)

    told()
    todo = list(_missing(plan.count, before, crew.size, plan.seeds))
    made: Iterator[SweepBatch] = (crew.batch(*each, told) for each in todo)
    if cluster is not None:
        # Here, since it comes with an extra.
        from echelon.experiments.sweeps.cluster import fly_on

        made = fly_on(cluster, plan, todo, told)
    for batch in made:
        keep(batch)
        done += batch.runs
        told()


def _missing(
    runs: int, before: Sequence[SweepBatch], size: int, seeds: int = 1
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
