"""All processes of a flight on this machine, in slow motion, so that other work does not count."""

import json
import time
import urllib.error
import urllib.request

import pytest

import echelon as ech
from echelon.agents.network.formation_motion import Rotate
from echelon.core.errors import FlightError
from echelon.flight.ground import page_of
from echelon.flight.local_flight import Together, flying
from echelon.flight.mission import Mission
from echelon.output.archive.flight_folder import flight_files, save_flight
from echelon.output.viewer.serve import serve, serving

pytestmark = pytest.mark.slow
CARTS, DT, SPEED, SECONDS = ech.models.DoubleIntegrator(), 0.02, 0.25, 8.0


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    graph = ech.Graph([(0, 1), (1, 2)], directed=True)
    places = ech.Formation.from_offsets(CARTS, graph, {1: (1.0, 0.0), 2: (1.0, 0.8)})
    places = places.moving(CARTS, graph, [Rotate(0.4)])
    circle = ech.references.Circle(rate=0.5)
    leader = ech.laws.StoppingLeader(reference=circle)
    drive = ech.Laws(leader, ech.laws.StoppingPoint())
    network = ech.Network(rate=25.0, delay=0.02, jitter=0.02, loss=0.2)
    world = ech.World(network=network)
    parts = ech.Parts(CARTS, graph, places, drive, initial={"position": 0.3}, world=world)
    folder = tmp_path_factory.mktemp("flight")
    save_flight(flight_files(parts, ech.Settings(horizon=SECONDS, dt=DT), "carts"), folder)
    return Mission(folder)


def wait_until(together, t):
    while together.time() < t:
        time.sleep(0.01)


def test_a_flight_in_processes_of_their_own_keeps_its_formation(mission):
    together = Together(mission, SECONDS, SPEED, 47700)
    with flying(together):
        wait_until(together, 5.0)
        before = together.time()
        together.kill(2)
        wait_until(together, 5.3)
        together.start_agent(2)
        wait_until(together, SECONDS - 0.2)
        errors = together.errors()
    late = [errors.worst(k, 7.4) for k in (1, 2)]
    assert max(late) < 0.01, late
    # The one that was killed went astray meanwhile, and came back.
    assert errors.worst(2, before) > max(errors.worst(1, before), late[1])
    assert errors.worst(1, 4.0) < 0.01


def test_the_page_shows_who_is_alive_and_its_button_stops_all(mission):
    together = Together(mission, SECONDS, SPEED, 47720)
    with serving(serve(page_of(together.ground))) as address, flying(together):
        wait_until(together, 1.0)
        state = json.load(urllib.request.urlopen(f"{address}state"))
        assert [row["mode"] for row in state["agents"]] == ["flies"] * 3 and state["started"]
        foreign = urllib.request.Request(f"{address}stop", b"", {"Origin": "http://example.org"})
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(foreign)
        urllib.request.urlopen(urllib.request.Request(f"{address}stop", b""))
        wait_until(together, 1.6)
        rows = json.load(urllib.request.urlopen(f"{address}state"))["agents"]
        assert {row["why"] for row in rows} == {"a signed stop command arrived"}
        assert "Ground station" in urllib.request.urlopen(address).read().decode()


def test_a_changed_law_is_refused(mission):
    file = mission.folder / "law-1" / "law.py"
    text = file.read_text("utf-8")
    file.write_text(text + "\n", "utf-8")
    with pytest.raises(FlightError, match=r"is not the file that its law\.json describes\.$"):
        mission.law(1)
    file.write_text(text, "utf-8")
    assert mission.law(1)[1]["agent"] == 1
    with pytest.raises(FlightError, match="`--agent` is 7, and the agents of this"):
        mission.law(7)
