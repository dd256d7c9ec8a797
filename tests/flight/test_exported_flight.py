"""Whole flights of exported laws, in this process under a clock that tests move."""

import math

import numpy as np
import pytest
from virtual_flight import LinkImpairment, VirtualFlight

import echelon as ech
from echelon.agents.network.formation_motion import Rotate
from echelon.output.archive.flight_folder import flight_files, save_flight
from echelon_flight.flight_log import read_log
from echelon_flight.local_flight import place_errors
from echelon_flight.supervisor import Fault

CARTS, DT, SECONDS = ech.models.DoubleIntegrator(), 0.02, 8.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    graph = ech.Graph([(0, 1), (1, 2)], directed=True)
    places = ech.Formation.from_offsets(CARTS, graph, {1: (1.0, 0.0), 2: (1.0, 0.8)})
    places = places.moving(CARTS, graph, [Rotate(0.4)])
    leader = ech.laws.StoppingLeader(reference=ech.references.Circle(rate=0.5))
    drive = ech.Laws(leader, ech.laws.StoppingPoint())
    world = ech.World(network=ech.Network(rate=25.0))
    parts = ech.Parts(CARTS, graph, places, drive, initial={"position": 0.3}, world=world)
    folder = tmp_path_factory.mktemp("flight")
    save_flight(flight_files(parts, ech.Settings(horizon=SECONDS, dt=DT), "carts"), folder)
    return folder


def test_a_formation_is_kept_over_a_radio_and_by_who_comes_back(folder, tmp_path, monkeypatch):
    radio = LinkImpairment(0.02, 0.02, 0.2)
    flight = VirtualFlight(folder, tmp_path / "key", monkeypatch, radio)
    for k in range(3):
        flight.start_agent(k)
    flight.take_off(0, 1, 2)
    flight.fly(0.5)
    errors, killed, back = [], None, None
    while (t := flight.time) < SECONDS - 0.1:
        if killed is None and t > 5.0:
            killed = len(errors)
            flight.kill(2)
        if back is None and t > 5.3:
            back = len(errors)
            flight.start_agent(2)
        flight.fly(DT)
        places = [vehicle.x[:2] for vehicle in flight.vehicles]
        errors.append(place_errors(flight.mission.facts, flight.time, places))
    late = [max(row[k] for row in errors[-30:]) for k in (1, 2)]
    assert max(late) < 0.01, late
    # The one that was killed went astray meanwhile, and came back.
    assert max(row[2] for row in errors[killed:]) > 10.0 * max(row[1] for row in errors[killed:])
    assert max(row[1] for row in errors[killed:]) < 0.01
    flight.wait(lambda state: len(flight.ended) == 3)
    assert set(flight.ended.values()) == {Fault.END}


def test_a_flight_in_which_nothing_is_late_is_its_own_simulation(tmp_path, monkeypatch):
    """By the logs, state and input of every tick; sums of 1/64 s have no rounding."""
    dt = 1.0 / 64.0
    graph = ech.Graph([(0, 1), (1, 2)], directed=True)
    places = ech.Formation.from_offsets(CARTS, graph, {1: (1.0, 0.0), 2: (1.0, 0.8)})
    leader = ech.laws.StoppingLeader(reference=ech.references.Circle(rate=0.5))
    drive = ech.Laws(leader, ech.laws.StoppingPoint())
    # A letter is there one period after it was sent: the least of a run.
    world = ech.World(network=ech.Network(rate=64.0, delay=dt))
    parts = ech.Parts(CARTS, graph, places, drive, initial={"position": 0.3}, world=world)
    settings = ech.Settings(horizon=3.0, dt=dt, substeps=2)
    save_flight(flight_files(parts, settings, "carts"), tmp_path / "flight")
    radio = LinkImpairment(dt, 0.0, 0.0)
    flight = VirtualFlight(tmp_path / "flight", tmp_path / "key", monkeypatch, radio)
    for k in range(3):
        flight.start_agent(k, logs=True)
    flight.take_off(0, 1, 2, soon=0.25 + dt / 2.0)
    flight.fly(3.5)
    run = ech.simulate(parts, settings)
    ends = [flight.agents[k].context.log for k in range(3)]
    for k, log in enumerate(ends):
        log.close()
        ticks = read_log(log.file).ticks[: len(run.times) - 1]
        np.testing.assert_array_equal([tick.time for tick in ticks], run.times[:-1])
        for ours, name in ((run.states, "x"), (run.inputs, "u")):
            rows = np.array([getattr(tick, name) for tick in ticks])
            np.testing.assert_allclose(rows, ours[: len(rows), k], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_agents_that_keep_apart_in_a_run_do_so_in_a_flight(tmp_path, monkeypatch):
    """Two followers begin at each other's places, with the leader between them."""
    graph = ech.Graph([(0, 1), (0, 2)], directed=True)
    places = ech.Formation.from_offsets(CARTS, graph, {1: (1.0, 0.0), 2: (-1.0, 0.0)})
    safety = ech.Safety(radii=(0.15, 0.15, 0.15))
    hover = ech.references.Hover(position=(0.0, 0.0, 0.0))
    starts = [[0.0, 0.0, 0.0, 0.0], [-1.0, 0.05, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
    least = {}
    for law in (ech.laws.StoppingPoint(), ech.laws.StoppingPoint(safety=safety)):
        drive = ech.Laws(ech.laws.StoppingLeader(reference=hover), law)
        world = ech.World(network=ech.Network(rate=25.0))
        parts = ech.Parts(CARTS, graph, places, drive, initial=starts, world=world)
        out = tmp_path / f"{law.safety is None}"
        save_flight(flight_files(parts, ech.Settings(horizon=SECONDS, dt=DT), "apart"), out)
        flight = VirtualFlight(out, tmp_path / "key", monkeypatch)
        for k in range(3):
            flight.start_agent(k)
        flight.take_off(0, 1, 2)
        gaps = []
        while not flight.ended and (not gaps or flight.time < SECONDS - 0.1):
            flight.fly(DT)
            x = [vehicle.x[:2] for vehicle in flight.vehicles]
            gaps.append(min(math.dist(x[i], x[j]) for i, j in ((0, 1), (0, 2), (1, 2))))
        least[law.safety is None] = min(gaps)
        assert max(place_errors(flight.mission.facts, SECONDS, x)) < 0.02
    # Without it the two pass through each other.
    assert least[True] < 0.1 and least[False] > safety.touching
