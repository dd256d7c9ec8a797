"""The knobs of a live loop: what they stand for, their sliders on the page, and scenario keys."""

import copy
import dataclasses
from typing import Any, NamedTuple, final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from echelon.agents.models.linearization import linearize
from echelon.agents.network.channel import Network
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import FormationMotion
from echelon.agents.network.graph import Graph
from echelon.agents.part import Event
from echelon.apps.live.attendance import RESHAPE
from echelon.core.errors import EchelonError
from echelon.core.numerics import precision
from echelon.core.types import Array, JsonObject
from echelon.core.words import Feedforward
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import Scenario, scenario_from_mapping
from echelon.guarantees.promises.closed_loop import LinearLoop, loop_of
from echelon.laws.law import Proves
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.synthesis.gains.gain import FixedGain, Gain
from echelon.synthesis.gains.riccati import Riccati


class Reshaping(NamedTuple):
    """A change of the shape that is under way: the shape before, by its name, and since when, s."""

    before: str | None
    at: float

    @property
    def end(self) -> float:
        """When all agents have their new places, s."""
        return self.at + RESHAPE


class Knobs(NamedTuple):
    """The positions of all knobs.

    Attributes:
        coupling: c; None of a law without one.
        weight: factor on the scenario's input weight R in the Riccati equation of the gain.
        feedforward: the share of the scenario's feed-forward that followers use, 0 to 1.
        size: factor on the size of the formation.
        turn: of the formation, degrees.
        wind: added to the rate of the first velocity, or of the first position.
        delay: of messages, s.
        loss: share of messages lost.
        outages: share of the time that a link is out.
        noise: factor on the noise of measurements.
        method: of the gain; None for the scenario's own.
        shape: of the formation; None for the scenario's own.
        events: agents that were lost and joined, by time.
        reshaping: how the formation comes to its shape; None where it has it.
    """

    coupling: float | None
    weight: float = 1.0
    feedforward: float = 1.0
    size: float = 1.0
    turn: float = 0.0
    wind: float = 0.0
    delay: float = 0.0
    loss: float = 0.0
    outages: float = 0.0
    noise: float = 1.0
    cut: frozenset[int] = frozenset()
    method: str | None = None
    shape: str | None = None
    events: tuple[Event, ...] = ()
    reshaping: Reshaping | None = None

    @property
    def roomy(self) -> bool:
        """Whether the loop needs room for events."""
        return bool(self.events or self.reshaping)

    @property
    def partial(self) -> bool:
        """Whether followers use less than the feed-forward that the scenario's law is about."""
        return self.feedforward < 1.0

    @property
    def before(self) -> "Knobs":
        """The positions with the shape that the formation comes from."""
        return self if self.reshaping is None else self._replace(shape=self.reshaping.before)


