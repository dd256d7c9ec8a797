"""`echelon verify`: a second opinion on a gain file."""

import json
from pathlib import Path
from typing import Annotated

import typer

from echelon.cli import tables
from echelon.cli.console import JsonOption


def verify(
    gain: Annotated[Path, typer.Argument(help="A gain file, as `design --out` writes it.")],
    as_json: JsonOption = False,
) -> None:
    """Recompute what a saved gain promises, from its file alone; exit code 0 if all of it holds."""
    from echelon.verifier.verify import verify as recompute

    found = recompute(gain)
    if as_json:
        lines = [each._asdict() for each in found.findings]
        told = {"holds": found.holds, "sentence": found.sentence, "findings": lines}
        print(json.dumps(told, indent=2))
    else:
        console = tables.console()
        titles = ("claim", "stored", "recomputed", "verdict", "how, or why not")
        whole = not console.is_terminal
        console.print(tables.plain_table(titles, found.findings), soft_wrap=whole)
        console.print(found.sentence, highlight=False, markup=False, soft_wrap=whole)
    raise typer.Exit(0 if found.holds else 1)
