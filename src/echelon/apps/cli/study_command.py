"""`echelon check`, `causes`, `design` and `compare`: studies of a scenario."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from echelon.apps.cli import options, tables
from echelon.apps.cli.options import JsonOption, ScenarioArgument, SetOption
from echelon.apps.cli.terminal import STATUS, STOP
from echelon.core.errors import ScenarioError
from echelon.output.archive.folder import claim_design, write_errors

if TYPE_CHECKING:
    from echelon.core.types import JsonObject
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.experiments.studies.causes import CauseStudy
    from echelon.experiments.studies.observed_region import ObservedRegion
    from echelon.simulation.engine.parts import Parts
    from echelon.simulation.engine.result import Result
    from echelon.simulation.step.settings import Settings


def check(
    scenario: ScenarioArgument,
    set_: SetOption = None,
    every: Annotated[
        bool, typer.Option("--all", help="Print every line, with its reason, as a table.")
    ] = False,
    region: Annotated[
        bool, typer.Option("--region", help="Also simulate random starts at several scales.")
    ] = False,
    seeds: Annotated[
        int, typer.Option(min=1, help="Random starts at each scale, with `--region`.")
    ] = 200,
    as_json: JsonOption = False,
    as_latex: options.LatexOption = False,
) -> None:
    """State what is guaranteed of a scenario, and why; exit code 0 if anything is."""
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"checking {loaded.name}", not as_json)
    # Not above: an error in the file is reported without the wait for JAX.
    from echelon.experiments.scenario.build import build
    from echelon.experiments.studies.check import check as examine

    experiment = build(loaded, to_run=region)
    checked = examine(*experiment)
    if region:
        checked = checked._replace(region=_region(*experiment, seeds))
    if as_json:
        print(json.dumps(checked.as_mapping(), indent=2))
    else:
        from echelon.output.reports.check_report import check_report, print_statements
        from echelon.output.reports.region_report import region_report

        if every or as_latex:
            print_statements(tables.console(as_latex=as_latex), checked)
            if checked.region is not None:
                print("\n" + region_report(checked.region))
        else:
            print(check_report(checked))
    raise typer.Exit(0 if checked.promised else 1)


def _region(parts: "Parts", settings: "Settings", seeds: int = 200) -> "ObservedRegion":
    from echelon.experiments.studies.observed_region import observed_region

    STATUS.begin("simulating random starts", log=False)
    return observed_region(parts, settings, seeds=seeds, progress=STATUS.counter("runs"))


def causes(
    run: Annotated[
        str, typer.Argument(metavar="RUN", help="The folder of a run, a scenario's name or file.")
    ],
    set_: SetOption = None,
    seconds: options.SecondsOption = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Look for the cause of a poor run by simulating changes of its scenario."""
    from echelon.experiments.scenario.scenario import load_scenario

    folder = Path(run).parent if Path(run).name == "run.nc" else run
    loaded = load_scenario(folder, set_ or [])
    study = look_for_causes(loaded, seconds, as_json)
    if as_json:
        print(json.dumps(study.as_mapping(), indent=2))
    else:
        tables.print_causes(study)


def look_for_causes(
    scenario: "Scenario", seconds: float, quiet: bool, result: "Result | None" = None
) -> "CauseStudy":
    """Return the causes of a run's outcome, with a line of progress on standard error."""
    STATUS.begin(f"looking for the causes of {scenario.name}", not quiet)
    from echelon.experiments.studies.causes import causes as study

    def progress(done: int, runs: int) -> None:
        STATUS.count(done, runs, "runs")
        STOP.check()

    return study(scenario, seconds, result, progress)


