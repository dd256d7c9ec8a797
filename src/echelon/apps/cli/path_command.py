"""`echelon path`: the leader's path as polynomial pieces for Crazyswarm2."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options
from echelon.apps.cli.status import STATUS
from echelon.core.files import write_atomic
from echelon.output.archive.folder import claim_file, write_errors

if TYPE_CHECKING:
    from echelon.simulation.engine.parts import Parts

_MEMORY = 31
"""Pieces of 132 bytes that fit into the 4 kB which a Crazyflie has for trajectories."""


def path(
    scenario: options.ScenarioArgument,
    set_: options.SetOption = None,
    agent: Annotated[
        int | None, typer.Option(help="Write this agent's goal, which is offset from the path.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Output file.")] = Path("path.csv"),
    force: options.OverwriteOption = False,
) -> None:
    """Write the leader's path as polynomials of degree 7, the CSV file of Crazyswarm2."""
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"fitting the path of {loaded.name}")
    from echelon.experiments.scenario.self_contained import files_of

    claim_file(out, force, files_of(loaded))
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
    if agent is not None:
        pieces = pieces.moved(_offset(parts, agent))
    with write_errors(out):
        write_atomic(out, pieces.text())
    print(f"- Written to {out}: {count} pieces, {length:g} s.")
    for warning in parts.drive.warnings(parts.model, parts.graph, settings):
        print(f"- Warning: {warning}")
    if count > _MEMORY:
        print(f"- Warning: the memory of a Crazyflie holds {_MEMORY} pieces.")


def _offset(parts: "Parts", agent: int) -> "list[float]":
    """Return the offset (x, y, z, yaw) of an agent's goal from the leader's state."""
    from echelon.agents.references.reference import COORDINATES
    from echelon.core.errors import FormationError

    if not 0 <= agent < parts.graph.agents:
        raise FormationError(
            f"`--agent` is {agent}, and agents are numbered from 0 to {parts.graph.agents - 1}."
        )
    row = dict(zip(parts.model.state_names, parts.formation.offsets[agent].tolist(), strict=True))
    return [row.get(name, 0.0) for name in COORDINATES]
