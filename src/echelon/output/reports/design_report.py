"""Tables of what the gain methods give on a scenario, and the recommendation."""

import enum
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from echelon.core.digits import about, at_least, at_most

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from echelon.core.types import JsonObject
    from echelon.experiments.studies.design import Design
    from echelon.synthesis.gains.gain import Gain

_DESIGN: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "method": ("method", lambda design: design.method),
    "coupling": ("coupling", lambda design: design.gain.coupling),
    "edge": ("edge", lambda design: design.promise.edge),
    "slowest_mode": ("slowest,\n1/s", lambda design: design.promise.slowest),
    "fastest_mode": ("fastest,\n1/s", lambda design: design.fastest),
    "longest_step": ("dt up to,\ns (1)", lambda design: design.step),
    "condition": ("cond(P)", lambda design: _condition(design.gain)),
    "gain_margin": ("gain\nmargin", lambda design: design.factors),
    "delay_margin": ("delay\nmargin, s", lambda design: design.delay),
    "rate": (
        "guaranteed,\n1/s",
        lambda design: design.promise.rate if design.promise.promised else None,
    ),
    "kind": ("by", lambda design: str(design.promise.kind) if design.promise.promised else None),
    "theorem": ("theorem", lambda design: design.promise.theorem),
    "radius": (
        "certified\nradius (2)",
        lambda design: getattr(design.promise.certified, "radius", None),
    ),
    "seconds": ("seconds", lambda design: design.seconds),
    "promised": ("", lambda design: design.promise.promised),
    "guarantee": ("", lambda design: design.promise.as_mapping()),
}
"""The numbers of a design, each with its column, if it has one, and its computation."""
_PARTS = (
    ("coupling", "edge", "slowest_mode", "fastest_mode", "seconds"),
    ("longest_step", "condition", "gain_margin", "delay_margin"),
    ("rate", "kind", "theorem", "radius"),
)
"""The columns of each table of designs; each table is at most 80 characters wide."""
_SAFE: dict[str, tuple[Callable[[float], str], ...]] = {
    "edge": (at_least,),
    "slowest_mode": (at_least,),
    "longest_step": (at_most,),
    "gain_margin": (at_least, at_most),
    "delay_margin": (at_most,),
    "rate": (at_most,),
    "radius": (at_most,),
}
"""How numbers that are guaranteed are rounded; of a range, its two ends."""


def design_row(design: "Design") -> "JsonObject":
    """Return the numbers of a design; missing ones are None."""
    row: JsonObject = {"method": design.method, "reason": design.reason}
    if design.gain is None or design.promise is None:
        return {**row, "seconds": design.seconds}
    return row | {name: _plain(of(design)) for name, (_, of) in _DESIGN.items()}


def _condition(gain: "Gain") -> float:
    import numpy as np

    return float(np.linalg.cond(gain.P))


def _plain(value: object) -> object:
    """Return a value ready for JSON, with None for infinity, which JSON cannot express."""
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    if isinstance(value, enum.Enum):
        return str(value)
    return None if value == float("inf") else value


_FOOTNOTES = (
    "(1) longest sampling period for which all checked modes remain stable.",
    "(2) r in sum_i delta_i'P delta_i <= r^2, reduced by the leader's motion over the horizon.",
)


def print_designs(out: "Console", rows: "list[JsonObject]", sentence: str) -> None:
    """Print the methods as tables, the reasons of those without a gain, and a recommendation."""
    for part in _PARTS:
        out.print(_design_table(rows, ("method", *part)))
    notes = [*_FOOTNOTES] if any(row.get("coupling") for row in rows) else []
    notes += [f"- {row['method']}: {row['reason']}" for row in rows if row["reason"]]
    for text in (*notes, sentence):
        out.print(text, highlight=False, markup=False, soft_wrap=not out.is_terminal)


def _design_table(rows: "list[JsonObject]", keys: Iterable[str]) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for key in keys:
        table.add_column(_DESIGN[key][0], justify="left" if key == "method" else "right")
    for row in rows:
        table.add_row(*(_cell(row.get(key), _SAFE.get(key, (about, about))) for key in keys))
    return table


def _cell(value: object, towards: tuple[Callable[[float], str], ...]) -> str:
    if isinstance(value, float):
        return towards[0](value)
    if isinstance(value, list):
        ends = zip(towards, value, strict=True)
        return " - ".join("inf" if part is None else text(part) for text, part in ends)
    return "-" if value is None else str(value)
