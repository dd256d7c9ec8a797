"""Mistakes on the ground: each says one sentence, and the page shows it.

Agents, station and vehicles fly in this process under a clock that stands still while they compute.
"""

import json
import sys
import time
import types

import pytest
import two_points
from free_port import free_port
from virtual_flight import VirtualFlight

from echelon_flight import __main__ as process
from echelon_flight.datagram_socket import DatagramSocket, bound, ports_of
from echelon_flight.ground import Ground
from echelon_flight.mission import Mission, make_key
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND


@pytest.fixture
def flight(tmp_path, monkeypatch):
    two_points.write(tmp_path / "points")
    return VirtualFlight(tmp_path / "points", tmp_path / "key", monkeypatch)


def notes(state, number=1):
    return state["agents"][number].get("notes", [])


def row(flight, number=1):
    return flight.ground.state()["agents"][number]


def refused(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["echelon_flight", *map(str, words)])
    with pytest.raises(SystemExit) as left:
        process.main()
    said = capsys.readouterr().err
    assert left.value.code == 2 and said.startswith("echelon-flight: ") and said.count("\n") == 1
    return said


def test_a_port_in_use(tmp_path, monkeypatch, capsys):
    two_points.write(tmp_path)
    make_key(tmp_path / "key")
    port = free_port() // 8 * 8
    ways = ports_of(2, port)
    wire = Mission(tmp_path).wire(GROUND, tmp_path / "key")
    ground = Ground(DatagramSocket(ways[2], ways[:2]), wire, 2)
    words = [tmp_path, "--agent", 1, "--key", tmp_path / "key", "--port", port]
    with bound(port + 1):
        said = refused(monkeypatch, capsys, *words)
    sentence = f"the address 127.0.0.1:{port + 1} is in use; a process with the same number"
    assert sentence in said
    until = time.monotonic() + 5.0
    while not any(sentence in note for note in notes(ground.state())):
        assert time.monotonic() < until
        ground.round()
    ground.close()


def test_a_flight_number_that_is_damaged_or_cannot_be_stored(tmp_path, monkeypatch, capsys):
    two_points.write(tmp_path)
    make_key(tmp_path / "key")
    (tmp_path / "key.agent-0.flight").write_text("x")
    (tmp_path / "key.agent-1.flight").mkdir()
    for k, sentence in ((0, "is `x`, and must be a whole number"), (1, "(is a directory)")):
        words = [tmp_path, "--agent", k, "--key", tmp_path / "key"]
        assert sentence in refused(monkeypatch, capsys, *words)


def unlike(flight, tmp_path, why):
    if "key" in why:
        make_key(tmp_path / "another key")
        return {"key": tmp_path / "another key"}
    if "clock" in why:
        return {"skew": 1.2}
    other = Mission(tmp_path / "points")
    other.facts = other.facts | {"formation": "cd" * 32}
    other.law = flight.mission.law
    return {"mission": other}


@pytest.mark.parametrize(
    "why",
    [
        "is signed with another key",
        "is of another formation",
        "has a time stamp that is farther from this clock than `stamp_difference` allows",
    ],
)
def test_an_agent_that_is_unlike_the_others_stays_on_the_ground(flight, tmp_path, why, capsys):
    flight.start_agent(0)
    flight.start_agent(1, **unlike(flight, tmp_path, why))
    flight.take_off(0)
    flight.fly(2.0)
    state = flight.ground.state()
    assert [each["mode"] for each in state["agents"]] == ["flies", "not heard yet"]
    assert f"a datagram of agent 1 {why}" in state["dropped"][0]
    assert f"a datagram of agent 1 {why}" in notes(state, 0)
    flight.agents[1].interrupt()
    flight.fly(0.1)
    said = capsys.readouterr().err
    assert said.count(f"agent 1: a datagram of the ground {why}.\n") == 1
    assert "it never flew" in said
    assert flight.ended == {1: Fault.SIGNAL} and row(flight, 0)["mode"] == "flies"


def test_a_law_that_overruns_its_period(flight, capsys):
    law, _ = flight.mission.law(1)

    def step(*arguments):
        flight.clock.busy += 0.6 * two_points.DT
        return law.step(*arguments)

    flight.start_agent(0)
    flight.start_agent(1, law=types.SimpleNamespace(**vars(law) | {"step": step}))
    flight.take_off(0, 1)
    sentence = "of its period, more than `overrun_share` allows"
    flight.wait(lambda state: sentence in (state["agents"][1].get("why") or ""), 4.0)
    # The other one flies on and ends as planned.
    assert row(flight, 0)["mode"] == "flies"
    flight.wait(lambda state: len(flight.ended) == 2)
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("agent 1")]
    assert len([line for line in said if line.endswith("the vehicle levels and descends.")]) == 1
    assert sentence in said[0] and flight.ended == {0: Fault.END, 1: Fault.OVERRUN}
    assert [vehicle.x[2] for vehicle in flight.vehicles] == [0.0, 0.0]


@pytest.mark.parametrize("step", [0.03, 0.04])
def test_a_link_with_another_step_than_the_law(flight, step):
    flight.step = step
    for k in (0, 1):
        flight.start_agent(k)
    flight.take_off(0, 1)
    told = f"states arrive every {step:g} s, and the law's period is {two_points.DT:g} s"
    if step >= 2.0 * two_points.DT:
        told = f"states arrive every {step:g} s, too slowly for the law (`slow_states`)"
        flight.wait(lambda state: all(each.get("why") == told for each in state["agents"]))
        flight.wait(lambda state: len(flight.ended) == 2)
        assert set(flight.ended.values()) == {Fault.PERIOD}
        return
    flight.wait(lambda state: all(told in notes(state, k) for k in (0, 1)))
    assert [row(flight, k)["mode"] for k in (0, 1)] == ["flies", "flies"]


def test_vehicles_that_vanish_in_the_air(flight):
    for k in (0, 1):
        flight.start_agent(k)
    flight.take_off(0, 1)
    flight.fly(1.0)
    flight.silent = True
    flight.wait(lambda state: "the newest state is" in (state["agents"][1].get("why") or ""))
    # Without states it may still be in the air.
    flight.fly(15.0)
    assert not flight.ended and row(flight)["mode"] == "descends"
    flight.fly(6.0)
    assert flight.ended == {0: Fault.STALE, 1: Fault.STALE}


def test_a_folder_that_was_changed_is_refused(tmp_path):
    two_points.write(tmp_path)
    mission, file = Mission(tmp_path), tmp_path / "law-1" / "law.py"
    assert mission.law(1)[1]["agent"] == 1
    with pytest.raises(process.FlightError, match="`--agent` is 7, and the agents of this"):
        mission.law(7)
    text = file.read_text("utf-8")
    file.write_text(text + "\n", "utf-8")
    with pytest.raises(process.FlightError, match=r"is not the file that its law\.json describes"):
        mission.law(1)
    file.write_text(text, "utf-8")
    facts = json.loads((tmp_path / "flight.json").read_text("utf-8"))
    (tmp_path / "flight.json").write_text(json.dumps(facts | {"formation": "cd"}), "utf-8")
    with pytest.raises(process.FlightError, match="is of another formation than"):
        Mission(tmp_path).law(1)
    earlier = {key: value for key, value in facts.items() if key != "message"}
    (tmp_path / "flight.json").write_text(json.dumps(earlier), "utf-8")
    with pytest.raises(process.FlightError, match="was prepared by an earlier version; prepare"):
        Mission(tmp_path).law(1)
    with pytest.raises(process.FlightError, match=r"cannot be read; `echelon fly SCENARIO --out"):
        Mission(tmp_path / "nowhere")
