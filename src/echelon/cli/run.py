"""`echelon run`: simulate a scenario and keep what it shows."""

import json
from pathlib import Path
from typing import Annotated

import typer

from echelon.cli import tables
from echelon.cli.console import JsonOption, ScenarioArgument, show_progress, written


def run(
    scenario: ScenarioArgument,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change a value, as in simulation.horizon=10."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder; default runs/NAME-TIME.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier run in --out.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Simulate a scenario; write its table, figures and dataset."""
    from echelon.scenario.scenario import load_scenario

    checked = load_scenario(scenario, set_ or [])
    from echelon.archive.folder import claim_folder
    from echelon.archive.run import write_data, write_findings
    from echelon.reports.run import print_report, say
    from echelon.results.metrics import metrics
    from echelon.scenario import build

    # Parts before the folder: a bad scenario must leave no empty folder behind.
    built = build.build(checked)
    folder = claim_folder(checked.name, out, force)
    console = tables.console()
    with show_progress(quiet=as_json) as progress:
        result = build.run(checked, progress, built)
    write_data(result, folder)
    numbers = metrics(result)
    findings = write_findings(result, folder, figures)
    if as_json:
        print(json.dumps(findings, indent=2))
    else:
        print_report(console, result, numbers)
        say(console, f"Written to {folder}: {written(folder)}.")
    raise typer.Exit(result.outcome.exit_code)