@final
class LiveParts:
    """The gain, formation, graph and wind of a loop at any position of the knobs."""

    def __init__(self, scenario: Scenario, experiment: Experiment) -> None:
        self.scenario, self.parts = scenario, experiment.parts
        model = self.parts.model
        self.start = _start(experiment)
        self.axes = list(model.position_indices())
        moves = self.parts.formation.motion is not None
        self.shapes = {} if moves else shapes_of(self.parts)
        # The state that the wind acts on; None of agents without a position.
        self.wind_state = self.axes[0] if self.axes else None
        if "velocity" in model.state_groups:
            self.wind_state = model.state_names.index(model.state_groups["velocity"][0])
        self._gains: dict[str | None, Gain | None] = {None: self.parts.drive.gain}
        self._weighted: tuple[tuple[str | None, float], Gain] | None = None

    def data(self) -> JsonObject:
        """Return a copy of the scenario's data, without its live events."""
        data = copy.deepcopy(self.scenario.data)
        data.pop("live", None)
        return data

    def gain(self, knobs: Knobs) -> Gain | None:
        """Return the gain of the method and the weight; its coupling is that of the method.

        Raises:
            ScenarioError: the method finds no gain.
        """
        gain = self.unweighted_gain(knobs)
        if gain is None or knobs.weight == 1.0:
            return gain
        key = knobs.method, knobs.weight
        if self._weighted is None or self._weighted[0] != key:
            self._weighted = key, self._weighted_gain(gain, *key)
        return self._weighted[1]

    def unweighted_gain(self, knobs: Knobs) -> Gain | None:
        """Return the gain of the method, with the scenario's input weight.

        Raises:
            ScenarioError: the method finds no gain.
        """
        if knobs.method not in self._gains:
            data = self.data()
            data.setdefault("follower", {})["gain"] = {"method": knobs.method}
            scenario = scenario_from_mapping(data, self.scenario.folder)
            self._gains[knobs.method] = build(scenario).parts.drive.gain
        return self._gains[knobs.method]

    def _weighted_gain(self, gain: Gain, method: str | None, weight: float) -> Gain:
        """Return a Riccati gain with another input weight, without a new certificate."""
        section = self.scenario.follower.gain if method is None else None
        with precision("float64"):
            linear = linearize(self.parts.model)
            feedback = Riccati(section and section.Q, weight * gain.R).feedback(
                self.parts.model, linear
            )
        return Gain(feedback.P, feedback.R, gain.coupling, gain.method, gain.certificate)

    def offsets(self, knobs: Knobs) -> Float[Array, "N n"]:
        """Return the offsets of the formation, scaled and turned about its first leader."""
        shape = self.parts.formation.offsets if knobs.shape is None else self.shapes[knobs.shape]
        offsets = np.array(shape, np.float64)
        center = offsets[self.parts.graph.leaders[0], self.axes]
        places = knobs.size * (offsets[:, self.axes] - center)
        if len(self.axes) > 1:
            angle = np.deg2rad(knobs.turn)
            c, s = np.cos(angle), np.sin(angle)
            places[:, :2] = places[:, :2] @ np.array([[c, s], [-s, c]])
        offsets[:, self.axes] = center + places
        return offsets

    def motion(self, knobs: Knobs, room: FormationMotion | None) -> FormationMotion | None:
        """Return how offsets change with time: the scenario's own, or to the shape of the knobs.

        `room` is a motion with room for one; None where a loop has none.
        """
        own = self.parts.formation.motion
        if own is not None or room is None:
            return own
        ends = [self.offsets(each)[:, self.axes] for each in (knobs.before, knobs)]
        center = ends[0][self.parts.graph.leaders[0]]
        begin = 0.0 if knobs.reshaping is None else knobs.reshaping.at
        rows = np.stack(ends, axis=1) - center, center, np.array([begin])
        return eqx.tree_at(lambda motion: (motion.places, motion.center, motion.begins), room, rows)

    def wind(self, knobs: Knobs) -> Float[Array, " n"]:
        """Return the constant wind of the scenario and the knob."""
        disturbance, model = self.parts.world.disturbance, self.parts.model
        wind = model.per_state({} if disturbance is None else disturbance.constant)
        if self.wind_state is not None:
            wind[self.wind_state] += knobs.wind
        return wind

    @property
    def longest_delay(self) -> float | None:
        """The delay (s) beyond which messages are forgotten when they arrive."""
        network = self.parts.world.network
        if network is None:
            return None
        return round(network.forget - 2.0 / network.rate - network.jitter, 9)

    def network(self, knobs: Knobs) -> Network | None:
        """Return the network with the delay, the losses and the outages of the knobs."""
        network = self.parts.world.network
        if network is None:
            return None
        bursts = dataclasses.replace(network.bursts, share=knobs.outages)
        return dataclasses.replace(network, delay=knobs.delay, loss=knobs.loss, bursts=bursts)

    def edges(self, knobs: Knobs, weights: Float[Array, " e"]) -> list[list[Any]]:
        """Return the edges with a weight that are not cut, as a scenario lists them."""
        edges = self.parts.graph.edges
        rows = [k for k in np.flatnonzero(weights) if k not in knobs.cut]
        pairs = zip(edges[rows].tolist(), weights[rows].tolist(), strict=True)
        return [[*pair, weight] for pair, weight in pairs]

    def graph(self, knobs: Knobs) -> Graph:
        """Return the graph without the cut edges.

        Raises:
            GraphError: it is disconnected.
        """
        graph = self.parts.graph
        return Graph(self.edges(knobs, graph.weights), graph.leaders, graph.agents, graph.directed)

    def loop(self, knobs: Knobs) -> LinearLoop | None:
        """Return the closed loop near the trim, as a guarantee judges it.

        None without a gain, on a switching graph, whose modes are not those of one matrix, after
        events, and in a world whose agents are others than those that theorems are about.

        Raises:
            GraphError: the cut links disconnect the graph.
        """
        gain, parts = self.gain(knobs), self.parts
        switches = parts.graph.schedule is not None or knobs.events
        if gain is None or switches or parts.drive.unknown or parts.world.presumed:
            return None
        gain = eqx.tree_at(lambda gain: gain.coupling, gain, knobs.coupling)
        assert isinstance(parts.drive, Laws)
        law: Any = parts.drive.follower
        law = dataclasses.replace(law, gain=gain)
        if not knobs.feedforward:
            law = dataclasses.replace(law, feedforward=Feedforward.NONE)
        # Without a cut the same object, whose eigenvalues are known.
        graph = self.graph(knobs) if knobs.cut else parts.graph
        with precision("float64"):
            return loop_of(parts.replace(drive=Laws(parts.drive.leader, law), graph=graph))


