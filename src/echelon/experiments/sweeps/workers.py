"""What computes the runs of a sweep, batch by batch."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple, final

from echelon.core.errors import EchelonError, Outcome
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.sweeps.numbers import Columns, columns_of, numbers_of, refused
from echelon.experiments.sweeps.plan import Sweep, SweepRun
from echelon.guarantees.promises.promise import Promise, promises
from echelon.simulation.engine.batch import Batch, StepCount
from echelon.simulation.engine.result import Result
from echelon.simulation.native import is_installed

_AGENT_STEPS, _MOST, _LEAST = 20_000_000, 2_500, 16
"""Of a batch: a second or two of native code, and as many runs as a vector has lanes."""
_SLOWER = 20
"""How many times slower JAX is."""
_FRAMES = 20
"""That a run is looked at: for what is not finite, or beyond the range of native code."""


class SweepBatch(NamedTuple):
    """Some runs of a sweep, one after the other: the number of the first, and what they came to."""

    first: int
    columns: Columns

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return len(self.columns["outcome"])


@final
class Workers:
    """Computes the runs of a sweep, batch by batch; a case is built once for its seeds.

    Args:
        plan: the sweep.
        threads: as in `sweep`.
    """

    def __init__(self, plan: Sweep, threads: int | None = None) -> None:
        """Build the first case."""
        self.plan, self.fleet = plan, Batch(threads)
        first = build(plan.case((0,) * len(plan.axes)))
        self._last: tuple[int, Experiment | str] = 0, first
        settings, graph = first.settings, first.parts.graph
        fast = settings.engine != "jax" and is_installed()
        most, least = (_AGENT_STEPS, _LEAST) if fast else (_AGENT_STEPS // _SLOWER, 1)
        self.size = max(least, min(_MOST, most // (settings.steps * graph.agents)))

    def batch(self, first: int, count: int, told: StepCount) -> SweepBatch:
        """Return what some runs come to; `told` is called several times a second.

        Raises:
            KeyboardInterrupt: Ctrl-C.
        """
        built = [self._built(run) for run in self.plan.runs(first, count)]
        flown = [each for each in built if not isinstance(each, str)]
        results, told_of = self.fleet.fly(flown, told), _promised(flown)
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
            told(0, 0)
        return SweepBatch(first, columns_of(rows))

    def _built(self, run: SweepRun) -> Experiment | str:
        """Return the parts and settings of a run, or why they cannot be made."""
        if self._last[0] != run.case:
            try:
                made: Experiment | str = build(self.plan.case(run.place))
            except EchelonError as error:
                made = str(error)
            self._last = run.case, made
        made = self._last[1]
        if isinstance(made, str):
            return made
        settings = made.settings
        settings = settings if run.seed is None else settings._replace(seed=run.seed)
        return Experiment(made.parts, settings._replace(store_every=-(-settings.steps // _FRAMES)))


def _promised(built: Sequence[Experiment]) -> Iterator[Promise | EchelonError]:
    """Yield what is promised of runs, of which neighbours often differ in the seed alone."""
    for _, alike in groupby(built, key=lambda each: id(each.parts)):
        runs = list(alike)
        # A dataset has no place for what motors give.
        yield from promises(runs[0].parts, [each.settings for each in runs], brief=True)
