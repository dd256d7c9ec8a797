"""`echelon run` and `echelon sweep`: simulate a scenario once, or for many values of its keys.

Both write to their folder while they compute, and can be continued.
"""

import contextlib
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, final

import typer

from echelon.apps.cli import options, tables
from echelon.apps.cli.show_command import show_address, wait
from echelon.apps.cli.study_command import look_for_causes
from echelon.apps.cli.terminal import STATUS, STOP
from echelon.core.errors import Outcome, OutputError
from echelon.core.words import amount

if TYPE_CHECKING:
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.experiments.sweeps.plan import Sweep
    from echelon.experiments.sweeps.workers import SweepBatch
    from echelon.output.archive.chunks import Chunks
    from echelon.output.archive.study_folder import Batches
    from echelon.simulation.engine.record import Segment
    from echelon.simulation.engine.result import Result
    from echelon.simulation.engine.simulate import RunSoFar


@final
class Job:
    """Work of a command whose results are stored part by part."""

    def __init__(self, command: Literal["run", "sweep"], chunks: "Chunks") -> None:
        self.command, self.chunks = command, chunks

    @property
    def folder(self) -> Path:
        """The folder of the output."""
        return self.chunks.folder

    @property
    def remainder(self) -> str:
        """What is left of the work where it ended early, and how to continue it."""
        if not self.chunks.hold_any:
            return "no results could be saved"
        resume = f"echelon {self.command} --resume {self.folder}"
        return f"partial results are saved, and `{resume}` continues"

    def resume(self, dataset: str) -> None:
        """Check that the work can be continued; leave the program where its dataset is complete.

        Raises:
            OutputError: the folder holds no such work, or its inputs changed.
        """
        if not self.chunks.exist and (self.folder / dataset).is_file():
            print(f"echelon: the {self.command} in `{self.folder}` is complete; nothing to do.")
            raise typer.Exit()
        self.chunks.check()

    @contextlib.contextmanager
    def cleanup(self) -> Iterator[None]:
        """Remove the folder if the work ends before any part of it is stored."""
        try:
            yield
        except BaseException:
            self.chunks.forget()
            raise


# ---- `echelon run` -------------------------------------------------------------------------------


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
    causes: Annotated[
        bool, typer.Option("--causes", help="Look for the cause if not everybody arrives.")
    ] = False,
    seconds: options.SecondsOption = 60.0,
    as_json: options.JsonOption = False,
) -> None:
    """Simulate a scenario; write its report, figures and dataset."""
    if view:
        from echelon.output.viewer.page import check_page

        check_page()
    tables.check_inputs("run", scenario, resume, set_, out, force)
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
            if not (as_json and causes):
                _print(result, as_json)
            _write(job, result, figures, as_json)
            # Afterwards, so that nothing of the run is lost if the search is ended.
            if causes or not as_json:
                _explain(specification, result, job, seconds if causes else None, as_json)
        if watched is not None and STOP.number is None and len(result.times):
            watched.show_all(job.folder)
    if result.outcome is Outcome.INTERRUPTED and STOP.number is None:
        # Then the disk ended it, and its message says so.
        raise OutputError(f"{result.message[:-1]}; {job.remainder}.")
    raise typer.Exit(STOP.exit_code or result.outcome.exit_code)


def _new_run(
    name: str, changes: Sequence[str], out: Path | None, force: bool, quiet: bool, figures: bool
) -> "tuple[Scenario, Experiment, Job]":
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
        tables.foretell(experiment, quiet)
    return scenario, experiment, job


def _unfinished_run(folder: Path) -> "tuple[Scenario, Experiment, Job]":
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
    from echelon.experiments.scenario import build
    from echelon.simulation.step.drive import Stopped

    def store(segment: "Segment") -> None:
        if watched is not None:
            watched.add(segment)
        try:
            job.chunks.write(segment)
        except OSError as error:
            raise Stopped(f"its folder cannot be written: {error.strerror or error},") from error

    stored = job.chunks.read()
    if watched is not None:
        for segment in stored:
            watched.add(segment)
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
    from echelon.output.reports.run_report import print_screen

    print_screen(tables.console(), result, metrics(result))


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
        tables.print_folder(job.folder, "`echelon report` prints all of it")


