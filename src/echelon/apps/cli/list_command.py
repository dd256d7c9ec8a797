"""`echelon init`, `list`, `explain`, `doctor` and `schema`: to begin, and to look up."""

import json
import shutil
import textwrap
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import JsonOption
from echelon.apps.cli.terminal import STATUS

if TYPE_CHECKING:
    from echelon.experiments.studies.doctor import Check


def init(folder: Annotated[Path, typer.Argument(help="A new folder, such as my-swarm.")]) -> None:
    """Create a folder with a scenario, a model, a law and a notebook that run as they are."""
    from echelon.output.archive.folder import create_starter

    files = create_starter(folder)
    print(f"- Written to {folder}: {', '.join(file.name for file in files)}.")
    print(f"- Next: cd {folder} && echelon run scenario.yaml")
    if find_spec("jupyterlab") is None:
        print("- The notebook needs JupyterLab: in echelon's clone, pip install '.[notebook]'")


def list_(as_json: JsonOption = False) -> None:
    """List scenarios, models, references, laws, gain methods, graphs, formations, integrators."""
    from echelon.experiments.scenario import registry
    from echelon.experiments.scenario.scenario import bundled_scenarios

    families = {"scenarios": bundled_scenarios(), **registry.families()}
    if as_json:
        print(json.dumps(families, indent=2))
        return
    width = max(len(name) for entries in families.values() for name in entries)
    for title, entries in families.items():
        print(f"{title}:")
        for name, text in entries.items():
            print(f"  {name:<{width}}  {text}")


def schema() -> None:
    """Print the JSON schema of the scenario file, for editors."""
    from echelon.experiments.scenario.scenario import json_schema

    print(json.dumps(json_schema(), indent=2))


def explain(
    term: Annotated[str | None, typer.Argument(help="A term of a table or a report.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Explain a term of tables and reports; without one, list all terms."""
    from echelon.output.reports.glossary import explain_term, glossary

    more = names_and_keys()
    entries = glossary(more) if term is None else explain_term(term, more)
    if as_json:
        print(json.dumps(entries, indent=2))
        return
    width = min(100, shutil.get_terminal_size().columns)
    for name, text in entries.items():
        print(name)
        if term is not None:
            print(textwrap.indent(textwrap.fill(text, width - 4), "    "))


def names_and_keys() -> dict[str, str]:
    """Return what the names and keys of a scenario file mean."""
    from echelon.experiments.scenario.registry import families
    from echelon.experiments.scenario.scenario import key_meanings

    named = {name: text for family in families().values() for name, text in family.items()}
    return {**named, **key_meanings()}


def doctor(as_json: JsonOption = False) -> None:
    """Print versions and devices, and run the self-checks of the physics."""
    STATUS.begin("checking this installation, which takes up to half a minute", not as_json)
    from echelon.experiments.studies.doctor import CHECKS
    from echelon.experiments.studies.doctor import checks as all_checks
    from echelon.experiments.studies.doctor import facts as all_facts

    facts, checks = all_facts(), list["Check"]()
    if not as_json:
        tables.console().print(tables.pairs(facts))
    for check in all_checks():
        checks.append(check)
        if not as_json:
            _print_check(check)
        STATUS.count(len(checks), len(CHECKS), "self-checks")
    if as_json:
        rows = [check._asdict() for check in checks]
        print(json.dumps({"facts": facts, "checks": rows}, indent=2))
    if not all(check.holds for check in checks):
        raise typer.Exit(1)


def _print_check(check: "Check") -> None:
    from rich.markup import escape

    verdict = "[green]pass[/]" if check.holds else "[red]FAIL[/]"
    sentence = escape(f"{check.claim} ({check.found})")
    tables.console().print(f"{verdict}  {sentence}", highlight=False)
