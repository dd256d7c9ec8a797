"""Builds the formation of a scenario: its shape, and how it changes with time."""

from typing import cast

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate, Scale
from echelon.agents.network.graph import Graph
from echelon.core.errors import FormationError, ScenarioError, listing
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.fault_list import FaultList
from echelon.experiments.scenario.formation_sections import MotionSpec, ShapeKeys, ShapeSpec
from echelon.experiments.scenario.named_class import named_class, offered
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.values import foreign_keys, marked_keys


def formation_of(
    scenario: Scenario, faults: FaultList, model: ControlAffine, graph: Graph
) -> Formation:
    """Return the formation of a scenario, with its motion; its faults are noted."""
    spec, starts = scenario.formation, scenario.initial.states
    formation = _shape(spec, model, graph)
    if spec.assign == "nearest":
        if not starts:
            raise FormationError(
                "`assign: nearest` needs `initial.states`: without them agents start about their "
                "own places."
            )
        n = len(model.state_names)
        whole = {agent: state for agent, state in starts.items() if len(state) == n}
        formation = formation.nearest(model, graph, whole)
    changes = list[OffsetMotion | Reshape]()
    for k, change in enumerate(spec.motion):
        with faults.at("formation", "motion", k):
            changes.append(_change(scenario, change, model, graph))
    # Of a motion with faults, which are noted, nothing else is said.
    complete = changes and len(changes) == len(spec.motion)
    return formation.moving(model, graph, changes) if complete else formation


def _change(
    scenario: Scenario, spec: MotionSpec, model: ControlAffine, graph: Graph
) -> OffsetMotion | Reshape:
    """Return a motion of the formation."""
    _check_keys(spec)
    if spec.rotate is not None:
        return Rotate(spec.rotate)
    if spec.scale is not None:
        return Scale(spec.scale, cast(float, spec.rate))
    if spec.reshape is None:
        part = named_class(scenario, OffsetMotion, {}, None, spec.python, spec.parameters)
        return part.create()
    horizon, at = scenario.simulation.horizon, cast(float, spec.at)
    if at >= horizon:
        raise FormationError(
            f"got a reshape at {at:g} s, allowed is a time before the horizon, {horizon:g} s."
        )
    _check_shape(spec.reshape)
    shape = _shape(spec.reshape, model, graph)
    return Reshape(shape.offsets, at, cast(float, spec.over), spec.assign == "nearest")


def _check_keys(spec: MotionSpec) -> None:
    """Check that a motion is of one kind, and has the keys of that."""
    kinds = [kind for kind in registry.MOTIONS if getattr(spec, kind) is not None]
    if len(kinds) != 1:
        got = " and ".join(f"`{kind}`" for kind in kinds) or "none"
        raise ScenarioError(f"got {got}, allowed is one of {listing(registry.MOTIONS)}.")
    for key, mark in marked_keys(MotionSpec).items():
        if kinds[0] in mark.needed_by and getattr(spec, key) is None:
            raise ScenarioError(f"`{kinds[0]}` needs the key `{key}`, which is missing.")
    for key in spec.model_fields_set & {*foreign_keys(MotionSpec, kinds[0])}:
        raise ScenarioError(f"got `{key}`, which `{kinds[0]}` does not take.")


def _check_shape(spec: ShapeSpec) -> None:
    if spec.name is not None and spec.offsets is not None:
        raise ScenarioError("got `offsets` and `name` of `reshape`, allowed is one of them.")
    choice = spec.name or "offsets"
    for key in spec.model_fields_set & {*foreign_keys(ShapeSpec, choice)}:
        raise ScenarioError(f"got `{key}`, which the shape `{choice}` does not take.")


def _shape(spec: ShapeKeys, model: ControlAffine, graph: Graph) -> Formation:
    if spec.name is None:
        return Formation.from_offsets(model, graph, spec.offsets or {})
    make = getattr(Formation, spec.name)
    return make(model, graph, **offered(make, {"spacing": spec.spacing, "columns": spec.columns}))
