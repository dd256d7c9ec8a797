"""The controls of the live page, and the scenario at any position of them."""

import copy
from collections.abc import Iterable, Sequence
from typing import Any, final

import numpy as np

from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import Reshape
from echelon.apps.live.attendance import KINDS, RESHAPE, as_entries, happened
from echelon.apps.live.knobs import SLIDERS, Knobs, LiveParts, Reshaping, ranges_of, write_keys
from echelon.core.errors import ScenarioError, SimulationError, did_you_mean, listing
from echelon.core.types import JsonObject
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import Scenario, scenario_from_mapping
from echelon.experiments.scenario.sections import FollowerSpec
from echelon.experiments.scenario.values import foreign_keys
from echelon.experiments.scenario.yaml import dump_yaml, rename_files
from echelon.synthesis.gains.riccati import InnerLoop, Riccati

_METHODS = (Riccati.name, InnerLoop.name)
"""Gain methods that take less than a picture's time, and need no parameters."""


@final
class Panel:
    """The controls that a scenario has, and the scenario at any position of the knobs."""

    def __init__(self, scenario: Scenario, experiment: Experiment) -> None:
        self.scenario, self.experiment = scenario, experiment
        self.live = LiveParts(scenario, experiment)
        self.start = self.live.start
        self.ranges = ranges_of(self.live)
        self.options = {
            "method": _METHODS if experiment.parts.drive.gain is not None else (),
            "shape": tuple(self.live.shapes),
        }

    @property
    def law(self) -> str:
        """The name of the followers' law; `scenario` for a user's own."""
        law = self.scenario.follower.law
        return law if isinstance(law, str) else AS_GIVEN

    @property
    def laws(self) -> tuple[str, ...]:
        """The laws to choose from, this one first."""
        return tuple(dict.fromkeys((self.law, *registry.FOLLOWER_LAWS)))

    def choices(self) -> dict[str, list[str]]:
        """Return the lists to choose from, as the page reads them."""
        lists = {k: [AS_GIVEN, *names] if names else [] for k, names in self.options.items()}
        return {"law": list(self.laws), **lists}

    def sliders(self) -> list[JsonObject]:
        """Return the sliders as the page reads them."""
        state = self.live.wind_state
        unit = "" if state is None else self.live.parts.model.state_units[state]
        rate = f"{unit}/s".replace("m/s/s", "m/s\u00b2") if unit else ""
        return [
            {
                "name": name,
                "text": SLIDERS[name][0],
                "unit": SLIDERS[name][1].format(rate=rate),
                "low": span.low,
                "high": span.high,
                "log": span.logarithmic,
                "value": getattr(self.start, name),
            }
            for name, span in self.ranges.items()
        ]

    def change(self, knobs: Knobs, name: str, value: Any, at: float = 0.0) -> Knobs:
        """Return the knobs after a change of one control at a time (s); numbers are clamped.

        Raises:
            SimulationError: there is no such control, or the value is not allowed.
            GraphError: an agent cannot be lost or join.
            ScenarioError: the chosen method finds no gain for these agents.
        """
        if name in ("cut", "restore"):
            edge = {self.edge(value)}
            return knobs._replace(cut=knobs.cut | edge if name == "cut" else knobs.cut - edge)
        if name in KINDS:
            at = max(at, self.experiment.settings.dt)
            events = happened(self.live.parts.graph, knobs.events, name, value, at)
            return knobs._replace(events=events)
        if name == "reshape":
            return self._reshaped(knobs, value, at)
        if name in self.options:
            return self._choose(knobs, name, value)
        if name not in self.ranges:
            raise SimulationError(
                f"there is no control `{name}`{did_you_mean(name, self.ranges)}; this scenario has "
                f"{listing(self.ranges)}."
            )
        return self._moved(knobs, name, value)

    def _moved(self, knobs: Knobs, name: str, value: Any) -> Knobs:
        if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
            raise SimulationError(f"`{name}` got `{value}`, and must be a number.")
        gain = self.live.unweighted_gain(knobs)
        if name == "weight" and gain is not None and gain.method != Riccati.name:
            raise SimulationError(
                f"`weight` is a weight of a Riccati equation, and the gain is by `{gain.method}`; "
                f"choose the method `{AS_GIVEN}` or `{Riccati.name}` first."
            )
        clamped = float(np.clip(value, self.ranges[name].low, self.ranges[name].high))
        return knobs._replace(**{name: round(clamped, 9)})

    def _choose(self, knobs: Knobs, name: str, value: Any) -> Knobs:
        choice = None if value == AS_GIVEN else str(value)
        if choice is not None:
            check_choice(name, value, self.options[name])
        changed = knobs._replace(**{name: choice})
        if name == "shape":
            return changed._replace(reshaping=None)
        # Each method chooses the coupling of its own gain.
        gain = None if choice is None else self.live.unweighted_gain(changed)
        coupling = self.start.coupling if gain is None else round(gain.coupling, 9)
        return changed._replace(weight=1.0, coupling=coupling)

    def _reshaped(self, knobs: Knobs, value: Any, at: float) -> Knobs:
        check_choice("shape", value, (AS_GIVEN, *self.options["shape"]))
        under_way = knobs.reshaping
        if under_way is not None and at < under_way.end:
            raise SimulationError(
                f"got `reshape` at {at:.4g} s, and the reshape before it lasts until "
                f"{under_way.end:.4g} s; wait for its end."
            )
        shape = None if value == AS_GIVEN else str(value)
        after = knobs._replace(shape=shape, reshaping=Reshaping(knobs.shape, at))
        live, graph = self.live, self.live.parts.graph
        change = Reshape(live.offsets(after), at, RESHAPE)
        moving = Formation(live.offsets(after.before)).moving(live.parts.model, graph, [change])
        live.parts.drive.check_motion(moving, graph)
        return after

    def edge(self, pair: Any) -> int:
        """Return the index of the edge between two agents.

        Raises:
            SimulationError: there is none.
        """
        graph = self.live.parts.graph
        for index, edge in enumerate(graph.edges.tolist()):
            pairs = [edge] if graph.directed else [edge, edge[::-1]]
            if isinstance(pair, list | tuple) and list(pair) in pairs:
                return index
        # As a file writes it; a checked scenario holds a tuple.
        text = list(pair) if isinstance(pair, tuple) else pair
        raise SimulationError(f"`{text}` is no link of the graph.")

    def scenario_at(self, knobs: Knobs) -> Scenario:
        """Return the scenario that describes the loop at a position of the knobs.

        Raises:
            ScenarioError: it is refused, as where cut links disconnect the graph.
        """
        data = self.live.data()
        if knobs.method is not None:
            data.setdefault("follower", {})["gain"] = {"method": knobs.method}
        write_keys(self.live, knobs, data)
        if knobs.cut:
            data["graph"] = self._graph(knobs)
        if knobs.events:
            data["events"] = as_entries(knobs.events)
        if knobs.roomy:
            # A scenario's events are before its end.
            last = max(each.at for each in (*knobs.events[-1:], knobs.reshaping) if each)
            end = last + data["simulation"]["horizon"]
            data["simulation"] = data["simulation"] | {"horizon": end}
        return scenario_from_mapping(data, self.scenario.folder)

    def _graph(self, knobs: Knobs) -> JsonObject:
        """Return the graph without the cut edges as a scenario states it."""
        graph = self.live.parts.graph.before
        schedule = graph.schedule
        section: JsonObject = {"leaders": list(graph.leaders), "agents": graph.agents}
        section |= {"directed": True} if graph.directed else {}
        weights = [graph.weights] if schedule is None else schedule.weights
        edges = [self.live.edges(knobs, row) for row in weights]
        if schedule is not None:
            later = zip(schedule.starts[1:].tolist(), edges[1:], strict=True)
            section["schedule"] = [{"at": at, "edges": row} for at, row in later]
            section |= {} if schedule.period is None else {"period": schedule.period}
        return {"edges": edges[0], **section}

    def saved(self, events: Sequence[JsonObject]) -> str:
        """Return the YAML of the scenario with live events, which it repeats."""
        data = self.live.data()
        # With absolute paths, since it may be saved in another folder.
        rename_files(data, lambda file: str((self.scenario.folder / file).resolve()))
        return dump_yaml({**data, "live": [dict(event) for event in events]})


