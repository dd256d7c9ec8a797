"""What a person may choose while a loop runs: another law, another shape of the formation."""

import copy

import numpy as np

from echelon.agents.network.formation import Formation
from echelon.core.errors import EchelonError, ScenarioError
from echelon.core.types import Array
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.checks import surplus_keys
from echelon.experiments.scenario.scenario import Scenario, scenario_from_mapping
from echelon.simulation.engine.parts import Parts

AS_GIVEN = "scenario"
"""A choice that stands for what the scenario says."""


def under(scenario: Scenario, law: str) -> tuple[Scenario, Experiment]:
    """Return a scenario whose followers obey another law, and what it builds.

    Its leaders keep their law where the followers' can do with it, or have the one by default.

    Raises:
        ScenarioError: the law does not fit these agents.
    """
    # A leader law that goes with the followers' law replaces the scenario's.
    ways = (True, False) if registry.FOLLOWER_LAWS[law].leader is None else (False,)
    for own in ways:
        try:
            made = _with(scenario, law, own)
            return made, build(made)
        except ScenarioError:
            if own == ways[-1]:
                raise
    raise AssertionError


def _with(scenario: Scenario, law: str, own: bool) -> Scenario:
    """Return a scenario with another law, and what of the keys fits it; `own` leaves the leader."""
    data = copy.deepcopy(scenario.data)
    data.pop("live", None)
    surplus = surplus_keys("follower", law)
    # A feed-forward of another law may be none of a law whose agents exchange more.
    dropped = {"law", *surplus, *(["feedforward"] if registry.FOLLOWER_LAWS[law].leader else [])}
    follower = data.get("follower") or {}
    data["follower"] = {"law": law} | {k: v for k, v in follower.items() if k not in dropped}
    leader = data.get("leader") or {}
    if not own:
        leader = {key: leader[key] for key in ("start_error",) if key in leader}
    if "gain" in surplus:
        # Only a gain makes a leader react.
        leader = {key: value for key, value in leader.items() if key != "reacts"}
    return scenario_from_mapping(data | ({"leader": leader} if leader else {}), scenario.folder)


def shapes_of(parts: Parts) -> dict[str, Array]:
    """Return offsets (N, n) by the name of each shape that these agents can take."""
    spacing, found = _spacing(parts), dict[str, Array]()
    for name in registry.FORMATIONS:
        try:
            made = getattr(Formation, name)(parts.model, parts.graph, spacing)
        except EchelonError:
            continue
        found[name] = made.offsets
    return found


def _spacing(parts: Parts) -> float:
    """Return how far neighbours' goals are apart, in the middle; 1 where they are nowhere."""
    axes = list(parts.model.position_indices())
    i, j = parts.graph.edges.T
    goals = parts.formation.offsets[:, axes]
    apart = np.linalg.norm(goals[i] - goals[j], axis=1)
    return float(np.median(apart[apart > 0.0])) if (apart > 0.0).any() else 1.0
