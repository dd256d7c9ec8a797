"""Output that commands share: tables, warnings, the files written."""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.apps.cli.terminal import STATUS
from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.output.archive.folder import write_errors

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.studies.causes import CauseStudy


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


def check_inputs(command: str, scenario: str | None, resume: Path | None, *others: object) -> None:
    """Check that a command is given either a scenario or a folder to continue.

    Raises:
        OutputError: it is given neither, or other inputs beside the folder.
    """
    if resume is None and scenario is None:
        raise OutputError(
            f"no scenario was given; give one, or `--resume` with the folder of a {command}."
        )
    if resume is not None and (scenario is not None or any(others)):
        raise OutputError("`--resume` takes its inputs from the folder; give no others.")
