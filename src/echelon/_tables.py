"""What the command line prints: tables of checks, designs and facts."""

import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from echelon._check import Line
    from echelon._design import Design
    from echelon._verify import Finding


def console() -> "Console":
    """Return a console that keeps tables whole where the output is no terminal."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=200)


def pairs(facts: dict[str, str]) -> "Table":
    """Return facts as two columns."""
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for name, text in facts.items():
        table.add_row(name, text)
    return table


def design_row(design: "Design") -> dict[str, Any]:
    """Return what is told of a design; what does not exist is None."""
    row: dict[str, Any] = {"method": design.method, "reason": design.reason}
    gain = design.gain
    if gain is None:
        return {**row, "seconds": design.seconds}
    import numpy as np

    certificate, region = gain.certificate, gain.certificate.region
    return {
        **row,
        "coupling": gain.coupling,
        "edge": certificate.edge,
        "slowest_mode": certificate.abscissa,
        "fastest_mode": design.fastest,
        "condition": float(np.linalg.cond(gain.P)),
        "region_rate": None if region is None else region.rate,
        "region_kind": None if region is None else region.kind,
        "theorem": None if region is None else region.theorem,
        "radius": None if region is None else region.radius,
        "seconds": design.seconds,
    }


def print_designs(rows: list[dict[str, Any]], chosen: str | None) -> None:
    """Print the methods side by side, the reasons of those without a gain, and the chosen one."""
    from rich import box
    from rich.table import Table

    keys = {
        "method": "method",
        "coupling": "coupling",
        "edge": "edge",
        "slowest_mode": "slowest,\n1/s",
        "fastest_mode": "fastest,\n1/s",
        "condition": "cond(P)",
        "region_rate": "rate on\ndomain, 1/s",
        "region_kind": "kind",
        "theorem": "theorem",
        "radius": "radius",
        "seconds": "seconds",
    }
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for key, title in keys.items():
        table.add_column(title, justify="left" if key == "method" else "right")
    for row in rows:
        table.add_row(*(_cell(row.get(key)) for key in keys))
    out = console()
    out.print(table)
    for row in rows:
        if row["reason"]:
            text = f"- {row['method']}: {row['reason']}"
            out.print(text, highlight=False, markup=False, soft_wrap=not out.is_terminal)
    text = f"Recommended: {chosen}." if chosen else "No method gives a stable loop here."
    out.print(text, highlight=False)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "-" if value is None else str(value)


_CHECKED = ("statement", "verdict", "kind", "number", "why, or what to change")


def lines_table(lines: "Iterable[Line | Finding]", columns: tuple[str, ...] = _CHECKED) -> "Table":
    """Return the lines of a check as a table, with the titles of its columns."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column)
    for line in lines:
        table.add_row(*(text.replace("[", "\\[") for text in line))
    return table
