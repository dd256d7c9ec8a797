"""`echelon explain`: the glossary in the terminal."""

import json
import shutil
import textwrap
from typing import Annotated

import typer

from echelon.apps.cli.options import JsonOption


def explain(
    term: Annotated[str | None, typer.Argument(help="A term of a table or a report.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Explain a term of tables and reports; without one, list all terms."""
    from echelon.output.reports.glossary import explain_term, glossary

    entries = glossary() if term is None else explain_term(term)
    if as_json:
        print(json.dumps(entries, indent=2))
        return
    width = min(100, shutil.get_terminal_size().columns)
    for name, text in entries.items():
        print(name)
        if term is not None:
            print(textwrap.indent(textwrap.fill(text, width - 4), "    "))
