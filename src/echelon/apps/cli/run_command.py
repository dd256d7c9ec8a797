"""`echelon run`: simulate a scenario and keep what it shows."""

import contextlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.console import JsonOption, foretell, show_progress, written
from echelon.apps.cli.stop import STOP
from echelon.core.errors import Outcome, OutputError

if TYPE_CHECKING:
    from echelon.apps.cli.watch import WatchedRun
    from echelon.experiments.scenario.build import Experiment
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.output.archive.chunks import Chunks
    from echelon.simulation.engine.record import Stretch
    from echelon.simulation.engine.result import Result
    from echelon.simulation.engine.simulate import RunSoFar


class _RunJob(NamedTuple):
    """A run to do, and what is computed of it already."""

    scenario: "Scenario"
    built: "Experiment"
    chunks: "Chunks"
    before: "Sequence[Stretch]" = ()


def run(
    scenario: Annotated[
        str | None,
        typer.Argument(help="A bundled scenario's name, a YAML file, or the folder of a run."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change a value, as in simulation.horizon=10."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder; default runs/NAME-TIME.")] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Go on with the run in this folder.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier run in --out.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    view: Annotated[
        bool, typer.Option("--view", help="Show it in the browser while it is computed.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a scenario; write its table, figures and dataset."""
    if view:
        from echelon.output.viewer.page import check_page

        check_page()
    if resume is None:
        job = _begin(scenario, set_ or [], out, force, as_json)
    elif scenario or set_ or out or force:
        raise OutputError("`--resume` goes on with what a folder holds, and takes no other input.")
    else:
        job = _continue(resume)
    from echelon.apps.cli.watch import watching
    from echelon.output.archive.folder import writing

    with contextlib.ExitStack() as stack:
        stack.enter_context(_undone(job.chunks))
        watched = stack.enter_context(watching(job.scenario, job.built)) if view else None
        stack.enter_context(writing(job.chunks.folder))
        with STOP.hold():
            result = _fly(job, watched, as_json)
            _show(result, as_json)
            _write(job.chunks, result, figures, as_json)
        if watched is not None and STOP.number is None and len(result.times):
            watched.show_all(job.chunks.folder)
    if result.outcome is Outcome.INTERRUPTED and STOP.number is None:
        # Then the disk ended it, and its message says so.
        raise OutputError(f"{result.message[:-1]}, and {_kept(job.chunks)}.")
    raise typer.Exit(STOP.exit_code or result.outcome.exit_code)


def _begin(
    scenario: str | None, changes: Sequence[str], out: Path | None, force: bool, quiet: bool
) -> _RunJob:
    """Return a new run, its folder taken and its inputs kept there."""
    if scenario is None:
        raise OutputError("got no scenario, allowed is one, or `--resume` with a run's folder.")
    from echelon.experiments.scenario.scenario import load_scenario

    checked = load_scenario(scenario, changes)
    from echelon.experiments.scenario.build import build
    from echelon.output.archive.chunks import Chunks
    from echelon.output.archive.folder import claim_folder

    # Parts before the folder: a bad scenario must leave no empty folder behind.
    built = build(checked, to_run=True)
    chunks = Chunks(claim_folder(checked.name, out, force))
    with _undone(chunks):
        chunks.begin(checked)
        foretell(built, quiet)
    return _RunJob(checked, built, chunks)


def _continue(folder: Path) -> _RunJob:
    """Return a run that was ended before, or leave where it is complete."""
    from echelon.experiments.scenario.scenario import KEPT, load_scenario
    from echelon.output.archive.chunks import Chunks

    chunks = Chunks(folder)
    if not chunks.exist and (folder / "summary.json").is_file():
        print(f"echelon: the run in `{folder}` is complete, and nothing is left to do.")
        raise typer.Exit()
    chunks.check()
    checked = load_scenario(folder / KEPT)
    from echelon.experiments.scenario.build import build

    return _RunJob(checked, build(checked), chunks, chunks.read())


def _fly(job: _RunJob, watched: "WatchedRun | None", quiet: bool) -> "Result":
    """Return the run, written while it lasts."""
    from echelon.experiments.scenario import build
    from echelon.simulation.step.drive import Stopped

    def keep(stretch: "Stretch") -> None:
        if watched is not None:
            watched.add(stretch)
        try:
            job.chunks.write(stretch)
        except OSError as error:
            raise Stopped(f"its folder cannot be written: {error.strerror or error},") from error

    if watched is not None:
        for stretch in job.before:
            watched.add(stretch)
    with _undone(job.chunks), show_progress(quiet) as show:

        def progress(run: "RunSoFar") -> None:
            if show is not None:
                show(run.done, run.steps)
            STOP.check()

        return build.run(job.scenario, progress, job.built, keep, job.before)


def _kept(chunks: "Chunks") -> str:
    """Return what becomes of a run that could not be written whole."""
    if not chunks.hold_any:
        return "nothing that was computed could be kept"
    return f"what was computed is kept, and `echelon run --resume {chunks.folder}` goes on"


@contextmanager
def _undone(chunks: "Chunks") -> Iterator[None]:
    """Leave no folder behind where a run ends before anything is computed."""
    try:
        yield
    except BaseException:
        chunks.forget()
        raise


def _show(result: "Result", as_json: bool) -> None:
    """Print what a run shows, before anything more is written."""
    if as_json:
        from echelon.experiments.results.dataset import summary

        print(json.dumps(summary(result), indent=2), flush=True)
        return
    from echelon.experiments.results.metrics import metrics
    from echelon.output.reports.run_report import print_report

    print_report(tables.console(), result, metrics(result))


def _write(chunks: "Chunks", result: "Result", figures: bool, quiet: bool) -> None:
    """Write what a run shows; its chunks stay until all of it is written, and nothing is left."""
    from echelon.output.archive.run_folder import write_findings

    try:
        write_findings(result, chunks.folder, figures)
    except OutputError as error:
        raise OutputError(f"{str(error)[:-1]}; {_kept(chunks)}.") from error
    if result.outcome.reached or result.outcome is Outcome.DIVERGED:
        chunks.remove()
    if not quiet:
        from echelon.output.reports.run_report import say

        say(tables.console(), f"Written to {chunks.folder}: {written(chunks.folder)}.")
