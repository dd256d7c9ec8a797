"""A run as plain arrays and names, from its dataset or from `run.nc`, without the model's code.

All figures draw a recording, so that a stored run gives the same figures as the run itself, and a
run that is still computed shows the same as one that is complete.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from echelon.agents.network.formation import Formation
from echelon.agents.network.switching import Schedule
from echelon.core.claim import number_in
from echelon.core.errors import OutputError
from echelon.core.numerics import precision
from echelon.core.types import Array, JsonObject
from echelon.core.words import GuaranteeVerdict, Theorem, amount
from echelon.experiments.results.dataset import FORMAT, labelled, labelled_parts
from echelon.experiments.results.labelled import Labelled, read_labelled
from echelon.experiments.results.metrics import Avoidance, Ellipsoid
from echelon.simulation.engine.frame_numbers import FrameChoice, FrameNumbers
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.record import Segment
from echelon.simulation.engine.result import Result
from echelon.simulation.step.settings import Settings

_AHEAD, _PLACES = 60.0, 121
"""Seconds of the reference by which the scene is sized, and the number of times in them."""
_BLOCK = 32
"""Frames for which V is computed at once: a constant, so that it is compiled once."""
_NOT_COMPUTED: JsonObject = {}
"""The guarantee of a run for which none was computed."""


class InputBounds(NamedTuple):
    """Limits of the actuators, low <= G u <= high."""

    matrix: Float[np.ndarray, "k m"]
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]

    def loads(self, inputs: Float[np.ndarray, "... m"]) -> Float[np.ndarray, "... k"] | None:
        """Return rows of G u as fractions of their range; None where a row has a single bound."""
        matrix, low, high = self
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            return None
        return (inputs @ matrix.T - low) / (high - low)


class TrackingErrors(NamedTuple):
    """Outputs of the L leaders minus their references', with the outputs' names and units."""

    error: Float[np.ndarray, "T L q"]
    names: tuple[str, ...]
    units: tuple[str, ...]


class LoopPoles(NamedTuple):
    """Poles of the checked modes, each mode with its eigenvalue of the graph."""

    poles: Complex[np.ndarray, "K n"]
    eigenvalues: Float[np.ndarray, " K"]


class MessageAges(NamedTuple):
    """Messages over a network that is late.

    Attributes:
        agents: age of the oldest message that an agent has of a neighbour, s; NaN before the first.
        edges: age of the newest message at each end of an edge, s.
        lost: at each end of an edge, since the frame before.
        forget: age beyond which messages are not used, s.
    """

    agents: Float[np.ndarray, "T N"]
    edges: Float[np.ndarray, "T E 2"]
    lost: Int[np.ndarray, "T E 2"]
    forget: float


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Recording(FrameNumbers):
    """A run: T stored frames of N agents with n states and m inputs, L of them leaders.

    Attributes:
        name: of the scenario, or of the model.
        model: the name of its class.
        times: s.
        inputs: as delivered by the actuators.
        reference: the leaders' reference state; None without one.
        offsets: each agent's goal relative to its leader; the first one where it moves.
        edges: with `weights`; of a graph that switches, all edges that exist at some time.
        heard: whether each end of an edge receives from the other.
        schedule: the weights over time, and who is there; None where they are constant.
        state_names, state_units, input_names, input_units: as texts.
        position: indices of the coordinates that a picture shows; none of an abstract agent.
        bounds: of the inputs; None without limits.
        lyapunov: V; None where the law has none.
        metric: P of V, where there is a gain; else None.
        saturated: fraction of steps in which a limit changed the agent's input.
        tracking: of the leaders; None without a reference.
        modes: None where the laws have no linearization.
        messages: over a network; None in the ideal one.
        avoidance: how agents kept apart, without slices before they did; None where they do not.
        guarantee: as `Guarantee.as_mapping` returns it; empty where none was computed.
        horizon, dt: s.
        attributes: provenance and settings, as stored.
        events: what happened, by time: `at` (s), `what`, `agents`, `until` (s) and `text`.
        radius: of an agent, m; None without a size.
        moving: offsets over time; None of constant ones.
    """

    name: str
    model: str
    times: Float[np.ndarray, " T"]
    states: Float[np.ndarray, "T N n"]
    inputs: Float[np.ndarray, "T N m"]
    reference: Float[np.ndarray, "T n"] | None
    offsets: Float[np.ndarray, "N n"]
    leaders: tuple[int, ...]
    nearest: Int[np.ndarray, " N"]
    edges: Int[np.ndarray, "E 2"]
    weights: Float[np.ndarray, " E"]
    heard: Bool[np.ndarray, "E 2"]
    schedule: Schedule | None
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    input_units: tuple[str, ...]
    position: tuple[int, ...]
    bounds: InputBounds | None
    lyapunov: Float[np.ndarray, " T"] | None
    lyapunov_rate: Float[np.ndarray, " T"] | None
    metric: Float[np.ndarray, "n n"] | None
    saturated: Float[np.ndarray, " N"]
    tracking: TrackingErrors | None
    modes: LoopPoles | None
    messages: MessageAges | None
    avoidance: Avoidance | None
    guarantee: JsonObject
    horizon: float
    dt: float
    attributes: JsonObject
    events: tuple[JsonObject, ...] = ()
    radius: float | None = None
    moving: Float[np.ndarray, "T N n"] | None = None

    def __repr__(self) -> str:
        frames = amount(len(self.times), "frame")
        return f"Recording({self.name!r}, {self.agents} agents, {frames})"

    @property
    def agents(self) -> int:
        """The number of agents."""
        return self.states.shape[1]

    @functools.cached_property
    def arrows(self) -> Int[np.ndarray, "K 2"]:
        """Edges along which only one end receives, as (sender, receiver)."""
        one = self.heard.sum(axis=1) == 1
        return np.where(self.heard[one, 1:], self.edges[one], self.edges[one, ::-1])

    def offsets_in(self, frames: FrameChoice = slice(None)) -> Float[np.ndarray, "*F N n"]:
        """Return the goal offsets in some frames, (F, N, n), or constant ones, (N, n)."""
        return self.offsets if self.moving is None else self.moving[frames]

    def linked(self, time: float) -> Bool[np.ndarray, " E"]:
        """Return which edges exist at a time (s)."""
        if self.schedule is None:
            return np.ones(len(self.edges), bool)
        return self.schedule.weights[self.schedule.row(time)] > 0.0

    @functools.cached_property
    def followers(self) -> tuple[int, ...]:
        """The agents that do not lead."""
        leaders = {*self.leaders}
        return tuple(k for k in range(self.agents) if k not in leaders)

    @property
    def ellipsoid(self) -> Ellipsoid | None:
        """The ellipsoid about each agent, a ball where they do not keep apart; None of a point."""
        if self.avoidance is not None:
            return self.avoidance.ellipsoid
        return None if self.radius is None else Ellipsoid(self.radius, self.radius, 2 * self.radius)

    @property
    def scales(self) -> Float[np.ndarray, " d"]:
        """The factors of the position's coordinates in distances between agents."""
        names, sizes = [self.state_names[k] for k in self.position], self.ellipsoid
        return np.ones(len(names)) if sizes is None else sizes.radius / sizes.radii(names)

    def near(self, frames: Int[np.ndarray, " F"]) -> Avoidance | None:
        """Return how near agents came: over all steps if they keep apart, else in frames.

        None of a single agent, and of agents without a size.
        """
        if self.avoidance is not None and len(self.avoidance.times):
            return self.avoidance
        distance = self.least_distances(frames, self.scales) if self.agents > 1 else None
        if distance is None or self.ellipsoid is None:
            return None
        return Avoidance(self.times[frames], distance, 0.0 * distance, self.ellipsoid)

    @property
    def rate(self) -> float | None:
        """The rate at which errors are guaranteed to decay from the start, 1/s; None for none."""
        held = self.guarantee.get("verdict") == str(GuaranteeVerdict.GUARANTEED)
        held = held and number_in(self.guarantee, "set_entered") is None
        return number_in(self.guarantee, "rate") or None if held else None

    def error_bound(self) -> Float[np.ndarray, " T"] | None:
        """Return the bound of a theorem on every formation error; None where no theorem applies.

        By Theorem 1, S = sum_i delta_i'P delta_i decays as e^(-2 alpha t) from starts in the
        certified set, if no limit acts and the scenario adds no wind or mismatch. If
        delta'P delta <= S, the norm of the measured part is at most the root of S times the largest
        eigenvalue of that block of P^-1.
        """
        stated = self.guarantee
        # While no limit acts, which is looked at here, a conditional claim holds as well.
        proved = stated.get("claim") is not None and stated["theorem"] == str(Theorem.T1)
        if not (proved and stated["covers_start"]) or self.metric is None:
            return None
        if number_in(stated, "set_entered") is not None:
            return None  # until then nothing bounds them
        rate = number_in(stated, "rate")
        if rate is None or self.saturated.any() or stated["ignores"]:
            return None
        first = self.deviations([0])[0]
        start = float(np.einsum("ia,ab,ib->", first, self.metric, first))
        block = np.linalg.inv(self.metric)[np.ix_(self.measured, self.measured)]
        largest = float(np.linalg.eigvalsh(block)[-1])
        return np.sqrt(start * largest) * np.exp(-(rate or 0.0) * self.times)

    @property
    def loads(self) -> Float[np.ndarray, "T N k"] | None:
        """Loads of the inputs, NaN of absent agents; None where they have none."""
        loads = None if self.bounds is None else self.bounds.loads(self.inputs)
        return None if loads is None else self.while_present(loads, range(self.agents))

    def while_present(
        self, values: Float[np.ndarray, "T K *s"], agents: Sequence[int]
    ) -> Float[np.ndarray, "T K *s"]:
        """Return values of some agents over time, NaN while those are absent."""
        if self.presence is None:
            return values
        here = self.presence[:, list(agents)]
        return np.where(here.reshape(*here.shape, *[1] * (values.ndim - 2)), values, np.nan)


