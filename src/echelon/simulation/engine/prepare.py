"""Checks and completes the parts of a run before it starts, whatever drives the agents."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.linearization import at_trim
from echelon.agents.models.model import ControlAffine, position_unit
from echelon.agents.models.model_check import check_model
from echelon.agents.models.relative_equilibrium import moves, path_states, separation
from echelon.agents.models.unlike import group_of, title_of
from echelon.agents.network.channel import Channel
from echelon.agents.network.events import event_faults
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import FormationMotion
from echelon.agents.world.sensing import Sensors
from echelon.core.cache import BoundedCache
from echelon.core.errors import SimulationError, check_kind, listing
from echelon.core.identity import digest
from echelon.core.limits import excess_frames
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.core.words import amount
from echelon.simulation.engine.frame_numbers import ClosestPair
from echelon.simulation.engine.parts import Parts, initial_states
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.meter import RunStatistics
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.settings import Settings


class Prepared(NamedTuple):
    """Parts that are checked, with their drive completed; the problem; the warnings of all."""

    parts: Parts
    problem: Problem
    warnings: tuple[str, ...]


def _size(prepared: Prepared) -> int:
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
    check_kind("parts", parts, Parts)
    check_kind("settings", settings, Settings)
    settings.check()
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
    model, graph, formation = parts.model, parts.graph, parts.formation
    # Gains, plans and starts are the same in a float32 run, and so is what is guaranteed of them.
    with precision("float64"):
        warnings = check_model(model) + parts.formation.remarks + parts.world.check(model)
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
        drive.check_backups(graph)
        if parts.leadership is not None:
            parts.leadership.check_network(parts.world.network)
        drive.check_world(parts.world, graph, settings.dt)
        scales = drive.safety and drive.safety.scales(model)
        problem = Problem(
            model,
            graph,
            formation,
            PlantStep.of(model, parts.world, settings, graph.agents),
            RunStatistics.of(model, graph, formation, settings, scales, _has_domain(parts)),
            settings,
            initial_states(parts, settings.seed),
            channel,
            sensors_of(parts, settings),
            parts.leadership,
            parts.world.parts,
        )
        parts.drive.accept(problem)
        warnings += parts.drive.warnings(model, graph, settings)
        if parts.formation.motion is not None:
            warnings += parts.drive.check_motion(parts.formation, graph)
    warnings += (*part_warnings(parts, problem.states, settings),)
    # Model and drive may say the same; a dictionary keeps the first, and the order.
    return Prepared(parts, problem, tuple(dict.fromkeys(warnings)))


def _has_domain(parts: Parts) -> bool:
    """Return whether a theorem may ask complete parts to stay in a domain; kinks have one too."""
    gain = parts.drive.gain
    claimed = gain is not None and gain.certificate.region is not None
    return claimed or (gain is not None and bool(at_trim(parts.model).kinks.any()))


def sensors_of(parts: Parts, settings: Settings) -> Sensors:
    """Return the sensors of a run."""
    sensing = parts.world.sensing
    if sensing is None:
        return Sensors()
    return sensing.prepared(parts.model, settings.dt, settings.horizon, settings.seed)


def channel_of(parts: Parts, settings: Settings) -> Channel | None:
    """Return the channel of a run; None for the ideal network."""
    network = parts.world.network
    return network and network.prepared(settings.dt, settings.horizon, settings.seed)


def check_engine(parts: Parts, settings: Settings) -> None:
    """Raise `EchelonError`, before compiling, unless the requested engine can step the agents."""
    if settings.engine == "native":
        prepared = prepare(parts, settings)
        with precision("float64"):
            prepared.parts.drive.check_engine(prepared.problem)


def check_memory(model: ControlAffine, agents: int, settings: Settings) -> None:
    """Raise `SimulationError`, with how many frames would fit, unless memory suffices for a run."""
    n, m = len(model.state_names), len(model.input_names)
    every = settings.store_every
    # The last term is the reference.
    numbers = agents * (n + m) + n
    excess = excess_frames(1 + -(-settings.steps // every), numbers, every)
    if excess is not None:
        raise SimulationError(f"the run {excess}.")


def _check_events(parts: Parts, settings: Settings) -> None:
    graph = parts.graph
    for fault in event_faults(graph.before, graph.events, graph.backups, settings.horizon):
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
    if moves(model):
        _check_translations(model, parts.formation)


def _check_translations(model: ControlAffine, formation: Formation) -> None:
    """Check that agents that move with the trim keep their offsets."""
    for agent, offset in enumerate(formation.offsets):
        away = separation(model, offset - formation.offsets[0])
        if np.abs(away).max() > _KEPT:
            along = np.abs(away[list(path_states(model))])
            size = float(np.linalg.norm(along)) or float(np.abs(away).max())
            unit = f"{position_unit(model)}/s" if along.any() and model.position else "per second"
            names = [n for n, x in zip(model.state_names, offset, strict=True) if x]
            raise SimulationError(
                f"the offset of agent {agent} in {listing(names)} separates it from the leader by "
                f"{size:.3g} {unit} for ever, since the trim of `{type(model).__name__}` moves; "
                "offset only what neither f nor g uses, such as positions."
            )


_KEPT = 1e-9
"""1/s, in the unit of each state: agents that separate no faster keep their offsets."""
_HALF_TURN = 3.0
"""Below half a turn in rad: no smaller spread is looked at, since `difference` is compiled."""
_MET = 1e-9
"""m; agents without a radius that come so near to each other meet."""
_COARSE = 1e-3
"""m; a run whose positions are not resolved to this is warned of."""


def part_warnings(parts: Parts, states: Array, settings: Settings) -> Iterator[str]:
    """Yield a sentence for each thing that is probably not intended.

    Args:
        parts: checked.
        states: (N, n) at time zero.
        settings: of the run.
    """
    for shape in parts.formation.shapes:
        yield from _goals(parts.model, shape)
    motion = parts.formation.motion
    if motion is not None and parts.drive.safety is None:
        yield from _meetings(parts.model, motion)
    yield from _starts(parts.model, states)
    yield from _spreads(parts)
    yield from _coarse(parts.model, states, settings)
    for part in parts.world.all_parts:
        yield from part.remarks(parts.model, settings.horizon)


def _coarse(model: ControlAffine, states: Array, settings: Settings) -> Iterator[str]:
    """Yield that positions (N, n) are too large for the digits of single precision."""
    if settings.precision != "float32" or not model.position:
        return
    farthest = np.abs(states[:, list(model.position_indices())]).max()
    with np.errstate(over="ignore"):
        step = float(np.spacing(np.float32(farthest)))
    if _COARSE < step < np.inf:
        yield (
            f"single precision resolves {step:.2g} m at the coordinate {farthest:.3g} m; "
            "`float64` resolves a billionth of that."
        )


def _goals(model: ControlAffine, formation: Formation) -> Iterator[str]:
    broken = formation.broken_symmetries(model)
    # One warning is enough: the other offsets mostly break the same symmetry.
    for agent, reason in list(broken.items())[:1]:
        yield (
            f"the offset of agent {agent} is no symmetry of "
            f"`{group_of(model, agent) or title_of(model)}`: {reason}, "
            "so the agents settle off their goals."
        )
    if not model.position:
        return
    pairs = formation.coincident()
    for i, j in pairs[:3]:
        yield f"agents {i} and {j} have the same goal, and would collide there."
    if len(pairs) > 3:
        yield f"{len(pairs) - 3} more pairs of agents have the same goal."
    if not pairs and model.radius is not None:
        closest = ClosestPair.of(formation.offsets[:, list(model.position_indices())], 0.0)
        if closest.touch(model.radius):
            i, j = closest.agents
            yield (
                f"the goals of agents {i} and {j} are {closest.distance:.3g} m apart, and agents "
                f"of radius {model.radius:.2g} m touch below {2.0 * model.radius:.3g} m."
            )


def _meetings(model: ControlAffine, motion: FormationMotion) -> Iterator[str]:
    for begin, i, j, apart in motion.meetings():
        if apart <= 2.0 * (model.radius or 0.0) + _MET:
            yield (
                f"in the reshape at {begin:g} s agents {i} and {j} come within {apart:.3g} m of "
                "each other; add `safety`, or choose other places."
            )


def _starts(model: ControlAffine, states: Array) -> Iterator[str]:
    for name, (low, high) in model.chart.items():
        values = states[:, model.state_names.index(name)]
        outside = np.flatnonzero(~((low < values) & (values < high)))
        for agent in outside[:1]:
            yield (
                f"agent {agent} starts with `{name}` at {values[agent]:.3g}, and the equations of "
                f"`{type(model).__name__}` hold between {low:.3g} and {high:.3g} only."
            )


def _spreads(parts: Parts) -> Iterator[str]:
    """Yield the states whose spread is larger than a difference of theirs can be."""
    model, initial = parts.model, parts.initial
    own = type(model).difference is not ControlAffine.difference
    if not own or not isinstance(initial, Mapping):
        return
    spread = model.per_state({k: v for k, v in initial.items() if isinstance(k, str)})  # type: ignore[misc]
    trim = np.asarray(model.trim[0], float)
    large = [
        k for k in np.flatnonzero(spread > _HALF_TURN).tolist() if _wraps(model, trim, k, spread[k])
    ]
    if large:
        names, sizes = (model.state_names[k] for k in large), {f"{spread[k]:g}" for k in large}
        yield (
            f"the initial spread of {listing(names)} is {' or '.join(sorted(sizes))} rad, and a "
            "difference of angles is at most half a turn, 3.14 rad."
        )


def _wraps(model: ControlAffine, trim: Array, k: int, size: float) -> bool:
    """Tell whether states that differ by a size in one state are closer to the model."""
    step = size * np.eye(len(trim))[k]
    with precision("float64"):
        difference = model.difference(jnp.asarray(trim + step), jnp.asarray(trim))
    return abs(float(difference[k])) < 0.999 * size
