"""`echelon compare`: consensus laws and optimization-based methods from the same starts."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options, tables
from echelon.apps.cli.console import print_folder
from echelon.apps.cli.status import STATUS
from echelon.apps.cli.stop import STOP

if TYPE_CHECKING:
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.experiments.studies.compare import Comparison


def compare(
    scenarios: Annotated[
        list[str],
        typer.Argument(help="Names of bundled scenarios, or YAML files.", metavar="SCENARIO..."),
    ],
    horizon: Annotated[float, typer.Option(help="Duration of every run, s.")] = 10.0,
    method: Annotated[
        list[str] | None, typer.Option(help="Only this method; repeat the option for several.")
    ] = None,
    set_: options.SetOption = None,
    out: options.FolderOption = None,
    force: options.ForceOption = False,
    figures: options.FiguresOption = True,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate the consensus laws and the optimization-based methods from the same starts."""
    from echelon.experiments.scenario.scenario import load_scenario

    # First, so that `--set simulation.horizon` wins over it.
    changes = [f"simulation.horizon={horizon!r}", *(set_ or [])]
    loaded = [load_scenario(name, changes) for name in scenarios]
    names = ", ".join(scenario.name for scenario in loaded)
    STATUS.begin(f"comparing methods on {names}, which takes minutes", not as_json)
    from echelon.experiments.scenario.build import build
    from echelon.experiments.studies.compare import known_labels
    from echelon.output.archive.folder import claim_folders
    from echelon.output.reports.comparison_report import comparison_mapping

    labels = known_labels(method)
    experiments = [build(scenario, to_run=True) for scenario in loaded]
    folders = claim_folders([scenario.name for scenario in loaded], out, force)
    with STOP.hold():
        comparisons = [
            _compare(*job, labels, figures, as_json)
            for job in zip(loaded, experiments, folders, strict=True)
        ]
    if as_json:
        rows = [comparison_mapping(comparison) for comparison in comparisons]
        print(json.dumps(rows[0] if len(rows) == 1 else rows, indent=2))
    raise typer.Exit(STOP.exit_code)


def _compare(
    scenario: "Scenario",
    experiment: "Experiment",
    folder: Path,
    labels: tuple[str, ...],
    figures: bool,
    quiet: bool,
) -> "Comparison":
    """Simulate all methods on a scenario, print the results, and write them."""
    from echelon.experiments.studies.compare import compare as simulate
    from echelon.output.archive.comparison_folder import Flights, write_comparison
    from echelon.output.reports.comparison_report import (
        comparison_mapping,
        comparison_report,
        print_comparison,
    )

    def progress(label: str, done: float, methods: int) -> None:
        STATUS.count(done, methods, f"methods, now {label}")
        STOP.check()

    flights = Flights(folder)
    STATUS.begin(f"comparing on {scenario.name}", not quiet)
    comparison = simulate(scenario, experiment, labels, progress, flights.write)
    # Printed before anything more is written, so that a full disk loses nothing of it.
    if not quiet:
        print_comparison(tables.console(), comparison)
    flights.check()
    rows, text = comparison_mapping(comparison), comparison_report(comparison)
    write_comparison(comparison, rows, text, folder, figures)
    if not quiet:
        print_folder(folder)
    return comparison
