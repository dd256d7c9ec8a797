"""The report of a comparison over seeds: outcomes, quantiles, and paired differences."""

import io
import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from echelon.core.types import JsonObject
from echelon.core.words import amount
from echelon.experiments.results.run_numbers import RUN_NUMBERS, settling_bound
from echelon.experiments.studies.seed_comparison import (
    LEVELS,
    MethodSeeds,
    PairedDifference,
    SeedComparison,
)
from echelon.output.reports.run_report import say

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_PAIRED = 4
"""With more methods than this, only the differences to the last one are printed."""


def seed_report(comparison: SeedComparison, width: int = 200) -> str:
    """Return a comparison over seeds as plain text."""
    from rich.console import Console

    text = io.StringIO()
    print_seeds(Console(file=text, width=width, color_system=None), comparison)
    return text.getvalue().rstrip("\n")


def print_seeds(console: "Console", comparison: SeedComparison) -> None:
    """Print a comparison over seeds on a rich console: three tables and remarks."""
    runs = f"{amount(len(comparison.seeds), 'seed')}, {comparison.horizon:.3g} s each"
    title = ", ".join([comparison.scenario, runs, *comparison.conditions])
    within = settling_bound(comparison.length_unit)
    table = _table(title, ("method", f"settled\nto {within}", "runs ended"))
    for row in comparison.compared:
        table.add_row(row.label, f"{row.settled} of {len(row.outcomes)}", _ended(row))
    console.print(table)
    levels = [f"{100 * level:.2g} %" for level in LEVELS]
    table = _table("quantiles over the seeds", ("number", "method", *levels))
    for name, row in itertools.product(comparison.names, comparison.compared):
        cells = (_cell(name, value) for value in row.quantiles(name))
        table.add_row(_head(comparison, name), row.label, *cells)
    console.print(table)
    _print_differences(console, comparison)
    for row in comparison.rows:
        if row.reason:
            say(console, f"{row.label}: {row.reason}")


def _print_differences(console: "Console", comparison: SeedComparison) -> None:
    heads = ("number", "first less second", "median", "95 % interval", "first\nbetter on")
    table = _table("paired differences", (*heads, "second\nbetter on"))
    methods, few = comparison.compared, len(comparison.compared) <= _PAIRED
    for pair in comparison.differences():
        if few or methods[-1].label in (pair.first, pair.second):
            cells = _difference(pair.median), _interval(pair), *map(str, pair.better)
            who = f"{pair.first} less {pair.second}"
            table.add_row(_head(comparison, pair.number), who, *cells)
    if table.rows:
        console.print(table)
        for sentence in _notes(few):
            say(console, sentence)


def _notes(few: bool) -> Iterator[str]:
    yield (
        "All methods have the same starts, noise and messages on each seed. A run without a number, "
        "as after it diverged, counts as worse than all others; `-` stands where too many runs have "
        "none. Intervals of the median are by the sign test."
    )
    if not few:
        yield "Differences to the last method are shown; `--json` has all."


def _ended(row: MethodSeeds) -> str:
    return ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in row.ended.most_common())


def _head(comparison: SeedComparison, name: str) -> str:
    unit = comparison.unit(name)
    return RUN_NUMBERS[name].label + (f", {unit}" if unit else "")


def _cell(name: str, value: float) -> str:
    return RUN_NUMBERS[name].cell(value if math.isfinite(value) else None, 3)


def _difference(value: float) -> str:
    return f"{value:+.3g}" if math.isfinite(value) else "-"


def _interval(pair: PairedDifference) -> str:
    if pair.interval is None or not all(map(math.isfinite, pair.interval)):
        return "-"
    return " to ".join(map(_difference, pair.interval))


def _table(title: str, columns: tuple[str, ...]) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for column in columns:
        words = column in ("number", "method", "first less second", "runs ended")
        table.add_column(column, justify="left" if words else "right", overflow="fold")
    return table


# ---- data ---------------------------------------------------------------------------------------


def seed_mapping(comparison: SeedComparison) -> JsonObject:
    """Return a comparison over seeds ready for JSON; what is not finite is None."""
    return {
        "scenario": comparison.scenario,
        "horizon_s": comparison.horizon,
        "conditions": list(comparison.conditions),
        "seeds": list(comparison.seeds),
        "methods": {row.label: _row_mapping(comparison, row) for row in comparison.rows},
        "differences": [_pair_mapping(pair) for pair in comparison.differences()],
    }


def _row_mapping(comparison: SeedComparison, row: MethodSeeds) -> JsonObject:
    if not row.outcomes:
        return {"reason": row.reason}
    return {
        "outcomes": dict(row.ended),
        "settled": row.settled,
        "quantiles": {name: [*map(_finite, row.quantiles(name))] for name in comparison.names},
        "reason": row.reason or None,
    }


def _pair_mapping(pair: PairedDifference) -> JsonObject:
    interval = None if pair.interval is None else [*map(_finite, pair.interval)]
    return {
        "number": pair.number,
        "first": pair.first,
        "second": pair.second,
        "median": _finite(pair.median),
        "interval_95": interval,
        "first_better": pair.better[0],
        "second_better": pair.better[1],
        "seeds": pair.seeds,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
