"""What a person may turn while a loop runs, and the scenario that says the same."""

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, final

import numpy as np
import scipy.sparse as sp

from echelon.agents.models.linearization import linearize
from echelon.agents.network.graph import Graph
from echelon.apps.live.choices import AS_GIVEN, shapes_of
from echelon.core.errors import SimulationError, did_you_mean, listing
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.override import named_files
from echelon.experiments.scenario.scenario import Scenario, scenario_from_mapping
from echelon.experiments.scenario.yaml import dump_yaml
from echelon.simulation.engine.law_drive import Laws
from echelon.synthesis.gains.fixed import FixedGain
from echelon.synthesis.gains.gain import Gain
from echelon.synthesis.gains.inner_loop import InnerLoop
from echelon.synthesis.gains.riccati import Riccati

_METHODS = (Riccati.name, InnerLoop.name)
"""Those that find a gain in no time, and need nothing more to be said."""


class Range(NamedTuple):
    """Between what a knob goes, on a logarithmic scale or not; what is beyond is clamped."""

    low: float
    high: float
    logarithmic: bool = False

    def clamp(self, value: float) -> float:
        """Return the nearest allowed value."""
        return float(np.clip(value, self.low, self.high))


class Knobs(NamedTuple):
    """How all knobs stand.

    Attributes:
        coupling: c; None of a law without one.
        weight: of the inputs in the Riccati equation of the gain, times the scenario's R.
        feedforward: 1 where followers are sent what the scenario says, 0 where nothing.
        size: of the formation, times the scenario's.
        turn: of it, degrees.
        wind: added to the first velocity's rate, or to the first position's.
        cut: places of the edges that are cut.
        method: of the gain; None for the scenario's own.
        shape: of the formation; None for the scenario's own.
    """

    coupling: float | None
    weight: float = 1.0
    feedforward: float = 1.0
    size: float = 1.0
    turn: float = 0.0
    wind: float = 0.0
    cut: frozenset[int] = frozenset()
    method: str | None = None
    shape: str | None = None


