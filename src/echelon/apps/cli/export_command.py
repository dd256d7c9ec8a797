"""`echelon report`, `export` and `path`: a run, a law or a leader's path as a file."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options
from echelon.apps.cli.tables import write_file
from echelon.apps.cli.terminal import STATUS
from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.core.gone import VALUES, gone
from echelon.output.archive.export import swarm_text
from echelon.output.archive.folder import check_empty, check_exists, claim_file, write_errors

if TYPE_CHECKING:
    from echelon.agents.references.polynomials import Polynomials
    from echelon.experiments.results.recording import Recording
    from echelon.simulation.engine.parts import Parts

_LAW, _BAG = "law", "rosbag2"
_MEMORY = 31
"""Pieces of 132 bytes that fit into the 4 kB which a Crazyflie has for trajectories."""


def report(
    run: options.RunArgument,
    beside: options.BesideOption = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.txt", help="Write it to this file instead.")
    ] = None,
    force: options.OverwriteOption = False,
    as_latex: options.LatexOption = False,
) -> None:
    """Print the numbers of a run or flight, the conditions of its guarantee, and its versions."""
    if out is not None:
        if ended := gone(VALUES, f"report --out {out.suffix.lower()}"):
            raise OutputError(f"a report as `{out.suffix}`{ended}")
        claim_file(out, force)
    STATUS.begin(f"reading {run}")
    from echelon.experiments.results.recording import recording_of
    from echelon.output.archive.run_folder import load, report_beside
    from echelon.output.reports.run_report import whole_report

    recording = recording_of(load(run))
    text = _beside(recording, beside) + whole_report(recording, report_beside(run))
    text = _latex(run) if as_latex else text
    if out is None:
        print(text)
    else:
        write_file(out, text + "\n")


def _latex(run: Path) -> str:
    """Return the report of a run with its tables as LaTeX."""
    from echelon.experiments.results.metrics import metrics
    from echelon.output.archive.run_folder import load
    from echelon.output.reports.latex import LatexConsole
    from echelon.output.reports.run_report import print_report

    loaded, told = load(run), io.StringIO()
    print_report(LatexConsole(file=told), loaded, metrics(loaded))
    return told.getvalue().rstrip("\n")


def _beside(flown: "Recording", run: Path | None) -> str:
    """Return where a flight and a run differ, as the first section of a report."""
    if run is None:
        return ""
    from echelon.experiments.results.beside import beside
    from echelon.experiments.results.recording import recording_of
    from echelon.output.archive.run_folder import load

    title = f"Beside {run}"
    lines = beside(flown, recording_of(load(run))).lines()
    return "\n".join([title, "-" * len(title), *lines, "", ""])


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
            help="csv, parquet, npz, mat, nc, html, mcap (default: the ending of --out, else csv); "
            "rosbag2, a folder; law.",
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
    """Write a run for pandas, NumPy, MATLAB, a spreadsheet or ROS 2, or an agent's law as source.

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
    if to == _BAG:
        _write_bag(Path(source), Path("bag") if out is None else out)
    else:
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


def _write_bag(run: Path, folder: Path) -> None:
    from echelon.output.archive.bags import save_bag

    check_exists(run)
    if folder.exists():
        raise OutputError(f"`{folder}` exists; choose another name for the folder of the bag.")
    STATUS.begin(f"reading {run}")
    from echelon.output.archive.run_folder import load

    with write_errors(folder):
        save_bag(load(run), folder)
    print(f"- Written to {folder}.")


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


def path(
    scenario: options.ScenarioArgument,
    set_: options.SetOption = None,
    agent: Annotated[
        int | None, typer.Option(help="Write this agent's goal, which is offset from the path.")
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Write all agents' goals and crazyflies.yaml: a folder.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("--out", help="Output file or folder (default: path.csv, path).")
    ] = None,
    force: options.OverwriteOption = False,
) -> None:
    """Write the leader's path as polynomials of degree 7, the CSV file of Crazyswarm2."""
    from echelon.core.errors import FormationError
    from echelon.experiments.scenario.scenario import load_scenario

    if every and agent is not None:
        raise FormationError("`--all` writes the goals of all agents; leave out `--agent`.")
    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"fitting the path of {loaded.name}")
    from echelon.experiments.scenario.self_contained import files_of

    target = out or Path("path" if every else "path.csv")
    if every:
        check_empty(target)
    else:
        claim_file(target, force, files_of(loaded))
    from echelon.agents.references.polynomials import Polynomials
    from echelon.agents.references.reference import Reference
    from echelon.core.errors import ReferenceError
    from echelon.experiments.scenario.build import build
    from echelon.laws.law import reference_of

    parts, settings = build(loaded)
    reference = reference_of(getattr(parts.drive, "leader", parts.drive))
    if not isinstance(reference, Reference):
        raise ReferenceError(
            f"`{scenario}` has no path in space, which `echelon path` writes; give it a "
            "`reference` other than `states`."
        )
    pieces = Polynomials.of(reference, settings.horizon)
    count, length = len(pieces.knots) - 1, float(pieces.knots[-1])
    agents = range(parts.graph.agents) if every else [agent]
    moved = [pieces.moved(_offset(parts, k)) for k in agents]
    with write_errors(target):
        if every:
            target.mkdir(parents=True, exist_ok=True)
        for file, text in _files(target, every, moved).items():
            write_atomic(file, text)
    many = f"{len(moved)} paths of " if every else ""
    print(f"- Written to {target}: {many}{count} pieces, {length:g} s.")
    for warning in parts.drive.warnings(parts.model, parts.graph, settings):
        print(f"- Warning: {warning}")
    if count > _MEMORY:
        print(f"- Warning: the memory of a Crazyflie holds {_MEMORY} pieces.")


def _files(target: Path, every: bool, paths: "list[Polynomials]") -> dict[Path, str]:
    texts = [path.text() for path in paths]
    if not every:
        return {target: texts[0]}
    begins = [path.coefficients[-1, 0].tolist() for path in paths]
    files = {target / f"agent{k}.csv": text for k, text in enumerate(texts)}
    return {**files, target / "crazyflies.yaml": swarm_text(begins)}


def _offset(parts: "Parts", agent: int | None) -> "list[float]":
    """Return the offset (x, y, z, yaw) of an agent's goal from the path, 0 for the path itself."""
    from echelon.agents.references.reference import COORDINATES
    from echelon.core.errors import FormationError

    if agent is None:
        return [0.0] * len(COORDINATES)
    if not 0 <= agent < parts.graph.agents:
        raise FormationError(
            f"`--agent` is {agent}, and agents are numbered from 0 to {parts.graph.agents - 1}."
        )
    row = dict(zip(parts.model.state_names, parts.formation.offsets[agent].tolist(), strict=True))
    return [row.get(name, 0.0) for name in COORDINATES]
