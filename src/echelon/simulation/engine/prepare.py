"""Checks and completes the parts of a run before it starts, whatever drives the agents."""

from typing import NamedTuple

import jax
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.channel import Channel
from echelon.agents.network.events import event_faults
from echelon.agents.world.sensing import Sensors
from echelon.core.cache import BoundedCache
from echelon.core.errors import SimulationError, check_kind
from echelon.core.identity import digest
from echelon.core.limits import excess_frames
from echelon.core.numerics import precision
from echelon.core.words import amount
from echelon.simulation.engine.initial import initial_states
from echelon.simulation.engine.part_warnings import part_warnings
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


def _size(prepared: Prepared) -> int:
    """Return the bytes of what is held with prepared parts."""
    arrays = jax.tree.leaves((prepared.problem.meter, prepared.problem.states))
    return sum(np.asarray(array).nbytes for array in arrays)


_CACHE = BoundedCache[Prepared](4, _size, 256 * 2**20)
"""Parts that were prepared last: a run, its guarantee and its gradient ask for the same."""


def prepare(parts: Parts, settings: Settings, to_store: bool = False) -> Prepared:
    """Check all parts and complete those that depend on others, in float64.

    The same parts are prepared once, unless a user's class takes part, which may change.

    Args:
        parts: agents, graph, formation, what drives them, starts and world.
        settings: of the run.
        to_store: whether a whole run will be stored, for which there must be memory.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    check_given(parts, settings)
    # By their bits too, since somebody may write to an array in them; a graph never changes.
    mutable = parts.model, parts.drive, parts.initial, parts.start_error, parts.world
    bits = digest((mutable, parts.formation.offsets, parts.formation.motion, settings))
    key = None if bits is None else (parts, bits)
    prepared = _CACHE.get_or_make(key, lambda: _prepare(parts, settings, to_store))
    if to_store:
        # Checked again, since the parts may have been prepared without storing in mind.
        check_memory(parts.model, parts.graph.agents, settings)
    return prepared


def _prepare(parts: Parts, settings: Settings, to_store: bool) -> Prepared:
    """Prepare parts that are not in the cache."""
    model, graph, formation = parts.model, parts.graph, parts.formation
    # Gains, plans and starts are the same in a float32 run, and so is what is guaranteed of them.
    with precision("float64"):
        warnings = check_model(model) + parts.world.check(model)
        _check_offsets(model, parts)
        if to_store:
            # Before gains and plans, which may take long.
            check_memory(model, graph.agents, settings)
        _check_events(parts, settings)
        # Laws are made for the graph as it is before anything happens to it.
        drive = parts.drive.prepare(model, graph.before)
        # A complete drive stays the same object, since caches use its identity.
        parts = parts if drive is parts.drive else parts.replace(drive=drive)
        parts.world.check_agents(model, graph.agents)
        # Its own numbers first: whether they suit the laws is asked of a network that can be.
        channel = channel_of(parts, settings)
        drive.check_heirs(graph)
        if parts.leadership is not None:
            parts.leadership.check_network(parts.world.network)
            if parts.leadership.waits is not None:
                drive.check_patience()
        drive.check_world(parts.world, graph, settings.dt)
        problem = Problem(
            model,
            graph,
            formation,
            Motion.of(model, parts.world, settings, graph.agents),
            Meter.of(
                model, graph, formation, settings, drive.safety and drive.safety.scales(model)
            ),
            settings,
            initial_states(parts, settings.seed),
            channel,
            sensors_of(parts, settings),
            parts.leadership,
        )
        parts.drive.accept(problem)
        warnings += parts.drive.warnings(model, graph, settings)
        if parts.formation.motion is not None:
            warnings += parts.drive.check_motion(parts.formation, graph)
    warnings += (*part_warnings(parts, problem.states, settings),)
    # Model and drive may say the same; a dictionary keeps the first, and the order.
    return Prepared(parts, problem, tuple(dict.fromkeys(warnings)))


def sensors_of(parts: Parts, settings: Settings) -> Sensors | None:
    """Return the sensors of a run; None for exact ones."""
    sensing = parts.world.sensing
    return sensing and sensing.prepared(parts.model, settings.dt, settings.horizon, settings.seed)


def channel_of(parts: Parts, settings: Settings) -> Channel | None:
    """Return the channel of a run; None for the ideal network."""
    network = parts.world.network
    return network and network.prepared(settings.dt, settings.horizon, settings.seed)


def check_given(parts: Parts, settings: Settings) -> None:
    """Check the arguments of a run.

    Raises:
        EchelonError: they are of another kind, or a number of the settings is out of range.
    """
    check_kind("parts", parts, Parts)
    check_kind("settings", settings, Settings)
    settings.check()


def check_engine(parts: Parts, settings: Settings) -> None:
    """Check, before anything is compiled, that the engine which is requested can step the agents.

    Raises:
        EchelonError: it cannot, or a part is malformed or does not fit the others.
    """
    if settings.engine == "native":
        prepared = prepare(parts, settings)
        with precision("float64"):
            prepared.parts.drive.check_engine(prepared.problem)


def check_memory(model: ControlAffine, agents: int, settings: Settings) -> None:
    """Check that memory suffices for what a run of so many agents stores.

    Raises:
        SimulationError: it does not; the text says how many frames would fit.
    """
    n, m = len(model.state_names), len(model.input_names)
    every = settings.store_every
    # The last term is the reference.
    numbers = agents * (n + m) + n
    excess = excess_frames(1 + -(-settings.steps // every), numbers, every)
    if excess is not None:
        raise SimulationError(f"the run {excess}.")


def _check_events(parts: Parts, settings: Settings) -> None:
    """Check that all that happens does so during the run."""
    graph = parts.graph
    for fault in event_faults(graph.before, graph.events, graph.heirs, settings.horizon):
        raise SimulationError(f"{fault.text}.")
    if graph.presence is not None and settings.devices > 1:
        raise SimulationError(
            f"`devices` is {settings.devices}, and must be 1 where agents are lost or join."
        )


def _check_offsets(model: ControlAffine, parts: Parts) -> None:
    shape = (parts.graph.agents, len(model.state_names))
    if parts.formation.offsets.shape != shape:
        raise SimulationError(
            f"the formation has offsets {parts.formation.offsets.shape}, and {shape[0]} agents "
            f"with {amount(shape[1], 'state')} need {shape}."
        )
