"""`echelon run`: simulate a scenario and write its results."""

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options, tables
from echelon.apps.cli.console import foretell, print_folder
from echelon.apps.cli.job import Job, check_inputs
from echelon.apps.cli.status import STATUS
from echelon.apps.cli.stop import STOP
from echelon.core.errors import Outcome, OutputError

if TYPE_CHECKING:
    from echelon.apps.cli.watch import WatchedRun
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.simulation.engine.record import Stretch
    from echelon.simulation.engine.result import Result
    from echelon.simulation.engine.simulate import RunSoFar


def run(
    scenario: Annotated[
        str | None,
        typer.Argument(help="The name of a bundled scenario, a YAML file, or a run's folder."),
    ] = None,
    set_: options.SetOption = None,
    out: options.FolderOption = None,
    resume: options.ResumeOption = None,
    force: options.ForceOption = False,
    figures: options.ResumedFiguresOption = None,
    view: Annotated[
        bool, typer.Option("--view", help="Show the run in the browser while it is computed.")
    ] = False,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate a scenario; write its report, figures and dataset."""
    if view:
        from echelon.output.viewer.page import check_page

        check_page()
    check_inputs("run", scenario, resume, set_, out, force)
    from echelon.apps.cli.watch import watching
    from echelon.output.archive.folder import writing

    if resume is None:
        figures = figures is not False
        new = str(scenario), set_ or [], out, force, as_json, figures
        specification, experiment, job = _new_run(*new)
    else:
        specification, experiment, job = _unfinished_run(resume)
        figures = job.chunks.figures if figures is None else figures
    with contextlib.ExitStack() as stack:
        stack.enter_context(job.cleanup())
        watched = stack.enter_context(watching(specification, experiment)) if view else None
        stack.enter_context(writing(job.folder))
        with STOP.hold():
            result = _simulate(specification, experiment, job, watched, as_json)
            _print(result, as_json)
            _write(job, result, figures, as_json)
        if watched is not None and STOP.number is None and len(result.times):
            watched.show_all(job.folder)
    if result.outcome is Outcome.INTERRUPTED and STOP.number is None:
        # Then the disk ended it, and its message says so.
        raise OutputError(f"{result.message[:-1]}; {job.remainder}.")
    raise typer.Exit(STOP.exit_code or result.outcome.exit_code)


def _new_run(
    name: str, changes: Sequence[str], out: Path | None, force: bool, quiet: bool, figures: bool
) -> "tuple[Scenario, Experiment, Job]":
    """Return the scenario, its parts, and a job in a new folder that holds all inputs."""
    from echelon.experiments.scenario.scenario import load_scenario

    scenario = load_scenario(name, changes)
    STATUS.begin(f"preparing {scenario.name}", not quiet)
    from echelon.experiments.scenario.build import build
    from echelon.output.archive.chunks import Chunks
    from echelon.output.archive.folder import claim_folder

    # Parts before the folder: a bad scenario must leave no empty folder behind.
    experiment = build(scenario, to_run=True)
    job = Job("run", Chunks(claim_folder(scenario.name, out, force)))
    with job.cleanup():
        job.chunks.begin(scenario, figures=figures)
        foretell(experiment, quiet)
    return scenario, experiment, job


def _unfinished_run(folder: Path) -> "tuple[Scenario, Experiment, Job]":
    """Return the scenario, its parts, and the job in a folder."""
    from echelon.experiments.scenario.scenario import SCENARIO_FILE, load_scenario
    from echelon.output.archive.chunks import Chunks

    job = Job("run", Chunks(folder))
    job.resume("summary.json")
    scenario = load_scenario(folder / SCENARIO_FILE)
    STATUS.begin(f"preparing {scenario.name}")
    from echelon.experiments.scenario.build import build

    return scenario, build(scenario), job


def _simulate(
    scenario: "Scenario",
    experiment: "Experiment",
    job: Job,
    watched: "WatchedRun | None",
    quiet: bool,
) -> "Result":
    """Return the run, which is stored and shown while it is computed."""
    from echelon.experiments.scenario import build
    from echelon.simulation.step.drive import Stopped

    def store(stretch: "Stretch") -> None:
        if watched is not None:
            watched.add(stretch)
        try:
            job.chunks.write(stretch)
        except OSError as error:
            raise Stopped(f"its folder cannot be written: {error.strerror or error},") from error

    stored = job.chunks.read()
    if watched is not None:
        for stretch in stored:
            watched.add(stretch)
    horizon = f"{experiment.settings.horizon:g} s of {experiment.parts.graph.agents} agents"
    STATUS.begin(f"simulating {scenario.name}, {horizon}", not quiet)
    with job.cleanup():

        def progress(run: "RunSoFar") -> None:
            STATUS.count(run.done, run.steps, "steps")
            STOP.check()

        return build.run(scenario, progress, experiment, store, stored)


def _print(result: "Result", as_json: bool) -> None:
    """Print the report before files are written, so that a full disk loses nothing of it."""
    if as_json:
        from echelon.experiments.results.summary import summary

        print(json.dumps(summary(result), indent=2), flush=True)
        return
    from echelon.experiments.results.metrics import metrics
    from echelon.output.reports.run_report import print_report

    print_report(tables.console(), result, metrics(result))


def _write(job: Job, result: "Result", figures: bool, quiet: bool) -> None:
    """Write all output; the chunks stay until the run is complete and everything is written."""
    from echelon.output.archive.run_folder import write_findings

    STATUS.begin("drawing and writing" if figures else "writing", log=False)
    try:
        write_findings(result, job.folder, figures)
    except OutputError as error:
        raise OutputError(f"{str(error)[:-1]}; {job.remainder}.") from error
    if result.outcome.reached or result.outcome is Outcome.DIVERGED:
        job.chunks.remove()
    if not quiet:
        print_folder(job.folder)
