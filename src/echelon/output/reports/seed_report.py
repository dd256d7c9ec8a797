"""The report of a comparison over seeds: outcomes, quantiles, and paired differences."""

import itertools
import math
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from echelon.core.types import JsonObject
from echelon.core.words import amount
from echelon.experiments.results.run_numbers import RUN_NUMBERS, settling_bound
from echelon.experiments.studies.seed_comparison import LEVELS, MethodSeeds, SeedComparison
from echelon.output.reports.run_report import say

if TYPE_CHECKING:
    from rich.console import Console

_PAIRED = 3
"""With more methods than this, only the differences to the last one are printed."""


def print_seeds(console: "Console", comparison: SeedComparison) -> None:
    """Print a comparison over seeds on a rich console: three tables and remarks."""
    seeds = amount(len(comparison.seeds), "seed")
    title = f"{comparison.scenario}, {seeds}, {comparison.horizon:.3g} s each"
    settled = f"settled\nto {settling_bound(comparison.length_unit)}"
    ended = [
        (row.label, f"{row.settled} of {len(row.outcomes)}", _ended(row))
        for row in comparison.compared
    ]
    _print(console, title, ("method", settled, "runs ended"), ended)
    levels = [f"{100 * level:.2g} %" for level in LEVELS]
    found = (
        (_head(comparison, x), row.label, *(_cell(x, value) for value in row.quantiles(x)))
        for x, row in itertools.product(comparison.names, comparison.compared)
    )
    _print(console, "quantiles over the seeds", ("number", "method", *levels), found)
    heads = ("number", "difference", "median", "95 % interval", "first\nbetter", "second\nbetter")
    _print(console, "differences on the same seed", heads, _differences(comparison))
    for sentence in _notes(comparison):
        say(console, sentence)


def _print(
    console: "Console", title: str, columns: Iterable[str], rows: Iterable[Iterable[str]]
) -> None:
    from rich import box
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for column in columns:
        words = column in ("number", "method", "difference", "runs ended")
        table.add_column(column, justify="left" if words else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    if table.rows:
        console.print(table)


def _differences(comparison: SeedComparison) -> Iterator[tuple[str, ...]]:
    methods = comparison.compared
    for pair in comparison.differences():
        if len(methods) <= _PAIRED or methods[-1].label in (pair.first, pair.second):
            ends = [_signed(end) for end in pair.interval or [math.nan]]
            interval = "-" if "-" in ends else " to ".join(ends)
            who = f"{pair.first} minus {pair.second}"
            numbers = _signed(pair.median), interval, *map(str, pair.better)
            yield _head(comparison, pair.number), who, *numbers


def _notes(comparison: SeedComparison) -> Iterator[str]:
    methods = comparison.compared
    yield from (f"Conditions: {text}." for text in comparison.conditions)
    if len(methods) > 1:
        yield "On each seed all methods have the same starts, noise and lost messages."
    if len(methods) > 1 and len(comparison.seeds) > 5:
        yield "Intervals contain the median difference with 95 %, by the sign test."
    if len(methods) > _PAIRED:
        yield f"Only differences to {methods[-1].label} are shown; comparison.json has all."
    if any(set(row.ended) - {"completed"} for row in methods):
        yield "A run without a number, as one that diverged, counts as worse than all others."
    if len(comparison.seeds) > 1 and methods and comparison.equal:
        yield "All seeds give the same numbers: here a seed changes nothing."
    for row in comparison.rows:
        if row.outcomes and row not in methods:
            done = f"{len(row.outcomes)} of {amount(len(comparison.seeds), 'run')}"
            yield f"{row.label}: interrupted after {done}, which seeds.csv contains."
        elif row.reason:
            yield f"{row.label}: {row.reason}"


def _ended(row: MethodSeeds) -> str:
    return ", ".join(f"{n} {word.replace('_', ' ')}" for word, n in row.ended.most_common())


def _head(comparison: SeedComparison, name: str) -> str:
    unit = comparison.unit(name)
    return RUN_NUMBERS[name].label + (f", {unit}" if unit else "")


def _cell(name: str, value: float) -> str:
    return RUN_NUMBERS[name].cell(value if math.isfinite(value) else None, 3)


def _signed(value: float) -> str:
    return "0" if value == 0.0 else f"{value:+.3g}" if math.isfinite(value) else "-"


# ---- data ---------------------------------------------------------------------------------------


def seed_mapping(comparison: SeedComparison) -> JsonObject:
    """Return a comparison over seeds ready for JSON; what is not finite is None."""
    differences = []
    for pair in comparison.differences():
        interval = None if pair.interval is None else _finite(pair.interval)
        plain = {"median": _finite([pair.median])[0], "interval": interval}
        differences.append(pair._asdict() | plain | {"better": [*pair.better]})
    return {
        "scenario": comparison.scenario,
        "horizon_s": comparison.horizon,
        "conditions": [*comparison.conditions],
        "seeds": [*comparison.seeds],
        "units": {name: comparison.unit(name) for name in comparison.names},
        "levels": [*LEVELS],
        "methods": {row.label: _row_mapping(comparison, row) for row in comparison.rows},
        "differences": differences,
    }


def _row_mapping(comparison: SeedComparison, row: MethodSeeds) -> JsonObject:
    if row not in comparison.compared:
        return {"outcomes": dict(row.ended), "reason": row.reason}
    quantiles = {name: _finite(row.quantiles(name)) for name in comparison.names}
    return {
        "outcomes": dict(row.ended),
        "settled": row.settled,
        "quantiles": quantiles,
        "reason": row.reason,
    }


def _finite(values: Iterable[float]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values]
