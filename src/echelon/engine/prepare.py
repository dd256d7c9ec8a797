"""What `simulate` asks of its arguments, before anything is computed."""

import math

from echelon.core.errors import SimulationError, did_you_mean, listing
from echelon.core.numerics import INTEGRATORS
from echelon.engine.result import Settings
from echelon.laws.law import Law
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.world.disturbance import Disturbance


def check_parts(
    graph: object, formation: object, leader: object, follower: object, disturbance: object
) -> None:
    """Check that each part is what its place asks for."""
    wanted = {"graph": (graph, Graph), "formation": (formation, Formation)}
    wanted |= {"leader": (leader, Law), "follower": (follower, Law)}
    if disturbance is not None:
        wanted["disturbance"] = disturbance, Disturbance
    for place, (part, kind) in wanted.items():
        if not isinstance(part, kind):
            got = (
                f"the class `{part.__name__}`"
                if isinstance(part, type)
                else f"a `{type(part).__name__}`"
            )
            raise SimulationError(f"`{place}` is {got}, and must be a `{kind.__name__}`.")


def check_settings(settings: Settings) -> None:
    """Check the numbers of a simulation.

    Raises:
        SimulationError: one is out of range.
    """
    horizon, dt = settings.horizon, settings.dt
    for name, value in (("horizon", horizon), ("dt", dt)):
        if not 0.0 < value < math.inf:
            raise SimulationError(
                f"`{name}` is {value}, and must be a positive finite number of seconds."
            )
    if horizon < dt:
        raise SimulationError(
            f"`horizon` is {horizon} s, and must be at least one step `dt` = {dt} s."
        )
    if settings.integrator not in INTEGRATORS:
        known = INTEGRATORS
        raise SimulationError(
            f"`integrator` is `{settings.integrator}`, allowed are {listing(known)}"
            f"{did_you_mean(settings.integrator, known)}."
        )
    if settings.seed != int(settings.seed) or settings.seed < 0:
        raise SimulationError(f"`seed` is {settings.seed}, and must be a whole number from 0 on.")
    if settings.store_every != int(settings.store_every) or settings.store_every < 1:
        raise SimulationError(f"`store_every` is {settings.store_every}, and must be at least 1.")
    if settings.precision not in ("float64", "float32"):
        raise SimulationError(
            f"`precision` is `{settings.precision}`, allowed are `float64` and `float32`."
        )


def formation_warnings(model: ControlAffine, formation: Formation) -> tuple[str, ...]:
    """Tell of offsets that the dynamics do not respect, and of goals that coincide."""
    broken = formation.broken_symmetries(model)
    told = [
        f"the offset of agent {agent} is no symmetry of `{type(model).__name__}`: {reason}, "
        "so the agents settle off their goals."
        for agent, reason in list(broken.items())[:1]
    ]
    pairs = formation.coincident() if model.position else ()
    told += [
        f"agents {i} and {j} have the same goal, and would collide there." for i, j in pairs[:3]
    ]
    if len(pairs) > 3:
        told.append(f"{len(pairs) - 3} more pairs of agents have the same goal.")
    return tuple(told)
