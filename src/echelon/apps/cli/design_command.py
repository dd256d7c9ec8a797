"""`echelon design`: gain methods side by side."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.console import JsonOption, ScenarioArgument

if TYPE_CHECKING:
    from echelon.simulation.engine.parts import Parts
    from echelon.simulation.step.settings import Settings


def design(
    scenario: ScenarioArgument,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value before designing."),
    ] = None,
    method: Annotated[str | None, typer.Option(help="Only this method.")] = None,
    out: Annotated[Path | None, typer.Option(help="Save the gain to this file.")] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Draw modes and certified set into this folder.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the gain in --out, or earlier figures.")
    ] = False,
    slice_: Annotated[
        str | None, typer.Option("--slice", metavar="STATE,STATE", help="What the set is drawn in.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Try all gain methods on a scenario, recommend one, save its gain, draw what it promises."""
    from echelon.experiments.scenario.scenario import load_scenario

    checked = load_scenario(scenario, set_ or [])
    from echelon.experiments.scenario.self_contained import files_of
    from echelon.output.archive.folder import claim_design

    # Before the study, which takes seconds: a name that is taken must not cost them.
    claim_design(out, figures, force, files_of(checked))
    from echelon.experiments.studies.design import design as study
    from echelon.synthesis.gains.gain_file import save_gain

    found = study(checked, method)
    sentence, best = found.because, found.recommended
    told: dict[str, Any] = {"recommended": None}
    if best is not None and best.gain is not None and best.parts is not None:
        told = {"recommended": best.method, "because": sentence}
        if out is not None:
            save_gain(best.gain, best.parts.model, best.parts.graph, out)
        if figures is not None:
            radii = _draw(best.parts, found.settings, figures, slice_)
            sentence += f"\n{radii}" if radii else ""
            told["radii"] = radii
    stopping = found.stopping
    if stopping is not None:
        sentence += f"\n{stopping.sentence()}"
        told["stopping_point"] = stopping.as_mapping()
    told["methods"] = [tables.design_row(each) for each in found.designs]
    if as_json:
        print(json.dumps(told, indent=2))
    else:
        tables.print_designs(told["methods"], sentence)
    raise typer.Exit(0 if best is not None or stopping is not None else 1)


def _draw(parts: "Parts", settings: "Settings", folder: Path, asked: str | None) -> str | None:
    """Draw a design's figures, and return a sentence on its radii if it has any."""
    from echelon.core.errors import OutputError
    from echelon.output.plots.design_figures import save_design_figures

    try:
        _, radii = save_design_figures(parts, settings, folder, asked)
    except OSError as error:
        raise OutputError(f"`{folder}` cannot be written: {error.strerror or error}.") from error
    return None if radii is None else radii.sentence()