def _start(experiment: Experiment) -> Knobs:
    drive, network = experiment.parts.drive, experiment.parts.world.network
    coupling = None if drive.gain is None else drive.gain.coupling
    if drive.gain is None and isinstance(drive, Laws):
        own = Proves.of(drive.follower).strength(experiment.settings.dt)
        coupling = None if own is None else float(own)
    knobs = Knobs(coupling)
    if network is None:
        return knobs
    return knobs._replace(delay=network.delay, loss=network.loss, outages=network.bursts.share)


def shapes_of(parts: Parts) -> dict[str, Array]:
    """Return the offsets (N, n) of each shape that these agents can take, by its name."""
    goals = parts.formation.offsets[:, list(parts.model.position_indices())]
    i, j = parts.graph.edges.T
    apart = np.linalg.norm(goals[i] - goals[j], axis=1)
    # The median distance of neighbours' goals; 1 if all goals coincide.
    spacing = float(np.median(apart[apart > 0.0])) if (apart > 0.0).any() else 1.0
    shapes = dict[str, Array]()
    for name in registry.FORMATIONS:
        try:
            shapes[name] = getattr(Formation, name)(parts.model, parts.graph, spacing).offsets
        except EchelonError:
            continue
    return shapes


# ---- sliders -------------------------------------------------------------------------------------


class Range(NamedTuple):
    """The values of a slider, whose scale may be logarithmic."""

    low: float
    high: float
    logarithmic: bool = False


SLIDERS = {
    "coupling": ("coupling c", ""),
    "weight": ("input weight R", "\u00d7"),
    "feedforward": ("feed-forward", ""),
    "size": ("formation size", "\u00d7"),
    "turn": ("formation turn", "\u00b0"),
    "wind": ("wind", "{rate}"),
    "delay": ("delay", "s"),
    "loss": ("messages lost", ""),
    "outages": ("links out", ""),
    "noise": ("noise", "\u00d7"),
}
"""The label and the unit of each slider; `{rate}` is that of the rate of the wind's state."""


