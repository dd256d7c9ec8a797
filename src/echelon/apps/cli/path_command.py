"""`echelon path`: the leader's path as polynomial pieces for Crazyswarm2."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options
from echelon.apps.cli.terminal import STATUS
from echelon.core.files import write_atomic
from echelon.output.archive.export import swarm_text
from echelon.output.archive.folder import check_empty, claim_file, write_errors

if TYPE_CHECKING:
    from echelon.agents.references.polynomials import Polynomials
    from echelon.simulation.engine.parts import Parts

_MEMORY = 31
"""Pieces of 132 bytes that fit into the 4 kB which a Crazyflie has for trajectories."""


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
