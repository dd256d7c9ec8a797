"""How tables, figures, data sets and the glossary present a number of a run or of an agent."""

import enum
from collections.abc import Callable
from typing import Any, NamedTuple, final, get_args, get_type_hints

ERROR = "error"
"""In place of a unit: that of the formation errors."""


def settling_bound(unit: str) -> str:
    """Return the error below which a follower has settled, for errors in m or without a unit."""
    return "1 cm" if unit else "0.01"


@final
class Shown(enum.Flag):
    """Where a number of a run appears, besides the glossary."""

    SWEEP = enum.auto()
    """In the dataset of a sweep."""
    DISTRIBUTION = enum.auto()
    """In the report and the figures of a sweep, as a distribution over its runs."""
    COMPARISON = enum.auto()
    """In the JSON of a comparison, and in its table of costs if the number has a column."""
    SUMMARY = enum.auto()
    """In the summary of a run."""


class Quantity(NamedTuple):
    """A number of a run or of an agent.

    Attributes:
        meaning: in data sets and the glossary.
        unit: `ERROR` for the unit of formation errors; empty without one.
        label: of an axis.
        column: of a table; `{unit}`, `{window}` (s) and `{settled}` stand for those of the run.
        of: computes it from the `RunNumbers` of a run, for an agent's number those of all
            followers, (F,); None for what `metrics` computes of each agent.
        shown: where it appears.
        key: in JSON; its name by default.
        scale: of the number in tables: 100 for a percentage.
        digits: most digits in tables.
        absent: in tables, if the number does not exist.
    """

    meaning: str
    unit: str = ""
    label: str = ""
    column: str = ""
    of: Callable[[Any], Any] | None = None
    shown: Shown = Shown.SWEEP
    key: str = ""
    scale: float = 1.0
    digits: int = 4
    absent: str = "-"

    def cell(self, value: float | None, digits: int = 4) -> str:
        """Return the number as a cell of a table."""
        if value is None:
            return self.absent
        return f"{self.scale * value:.{min(digits, self.digits)}g}"


def quantities(numbers: type) -> dict[str, Quantity]:
    """Return the quantities among the fields of a tuple of numbers, by name."""
    hints = get_type_hints(numbers, include_extras=True)
    marks = ((name, mark) for name, hint in hints.items() for mark in get_args(hint)[1:])
    return {name: mark for name, mark in marks if isinstance(mark, Quantity)}
