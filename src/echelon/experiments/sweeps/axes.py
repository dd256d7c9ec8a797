"""What varies in a sweep: a key of the scenario, and the values that it takes."""

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, combinations
from pathlib import Path
from typing import Any, NamedTuple

from echelon.core.errors import ScenarioError
from echelon.core.limits import excess_runs
from echelon.experiments.scenario.yaml import inline_yaml, read_yaml

SEED = "seed"
"""The key that changes what is drawn and nothing else."""
_RANGE = re.compile(r"(-?[0-9]{1,18})\.\.(-?[0-9]{1,18})")


class Axis(NamedTuple):
    """A key of a scenario, its parts joined by dots, and its values in their order."""

    key: str
    values: Sequence[Any]

    def override(self, k: int) -> str:
        """Return what lays value k over a scenario."""
        return f"{self.key}={inline_yaml(self.values[k])}"

    @property
    def text(self) -> str:
        """The axis as the command line has it."""
        if isinstance(self.values, range) and self.values.step == 1 and len(self.values) > 1:
            return f"{self.key}={self.values[0]}..{self.values[-1]}"
        return f"{self.key}={inline_yaml(list(self.values))[1:-1]}"


def read_axes(texts: Iterable[str]) -> tuple[Axis, ...]:
    """Return axes from texts such as `seed=0..9999` and `follower.gain.coupling=1,2,4`.

    Raises:
        ScenarioError: one is malformed, or two are of one key.
    """
    return _checked([_read(text) for text in texts])


def axes_of(values: Mapping[str, Iterable[Any]]) -> tuple[Axis, ...]:
    """Return axes from values by key.

    Raises:
        ScenarioError: a key has no values, or has one twice; or two are of one part of a scenario.
    """
    found = [Axis(key, v if isinstance(v, range) else tuple(v)) for key, v in values.items()]
    return _checked(found)


def _checked(axes: list[Axis]) -> tuple[Axis, ...]:
    if not axes:
        raise ScenarioError("a sweep varies nothing; give a key and its values, as in `seed=0..9`.")
    for axis in axes:
        place = f"--over {axis.key}"
        if not len(axis.values):
            raise ScenarioError(f"{place}: got no values, allowed are one or more.")
        seen = [] if isinstance(axis.values, range) else list(map(inline_yaml, axis.values))
        twice = next((v for v in seen if seen.count(v) > 1), None) if len(seen) < 2000 else None
        if twice is not None or len(seen) != len(set(seen)):
            raise ScenarioError(f"{place}: got `{twice or 'a value'}` twice, and once is enough.")
    for one, other in combinations(sorted(axis.key.split(".") for axis in axes), 2):
        if other[: len(one)] == one:
            said = f"got `{'.'.join(one)}` too, of which it is a part"
            said = "got this key twice" if one == other else said
            raise ScenarioError(f"--over {'.'.join(other)}: {said}; vary it once.")
    return tuple(axes)


def _read(text: str) -> Axis:
    """Return the axis of a text."""
    place = "--over " + " ".join(text.split())
    key, equals, values = text.partition("=")
    if not equals or not all(part.strip() for part in key.split(".")):
        raise ScenarioError(f"{place}: got no `key=values`, allowed is as in `seed=0..9`.")
    document = read_yaml(f"[{values}]", place)
    if document.faults or not isinstance(document.data, list):
        said = document.faults[0].message if document.faults else "got no list of values."
        raise ScenarioError(f"{place}: {said}")
    parts = [_range(item, place) for item in document.data]
    excess = excess_runs(sum(map(len, parts)))
    if excess is not None:
        raise ScenarioError(f"{place}: {excess}.")
    key = ".".join(part.strip() for part in key.split("."))
    values = parts[0] if len(parts) == 1 else tuple(chain(*parts))
    if key.endswith(".file"):
        # A sweep may go on from another working folder.
        values = tuple(str(Path(str(value)).resolve()) for value in values)
    return Axis(key, values)


def _range(item: Any, place: str) -> Sequence[Any]:
    """Return what an item of a list stands for: `2..5` for whole numbers, else itself."""
    found = _RANGE.fullmatch(item) if isinstance(item, str) else None
    if found is None:
        return (item,)
    first, last = map(int, found.groups())
    if last < first:
        raise ScenarioError(f"{place}: got `{item}`, and a range must not fall.")
    return range(first, last + 1)