def design(
    scenario: options.ScenarioArgument,
    set_: options.SetOption = None,
    method: Annotated[str | None, typer.Option(help="Only this method.")] = None,
    out: options.GainFileOption = None,
    figures: Annotated[
        Path | None, typer.Option(help="Draw modes and certified set into this folder.")
    ] = None,
    force: options.OverwriteOption = False,
    region: Annotated[
        bool,
        typer.Option("--region", help="Draw also how many random starts fail at several scales."),
    ] = False,
    slice_: Annotated[
        str | None,
        typer.Option("--slice", metavar="STATE,STATE", help="Draw the set in these two states."),
    ] = None,
    as_json: options.JsonOption = False,
    as_latex: options.LatexOption = False,
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
    sentence, best = report.because, report.recommended
    summary: JsonObject = {"recommended": None}
    if best is not None and best.gain is not None and best.parts is not None:
        summary = {"recommended": best.method, "because": sentence}
        if out is not None:
            save_gain(best.gain, best.parts.model, best.parts.graph, out)
        if figures is not None:
            seen = _region(best.parts, report.settings) if region else None
            radii = _draw(best.parts, report.settings, figures, slice_, seen)
            sentence += f"\n{radii}" if radii else ""
            summary["radii"] = radii
            if seen is not None:
                from echelon.output.reports.region_report import region_report

                sentence += f"\n\n{region_report(seen)}"
                summary["region"] = seen.as_mapping()
    from echelon.output.reports.design_report import design_row, print_designs

    summary["methods"] = [design_row(row) for row in report.designs]
    if as_json:
        print(json.dumps(summary, indent=2))
    else:
        print_designs(tables.console(as_latex=as_latex), summary["methods"], sentence)
    raise typer.Exit(1 if best is None else 0)


def _draw(
    parts: "Parts",
    settings: "Settings",
    folder: Path,
    states: str | None,
    region: "ObservedRegion | None",
) -> str | None:
    from echelon.output.plots.study_figures import save_design_figures

    with write_errors(folder):
        _, radii = save_design_figures(parts, settings, folder, states, region)
    return None if radii is None else radii.sentence()


def compare(
    scenarios: Annotated[
        list[str] | None,
        typer.Argument(help="Names of bundled scenarios, or YAML files.", metavar="SCENARIO..."),
    ] = None,
    horizon: Annotated[float, typer.Option(help="Duration of every run, s.")] = 10.0,
    method: Annotated[
        list[str] | None,
        typer.Option(help="Only this method, or your law `FILE.py:CLASS`; repeat for several."),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(
            metavar="0..199", help="Run each method on all these seeds; by default, the laws."
        ),
    ] = None,
    set_: options.SetOption = None,
    out: options.FolderOption = None,
    resume: options.ResumeOption = None,
    force: options.ForceOption = False,
    figures: options.FiguresOption = True,
    as_json: options.JsonOption = False,
    as_latex: options.LatexOption = False,
) -> None:
    """Simulate the consensus laws and the optimization-based methods from the same starts."""
    from echelon.experiments.scenario.scenario import load_scenario

    some = next(iter(scenarios or ()), None)
    tables.check_inputs("comparison", some, resume, method, seeds, set_, out, force)
    if resume is None:
        # First, so that `--set simulation.horizon` wins over it.
        changes = [f"simulation.horizon={horizon!r}", *(set_ or [])]
        loaded = [load_scenario(name, changes) for name in scenarios or ()]
        names = ", ".join(scenario.name for scenario in loaded)
        minutes = ", which takes minutes" * (seeds is None)
        STATUS.begin(f"comparing methods on {names}{minutes}", not as_json)
        jobs, labels, drawn = _new_comparisons(loaded, method, seeds, out, force)
    else:
        jobs, labels, drawn = _unfinished_comparison(resume)
    with STOP.hold():
        rows = [_compare(*job, labels, drawn, figures, as_json, as_latex) for job in jobs]
    if as_json:
        print(json.dumps(rows[0] if len(rows) == 1 else rows, indent=2))
    raise typer.Exit(STOP.exit_code)


_Jobs: TypeAlias = "list[tuple[Scenario, Experiment, Path]]"
"""Comparisons that are to be made, each with its folder."""


def _new_comparisons(
    loaded: "list[Scenario]",
    method: list[str] | None,
    seeds: str | None,
    out: Path | None,
    force: bool,
) -> tuple[_Jobs, tuple[str, ...], Sequence[int] | None]:
    from echelon.experiments.scenario.build import build
    from echelon.experiments.studies.compare import known_labels, laws_of
    from echelon.output.archive.folder import claim_folders
    from echelon.output.archive.study_folder import SeedBatches

    drawn = None if seeds is None else _read_seeds(seeds)
    labels = known_labels(method, slow=drawn is None)
    experiments = [build(scenario, to_run=True) for scenario in loaded]
    for scenario, experiment in zip(loaded, experiments, strict=True):
        laws_of(scenario, experiment.parts, labels)
    folders = claim_folders([scenario.name for scenario in loaded], out, force)
    for scenario, folder in zip(loaded, folders, strict=True) if drawn is not None else ():
        SeedBatches(folder).begin(scenario, labels, drawn or ())
    return [*zip(loaded, experiments, folders, strict=True)], labels, drawn


def _unfinished_comparison(folder: Path) -> tuple[_Jobs, tuple[str, ...], Sequence[int] | None]:
    from echelon.output.archive.study_folder import SeedBatches

    batches = SeedBatches(folder)
    if not batches.chunks.exist and (folder / "comparison.json").is_file():
        print(f"echelon: the comparison in `{folder}` is complete; nothing to do.")
        raise typer.Exit()
    scenario, labels, drawn = batches.begun()
    from echelon.experiments.scenario.build import build

    return [(scenario, build(scenario, to_run=True), folder)], labels, drawn


def _read_seeds(text: str) -> Sequence[int]:
    from echelon.experiments.sweeps.plan import read_axes

    try:
        (axis,) = read_axes([f"seed={text}"])
    except ScenarioError as error:
        raise ScenarioError(str(error).replace("--over seed", "--seeds", 1)) from error
    if not all(isinstance(seed, int) and seed >= 0 for seed in axis.values):
        raise ScenarioError(f"--seeds {text}: allowed are whole numbers from 0 on, as `0..199`.")
    return axis.values


def _compare(
    scenario: "Scenario",
    experiment: "Experiment",
    folder: Path,
    labels: tuple[str, ...],
    seeds: Sequence[int] | None,
    figures: bool,
    quiet: bool,
    as_latex: bool,
) -> "JsonObject":
    from echelon.experiments.studies.compare import compare as simulate
    from echelon.experiments.studies.seed_comparison import compare_seeds
    from echelon.output.archive.study_folder import Flights, SeedBatches, write_comparison
    from echelon.output.reports.comparison_report import (
        comparison_mapping,
        comparison_report,
        print_comparison,
    )

    def progress(label: str, done: float, methods: int) -> None:
        STATUS.count(done, methods, f"methods, now {label}")
        STOP.check()

    flights, batches = Flights(folder), SeedBatches(folder)
    STATUS.begin(f"comparing on {scenario.name}", not quiet)
    with write_errors(folder):
        comparison = (
            simulate(scenario, experiment, labels, progress, flights.write)
            if seeds is None
            else compare_seeds(scenario, seeds, experiment, labels, progress, batches.store)
        )
    # Printed before anything more is written, so that a full disk loses nothing of it.
    if not quiet:
        print_comparison(tables.console(as_latex=as_latex), comparison)
    flights.check()
    rows, text = comparison_mapping(comparison), comparison_report(comparison)
    write_comparison(comparison, rows, text, folder, figures)
    if STOP.number is None:
        batches.chunks.remove()
    if not quiet:
        resume = f"`echelon compare --resume {folder}` continues" if batches.chunks.hold_any else ""
        tables.print_folder(folder, resume)
    return rows
