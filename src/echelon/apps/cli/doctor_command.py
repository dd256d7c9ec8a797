"""`echelon doctor`: versions, devices and self-checks."""

import json
from typing import TYPE_CHECKING

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import JsonOption
from echelon.apps.cli.status import STATUS


def doctor(as_json: JsonOption = False) -> None:
    """Print versions and devices, and run the self-checks of the physics."""
    from echelon.experiments.studies.doctor import checks as all_checks
    from echelon.experiments.studies.doctor import facts as all_facts

    facts, checks = all_facts(), list(all_checks())
    if as_json:
        rows = [check._asdict() for check in checks]
        print(json.dumps({"facts": facts, "checks": rows}, indent=2))
    else:
        from rich.markup import escape

        console = tables.console()
        console.print(tables.pairs(facts))
        for check in checks:
            verdict = "[green]pass[/]" if check.holds else "[red]FAIL[/]"
            sentence = escape(f"{check.claim} ({check.found})")
            console.print(f"{verdict}  {sentence}", highlight=False)
    if not all(check.holds for check in checks):
        raise typer.Exit(1)
