"""The lists of the live page: other laws for the followers, other shapes of the formation."""

import copy

import numpy as np

from echelon.agents.network.formation import Formation
from echelon.core.errors import EchelonError, ScenarioError
from echelon.core.types import Array
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import Scenario, scenario_from_mapping
from echelon.experiments.scenario.sections import FollowerSpec
from echelon.experiments.scenario.values import foreign_keys
from echelon.simulation.engine.parts import Parts

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
    """Return a scenario with another follower law and those of its keys that the law takes."""
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


def shapes_of(parts: Parts) -> dict[str, Array]:
    """Return the offsets (N, n) of each shape that these agents can take, by its name."""
    spacing, shapes = _spacing(parts), dict[str, Array]()
    for name in registry.FORMATIONS:
        try:
            shapes[name] = getattr(Formation, name)(parts.model, parts.graph, spacing).offsets
        except EchelonError:
            continue
    return shapes


def _spacing(parts: Parts) -> float:
    """Return the median distance of neighbours' goals; 1 if all goals coincide."""
    axes = list(parts.model.position_indices())
    i, j = parts.graph.edges.T
    goals = parts.formation.offsets[:, axes]
    apart = np.linalg.norm(goals[i] - goals[j], axis=1)
    return float(np.median(apart[apart > 0.0])) if (apart > 0.0).any() else 1.0