def recording_of(run: Result | Recording) -> Recording:
    """Return a run as figures draw it; of a run from disk no part is built."""
    if isinstance(run, Recording):
        return run
    data = labelled(run)
    return recording(data.arrays(), data.attributes)


def read_recording(file: Path) -> tuple[Recording, Labelled]:
    """Return the run in a netCDF file, and all that the file contains.

    Raises:
        OutputError: the file cannot be read, is damaged, or has another format.
    """
    try:
        data = read_labelled(file)
        return recording(data.arrays(), data.attributes), data
    except OutputError as error:
        raise OutputError(f"`{file}`: {error}") from error
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        raise OutputError(
            f"`{file}` cannot be read as a run: it is damaged, or was not written by echelon "
            f"({str(error).splitlines()[0] if str(error) else type(error).__name__})."
        ) from error


def is_unlike(run: Recording) -> bool:
    """Tell whether a run is of groups of unlike agents."""
    return bool(run.attributes.get("groups"))


def group_name(run: Recording, agent: int) -> str:
    """Return the name of an agent's group, which its last state says; empty where all are alike."""
    if not is_unlike(run):
        return ""
    return str(run.attributes["groups"]).split("; ")[round(run.states[0, agent, -1])]


def recording(arrays: Mapping[str, np.ndarray], attributes: JsonObject) -> Recording:
    """Return a run from the arrays and the attributes of its dataset.

    Raises:
        OutputError: the dataset has another format.
        KeyError: it is not a dataset of a run.
    """
    if "states" not in arrays or "model" not in attributes:
        raise KeyError("it has no states of agents")
    version = int(attributes.get("format", 1))
    if version != FORMAT:
        by = attributes.get("version_echelon", "?")
        raise OutputError(
            f"the run has format {version}, of echelon {by}, and this version reads format "
            f"{FORMAT}; run it again by `echelon run FOLDER --out OTHER`."
        )
    names = _texts(arrays, "state")
    return Recording(
        name=str(attributes.get("scenario") or attributes["model"]),
        model=str(attributes["model"]),
        times=arrays["time"],
        states=arrays["states"],
        inputs=arrays["inputs"],
        reference=arrays.get("reference"),
        offsets=arrays["offset"],
        moving=arrays.get("moving_offset"),
        leaders=tuple(int(k) for k in np.flatnonzero(arrays["is_leader"])),
        nearest=arrays["nearest_leader"].astype(int),
        edges=arrays["edge_agents"].astype(int),
        weights=arrays["edge_weight"],
        heard=arrays["edge_heard"].astype(bool),
        schedule=_schedule(arrays),
        state_names=names,
        state_units=_texts(arrays, "state_unit"),
        input_names=_texts(arrays, "input"),
        input_units=_texts(arrays, "input_unit"),
        # As text, since netCDF stores an empty list as nothing.
        position=tuple(names.index(name) for name in str(attributes["position"]).split()),
        bounds=_bounds(arrays),
        lyapunov=arrays.get("lyapunov"),
        lyapunov_rate=arrays.get("lyapunov_rate"),
        metric=arrays.get("P"),
        saturated=arrays["saturated"],
        tracking=_tracking(arrays),
        modes=_modes(arrays),
        messages=_messages(arrays),
        avoidance=_avoidance(arrays),
        events=tuple(json.loads(attributes.get("events", "[]"))),
        guarantee=json.loads(attributes["guarantee"]),
        horizon=float(attributes["horizon"]),
        dt=float(attributes["dt"]),
        attributes=dict(attributes),
        radius=float(attributes["radius"]) if "radius" in attributes else None,
    )


