"""Builds the world of a scenario: plants, wind, actuators, sensors, network, and what happens."""

from typing import Any

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.channel import Bursts, Network
from echelon.agents.network.events import (
    Cut,
    Event,
    Join,
    Lose,
    check_heirs,
    event_faults,
)
from echelon.agents.network.graph import Graph
from echelon.agents.world.actuator import Actuator
from echelon.agents.world.disturbance import Disturbance
from echelon.agents.world.sensing import Sensing
from echelon.agents.world.world import check_plant, vary_parameters
from echelon.core.errors import ScenarioError
from echelon.experiments.scenario.event_sections import EventSpec
from echelon.experiments.scenario.fault_list import FaultList
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.sections import PlantSpec, VariationSpec
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.leadership import Leadership


def plants_of(
    scenario: Scenario, faults: FaultList, model: ControlAffine
) -> tuple[ControlAffine | None, dict[int, ControlAffine]]:
    """Return the agents that move, where they differ from the model: all, and single ones."""
    spec = scenario.plant
    if spec is None:
        return None, {}

    def varied(part: VariationSpec | PlantSpec) -> ControlAffine:
        plant = vary_parameters(model, part.parameters, part.scale)
        check_model(plant)
        check_plant(model, plant)
        return plant

    plants = {
        k: faults.part(lambda part=part: varied(part), "plant", "agents", k)
        for k, part in spec.agents.items()
    }
    alike = spec.agents and not (spec.parameters or spec.scale)
    return (None if alike else faults.part(lambda: varied(spec), "plant")), plants


def disturbance_of(
    scenario: Scenario, faults: FaultList, model: ControlAffine
) -> Disturbance | None:
    """Return wind and noise; None without."""
    spec = scenario.disturbance
    if spec is None:
        return None
    for key in ("constant", "rms", "input_rms"):
        with faults.at("disturbance", key):
            # Each alone, so that its fault is reported at its own line.
            Disturbance(**{key: getattr(spec, key)}).prepared(model, scenario.simulation.dt, 0)
    disturbance = None
    with faults.at("disturbance"):
        numbers: dict[str, Any] = spec.model_dump() | {"air": spec.air or ()}
        disturbance = Disturbance(**numbers)
        disturbance.prepared(model, scenario.simulation.dt, 0)
    return disturbance


def actuator_of(scenario: Scenario, faults: FaultList, model: ControlAffine) -> Actuator | None:
    """Return the actuators; None for ideal ones."""
    spec = scenario.actuator
    if spec is None:
        return None
    actuator = None
    with faults.at("actuator"):
        actuator = Actuator(**spec.model_dump())
        actuator.prepared(model)
    return actuator


def sensing_of(scenario: Scenario, faults: FaultList, model: ControlAffine) -> Sensing | None:
    """Return what agents measure; None for exact states."""
    spec = scenario.sensing
    if spec is None:
        return None
    sensing, simulation = None, scenario.simulation
    with faults.at("sensing", "noise"):
        model.per_state(spec.noise)
    with faults.at("sensing"):
        sensing = Sensing(**spec.model_dump())
        sensing.prepared(model, simulation.dt, simulation.horizon, 0)
    return sensing


def network_of(scenario: Scenario, faults: FaultList) -> Network | None:
    """Return the network; None for the ideal one."""
    spec, simulation = scenario.network, scenario.simulation
    if spec is None:
        return None
    network = None
    with faults.at("network"):
        numbers: dict[str, Any] = spec.model_dump()
        numbers["bursts"] = Bursts(**numbers["bursts"])
        network = Network(**numbers)
        network.prepared(simulation.dt, simulation.horizon, scenario.seed)
    return network


def leadership_of(scenario: Scenario, faults: FaultList, graph: Graph) -> Leadership | None:
    """Return who takes the lead after the leader, and whether it waits; None for neither."""
    spec = scenario.leadership
    if spec is None:
        return None
    leadership = None
    with faults.at("leadership", "heirs"):
        check_heirs(graph, spec.heirs)
        leadership = Leadership(**spec.model_dump())
    faults.settle()
    return leadership


def events_of(
    scenario: Scenario, faults: FaultList, graph: Graph, leadership: Leadership | None
) -> list[Event]:
    """Return what happens during the run; a fault is noted at its event."""
    events = [_event(spec) for spec in scenario.events]
    heirs = () if leadership is None else leadership.heirs
    for k, text in event_faults(graph, events, heirs, scenario.simulation.horizon):
        with faults.at("events", k):
            raise ScenarioError(f"{text}.")
    faults.settle()
    return events


def _event(spec: EventSpec) -> Event:
    if spec.cut is not None:
        return Cut(spec.cut, spec.at, spec.duration)
    if spec.join is not None:
        return Join(spec.join, spec.at)
    assert spec.lose is not None, "the schema holds that there is one of three"
    return Lose(spec.lose, spec.at)


def check_world(faults: FaultList, parts: Parts, dt: float) -> None:
    """Record what of a world does not suit the agents or their laws."""
    with faults.at("plant", "agents"):
        parts.world.check_agents(parts.model, parts.graph.agents)
    with faults.at("leadership"):
        parts.drive.check_heirs(parts.graph)
        if parts.leadership is not None:
            parts.leadership.check_network(parts.world.network)
            if parts.leadership.waits is not None:
                parts.drive.check_patience()
    with faults.at("network"):
        parts.drive.check_world(parts.world, parts.graph, dt)
