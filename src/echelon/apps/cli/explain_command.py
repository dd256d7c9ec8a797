"""`echelon explain`: the glossary in the terminal."""

import json
import shutil
import textwrap
from typing import Annotated

import typer

from echelon.apps.cli.console import JsonOption


def explain(
    term: Annotated[str | None, typer.Argument(help="A word of a table or a report.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Say what a word means that tables and reports print; without one, list them all."""
    from echelon.output.reports.glossary import explain_term, glossary

    found = glossary() if term is None else explain_term(term)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    wide = min(100, shutil.get_terminal_size().columns)
    for name, text in found.items():
        print(name)
        if term is not None:
            print(textwrap.indent(textwrap.fill(text, wide - 4), "    "))
