"""`echelon compare`: laws and optimization from the same starts."""

import json
from pathlib import Path
from typing import Annotated

import typer

from echelon.cli import tables
from echelon.cli.console import JsonOption, announce, written


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
    from echelon.scenario.scenario import load_scenario

    changes = [f"simulation.horizon={horizon!r}", *(set_ or [])]
    checked = [load_scenario(each, changes) for each in scenarios]
    from echelon.archive.comparison import write_comparison
    from echelon.archive.folder import claim_folders
    from echelon.reports.comparison import (
        comparison_mapping,
        comparison_report,
        print_comparison,
    )
    from echelon.scenario.build import build
    from echelon.studies.compare import compare as fly
    from echelon.studies.compare import known_labels

    labels = known_labels(method)
    parts = [build(each) for each in checked]
    folders = claim_folders([each.name for each in checked], out, force)
    told = []
    for scenario, built, folder in zip(checked, parts, folders, strict=True):
        found = fly(scenario, built, labels, announce(quiet=as_json))
        told.append(comparison_mapping(found))
        text = comparison_report(found)
        write_comparison(found, told[-1], text, folder, figures)
        if not as_json:
            print_comparison(tables.console(), found)
            print(f"- Written to {folder}: {written(folder)}.")
    if as_json:
        print(json.dumps(told[0] if len(told) == 1 else told, indent=2))