def check_choice(control: str, value: object, options: Iterable[str]) -> None:
    """Check that a value is among the options of a control.

    Raises:
        SimulationError: it is not.
    """
    names = list(options)
    if value not in names:
        allowed = f"there are {listing(names)}" if names else "none can be chosen"
        raise SimulationError(f"there is no {control} `{value}` here; {allowed}.")


# ---- laws to choose from -------------------------------------------------------------------------


AS_GIVEN = "scenario"
"""The choice that stands for the scenario's own."""


def under(scenario: Scenario, law: str) -> tuple[Scenario, Experiment]:
    """Return a scenario with another follower law, and its experiment.

    Leaders keep their law if it fits the followers', and have the default law otherwise.

    Raises:
        ScenarioError: the law does not fit these agents.
    """
    # A leader law that goes with the followers' law replaces the scenario's.
    ways = (True, False) if registry.FOLLOWER_LAWS[law].leader is None else (False,)
    for keep_leader in ways:
        try:
            changed = _with_law(scenario, law, keep_leader)
            return changed, build(changed)
        except ScenarioError:
            if keep_leader == ways[-1]:
                raise
    raise AssertionError


def _with_law(scenario: Scenario, law: str, keep_leader: bool) -> Scenario:
    data = copy.deepcopy(scenario.data)
    data.pop("live", None)
    surplus = foreign_keys(FollowerSpec, law)
    # A feed-forward of another law may be none of a law whose agents exchange more.
    dropped = {"law", *surplus, *(["feedforward"] if registry.FOLLOWER_LAWS[law].leader else [])}
    follower = data.get("follower") or {}
    data["follower"] = {"law": law} | {k: v for k, v in follower.items() if k not in dropped}
    leader = data.get("leader") or {}
    if not keep_leader:
        leader = {key: leader[key] for key in ("start_error",) if key in leader}
    if "gain" in surplus:
        # Only a gain makes a leader react.
        leader = {key: value for key, value in leader.items() if key != "reacts"}
    return scenario_from_mapping(data | ({"leader": leader} if leader else {}), scenario.folder)
