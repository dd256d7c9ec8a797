"""The plan of a sweep: its runs, and the order in which they are computed."""

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from echelon.core.errors import ScenarioError
from echelon.core.limits import excess_runs
from echelon.experiments.scenario.scenario import Scenario, with_overrides
from echelon.experiments.sweeps.axes import SEED, Axis

if TYPE_CHECKING:
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.sweeps.frame_shape import FrameShape

_SHAPING = ("model", "graph", "simulation")
"""The sections on which agents, states and times of a run depend."""


class SweepRun(NamedTuple):
    """A run of a sweep.

    Attributes:
        place: the index of its value on each axis.
        case: number of its case; runs of one case differ only in the seed.
        seed: its seed; None for the scenario's.
    """

    place: tuple[int, ...]
    case: int
    seed: int | None


@final
class Sweep:
    """A scenario in all combinations of the values of some of its keys.

    Runs are numbered with the seeds running fastest, whatever the order of the axes, since runs
    that differ only in the seed are built once.

    Args:
        scenario: what does not vary.
        axes: the keys that vary, with their values.
        every: store the states and inputs of every so-manieth step of each run; None stores none.

    Raises:
        ScenarioError: there are too many runs, or a value makes a scenario with faults; or states
            are stored, and a value changes the agents, states or times of a run.
        SimulationError: the engine cannot step the first run.
    """

    def __init__(
        self, scenario: Scenario, axes: tuple[Axis, ...], every: int | None = None
    ) -> None:
        """Check all values, each with the first ones of the other axes."""
        self.scenario, self.axes, self.every = scenario, axes, every
        if every is not None and every < 1:
            raise ScenarioError(f"`keep_states` is {every}, and must be a whole number from 1 on.")
        self._check_size(0)
        for axis in axes:
            # A seed is a whole number from 0 on: if the ends of a range are, all are.
            ends = axis.key == SEED and isinstance(axis.values, range)
            last = len(axis.values) - 1
            for k in {0, last} if ends else range(last + 1):
                self._varied([a.override(k if a is axis else 0) for a in axes])
        self._check_size(self._columns())
        self._check_frames()

    def __getstate__(self) -> dict[str, object]:
        """Return what a worker needs, which builds the parts by itself."""
        return {name: value for name, value in vars(self).items() if name != "first_built"}

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
        indices = np.unravel_index(number, [self.shape[k] for k in self.order])
        place = dict(zip(self.order, map(int, indices), strict=True))
        seeds = (int(a.values[place[k]]) for k, a in enumerate(self.axes) if a.key == SEED)
        by_axis = tuple(place[k] for k in range(len(self.axes)))
        return SweepRun(by_axis, number // self.seeds, next(seeds, None))

    def runs(self, first: int, count: int) -> Iterator[SweepRun]:
        """Yield runs by their numbers."""
        return map(self.run, range(first, first + count))

    def case(self, place: tuple[int, ...]) -> Scenario:
        """Return the scenario of a run, with the first of the seeds."""
        chosen = zip(self.axes, place, strict=True)
        return self._varied([a.override(0 if a.key == SEED else k) for a, k in chosen])

    def _varied(self, overrides: list[str]) -> Scenario:
        try:
            return with_overrides(self.scenario, overrides)
        except ScenarioError as error:
            # Name the option that was used: `--set` has the same texts.
            text = str(error)
            for axis in self.axes:
                text = text.replace(f"--set {axis.key}=", f"--over {axis.key}=")
            raise ScenarioError(text) from error

    def _check_size(self, numbers: int) -> None:
        excess = excess_runs(self.count, numbers)
        if excess is not None:
            raise ScenarioError(f"the sweep is too large: {excess}.")

    @cached_property
    def first_built(self) -> "Experiment":
        """The parts and settings of the first case."""
        from echelon.experiments.scenario.build import build
        from echelon.simulation.engine.prepare import check_engine

        first = build(self.case((0,) * len(self.axes)))
        check_engine(*first)
        return first

    @cached_property
    def frames(self) -> "FrameShape | None":
        """The frames that are stored of each run; None if none are."""
        from echelon.experiments.sweeps.frame_shape import FrameShape

        return None if self.every is None else FrameShape.of(self.first_built, self.every)

    def _check_frames(self) -> None:
        """Check that all values of the keys on which the shape of a run depends leave it."""
        if self.frames is None or self.every is None:
            return
        from echelon.experiments.scenario.build import build

        for place, axis in enumerate(self.axes):
            if axis.key.partition(".")[0] not in _SHAPING:
                continue
            for k in range(1, len(axis.values)):
                case = self.case(tuple(k if at == place else 0 for at in range(len(self.axes))))
                self.frames.check(type(self.frames).of(build(case), self.every), axis.key)

    def _columns(self) -> int:
        """Return how many values are stored of a run, without its frames."""
        from echelon.experiments.sweeps.numbers import AGENT_COLUMNS, RUN_COLUMNS, WORDS

        agents = self.first_built.parts.graph.agents
        return len(RUN_COLUMNS) + len(WORDS) + len(AGENT_COLUMNS) * agents
