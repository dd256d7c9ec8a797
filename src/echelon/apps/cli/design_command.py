"""`echelon design`: a comparison of all gain methods on a scenario."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options, tables
from echelon.apps.cli.status import STATUS
from echelon.output.archive.folder import claim_design, write_errors

if TYPE_CHECKING:
    from echelon.core.types import JsonObject
    from echelon.simulation.engine.parts import Parts
    from echelon.simulation.step.settings import Settings


def design(
    scenario: options.ScenarioArgument,
    set_: options.SetOption = None,
    method: Annotated[str | None, typer.Option(help="Only this method.")] = None,
    out: options.GainFileOption = None,
    figures: Annotated[
        Path | None, typer.Option(help="Draw modes and certified set into this folder.")
    ] = None,
    force: options.OverwriteOption = False,
    slice_: Annotated[
        str | None,
        typer.Option("--slice", metavar="STATE,STATE", help="Draw the set in these two states."),
    ] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Try all gain methods, recommend one, save its gain, and draw its guarantee."""
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"designing gains for {loaded.name}", not as_json)
    from echelon.experiments.scenario.self_contained import files_of

    # Before the study, which takes seconds.
    claim_design(out, figures, force, files_of(loaded))
    from echelon.experiments.studies.design import design as study
    from echelon.synthesis.gains.gain_file import save_gain

    report = study(loaded, method, STATUS.counter("methods"))
    sentence, best, law_design = report.because, report.recommended, report.law_design
    summary: JsonObject = {"recommended": None}
    if best is not None and best.gain is not None and best.parts is not None:
        summary = {"recommended": best.method, "because": sentence}
        if out is not None:
            save_gain(best.gain, best.parts.model, best.parts.graph, out)
        if figures is not None:
            radii = _draw(best.parts, report.settings, figures, slice_)
            sentence += f"\n{radii}" if radii else ""
            summary["radii"] = radii
    if law_design is not None:
        sentence += f"\n{law_design.sentence()}"
        summary[law_design.name] = law_design.as_mapping()
    summary["methods"] = [tables.design_row(row) for row in report.designs]
    if as_json:
        print(json.dumps(summary, indent=2))
    else:
        tables.print_designs(summary["methods"], sentence)
    raise typer.Exit(0 if best is not None or law_design is not None else 1)


def _draw(parts: "Parts", settings: "Settings", folder: Path, states: str | None) -> str | None:
    """Draw a design's figures, and return a sentence on its radii if it has any."""
    from echelon.output.plots.study_figures import save_design_figures

    with write_errors(folder):
        _, radii = save_design_figures(parts, settings, folder, states)
    return None if radii is None else radii.sentence()
