"""Tables of checks, designs and facts on the terminal."""

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from echelon.core.statement import Statement
    from echelon.core.types import JsonObject
    from echelon.experiments.studies.design import Design


def console(width: int = 200) -> "Console":
    """Return a console that keeps each row on one line where the output is no terminal."""
    from rich.console import Console

    # Wider than any table here, since `grep` and `awk` read lines.
    return Console() if sys.stdout.isatty() else Console(width=width)


def pairs(facts: dict[str, str]) -> "Table":
    """Return facts as two columns."""
    from rich.markup import escape
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for name, text in facts.items():
        table.add_row(name, escape(text))
    return table


def print_table(table: "Table", sentence: str) -> None:
    """Print a table and a sentence, each row on one line where the output is no terminal."""
    out = console()
    out.print(table, soft_wrap=not out.is_terminal)
    out.print(sentence, highlight=False, markup=False, soft_wrap=not out.is_terminal)


def design_row(design: "Design") -> "JsonObject":
    """Return the numbers of a design; missing ones are None."""
    row: JsonObject = {"method": design.method, "reason": design.reason}
    gain, promise = design.gain, design.promise
    if gain is None or promise is None:
        return {**row, "seconds": design.seconds}
    import numpy as np

    region, theorem, factors = promise.certified, promise.theorem, design.factors
    return {
        **row,
        "advice": design.advice,
        "coupling": gain.coupling,
        "edge": promise.edge,
        "slowest_mode": promise.slowest,
        "fastest_mode": design.fastest,
        "longest_step": _finite(design.step),
        "condition": float(np.linalg.cond(gain.P)),
        "gain_margin": None if factors is None else [_finite(factor) for factor in factors],
        "delay_margin": _finite(design.delay),
        "promised": promise.promised,
        "rate": promise.rate,
        "kind": str(promise.kind) if promise.promised else None,
        "theorem": None if theorem is None else str(theorem),
        "radius": None if region is None else _finite(region.radius),
        "promise": promise.as_mapping(),
        "seconds": design.seconds,
    }


def _finite(value: float | None) -> float | None:
    """Return a number, or None for infinity, which JSON cannot express."""
    return None if value is None or value == float("inf") else value


_COLUMNS = {
    "method": "method",
    "coupling": "coupling",
    "edge": "edge",
    "slowest_mode": "slowest,\n1/s",
    "fastest_mode": "fastest,\n1/s",
    "longest_step": "dt up to,\ns (1)",
    "condition": "cond(P)",
    "gain_margin": "gain\nmargin",
    "delay_margin": "delay\nmargin, s",
    "rate": "guaranteed,\n1/s",
    "kind": "by",
    "theorem": "theorem",
    "radius": "certified\nradius (2)",
    "seconds": "seconds",
}
_FOOTNOTES = (
    "(1) longest sampling period for which all checked modes remain stable.",
    "(2) r in sum_i delta_i'P delta_i <= r^2, reduced by the leader's motion over the horizon.",
)


def print_designs(rows: "list[JsonObject]", sentence: str) -> None:
    """Print the methods as a table, the reasons of those without a gain, and a recommendation."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for key, title in _COLUMNS.items():
        table.add_column(title, justify="left" if key == "method" else "right")
    for row in rows:
        table.add_row(*(_cell(row.get(key)) for key in _COLUMNS))
    out = console()
    out.print(table)
    notes = [*_FOOTNOTES] if any(row.get("coupling") for row in rows) else []
    for row in rows:
        notes += [f"- {row['method']}: {row[key]}" for key in ("reason", "advice") if row.get(key)]
    for text in (*notes, sentence):
        out.print(text, highlight=False, markup=False, soft_wrap=not out.is_terminal)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list):
        return " - ".join("inf" if part is None else f"{part:.3g}" for part in value)
    return "-" if value is None else str(value)


def statements_table(lines: "Iterable[Statement]") -> "Table":
    """Return the statements of a check as a table."""
    rows = ((x.name, str(x.verdict), str(x.kind), x.number_text, x.explanation) for x in lines)
    return plain_table(
        ("statement", "verdict", "kind", "number", "reason, or what to change"), rows
    )


def plain_table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> "Table":
    """Return rows of plain text as a table."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*(text.replace("[", "\\[") for text in row))
    return table
