"""`echelon sweep`: a scenario many times, with other seeds or other values of its keys."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli.console import JsonOption, show_progress, written
from echelon.apps.cli.stop import STOP
from echelon.core.errors import OutputError

if TYPE_CHECKING:
    from echelon.experiments.sweeps.plan import Sweep
    from echelon.experiments.sweeps.workers import SweepBatch
    from echelon.output.archive.sweep_folder import Batches


def sweep(
    scenario: Annotated[
        str | None, typer.Argument(help="A bundled scenario's name, or a YAML file.")
    ] = None,
    over: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES",
            help="What varies, as in seed=0..99 or follower.gain.coupling=1,2.",
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value in every run."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder; default runs/sweep-NAME-TIME.")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Go on with the sweep in this folder.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier sweep in --out.")
    ] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, help="For native code; one a processor if left out.")
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="URL", help="A dask scheduler whose workers compute.")
    ] = None,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario with all combinations of values; write one dataset of what each comes to."""
    if resume is None:
        plan, batches = _begin(scenario, over or [], set_ or [], out, force)
    elif scenario or over or set_ or out or force:
        raise OutputError("`--resume` goes on with what a folder holds, and takes no other input.")
    else:
        plan, batches = _continue(resume)
    from echelon.output.archive.folder import BATCHES, writing

    with writing(batches.folder, BATCHES), STOP.hold():
        done = _compute(plan, batches, threads, cluster, as_json)
        _finish(plan, batches, done, figures, as_json)
    raise typer.Exit(STOP.exit_code)


def _begin(
    scenario: str | None, over: Sequence[str], changes: Sequence[str], out: Path | None, force: bool
) -> "tuple[Sweep, Batches]":
    """Return a new sweep, its folder taken and its inputs kept there."""
    if scenario is None:
        raise OutputError("got no scenario, allowed is one, or `--resume` with a sweep's folder.")
    from echelon.experiments.scenario.scenario import load_scenario
    from echelon.experiments.sweeps.axes import read_axes

    axes = read_axes(over)
    checked = load_scenario(scenario, changes)
    from echelon.experiments.sweeps.plan import Sweep
    from echelon.output.archive.folder import BATCHES, claim_folder
    from echelon.output.archive.sweep_folder import Batches

    plan = Sweep(checked, axes)
    batches = Batches(claim_folder(f"sweep-{checked.name}", out, force, BATCHES))
    with _undone(batches):
        batches.begin(plan)
    return plan, batches


def _continue(folder: Path) -> "tuple[Sweep, Batches]":
    """Return a sweep that was ended before, or leave where it is complete."""
    from echelon.output.archive.sweep_folder import Batches

    batches = Batches(folder)
    if not batches.chunks.exist and (folder / "sweep.nc").is_file():
        print(f"echelon: the sweep in `{folder}` is complete, and nothing is left to do.")
        raise typer.Exit()
    return batches.plan(), batches


def _compute(
    plan: "Sweep", batches: "Batches", threads: int | None, cluster: str | None, quiet: bool
) -> "list[SweepBatch]":
    """Return the batches of a sweep, each written as soon as it is there."""
    from echelon.experiments.sweeps.sweep import compute

    found = batches.read()

    def keep(batch: "SweepBatch") -> None:
        batches.write(batch)
        found.append(batch)

    with _undone(batches), show_progress(quiet, "runs") as show:
        try:
            compute(plan, keep, _watched(show), tuple(found), threads, cluster)
        except KeyboardInterrupt:
            pass  # what is done is kept, and told below
    return found


def _watched(show: Callable[[int, int], None] | None) -> Callable[[int, int], None]:
    def progress(done: int, runs: int) -> None:
        if show is not None:
            show(done, runs)
        STOP.check()

    return progress


@contextmanager
def _undone(batches: "Batches") -> Iterator[None]:
    """Leave no folder behind where a sweep ends before anything is computed."""
    try:
        yield
    except BaseException:
        batches.chunks.forget()
        raise


def _finish(
    plan: "Sweep", batches: "Batches", done: "Sequence[SweepBatch]", figures: bool, quiet: bool
) -> None:
    """Write and show what the batches hold; they stay until all runs are in the dataset."""
    from echelon.experiments.sweeps.sweep_dataset import dataset_of
    from echelon.output.archive.sweep_folder import write_sweep
    from echelon.output.reports.sweep_report import sweep_mapping, sweep_report

    data = dataset_of(plan, done)
    text = sweep_report(data)
    if not quiet:
        print(text, flush=True)
    write_sweep(data, text, batches.folder, figures)
    whole = sum(batch.runs for batch in done) == plan.count
    if whole:
        batches.chunks.remove()
    if quiet:
        print(json.dumps({"folder": str(batches.folder), **sweep_mapping(data)}, indent=2))
    elif whole:
        print(f"- Written to {batches.folder}: {written(batches.folder)}.")
    else:
        print(f"- What was computed is kept; `echelon sweep --resume {batches.folder}` goes on.")