def _texts(arrays: Mapping[str, np.ndarray], name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in arrays[name])


def _schedule(values: Mapping[str, np.ndarray]) -> Schedule | None:
    if "stretch_start" not in values:
        return None
    period = float(values["graph_period"])
    starts, weights = values["stretch_start"], values["edge_weight_then"]
    present, nearest = values.get("present_then"), values.get("nearest_leader_then")
    if present is None or nearest is None:
        return Schedule(starts, weights, period if np.isfinite(period) else None)
    return Schedule(starts, weights, None, present.astype(bool), nearest.astype(int))


def _bounds(values: Mapping[str, np.ndarray]) -> InputBounds | None:
    if "limit_matrix" not in values:
        return None
    return InputBounds(values["limit_matrix"], values["limit_low"], values["limit_high"])


def _tracking(values: Mapping[str, np.ndarray]) -> TrackingErrors | None:
    if "tracking_error" not in values:
        return None
    names, units = _texts(values, "output"), _texts(values, "output_unit")
    return TrackingErrors(values["tracking_error"], names, units)


def _modes(values: Mapping[str, np.ndarray]) -> LoopPoles | None:
    if "pole_real" not in values:
        return None
    poles = values["pole_real"] + 1j * values["pole_imaginary"]
    return LoopPoles(poles, values["mode_eigenvalue"])