def _explain(
    scenario: "Scenario", result: "Result", job: Job, seconds: float | None, as_json: bool
) -> None:
    """Print the outcome of a poor run, with its causes if they are to be looked for."""
    from echelon.experiments.results.role_outcome import run_outcome
    from echelon.experiments.results.summary import summary
    from echelon.output.reports.causes_report import outcome_sentence

    complete = result.outcome.reached or result.outcome is Outcome.DIVERGED
    outcome = run_outcome(result)
    if seconds is None or not complete:
        if complete and outcome.poor:
            where = f"`echelon causes {job.folder}` looks for the cause."
            print(f"- {outcome_sentence(outcome, result.length_unit)} {where}")
        return
    try:
        study = look_for_causes(scenario, seconds, as_json, result)
    except KeyboardInterrupt:
        print("echelon: stopped looking for causes.", file=sys.stderr)
        return
    if as_json:
        print(json.dumps({**summary(result), "causes": study.as_mapping()}, indent=2), flush=True)
    else:
        tables.print_causes(study)


# ---- `echelon run --view` ------------------------------------------------------------------------


@final
class WatchedRun:
    """A run whose page shows each part once it is computed; a fault of the page ends nothing."""

    def __init__(self, scenario: "Scenario", experiment: "Experiment") -> None:
        from echelon.experiments.results.lyapunov import fixed_metric, potential
        from echelon.experiments.results.recording import empty_recording
        from echelon.guarantees.promises.promise import guarantee
        from echelon.output.viewer.replay import Growing
        from echelon.simulation.engine.prepare import prepare

        prepared = prepare(*experiment)
        parts, settings = prepared.parts, prepared.problem.settings
        self.formation = parts.formation
        stated = guarantee(parts, settings).as_mapping()
        self.run = empty_recording(parts, settings, prepared.problem.states, scenario.name, stated)
        # The V of a P that turns is computed only at the end.
        P = None if parts.formation.motion is not None else fixed_metric(parts)
        self.potential = None if P is None else potential(parts.model, parts.graph, P)
        self.page = Growing(self.run)

    def add(self, segment: "Segment") -> None:
        """Show a part that was computed."""
        from echelon.experiments.results.recording import so_far

        # An agent without finite numbers cannot be drawn; the page says so at the end.
        if segment.finite:
            with contextlib.suppress(OutputError):
                self.page.add(so_far(self.run, segment, self.potential, self.formation))

    def show_all(self, folder: Path) -> None:
        """Show the complete run until Ctrl-C."""
        from echelon.experiments.results.recording import recording_of
        from echelon.output.archive.run_folder import load, report_beside
        from echelon.output.reports.run_report import whole_report

        with STOP.hold():
            run = recording_of(load(folder))
            self.page.finish(run, whole_report(run, report_beside(folder)))
            text = "echelon: complete; the page is still served. Ctrl-C quits."
            print(text, file=sys.stderr)
            wait()


@contextlib.contextmanager
def watching(scenario: "Scenario", experiment: "Experiment") -> Iterator[WatchedRun]:
    """Serve the page of a run that is about to start, and open a browser."""
    from echelon.output.viewer.replay import growing_page

    watched = WatchedRun(scenario, experiment)
    handler = growing_page(watched.page)
    with handler.serving() as address:
        show_address(address, handler.port, browser=True)
        yield watched


# ---- `echelon sweep` -----------------------------------------------------------------------------


