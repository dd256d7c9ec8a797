"""One real flight: a process for each agent, for the vehicles and for a network that loses."""

import json
import time
import urllib.error
import urllib.request

import pytest
import two_points
from free_port import free_port

from echelon_flight.ground import page_of
from echelon_flight.local_flight import LocalFlight
from echelon_flight.mission import Mission

SPEED = 0.5
"""In slow motion, so that other work on the machine does not count."""


def wait_until(flight, t):
    while flight.time() < t:
        time.sleep(0.01)


def agents(address):
    return json.load(urllib.request.urlopen(f"{address}state"))["agents"]


def press_stop(address, **headers):
    urllib.request.urlopen(urllib.request.Request(f"{address}stop", b"", headers))


@pytest.mark.slow
def test_a_flight_from_the_start_to_the_stop(tmp_path):
    two_points.write(tmp_path)
    facts = json.loads((tmp_path / "flight.json").read_text("utf-8"))
    facts["weather"] = {"delay": 0.02, "jitter": 0.02, "loss": 0.2}
    (tmp_path / "flight.json").write_text(json.dumps(facts), "utf-8")
    flight = LocalFlight(Mission(tmp_path), 60.0, SPEED, free_port() // 8 * 8)
    with page_of(flight.ground).serving() as address, flight:
        wait_until(flight, 1.5)
        assert [row["mode"] for row in agents(address)] == ["flies"] * 2
        flight.kill(1)
        wait_until(flight, 1.8)
        flight.start_agent(1)
        wait_until(flight, 4.0)
        errors = flight.errors()
        with pytest.raises(urllib.error.HTTPError):
            press_stop(address, Origin="http://example.org")
        assert [row["mode"] for row in agents(address)] == ["flies"] * 2
        press_stop(address)
        flight.wait_until_down()
        assert {row["why"] for row in agents(address)} == {"a signed stop command arrived"}
        assert "Ground station" in urllib.request.urlopen(address).read().decode()
    assert errors.worst(1, 3.8) < 0.01 < errors.worst(1, 0.0)
    heights = (tmp_path / "positions.csv").read_text().splitlines()[-1].split(",")[4::3]
    assert heights == ["0.000000"] * 2
