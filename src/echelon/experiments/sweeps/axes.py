"""The axes of a sweep: keys of the scenario with the values that they take."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, combinations
from pathlib import Path
from typing import Any, NamedTuple

from echelon.core.errors import ScenarioError
from echelon.core.limits import excess_runs
from echelon.experiments.scenario.yaml import inline_yaml, read_yaml

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
        [Axis(key, v if isinstance(v, range) else tuple(v)) for key, v in values.items()]
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
    """Return the axis of a text."""
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
