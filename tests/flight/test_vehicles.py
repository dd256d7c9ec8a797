"""Simulated vehicles: what their autopilots do by themselves."""

import dataclasses
import types

import pytest

import echelon as ech
from echelon.output.archive.flight_folder import _vehicles
from echelon_flight.simulated_vehicles import Vehicle


def test_a_vehicle_of_any_mass_levels_and_lands_softly():
    model = ech.models.Quadrotor.crazyflie()
    graph = ech.Graph.path(2)
    places = ech.Formation.from_offsets(model, graph, {1: (1.0, 0.0, 0.0)})
    circle = ech.references.Circle(center=(0.0, 0.0, 1.0))
    drive = ech.Laws(ech.laws.StoppingLeader(reference=circle), ech.laws.StoppingPoint())
    light, heavy = (dataclasses.replace(model, mass=share * model.mass) for share in (0.8, 1.2))
    world = ech.World(plants={0: light, 1: heavy})
    parts = ech.Parts(model, graph, places, drive, world=world)
    dt = 0.01
    facts, files = _vehicles(parts, ech.Settings(horizon=1.0, dt=dt))
    for number, name in enumerate(facts["files"]):
        module = types.ModuleType(name)
        exec(files[name], vars(module))
        vehicle = Vehicle(facts, number, module.move)
        vehicle.x[6] = 0.5
        vehicle.hear(2, [], 0.0)
        speeds = []
        for _ in range(int(5.0 / dt) * facts["substeps"]):
            vehicle.advance(0.0, 0.1)
            speeds.append(vehicle.x[5])
        assert vehicle.x[2] == 0.0 and min(speeds) > -1.0
        assert vehicle.x[6:8] == pytest.approx([0.0, 0.0], abs=0.05)