def sweep(
    scenario: Annotated[
        str | None, typer.Argument(help="The name of a bundled scenario, or a YAML file.")
    ] = None,
    over: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="Values to vary, as in seed=0..99 or follower.gain.coupling=1,2.",
        ),
    ] = None,
    set_: options.SetOption = None,
    out: options.FolderOption = None,
    resume: options.ResumeOption = None,
    force: options.ForceOption = False,
    keep_states: Annotated[
        int | None,
        typer.Option(
            metavar="K", min=1, help="Store states and inputs of every K-th step of each run."
        ),
    ] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads of native code (default: one per processor).")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="URL", help="Compute on workers of this dask scheduler.")
    ] = None,
    figures: options.FiguresOption = True,
    as_json: options.JsonOption = False,
) -> None:
    """Run a scenario for all combinations of values; write the numbers of all runs as a dataset."""
    tables.check_inputs("sweep", scenario, resume, over, set_, out, force, keep_states)
    if cluster is not None:
        from echelon.experiments.sweeps.cluster import check_scheduler

        check_scheduler(cluster)
    from echelon.output.archive.folder import BATCHES, writing

    if resume is None:
        plan, batches, job = _new_sweep(
            str(scenario), over or [], set_ or [], out, force, keep_states, as_json
        )
    else:
        plan, batches, job = _unfinished_sweep(resume)
    with writing(job.folder, BATCHES), STOP.hold():
        with job.cleanup():
            results = _compute(plan, batches, threads, cluster, as_json)
        _write_sweep(plan, job, batches, results, figures, as_json)
    raise typer.Exit(STOP.exit_code)


def _new_sweep(
    name: str,
    over: Sequence[str],
    changes: Sequence[str],
    out: Path | None,
    force: bool,
    keep_states: int | None,
    quiet: bool,
) -> "tuple[Sweep, Batches, Job]":
    from echelon.experiments.scenario.scenario import load_scenario

    scenario = load_scenario(name, changes)
    STATUS.begin(f"preparing {scenario.name}", not quiet)
    from echelon.experiments.sweeps.plan import Sweep, read_axes
    from echelon.output.archive.folder import BATCHES, claim_folder
    from echelon.output.archive.study_folder import Batches
    from echelon.simulation.engine.prepare import prepare

    plan = Sweep(scenario, read_axes(over), keep_states)
    batches = Batches(claim_folder(f"sweep-{scenario.name}", out, force, BATCHES))
    job = Job("sweep", batches.chunks)
    with job.cleanup():
        batches.begin(plan)
        # Those of other cases are in the report, which counts them.
        tables.warn(prepare(*plan.first_built).warnings, quiet)
    return plan, batches, job


def _unfinished_sweep(folder: Path) -> "tuple[Sweep, Batches, Job]":
    from echelon.output.archive.study_folder import Batches

    batches = Batches(folder)
    job = Job("sweep", batches.chunks)
    job.resume("sweep.nc")
    return batches.plan(), batches, job


def _compute(
    plan: "Sweep", batches: "Batches", threads: int | None, cluster: str | None, quiet: bool
) -> "list[SweepBatch]":
    """Return the batches of a sweep, each written as soon as it is computed."""
    from echelon.experiments.sweeps.sweep import compute

    results = batches.read()

    def store(batch: "SweepBatch") -> None:
        batches.write(batch)
        # In the folder, since those of all batches would fill the memory.
        results.append(batch._replace(frames=None))

    def progress(done: int, runs: int) -> None:
        STATUS.count(done, runs, "runs")
        STOP.check()

    stored = tuple(results)
    STATUS.begin(f"simulating {plan.scenario.name}, {amount(plan.count, 'run')}", not quiet)
    try:
        compute(plan, store, progress, stored, threads, cluster)
    except KeyboardInterrupt:
        # What is computed by then is stored, and the report says so.
        if not results:
            print("echelon: stopped; there were no results to save.", file=sys.stderr)
            raise typer.Exit(STOP.exit_code) from None
    return results


def _write_sweep(
    plan: "Sweep",
    job: Job,
    batches: "Batches",
    results: "Sequence[SweepBatch]",
    figures: bool,
    quiet: bool,
) -> None:
    """Write and print the results; the batches stay until all runs are in the dataset."""
    from echelon.experiments.sweeps.sweep_dataset import dataset_of
    from echelon.output.archive.study_folder import write_sweep
    from echelon.output.reports.sweep_report import sweep_mapping, sweep_report

    data = dataset_of(plan, results)
    text = sweep_report(data)
    if not quiet:
        print(text, flush=True)
    complete = sum(batch.runs for batch in results) == plan.count
    write_sweep(data, text, job.folder, figures and complete)
    if complete:
        batches.write_frames(plan)
        job.chunks.remove()
    if quiet:
        print(json.dumps({"folder": str(job.folder), **sweep_mapping(data)}, indent=2))
    elif complete:
        tables.print_folder(job.folder)
    else:
        print(f"- Incomplete: {job.remainder}.")
