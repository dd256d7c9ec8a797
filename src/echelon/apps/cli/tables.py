"""Output that commands share: tables, warnings, the files written."""

import enum
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from echelon.apps.cli.terminal import STATUS
from echelon.core.digits import about, at_least, at_most
from echelon.core.files import write_atomic
from echelon.output.archive.folder import write_errors

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from echelon.core.statement import Statement
    from echelon.core.types import JsonObject
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.studies.causes import CauseStudy
    from echelon.experiments.studies.design import Design
    from echelon.synthesis.gains.gain import Gain


def console(width: int = 200, as_latex: bool = False) -> "Console":
    """Return a console that keeps each row on one line where the output is no terminal."""
    if as_latex:
        from echelon.output.reports.latex import LatexConsole

        return LatexConsole(width=width)
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


def print_designs(rows: "list[JsonObject]", sentence: str, as_latex: bool = False) -> None:
    """Print the methods as tables, the reasons of those without a gain, and a recommendation."""
    out = console(as_latex=as_latex)
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


def print_statements(
    groups: "Mapping[str, Iterable[Statement]]", sentences: Iterable[str], as_latex: bool = False
) -> None:
    """Print sentences and all statements, each on one line where the output is no terminal."""
    out = console(as_latex=as_latex)
    flat = not out.is_terminal
    for sentence in sentences:
        out.print(sentence, highlight=False, markup=False, soft_wrap=flat)
    heads = ("statement", "verdict", "kind", "number", "reason, or what to change")
    for title, lines in groups.items():
        rows = ((x.name, x.shown_verdict, str(x.kind), x.number_text, x.explanation) for x in lines)
        out.print(f"\n{title}:", highlight=False, markup=False)
        out.print(plain_table(heads, rows), soft_wrap=flat)


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


def foretell(experiment: "Experiment", quiet: bool) -> None:
    """Print the warnings of a run, and what is guaranteed, in one line unless nothing is."""
    if quiet or STATUS.silent:
        return
    from echelon.experiments.studies.design import ways_out
    from echelon.guarantees.promises.promise import guarantee
    from echelon.output.reports.guarantee_text import guarantee_lines, guarantee_text
    from echelon.simulation.engine.prepare import prepare

    warn(prepare(*experiment).warnings)
    stated = guarantee(*experiment)
    if not stated.claimed:
        print(f"echelon: {guarantee_text(stated)}", file=sys.stderr, flush=True)
    elif stated.conditions or sys.stderr.isatty():
        left = "".join(f", while {condition}" for condition in stated.conditions)
        print(f"echelon: {guarantee_lines(stated)[0]}{left}", file=sys.stderr, flush=True)
    for change in ways_out(*experiment):
        print(f"  with {'':9}`--set {change}` there is a guarantee", file=sys.stderr, flush=True)


def warn(warnings: Iterable[str], quiet: bool = False) -> None:
    """Print warnings before what they warn of is computed, each on a line of standard error."""
    if not (quiet or STATUS.silent):
        for text in warnings:
            print(f"echelon: Warning: {text}", file=sys.stderr, flush=True)


def print_causes(study: "CauseStudy") -> None:
    """Print what was found about the outcome of a run, a sentence each."""
    from echelon.output.reports.causes_report import causes_sentences
    from echelon.output.reports.run_report import say

    out = console()
    for sentence in causes_sentences(study):
        say(out, sentence)


def print_folder(folder: Path, remark: str = "") -> None:
    """Print the names of all files in a folder, and a remark."""
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir())
    end = f"; {remark}." if remark else "."
    print(f"- Written to {folder}: {', '.join(names)}{end}")


def write_file(file: Path, content: bytes | str, remark: str = "{}") -> None:
    """Write a file, and print its size as `print_file` does.

    Raises:
        OutputError: it cannot be written.
    """
    with write_errors(file):
        write_atomic(file, content)
    print_file(file, remark)


def print_file(file: Path, remark: str) -> None:
    """Print the size of a file, with a remark that goes before it or after it."""
    print(f"- Written to {file}: {remark.format(f'{file.stat().st_size / 1e6:.2f} MB')}.")
