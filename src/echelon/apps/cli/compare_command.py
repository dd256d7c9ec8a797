"""`echelon compare`: laws and optimization from the same starts."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.console import JsonOption, announce, written
from echelon.apps.cli.stop import STOP

if TYPE_CHECKING:
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.experiments.studies.compare import Comparison


def compare(
    scenarios: Annotated[
        list[str],
        typer.Argument(help="Bundled scenarios' names, or YAML ", metavar="SCENARIO..."),
    ],
    horizon: Annotated[float, typer.Option(help="Length of every run, s.")] = 10.0,
    method: Annotated[
        list[str] | None, typer.Option(help="Only this method; may be given several times.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value in every scenario."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder; default runs/compare-NAME-TIME.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier comparison in --out.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Fly the consensus laws and an optimization-based method from the same starts."""
    from echelon.experiments.scenario.scenario import load_scenario

    # First, so that `--set simulation.horizon` wins over it.
    changes = [f"simulation.horizon={horizon!r}", *(set_ or [])]
    checked = [load_scenario(each, changes) for each in scenarios]
    from echelon.experiments.scenario.build import build
    from echelon.experiments.studies.compare import known_labels
    from echelon.output.archive.folder import claim_folders
    from echelon.output.reports.comparison_report import comparison_mapping

    labels = known_labels(method)
    parts = [build(each, to_run=True) for each in checked]
    folders = claim_folders([each.name for each in checked], out, force)
    with STOP.hold():
        found = [
            _compare(*each, labels, figures, as_json)
            for each in zip(checked, parts, folders, strict=True)
        ]
    if as_json:
        told = [comparison_mapping(each) for each in found]
        print(json.dumps(told[0] if len(told) == 1 else told, indent=2))
    raise typer.Exit(STOP.exit_code)


def _compare(
    scenario: "Scenario",
    built: "Experiment",
    folder: Path,
    labels: tuple[str, ...],
    figures: bool,
    quiet: bool,
) -> "Comparison":
    """Fly all methods on a scenario, show what they did, and write it."""
    from echelon.experiments.studies.compare import compare as fly
    from echelon.output.archive.comparison_folder import Flights, write_comparison
    from echelon.output.reports.comparison_report import (
        comparison_mapping,
        comparison_report,
        print_comparison,
    )

    flights = Flights(folder)
    found = fly(scenario, built, labels, announce(quiet), STOP.check, flights.write)
    # Shown before anything more is written: a full disk takes nothing of it.
    if not quiet:
        print_comparison(tables.console(), found)
    flights.check()
    write_comparison(found, comparison_mapping(found), comparison_report(found), folder, figures)
    if not quiet:
        print(f"- Written to {folder}: {written(folder)}.")
    return found
