"""Builds the world of a scenario: plant, disturbance and network."""

from typing import Any

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.channel import Bursts, Network
from echelon.agents.network.graph import Graph
from echelon.agents.world.disturbance import Disturbance
from echelon.agents.world.plant import check_plant, vary_parameters
from echelon.experiments.scenario.fault_list import FaultList
from echelon.experiments.scenario.scenario import Scenario
from echelon.laws.law import Law
from echelon.simulation.engine.law_drive import Laws


def plant_of(scenario: Scenario, model: ControlAffine) -> ControlAffine | None:
    """Return the agents that move, where they differ from the model."""
    spec = scenario.plant
    if spec is None:
        return None
    plant = vary_parameters(model, spec.parameters, spec.scale)
    check_model(plant)
    check_plant(model, plant)
    return plant


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
    return Disturbance(**spec.model_dump())


def network_of(
    scenario: Scenario, faults: FaultList, graph: Graph, leader: Law | None, follower: Law | None
) -> Network | None:
    """Return the network, checked against the laws; None for the ideal one."""
    spec, simulation = scenario.network, scenario.simulation
    if spec is None:
        return None
    network = None
    with faults.at("network"):
        numbers: dict[str, Any] = spec.model_dump()
        numbers["bursts"] = Bursts(**numbers["bursts"])
        network = Network(**numbers)
        network.prepared(simulation.dt, simulation.horizon, scenario.seed)
        if leader is not None and follower is not None:
            Laws(leader, follower).check_network(network, graph, simulation.dt)
    return network
