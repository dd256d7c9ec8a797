"""What is checked and made ready before a run, whatever drives it."""

from typing import NamedTuple

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.formation import Formation
from echelon.core.errors import SimulationError, check_kind
from echelon.core.limits import excess_frames
from echelon.core.numerics import precision
from echelon.simulation.engine.initial import initial_states
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.meter import Meter
from echelon.simulation.step.motion import Motion
from echelon.simulation.step.settings import Settings


class Prepared(NamedTuple):
    """Parts that are checked, with their drive completed; the problem; the warnings of all."""

    parts: Parts
    problem: Problem
    warnings: tuple[str, ...]


def prepare(parts: Parts, settings: Settings, to_store: bool = False) -> Prepared:
    """Check all parts and complete those that depend on others, in float64.

    Args:
        parts: agents, graph, formation, what drives them, starts and world.
        settings: of the run.
        to_store: whether a whole run will be stored, which must then have room.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    check_given(parts, settings)
    model, graph, formation = parts.model, parts.graph, parts.formation
    # Gains, plans and starts are the same in a float32 run, and so is what is promised of them.
    with precision("float64"):
        warnings = check_model(model) + parts.world.check(model)
        _check_offsets(model, parts)
        if to_store:
            # Before gains and plans, which may take long.
            check_memory(model, graph.agents, settings)
        drive = parts.drive.prepare(model, graph)
        # What is complete stays the same object, so that what is known of it is found again.
        parts = parts if drive is parts.drive else parts.replace(drive=drive)
        problem = Problem(
            model,
            graph,
            formation,
            Motion.of(model, parts.world, settings),
            Meter.of(model, graph, formation, settings),
            settings,
            initial_states(parts, settings.seed),
            parts.world.channel,
        )
        parts.drive.accept(problem)
        warnings += parts.drive.warnings(model, graph, settings)
    warnings += formation_warnings(model, formation)
    # Model and drive may say the same; a dictionary keeps the first, and the order.
    return Prepared(parts, problem, tuple(dict.fromkeys(warnings)))


def check_given(parts: Parts, settings: Settings) -> None:
    """Check what a run is asked for.

    Raises:
        EchelonError: it is something else, or a number of the settings is out of range.
    """
    check_kind("parts", parts, Parts)
    check_kind("settings", settings, Settings)
    settings.check()


def check_memory(model: ControlAffine, agents: int, settings: Settings) -> None:
    """Check that what a run of so many agents stores has room, before anything is made for it.

    Raises:
        SimulationError: it has not, and what would.
    """
    n, m = len(model.state_names), len(model.input_names)
    every = settings.store_every
    # The last term is the reference.
    numbers = agents * (n + m) + n
    excess = excess_frames(1 + -(-settings.steps // every), numbers, every)
    if excess is not None:
        raise SimulationError(f"the run {excess}.")


def _check_offsets(model: ControlAffine, parts: Parts) -> None:
    shape = (parts.graph.agents, len(model.state_names))
    if parts.formation.offsets.shape != shape:
        raise SimulationError(
            f"the formation has offsets {parts.formation.offsets.shape}, and {shape[0]} agents "
            f"with {shape[1]} states need {shape}."
        )


def formation_warnings(model: ControlAffine, formation: Formation) -> tuple[str, ...]:
    """Tell of offsets that the dynamics do not respect, and of goals that coincide."""
    broken = formation.broken_symmetries(model)
    sentences = [
        f"the offset of agent {agent} is no symmetry of `{type(model).__name__}`: {reason}, "
        "so the agents settle off their goals."
        # The first is enough: what one offset breaks, the others mostly break too.
        for agent, reason in list(broken.items())[:1]
    ]
    pairs = formation.coincident() if model.position else ()
    sentences += [
        f"agents {i} and {j} have the same goal, and would collide there." for i, j in pairs[:3]
    ]
    if len(pairs) > 3:
        sentences.append(f"{len(pairs) - 3} more pairs of agents have the same goal.")
    return tuple(sentences)
