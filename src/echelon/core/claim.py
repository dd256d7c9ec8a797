"""What a guarantee claims, as data: numbers with their units, and what they rest on in phrases."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from echelon.core.digits import about, at_least, at_most, finite_or_none
from echelon.core.types import JsonObject
from echelon.core.words import Word


class ClaimKind(Word):
    """What is claimed of a run."""

    CONVERGES = "errors converge to zero"
    BOUNDED = "V does not increase"
    APART = "agents never touch"


class Rounding(Word):
    """In which direction a number may be rounded, so that no more is stated than is known."""

    DOWN = "not more than it"
    UP = "not less than it"
    NEAREST = "to the nearest"


_ROUNDED = {Rounding.DOWN: at_most, Rounding.UP: at_least, Rounding.NEAREST: about}


class Number(NamedTuple):
    """A number of a claim with its unit, and how it is rounded where it is shown."""

    value: float
    unit: str = ""
    rounding: Rounding = Rounding.NEAREST

    def shown(self, digits: int = 3) -> str:
        """Return it in a few digits, with its unit."""
        return f"{_ROUNDED[self.rounding](self.value, digits)} {self.unit}".rstrip()

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON, where a number that is not finite is None."""
        value = finite_or_none(self.value)
        return {"value": value, "unit": self.unit, "rounding": str(self.rounding)}


class Claim(NamedTuple):
    """What is claimed; each phrase stands on a line of its own.

    Attributes:
        what: converges, does not grow, or stays apart.
        start: from which starts.
        graphs: for which graphs and numbers of agents; empty for this one.
        premises: what has to be true of the run, and follows from no computation.
        numbers: by name.
        notes: what else is known, or is not.
    """

    what: ClaimKind
    start: tuple[str, ...]
    graphs: tuple[str, ...] = ()
    premises: tuple[str, ...] = ()
    numbers: Mapping[str, Number] = MappingProxyType({})
    notes: tuple[str, ...] = ()


def number_in(stated: JsonObject, name: str) -> float | None:
    """Return a number of a guarantee that was made ready for JSON; None where it has none."""
    return (stated["numbers"].get(name) or {"value": None})["value"]