def _avoidance(values: Mapping[str, np.ndarray]) -> Avoidance | None:
    if "ellipsoid_radius" not in values:
        return None
    names = "ellipsoid_radius", "ellipsoid_height", "kept_distance"
    ellipsoid = Ellipsoid(*(float(values[name]) for name in names))
    slices = "slice_start", "scaled_distance", "active_rows"
    times, distance, active = (values.get(name, np.zeros(0)) for name in slices)
    return Avoidance(times, distance, active, ellipsoid)


def _messages(values: Mapping[str, np.ndarray]) -> MessageAges | None:
    if "edge_age" not in values:
        return None
    rows = values["age"], values["edge_age"], values["edge_lost"].astype(int)
    return MessageAges(*rows, float(values["forget"]))


def empty_recording(
    parts: Parts,
    settings: Settings,
    states: Float[Array, "N n"],
    name: str,
    stated: JsonObject = _NOT_COMPUTED,
) -> Recording:
    """Return a recording of agents that stay at their goals, by which the scene is sized."""
    model, fixed = parts.model, labelled_parts(parts, settings)
    times = np.linspace(0.0, min(_AHEAD, max(settings.horizon, 10.0)), _PLACES)
    ahead, reference = _ahead(parts, states, times)
    trim, agents = np.asarray(model.trim[1], float), parts.graph.agents
    frames = {
        "time": times,
        "states": ahead,
        "inputs": np.broadcast_to(trim, (_PLACES, agents, len(trim))),
        "saturated": np.zeros(agents),
    }
    frames |= {} if reference is None else {"reference": reference}
    if parts.formation.motion is not None:
        frames["moving_offset"] = parts.formation.offsets_at(times)
    attributes = {"scenario": name, "outcome": "completed", "message": ""}
    attributes["guarantee"] = json.dumps(stated)
    return recording(fixed.arrays() | frames, fixed.attributes | attributes)


def _ahead(
    parts: Parts, start: Float[Array, "N n"], times: Float[Array, " T"]
) -> tuple[Float[Array, "T N n"], Float[Array, "T n"] | None]:
    with precision("float64"):
        path = parts.drive.reference_states(parts.model, jnp.asarray(times))
    if path is None:
        return np.broadcast_to(start, (len(times), *np.shape(start))).copy(), None
    reference = np.asarray(path, float)
    states = reference[:, None] + parts.formation.offsets_at(times)
    states[0] = start
    return states, reference


def so_far(
    run: Recording,
    segment: Segment,
    potential: Callable[[Array], Array] | None,
    formation: Formation,
) -> Recording:
    """Return a part of a run as a recording.

    `run` is one of `empty_recording`; `potential` gives V (T,) of states minus offsets (T, N, n).
    """
    moving = None if formation.motion is None else formation.offsets_at(segment.times)
    lyapunov, count = None, len(segment.times)
    if potential is not None:
        # Block by block, the last one padded with copies.
        y = segment.states - run.offsets
        whole = -(-count // _BLOCK) * _BLOCK
        padded = np.concatenate([y, np.repeat(y[-1:], whole - count, axis=0)])
        blocks = map(potential, np.split(padded, whole // _BLOCK))
        lyapunov = np.concatenate([*blocks])[:count]
    return dataclasses.replace(
        run,
        times=segment.times,
        states=segment.states,
        inputs=segment.inputs,
        reference=segment.reference,
        moving=moving,
        lyapunov=lyapunov,
    )