def ranges_of(live: LiveParts) -> dict[str, Range]:
    """Return the ranges of the sliders that parts have, in the order of `SLIDERS`."""
    parts, ranges = live.parts, dict[str, Range]()
    gain, c, most = parts.drive.gain, live.start.coupling, live.longest_delay
    section = (live.data().get("follower") or {}).get("gain") or {}
    if c is not None:
        ranges["coupling"] = Range(0.02 * c, 8.0 * c, True)
    if gain is not None and gain.method == Riccati.name and "file" not in section:
        ranges["weight"] = Range(0.02, 50.0, True)
    if str(parts.drive.feedforward.name) != "NONE":
        ranges["feedforward"] = Range(0.0, 1.0)
    apart = bool(live.axes) and parts.formation.offsets[:, live.axes].any()
    if parts.formation.motion is None and (live.shapes or apart):
        ranges["size"] = Range(0.3, 3.0, True)
        if len(live.axes) > 1:
            ranges["turn"] = Range(-180.0, 180.0)
    if live.wind_state is not None:
        ranges["wind"] = Range(-3.0, 3.0)
    if most is not None:
        ranges |= {"delay": Range(0.0, most), "loss": Range(0.0, 1.0), "outages": Range(0.0, 0.9)}
    if parts.world.sensing is not None and any(parts.world.sensing.noise.values()):
        ranges["noise"] = Range(0.0, 10.0)
    return ranges


def write_keys(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    """Write the scenario keys that have the effect of the knobs, the graph and events excepted."""
    _write_gain(live, knobs, data)
    if not knobs.feedforward:
        data.setdefault("follower", {})["feedforward"] = "none"
    _write_formation(live, knobs, data)
    if knobs.wind and live.wind_state is not None:
        name = live.parts.model.state_names[live.wind_state]
        constant = data.setdefault("disturbance", {}).setdefault("constant", {})
        constant[name] = constant.get(name, 0.0) + knobs.wind
    now, start = ((x.delay, x.loss, x.outages) for x in (knobs, live.start))
    if live.parts.world.network is not None and now != start:
        length = live.parts.world.network.bursts.length
        data["network"] |= {"delay": knobs.delay, "loss": knobs.loss}
        data["network"]["bursts"] = {"share": knobs.outages, "length": length}
    if knobs.noise != 1.0:
        noise = data["sensing"]["noise"]
        data["sensing"]["noise"] = {name: knobs.noise * x for name, x in noise.items()}


def _write_gain(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    own = live.parts.drive.gain
    # On another graph a method would choose another coupling, so it is written there too.
    if knobs.coupling is not None and (knobs.cut or knobs.coupling != live.start.coupling):
        follower = data.setdefault("follower", {})
        if own is None:
            follower["coupling"] = knobs.coupling
        else:
            section = follower.setdefault("gain", {})
            if "file" in section:
                section = {"method": FixedGain.name, "P": own.P.tolist(), "R": own.R.tolist()}
            follower["gain"] = section | {"coupling": knobs.coupling}
    gain = live.unweighted_gain(knobs)
    if knobs.weight != 1.0 and gain is not None:
        section = data.setdefault("follower", {}).setdefault("gain", {})
        section |= {"method": Riccati.name, "R": (knobs.weight * gain.R).tolist()}


def _write_formation(live: LiveParts, knobs: Knobs, data: JsonObject) -> None:
    def places(knobs: Knobs) -> JsonObject:
        offsets = live.offsets(knobs)
        agents = np.flatnonzero(offsets.any(axis=1))
        return {"offsets": {i: offsets[i, live.axes].tolist() for i in agents}}

    if knobs.reshaping is not None:
        change = {"reshape": places(knobs), "at": knobs.reshaping.at, "over": RESHAPE}
        data["formation"] = {**places(knobs.before), "motion": [change]}
    elif (knobs.size, knobs.turn, knobs.shape) != (1.0, 0.0, None):
        data["formation"] = places(knobs)
