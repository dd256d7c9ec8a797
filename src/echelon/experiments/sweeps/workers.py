"""Computes the runs of a sweep, batch by batch."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import final

from echelon.core.errors import EchelonError, Outcome
from echelon.core.types import JsonObject
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.sweeps.plan import Sweep, SweepRun
from echelon.experiments.sweeps.sweep_dataset import SweepBatch, columns_of, numbers_of, refused
from echelon.guarantees.promises.promise import Guarantee, promises
from echelon.simulation.engine.batch import FRAMES, Batch, StepCount, batch_size
from echelon.simulation.engine.result import Result


@final
class Workers:
    """Computes the runs of a sweep, batch by batch; a case is built once for its seeds."""

    def __init__(self, plan: Sweep, threads: int | None = None) -> None:
        self.plan, self.runs = plan, Batch(threads)
        first = plan.first_built
        self._last: tuple[int, Experiment | str] = 0, first
        stored = None if plan.frames is None else plan.frames.numbers
        self.size = batch_size(*first, stored)

    def batch(self, first: int, count: int, progress: StepCount) -> SweepBatch:
        """Return the numbers of some runs; `progress` is called several times a second.

        Raises:
            KeyboardInterrupt: Ctrl-C.
        """
        runs = [self._build(run) for run in self.plan.runs(first, count)]
        valid = [run for run in runs if not isinstance(run, str)]
        results, guarantees = self.runs.fly(valid, progress), _promises(valid)
        rows, flown = list[JsonObject](), list[Result | None]()
        for run in runs:
            result = run if isinstance(run, str) else next(results)
            guarantee = None if isinstance(run, str) else next(guarantees)
            if isinstance(result, Result) and isinstance(guarantee, Guarantee):
                if result.outcome in (Outcome.INTERRUPTED, Outcome.STOPPED):
                    raise KeyboardInterrupt
                rows.append(numbers_of(result, guarantee))
                flown.append(result)
            else:
                flown.append(None)
                rows.append(refused(str(guarantee if isinstance(result, Result) else result)))
            progress(0, 0)
        frames = None if self.plan.frames is None else self.plan.frames.stored(flown)
        return SweepBatch(first, columns_of(rows), frames)

    def _build(self, run: SweepRun) -> Experiment | str:
        if self._last[0] != run.case:
            try:
                case: Experiment | str = build(self.plan.case(run.place))
            except EchelonError as error:
                case = str(error)
            self._last = run.case, case
        case = self._last[1]
        if isinstance(case, str):
            return case
        settings = case.settings
        settings = settings if run.seed is None else settings._replace(seed=run.seed)
        every = self.plan.every or -(-settings.steps // FRAMES)
        return Experiment(case.parts, settings._replace(store_every=every))


def _promises(experiments: Sequence[Experiment]) -> Iterator[Guarantee | EchelonError]:
    """Yield the promises of runs; consecutive runs often differ only in the seed."""
    for _, same_parts in groupby(experiments, key=lambda experiment: id(experiment.parts)):
        runs = list(same_parts)
        yield from promises(runs[0].parts, [run.settings for run in runs], brief=True)
