"""`echelon check`: the paper's assumptions on a scenario."""

import json
from typing import Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.console import JsonOption, ScenarioArgument


def check(
    scenario: ScenarioArgument,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value before checking."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Walk through the paper's assumptions on a scenario; exit code 0 if something is promised."""
    from echelon.experiments.scenario.scenario import load_scenario

    checked = load_scenario(scenario, set_ or [])
    # Not above: a typing error in the file is told without the wait for JAX.
    from echelon.experiments.scenario.build import build
    from echelon.experiments.studies.check import check as examine

    found = examine(*build(checked))
    if as_json:
        lines = [line.as_mapping() for line in found.lines]
        print(json.dumps({"promise": found.promise.as_mapping(), "lines": lines}, indent=2))
    else:
        console = tables.console()
        whole = not console.is_terminal
        console.print(tables.statements_table(found.lines), soft_wrap=whole)
        console.print(found.promise.sentence(), highlight=False, markup=False, soft_wrap=whole)
    raise typer.Exit(0 if found.promised else 1)