@final
class Panel:
    """Which knobs a scenario has, their ranges, and what they mean for it.

    Args:
        scenario: as it was given.
        built: what it builds.
    """

    def __init__(self, scenario: Scenario, built: Experiment) -> None:
        """Find out which knobs there are."""
        self.scenario, self.built, parts = scenario, built, built.parts
        self.parts, model = parts, parts.model
        gain = parts.drive.gain
        self.start = Knobs(_coupling(built))
        self.ranges: dict[str, Range] = {}
        self.gains: dict[str | None, Gain | None] = {None: gain}
        self.weighed: tuple[Any, Gain | None] = None, None
        self.methods = _METHODS if gain is not None else ()
        if self.start.coupling is not None:
            c = self.start.coupling
            self.ranges["coupling"] = Range(0.02 * c, 8.0 * c, True)
        if gain is not None and gain.method == Riccati.name and "file" not in self._own_gain():
            self.ranges["weight"] = Range(0.02, 50.0, True)
        if str(parts.drive.feedforward.name) != "NONE":
            self.ranges["feedforward"] = Range(0.0, 1.0)
        self.axes = list(model.position_indices())
        self.shapes = shapes_of(parts)
        if self.shapes or (self.axes and parts.formation.offsets[:, self.axes].any()):
            self.ranges["size"] = Range(0.3, 3.0, True)
            if len(self.axes) > 1:
                self.ranges["turn"] = Range(-180.0, 180.0)
        self.windward = self._windward()
        if self.windward is not None:
            self.ranges["wind"] = Range(-3.0, 3.0)

    @property
    def law(self) -> str:
        """The followers' law, by its name; `scenario` for one of a person's own."""
        law = self.scenario.follower.law
        return law if isinstance(law, str) else AS_GIVEN

    @property
    def laws(self) -> tuple[str, ...]:
        """The laws that may be chosen, this one first."""
        return tuple(dict.fromkeys((self.law, *registry.FOLLOWER_LAWS)))

    def choices(self) -> dict[str, Any]:
        """Return what may be chosen by name, as the page takes it: first what is chosen now."""
        return {
            "law": list(self.laws),
            "method": [AS_GIVEN, *self.methods] if self.methods else [],
            "shape": [AS_GIVEN, *self.shapes] if self.shapes else [],
        }

    def _windward(self) -> int | None:
        """Return the state that the wind acts on; None of agents without a position."""
        groups, names = self.parts.model.state_groups, self.parts.model.state_names
        if "velocity" in groups:
            return names.index(groups["velocity"][0])
        return self.axes[0] if self.axes else None

    def told(self) -> list[dict[str, Any]]:
        """Return the knobs as the page takes them."""
        units = self.parts.model.state_units
        wind = "" if self.windward is None else units[self.windward]
        texts = {
            "coupling": ("coupling c", ""),
            "weight": ("input weight R", "\u00d7"),
            "feedforward": ("feed-forward", ""),
            "size": ("formation size", "\u00d7"),
            "turn": ("formation turn", "\u00b0"),
            "wind": ("wind", f"{wind}/s".replace("m/s/s", "m/s\u00b2") if wind else ""),
        }
        return [
            {
                "name": name,
                "text": texts[name][0],
                "unit": texts[name][1],
                "low": span.low,
                "high": span.high,
                "log": span.logarithmic,
                "value": getattr(self.start, name),
            }
            for name, span in self.ranges.items()
        ]

    def turned(self, knobs: Knobs, name: str, value: float) -> Knobs:
        """Return the knobs with one of them at a value, clamped.

        Raises:
            SimulationError: there is no such knob, or the value is no number.
        """
        if name not in self.ranges:
            raise SimulationError(
                f"there is no knob `{name}`{did_you_mean(name, self.ranges)}; this scenario has "
                f"{listing(self.ranges)}."
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
            raise SimulationError(f"`{name}` got `{value}`, and must be a number.")
        gain = self.gains[knobs.method]
        if name == "weight" and gain is not None and gain.method != Riccati.name:
            raise SimulationError(
                f"`weight` is of the inputs in a Riccati equation, and the gain is by "
                f"`{gain.method}`; choose the scenario's or `{Riccati.name}` first."
            )
        return knobs._replace(**{name: round(self.ranges[name].clamp(value), 9)})

    def with_method(self, knobs: Knobs, name: object) -> Knobs:
        """Return the knobs with the gain of another method, and the coupling that it chooses.

        Raises:
            SimulationError: there is no such method here.
            ScenarioError: it finds no gain for these agents.
        """
        if name == AS_GIVEN:
            return knobs._replace(method=None, weight=1.0, coupling=self.start.coupling)
        check_choice("method", name, self.methods)
        changed = knobs._replace(method=str(name), weight=1.0)
        gain = self.gain(changed)
        return changed if gain is None else changed._replace(coupling=round(gain.coupling, 9))

    def with_shape(self, knobs: Knobs, name: object) -> Knobs:
        """Return the knobs with another shape of the formation.

        Raises:
            SimulationError: there is no such shape here.
        """
        if name == AS_GIVEN:
            return knobs._replace(shape=None)
        check_choice("shape", name, self.shapes)
        return knobs._replace(shape=str(name))

    def gain(self, knobs: Knobs) -> Gain | None:
        """Return the gain of the method of the knobs; its coupling is another matter.

        Raises:
            ScenarioError: the method finds none.
        """
        if knobs.method not in self.gains:
            plain = self.start._replace(method=knobs.method, coupling=None)
            self.gains[knobs.method] = build(self.standing(plain)).parts.drive.gain
        gain = self.gains[knobs.method]
        if gain is None or knobs.weight == 1.0:
            return gain
        asked = knobs.method, knobs.weight
        if self.weighed[0] != asked:
            self.weighed = asked, self._weighed(gain, *asked)
        return self.weighed[1]

    def _weighed(self, gain: Gain, method: str | None, weight: float) -> Gain:
        """Return a Riccati gain with another weight of the inputs, without a new certificate."""
        given = self.scenario.follower.gain if method is None else None
        with precision("float64"):
            linear = linearize(self.parts.model)
            found = Riccati(given and given.Q, weight * gain.R).feedback(self.parts.model, linear)
        return Gain(found.P, found.R, gain.coupling, gain.method, gain.certificate)

    def offsets(self, knobs: Knobs) -> Array:
        """Return the offsets (N, n) of the formation as it stands, about its first leader."""
        chosen = None if knobs.shape is None else self.shapes[knobs.shape]
        offsets = np.array(self.parts.formation.offsets if chosen is None else chosen, np.float64)
        middle = offsets[self.parts.graph.leaders[0], self.axes]
        places = knobs.size * (offsets[:, self.axes] - middle)
        if len(self.axes) > 1:
            angle = np.deg2rad(knobs.turn)
            c, s = np.cos(angle), np.sin(angle)
            places[:, :2] = places[:, :2] @ np.array([[c, s], [-s, c]])
        offsets[:, self.axes] = middle + places
        return offsets

    def wind(self, knobs: Knobs) -> Array:
        """Return the lasting wind (n,) with what the knob adds."""
        known, model = self.parts.world.disturbance, self.parts.model
        wind = model.per_state({} if known is None else known.constant)
        if self.windward is not None:
            wind[self.windward] += knobs.wind
        return wind

    def slowest(self, knobs: Knobs) -> float | None:
        """Return the slowest mode (1/s) near the trim under a gain; None without one.

        None on a graph that switches too, whose modes are none of one matrix.
        """
        gain, graph = self.gain(knobs), self.parts.graph
        if gain is None or knobs.coupling is None or graph.schedule is not None:
            return None
        kept = [k for k in range(len(graph.edges)) if k not in knobs.cut]
        i, j = graph.edges[kept].T
        heavy, count = graph.weights[kept], graph.agents
        A = sp.coo_array((heavy, (j, i)), shape=(count, count)).toarray()
        A = A if graph.directed else A + A.T
        rows = list(graph.followers)
        L = (np.diag(A.sum(axis=1)) - A)[np.ix_(rows, rows)]
        values = np.linalg.eigvals(L) if graph.directed else np.linalg.eigvalsh(L)
        with precision("float64"):
            A, B = linearize(self.parts.model).with_inner(gain.inner)
        K = gain.R_inverse @ B.T @ gain.P
        # The extreme ones and some between: of a thousand the rest would take seconds.
        few = values[np.unique(np.linspace(0, len(values) - 1, 40).astype(int))]
        poles = np.linalg.eigvals(A - knobs.coupling * few[:, None, None] * (B @ K))
        return float(poles.real.max())

    # ---- the scenario that says the same --------------------------------------------------------

    def standing(self, knobs: Knobs) -> Scenario:
        """Return the scenario with the knobs as they stand: what is promised is asked of it.

        Raises:
            ScenarioError: it is refused, as where a cut has parted the graph.
        """
        data = self._data()
        if knobs.method is not None:
            data.setdefault("follower", {})["gain"] = {"method": knobs.method}
        if knobs.weight != 1.0:
            told = data.setdefault("follower", {}).setdefault("gain", {})
            told |= {"method": Riccati.name, "R": self._given_weight(knobs)}
        # With another graph a method would choose another coupling.
        if knobs.coupling is not None and (knobs.cut or knobs.coupling != self.start.coupling):
            self._couple(data.setdefault("follower", {}), knobs.coupling)
        if not knobs.feedforward:
            data.setdefault("follower", {})["feedforward"] = "none"
        if knobs.cut:
            data["graph"] = self._graph(knobs)
        if (knobs.size, knobs.turn, knobs.shape) != (1.0, 0.0, None):
            offsets = self.offsets(knobs)
            rows = {i: offsets[i, self.axes].tolist() for i in np.flatnonzero(offsets.any(axis=1))}
            data["formation"] = {"offsets": rows}
        if knobs.wind and self.windward is not None:
            name = self.parts.model.state_names[self.windward]
            constant = data.setdefault("disturbance", {}).setdefault("constant", {})
            constant[name] = constant.get(name, 0.0) + knobs.wind
        return scenario_from_mapping(data, self.scenario.folder)

    def _given_weight(self, knobs: Knobs) -> list[list[float]]:
        """Return R of the knobs as a scenario has it."""
        gain = self.gains[knobs.method]
        assert gain is not None
        return (knobs.weight * gain.R).tolist()

    def _own_gain(self) -> dict[str, Any]:
        """Return what the scenario says of the followers' gain."""
        return (self.scenario.data.get("follower") or {}).get("gain") or {}

    def _graph(self, knobs: Knobs) -> dict[str, Any]:
        """Return the graph without what is cut as a scenario has it."""
        graph, schedule = self.parts.graph, self.parts.graph.schedule
        told: dict[str, Any] = {"leaders": list(graph.leaders), "agents": graph.agents}
        told |= {"directed": True} if graph.directed else {}
        if schedule is None:
            return {"edges": self._edges(knobs, graph.weights), **told}
        rows = [self._edges(knobs, weights) for weights in schedule.weights]
        later = zip(schedule.starts[1:].tolist(), rows[1:], strict=True)
        told["schedule"] = [{"at": at, "edges": edges} for at, edges in later]
        told |= {} if schedule.period is None else {"period": schedule.period}
        return {"edges": rows[0], **told}

    def _couple(self, follower: dict[str, Any], coupling: float) -> None:
        """Write a coupling where the followers' law has it."""
        if self.parts.drive.gain is None:
            follower["coupling"] = coupling
            return
        follower.setdefault("gain", {})["coupling"] = coupling
        if "file" in follower["gain"]:
            follower["gain"] = self._given(coupling)

    def _data(self) -> dict[str, Any]:
        """Return the scenario's data, without what was done live."""
        data = copy.deepcopy(self.scenario.data)
        data.pop("live", None)
        return data

    def _given(self, coupling: float) -> dict[str, Any]:
        gain = self.parts.drive.gain
        assert gain is not None
        P, R = gain.P.tolist(), gain.R.tolist()
        return {"method": FixedGain.name, "P": P, "R": R, "coupling": coupling}

    def graph(self, knobs: Knobs) -> Graph:
        """Return the graph without what is cut.

        Raises:
            GraphError: it is in two parts.
        """
        graph = self.parts.graph
        edges = self._edges(knobs, graph.weights)
        return Graph(edges, graph.leaders, graph.agents, graph.directed)

    def _edges(self, knobs: Knobs, weights: Array) -> list[list[Any]]:
        """Return the edges with weights that are not cut."""
        edges = self.parts.graph.edges
        kept = [k for k in np.flatnonzero(weights) if k not in knobs.cut]
        pairs = zip(edges[kept].tolist(), weights[kept].tolist(), strict=True)
        return [[*pair, weight] for pair, weight in pairs]

    def saved(self, events: Sequence[Mapping[str, Any]]) -> str:
        """Return the YAML of the scenario with what was done live, which it repeats."""
        data = self._data()
        # It may be written elsewhere than where the files that it names are.
        for path, file, rest in list(named_files(data, ())):
            place: Any = data
            for key in path[:-1]:
                place = place[key]
            place[path[-1]] = f"{(self.scenario.folder / file).resolve()}{rest}"
        return dump_yaml({**data, "live": [dict(event) for event in events]})


def _coupling(built: Experiment) -> float | None:
    """Return how strongly the followers agree; None of a law without such a number."""
    drive, dt = built.parts.drive, built.settings.dt
    if drive.gain is not None:
        return drive.gain.coupling
    coupling = drive.follower.strength(dt) if isinstance(drive, Laws) else None
    return None if coupling is None else float(coupling)


def check_choice(what: str, name: object, allowed: Iterable[str]) -> None:
    """Check that something may be chosen.

    Raises:
        SimulationError: it may not.
    """
    if name not in list(allowed):
        there = f"there are {listing(allowed)}" if list(allowed) else "none can be chosen"
        raise SimulationError(f"there is no {what} `{name}` here; {there}.")
