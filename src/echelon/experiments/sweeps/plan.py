"""Which runs a sweep has, and in which order they are computed."""

from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple, final

import numpy as np

from echelon.core.errors import ScenarioError
from echelon.core.limits import excess_runs
from echelon.experiments.scenario.scenario import Scenario, varied
from echelon.experiments.sweeps.axes import SEED, Axis

NUMBERS, OF_AGENT = 16, 6
"""That are kept of a run, and of each of its agents."""


class SweepRun(NamedTuple):
    """A run of a sweep.

    Attributes:
        place: the number of its value on each axis.
        case: number of what it shares with those that differ in the seed alone.
        seed: its seed; None where the scenario says it.
    """

    place: tuple[int, ...]
    case: int
    seed: int | None


@final
class Sweep:
    """A scenario in all combinations of the values of some of its keys.

    Runs are numbered with the seeds running fastest, wherever they stand among the axes, since what
    differs in its seed alone is built once.

    Args:
        scenario: what does not vary.
        axes: what does.

    Raises:
        ScenarioError: there are too many runs, or a value makes a scenario with faults.
    """

    def __init__(self, scenario: Scenario, axes: tuple[Axis, ...]) -> None:
        """Check all values, each with the first ones of the other axes."""
        self.scenario, self.axes = scenario, axes
        self._check_size(0)
        for axis in axes:
            # A seed is a whole number from 0 on: if the ends of a range are, all are.
            ends = axis.key == SEED and isinstance(axis.values, range)
            last = len(axis.values) - 1
            for k in {0, last} if ends else range(last + 1):
                self._varied([a.override(k if a is axis else 0) for a in axes])
        self._check_size(NUMBERS + OF_AGENT * self._agents())

    @property
    def shape(self) -> tuple[int, ...]:
        """How many values each axis has."""
        return tuple(len(axis.values) for axis in self.axes)

    @property
    def count(self) -> int:
        """How many runs there are."""
        return int(np.prod([1, *self.shape], dtype=object))

    @property
    def seeds(self) -> int:
        """How many runs each case has."""
        return int(np.prod([len(axis.values) for axis in self.axes if axis.key == SEED]))

    @cached_property
    def order(self) -> list[int]:
        """The axes from the slowest to the fastest, seeds last."""
        return sorted(range(len(self.axes)), key=lambda k: self.axes[k].key == SEED)

    def run(self, number: int) -> SweepRun:
        """Return a run by its number."""
        found = np.unravel_index(number, [self.shape[k] for k in self.order])
        place = dict(zip(self.order, map(int, found), strict=True))
        drawn = (int(a.values[place[k]]) for k, a in enumerate(self.axes) if a.key == SEED)
        here = tuple(place[k] for k in range(len(self.axes)))
        return SweepRun(here, number // self.seeds, next(drawn, None))

    def runs(self, first: int, count: int) -> Iterator[SweepRun]:
        """Yield runs by their numbers."""
        return map(self.run, range(first, first + count))

    def case(self, place: tuple[int, ...]) -> Scenario:
        """Return the scenario of a run, with the first of the seeds."""
        wanted = [0 if a.key == SEED else k for a, k in zip(self.axes, place, strict=True)]
        return self._varied([a.override(k) for a, k in zip(self.axes, wanted, strict=True)])

    def _varied(self, overrides: list[str]) -> Scenario:
        try:
            return varied(self.scenario, overrides)
        except ScenarioError as error:
            # The option's own name: the same texts come from `--set` too.
            text = str(error)
            for axis in self.axes:
                text = text.replace(f"--set {axis.key}=", f"--over {axis.key}=")
            raise ScenarioError(text) from error

    def _check_size(self, numbers: int) -> None:
        excess = excess_runs(self.count, numbers)
        if excess is not None:
            raise ScenarioError(f"the sweep is too large: {excess}.")

    def _agents(self) -> int:
        from echelon.experiments.scenario.build import build

        return build(self.case((0,) * len(self.axes))).parts.graph.agents
