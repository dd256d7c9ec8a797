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

    more = _names_and_keys()
    entries = glossary(more) if term is None else explain_term(term, more)
    if as_json:
        print(json.dumps(entries, indent=2))
        return
    width = min(100, shutil.get_terminal_size().columns)
    for name, text in entries.items():
        print(name)
        if term is not None:
            print(textwrap.indent(textwrap.fill(text, width - 4), "    "))


def _names_and_keys() -> dict[str, str]:
    """Return what the names and keys of a scenario file mean."""
    from echelon.experiments.scenario.registry import families
    from echelon.experiments.scenario.scenario import key_meanings

    named = {name: text for family in families().values() for name, text in family.items()}
    return {**named, **key_meanings()}
