"""`echelon export`: a run's numbers, or one agent's law, for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli import options
from echelon.apps.cli.tables import write_file
from echelon.apps.cli.terminal import STATUS
from echelon.core.errors import OutputError
from echelon.output.archive.folder import check_empty, check_exists, claim_file

_LAW = "law"


def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="RUN", help="The folder of a run, or its `run.nc`; a scenario for a law."
        ),
    ],
    to: Annotated[
        str | None,
        typer.Option(
            "--to",
            help="csv, parquet, npz, mat, nc, html (default: the ending of --out, else csv); law.",
        ),
    ] = None,
    agent: Annotated[
        int | None, typer.Option(help="Write the law of this agent of a scenario.")
    ] = None,
    set_: options.SetOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Output (default: run.csv, run.npz, ...; a folder law-AGENT)."),
    ] = None,
    force: options.OverwriteOption = False,
) -> None:
    """Write a run for pandas, NumPy, MATLAB or a spreadsheet, or an agent's law as source code.

    The law runs without echelon, on the agent's own computer: as Python, and as C.
    """
    if agent is None and to == _LAW or agent is not None and to not in (None, _LAW):
        raise OutputError(
            "`--to law` needs `--agent`, the number of an agent."
            if agent is None
            else f"`--agent` is of a law, and `--to` is `{to}`; use `law`, or leave `--agent` out."
        )
    if agent is not None:
        _write_law(source, agent, set_ or [], Path(f"law-{agent}") if out is None else out)
        return
    if set_:
        raise OutputError("`--set` is of a scenario, and a run is written as it is; leave it out.")
    _write_run(Path(source), to, out, force)


def _write_run(run: Path, to: str | None, out: Path | None, force: bool) -> None:
    from echelon.output.archive.export import content_of

    check_exists(run)
    file = Path(f"run.{to or 'csv'}") if out is None else out
    ending = file.suffix.lower().removeprefix(".")
    content = content_of(to) if to else content_of(ending or "csv", f"`{file}` ends in")
    if to and ending and to != ending:
        raise OutputError(f"`--to` is `{to}`, and `{file}` ends in `.{ending}`; leave out `--to`.")
    claim_file(file, force)
    STATUS.begin(f"reading {run}")
    from echelon.output.archive.run_folder import load, report_beside

    write_file(file, content(load(run), report_beside(run)))


def _write_law(scenario: str, agent: int, changes: list[str], folder: Path) -> None:
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, changes)
    STATUS.begin(f"writing the law of agent {agent} of {loaded.name}")
    check_empty(folder)
    from echelon.experiments.scenario.build import build
    from echelon.experiments.scenario.self_contained import content_of_files
    from echelon.output.archive.flight_folder import law_files, save_law

    files = law_files(*build(loaded), agent, content_of_files(loaded))
    save_law(files, folder)
    print(f"- Written to {folder}: {', '.join(files)}.")
