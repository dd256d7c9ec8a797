"""`echelon doctor`: versions, devices and self-checks."""

import json
from typing import TYPE_CHECKING

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import JsonOption
from echelon.apps.cli.status import STATUS

if TYPE_CHECKING:
    from echelon.experiments.studies.doctor import Check


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
            _print(check)
        STATUS.count(len(checks), len(CHECKS), "self-checks")
    if as_json:
        rows = [check._asdict() for check in checks]
        print(json.dumps({"facts": facts, "checks": rows}, indent=2))
    if not all(check.holds for check in checks):
        raise typer.Exit(1)


def _print(check: "Check") -> None:
    from rich.markup import escape

    verdict = "[green]pass[/]" if check.holds else "[red]FAIL[/]"
    sentence = escape(f"{check.claim} ({check.found})")
    tables.console().print(f"{verdict}  {sentence}", highlight=False)
