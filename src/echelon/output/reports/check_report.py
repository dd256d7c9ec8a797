"""The text of a check: the verdict on the scenario, what it rests on, and the paper's claims."""

import enum
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, final

from echelon.core.statement import Hypothesis, Statement, Topic
from echelon.core.words import Verdict, amount
from echelon.experiments.studies.check import CheckResult
from echelon.output.reports.guarantee_text import WIDTH, guarantee_lines
from echelon.output.reports.region_report import region_report

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

HEIGHT = 40
"""Lines of a terminal."""
_PAPERS = {
    *(Topic.AUTONOMOUS, Topic.GRAPH, Topic.GROUNDED, Topic.POSITIVE, Topic.SCHUR, Topic.EDGES),
    *(Topic.MONOTONE, Topic.DRIFT_ALONG_Z, Topic.LMI_AS_PRINTED, Topic.FINITE),
}
_RESTS = "what a guarantee rests on"
_LOOP = "leader, links and margins of this loop"
_PRINTED = "the paper's printed claims; a note is one that does not hold, and is not needed"


def grouped(lines: Sequence[Statement]) -> dict[str, list[Statement]]:
    """Return the lines of a check under the titles of their groups."""
    groups: dict[str, list[Statement]] = {_RESTS: [], _LOOP: [], _PRINTED: []}
    for line in lines:
        papers = _PRINTED if line.statement in _PAPERS else _LOOP
        groups[_RESTS if isinstance(line.statement, Hypothesis) else papers].append(line)
    return groups


@final
class _Detail(enum.IntEnum):
    """What has room of the lines that hold, from most to least."""

    ROWS = 0
    NUMBERS = 1
    NAMES = 2
    COUNTS = 3


def check_report(check: CheckResult) -> str:
    """Return a check in at most 80 columns, and 40 lines unless more than that fails.

    What fails stands with its remedy, and what holds with its number as far as there is room, else
    by its name, or as a count; of what is not needed the names alone. An observed region follows.
    """
    texts = ["\n".join(_text(check, detail)) for detail in _Detail]
    text = next((text for text in texts if text.count("\n") < HEIGHT), texts[-1])
    return text if check.region is None else f"{text}\n\n{region_report(check.region)}"


def check_sentences(check: CheckResult) -> list[str]:
    """Return the lines of what is guaranteed, and the warnings."""
    return [*guarantee_lines(check.promise), *(f"Warning: {text}" for text in check.warnings)]


def _text(check: CheckResult, detail: _Detail) -> Iterator[str]:
    yield from guarantee_lines(check.promise, brief=detail >= _Detail.NAMES)
    for warning in check.warnings:
        yield from textwrap.wrap(f"Warning: {warning}", WIDTH)
    width = max(len(line.name) for line in check.lines)
    for title, lines in grouped(check.lines).items():
        yield from ("", f"{title}:")
        brief = title == _PRINTED
        least = max(detail, _Detail.NAMES) if brief else detail
        yield from _group(lines, width, least, brief)
    end = f"`--all` shows all {len(check.lines)} lines with reasons; "
    yield from ("", end + "`echelon explain TERM` explains one.")


def _group(lines: list[Statement], width: int, detail: _Detail, brief: bool) -> Iterator[str]:
    rows = detail is _Detail.ROWS
    shown = [x for x in lines if x.fails or (rows and x.verdict is Verdict.HOLDS and x.number_text)]
    for line in shown:
        yield from _row(line, width, detail is _Detail.COUNTS, brief)
    for verdict in (Verdict.HOLDS, Verdict.NOT_NEEDED, Verdict.VACUOUS):
        rest = [line for line in lines if line not in shown and line.verdict is verdict]
        if rest:
            yield from _listed(rest, detail)


def _listed(lines: list[Statement], detail: _Detail) -> Iterator[str]:
    verdict = lines[0].verdict
    numbers = verdict is Verdict.HOLDS and detail is _Detail.NUMBERS
    names = [f"{x.name} ({x.number_text})" if numbers and x.number_text else x.name for x in lines]
    text = amount(len(lines), "line") if detail is _Detail.COUNTS else "; ".join(names)
    yield from _wrapped(f"{verdict}: {text}", " ", "   ")


def _row(line: Statement, width: int, short: bool, brief: bool) -> Iterator[str]:
    """With `short` a text in place of the number has one row."""
    head = f" {line.name:{width}}  {line.shown_verdict:5}  "
    text = line.number_text or (line.text if line.fails else "")
    text = textwrap.shorten(text, WIDTH - len(head), placeholder=" ...") if short else text
    yield from _wrapped(text, head, " " * len(head)) or [head.rstrip()]
    if line.fails and not brief:
        yield from _wrapped(line.remedy, "   -> ", " " * 6)


def _wrapped(text: str, first: str, later: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=first, subsequent_indent=later)


# ---- all lines -----------------------------------------------------------------------------------


def print_statements(out: "Console", check: CheckResult) -> None:
    """Print sentences and all statements, each on one line where the output is no terminal."""
    flat = not out.is_terminal
    for sentence in check_sentences(check):
        out.print(sentence, highlight=False, markup=False, soft_wrap=flat)
    heads = ("statement", "verdict", "kind", "number", "reason, or what to change")
    for title, lines in grouped(check.lines).items():
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
