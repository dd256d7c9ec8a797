"""The plan of a sweep: its axes, its runs in the order of computing, and what is stored of each."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import chain, combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, final

import numpy as np

from echelon.core.errors import ScenarioError
from echelon.core.limits import excess_runs
from echelon.experiments.results.run_numbers import AGENT_NUMBERS, RUN_NUMBERS, Appearance, shown_in
from echelon.experiments.scenario.scenario import Scenario, with_overrides
from echelon.experiments.scenario.yaml import inline_yaml, plain, read_yaml

if TYPE_CHECKING:
    from echelon.core.types import Array
    from echelon.experiments.scenario.build import Experiment
    from echelon.simulation.engine.result import Result

RUN_COLUMNS = tuple(shown_in(RUN_NUMBERS, Appearance.SWEEP))
AGENT_COLUMNS = tuple(shown_in(AGENT_NUMBERS, Appearance.SWEEP))
SUMMARIZED = tuple(shown_in(RUN_NUMBERS, Appearance.DISTRIBUTION))
"""The numbers that reports and figures show the distribution of."""
UNIT = "error_unit"
WORDS = (
    *("message", "promise_verdict", "promise_kind", "promise_theorem", "promise_against"),
    *("engine", "warnings", UNIT),
)
"""The columns of each run: numbers of it, numbers of its agents, and texts."""
_SHAPING = ("model", "agents", "graph", "simulation")
"""The sections on which agents, states and times of a run depend."""
StoredFrames: TypeAlias = "Mapping[str, Array]"
"""`states` (runs, T, N, n) and `inputs` (runs, T, N, m); NaN where a run has none."""
NAMES = ("states", "inputs")
SEED = "seed"
"""The key that changes only random draws."""
_RANGE = re.compile(r"(-?[0-9]{1,18})\.\.(-?[0-9]{1,18})")


class Axis(NamedTuple):
    """A key of a scenario, its parts joined by dots, and its values in their order."""

    key: str
    values: Sequence[Any]

    def override(self, k: int) -> str:
        """Return the override that sets value k."""
        return f"{self.key}={inline_yaml(self.values[k])}"

    @property
    def text(self) -> str:
        """The axis as an argument of the command line."""
        if isinstance(self.values, range) and self.values.step == 1 and len(self.values) > 1:
            return f"{self.key}={self.values[0]}..{self.values[-1]}"
        return f"{self.key}={inline_yaml(list(self.values))[1:-1]}"


def read_axes(texts: Iterable[str]) -> tuple[Axis, ...]:
    """Return axes from texts such as `seed=0..9999` and `follower.gain.coupling=1,2,4`.

    Raises:
        ScenarioError: an axis is malformed, or a key has two.
    """
    return _checked([_read(text) for text in texts])


def axes_of(values: Mapping[str, Iterable[Any]]) -> tuple[Axis, ...]:
    """Return axes from values by key.

    Raises:
        ScenarioError: a key has no list of values, or a value twice; or one key is inside another.
    """
    for key, v in values.items():
        if isinstance(v, str) or not isinstance(v, Iterable):
            raise ScenarioError(f"--over {key}: got {v!r}, allowed is a list of values, as [1, 2].")
    return _checked(
        [
            Axis(key, v if isinstance(v, range) else tuple(map(plain, v)))
            for key, v in values.items()
        ]
    )


def _checked(axes: list[Axis]) -> tuple[Axis, ...]:
    if not axes:
        raise ScenarioError("got nothing to vary; give a key and its values, as in `seed=0..9`.")
    for axis in axes:
        place = f"--over {axis.key}"
        if not len(axis.values):
            raise ScenarioError(f"{place}: got no values, allowed are one or more.")
        texts = [] if isinstance(axis.values, range) else list(map(inline_yaml, axis.values))
        twice = next((text for text, count in Counter(texts).items() if count > 1), None)
        if twice is not None:
            raise ScenarioError(f"{place}: got `{twice}` twice, give each value once.")
    for one, other in combinations(sorted(axis.key.split(".") for axis in axes), 2):
        if other[: len(one)] == one:
            text = f"this key is inside `{'.'.join(one)}`, which varies too"
            text = "got this key twice" if one == other else text
            raise ScenarioError(f"--over {'.'.join(other)}: {text}; vary one of them.")
    return tuple(axes)


def _read(text: str) -> Axis:
    place = "--over " + " ".join(text.split())
    key, equals, values = text.partition("=")
    if not equals or not all(part.strip() for part in key.split(".")):
        raise ScenarioError(f"{place}: got no `key=values`, give them as in `seed=0..9`.")
    document = read_yaml(f"[{values}]", place)
    if document.faults or not isinstance(document.data, list):
        text = document.faults[0].message if document.faults else "got no list of values."
        raise ScenarioError(f"{place}: {text}")
    parts = [_range(item, place) for item in document.data]
    excess = excess_runs(sum(map(len, parts)))
    if excess is not None:
        raise ScenarioError(f"{place}: {excess}.")
    key = ".".join(part.strip() for part in key.split("."))
    values = parts[0] if len(parts) == 1 else tuple(chain(*parts))
    if key.endswith(".file"):
        # A sweep may be continued from another working folder.
        values = tuple(str(Path(str(value)).resolve()) for value in values)
    return Axis(key, values)


def _range(item: object, place: str) -> Sequence[object]:
    """Return the values of an item: whole numbers for `2..5`, otherwise the item."""
    match = _RANGE.fullmatch(item) if isinstance(item, str) else None
    if match is None:
        return (item,)
    first, last = map(int, match.groups())
    if last < first:
        raise ScenarioError(f"{place}: got `{item}`, a range must ascend.")
    return range(first, last + 1)


class FrameShape(NamedTuple):
    """What the runs of a sweep that stores states have in common.

    Attributes:
        times: (T,) s.
        states, inputs: names.
    """

    times: tuple[float, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    agents: int

    @classmethod
    def of(cls, experiment: "Experiment", every: int) -> "FrameShape":
        """Return the shape of a run that stores every so-manieth step."""
        from echelon.simulation.engine.chunk_grid import ChunkGrid

        parts, settings = experiment
        grid = ChunkGrid(settings._replace(store_every=every), 1)
        steps = np.arange(settings.steps + 1)
        times = settings.dt * steps[grid.stored(steps)]
        model = parts.model
        return cls(tuple(times), model.state_names, model.input_names, parts.graph.agents)

    @property
    def numbers(self) -> int:
        """How many numbers are stored of each run."""
        return len(self.times) * self.agents * (len(self.states) + len(self.inputs))

    def check(self, other: "FrameShape", key: str) -> None:
        """Check that a value of a key leaves the shape as it is.

        Raises:
            ScenarioError: it does not.
        """
        if self != other:
            raise ScenarioError(
                f"--over {key}: its values change the agents, states or times of a run, and runs "
                "whose states are stored must have them in common; leave `--keep-states` out."
            )

    def stored(self, results: "Sequence[Result | None]") -> StoredFrames:
        """Return the frames of some runs; None of those that could not be built."""
        sizes = (len(self.states), len(self.inputs))
        frames = {
            name: np.full((len(results), len(self.times), self.agents, size), np.nan)
            for name, size in zip(NAMES, sizes, strict=True)
        }
        for k, result in enumerate(results):
            if result is not None:
                for name, whole in frames.items():
                    whole[k, : len(result.times)] = getattr(result, name)
        return frames


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
    def frames(self) -> FrameShape | None:
        """The frames that are stored of each run; None if none are."""
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
                self.frames.check(FrameShape.of(build(case), self.every), axis.key)

    def _columns(self) -> int:
        agents = self.first_built.parts.graph.agents
        return len(RUN_COLUMNS) + len(WORDS) + len(AGENT_COLUMNS) * agents
