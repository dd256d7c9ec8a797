"""Runs a sweep: a scenario with all combinations of values of some of its keys."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from echelon.core.errors import ScenarioError
from echelon.core.limits import excess_runs
from echelon.experiments.scenario.scenario import ScenarioLike, as_scenario
from echelon.experiments.sweeps.plan import Sweep, axes_of
from echelon.experiments.sweeps.sweep_dataset import SweepBatch, dataset_of
from echelon.experiments.sweeps.workers import Workers

if TYPE_CHECKING:
    import xarray as xr

Progress: TypeAlias = Callable[[int, int], None]
"""Called during the computation, with the runs done and the runs in total."""
Keep: TypeAlias = Callable[[SweepBatch], None]
"""Called with every batch as soon as it is computed."""


def sweep(
    scenario: ScenarioLike,
    over: Mapping[str, Iterable[Any]],
    threads: int | None = None,
    keep_states: int | None = None,
) -> "xr.Dataset":
    """Run a scenario with all combinations of values of some of its keys.

    Args:
        scenario: the keys that do not vary: a scenario, its name, its file, or a mapping.
        over: the values of each key, such as `{"seed": range(100), "follower.gain.coupling": [1,
            2]}`; a key's parts are joined by dots.
        threads: threads of native code; by default one for each processor. No number depends on
            them.
        keep_states: store the states and inputs of every so-manieth step of each run, and of its
            end; by default none.

    Returns:
        A dataset with a dimension for each key, and `agent`: outcomes, errors, settling times,
        saturation, and the guarantee of each run. With `keep_states` also `states` (key, .., time,
        agent, state) and `inputs` (key, .., time, agent, input), NaN after the end of a run that
        ended early.

    Raises:
        ScenarioError: a key is unknown, a value is not allowed, or there are too many runs or
            stored states; or states are stored, and a value changes their number or times.
    """
    plan = Sweep(as_scenario(scenario), axes_of(over), keep_states)
    excess = None if plan.frames is None else excess_runs(plan.count, plan.frames.numbers)
    if excess is not None:
        raise ScenarioError(f"the sweep is too large: {excess}; `echelon sweep` stores on disk.")
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
    """Compute the runs of a sweep that are in no batch yet.

    `keep` takes every batch; an error that `progress` raises, called often, ends the sweep.

    Raises:
        KeyboardInterrupt: Ctrl-C; all batches that `keep` received are complete.
        EchelonError: the cluster does not answer, or a batch fails on it.
    """
    workers, done = Workers(plan, threads), sum(batch.runs for batch in before)

    def report(_: int = 0, __: int = 0) -> None:
        if progress is not None:
            progress(done, plan.count)

    report()
    todo = list(_missing(plan.count, before, workers.size, plan.seeds))
    batches: Iterator[SweepBatch] = (workers.batch(*batch, report) for batch in todo)
    if cluster is not None:
        # Here, since it needs an extra.
        from echelon.experiments.sweeps.cluster import fly_on

        batches = fly_on(cluster, plan, todo, report)
    for batch in batches:
        keep(batch)
        done += batch.runs
        report()


def _missing(
    runs: int, before: Sequence[SweepBatch], size: int, seeds: int = 1
) -> Iterator[tuple[int, int]]:
    """Cases with more seeds than a batch has runs share no batch; no batch splits other cases."""
    whole = seeds if seeds > size else size - size % seeds
    at = 0
    for first, end in [*sorted((b.first, b.first + b.runs) for b in before), (runs, runs)]:
        while at < first:
            # The same batches as without an interruption, so that numbers agree to the bit.
            begun = at - at % whole
            inner = at - (at - begun) % size + size
            count = min(first, inner, begun + whole) - at
            yield at, count
            at += count
        at = max(at, end)
