"""`echelon sweep`: a scenario many times, with other seeds or other values of its keys."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options
from echelon.apps.cli.console import print_folder, warn
from echelon.apps.cli.job import Job, check_inputs
from echelon.apps.cli.status import STATUS
from echelon.apps.cli.stop import STOP, Ended
from echelon.core.words import amount

if TYPE_CHECKING:
    from echelon.experiments.sweeps.plan import Sweep
    from echelon.experiments.sweeps.workers import SweepBatch
    from echelon.output.archive.sweep_folder import Batches


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
    check_inputs("sweep", scenario, resume, over, set_, out, force, keep_states)
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
        _write(plan, job, batches, results, figures, as_json)
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
    """Return a sweep and a job in a new folder that holds all inputs."""
    from echelon.experiments.scenario.scenario import load_scenario
    from echelon.experiments.sweeps.axes import read_axes

    axes = read_axes(over)
    scenario = load_scenario(name, changes)
    STATUS.begin(f"preparing {scenario.name}", not quiet)
    from echelon.experiments.sweeps.plan import Sweep
    from echelon.output.archive.folder import BATCHES, claim_folder
    from echelon.output.archive.sweep_folder import Batches
    from echelon.simulation.engine.prepare import prepare

    plan = Sweep(scenario, axes, keep_states)
    batches = Batches(claim_folder(f"sweep-{scenario.name}", out, force, BATCHES))
    job = Job("sweep", batches.chunks)
    with job.cleanup():
        batches.begin(plan)
        # Those of other cases are in the report, which counts them.
        warn(prepare(*plan.first_built).warnings, quiet)
    return plan, batches, job


def _unfinished_sweep(folder: Path) -> "tuple[Sweep, Batches, Job]":
    """Return the sweep and the job in a folder."""
    from echelon.output.archive.sweep_folder import Batches

    batches = Batches(folder)
    job = Job("sweep", batches.chunks)
    job.resume("sweep.nc")
    return batches.plan(), batches, job


def _compute(
    plan: "Sweep", batches: "Batches", threads: int | None, cluster: str | None, quiet: bool
) -> "list[SweepBatch]":
    """Return the batches of a sweep, each written as soon as it is computed."""
    from echelon.experiments.sweeps.sweep import compute
    from echelon.experiments.sweeps.sweep_dataset import dataset_of

    # What writes results is loaded before there are any: Ctrl-C then does not wait for it.
    dataset_of(plan, ())[[]].to_netcdf(None, engine="h5netcdf")
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
        STOP.aside(lambda: compute(plan, store, progress, stored, threads, cluster))
    except KeyboardInterrupt:
        # What is computed by then is stored, and the report says so.
        if not results:
            raise Ended from None
    # A copy, as a thread that goes on may add to them.
    return [*results]


def _write(
    plan: "Sweep",
    job: Job,
    batches: "Batches",
    results: "Sequence[SweepBatch]",
    figures: bool,
    quiet: bool,
) -> None:
    """Write and print the results; the batches stay until all runs are in the dataset."""
    from echelon.experiments.sweeps.sweep_dataset import dataset_of
    from echelon.output.archive.sweep_folder import write_sweep
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
        print_folder(job.folder)
    else:
        print(f"- Incomplete: {job.remainder}.")
