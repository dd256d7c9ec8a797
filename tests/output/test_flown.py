"""A flight that took place, as `ech.load` returns it, beside its logs and beside a simulation.

The flights are of vehicles in this process, under a clock that a test moves.
"""

import json
import shutil

import numpy as np
import pytest
from virtual_flight import VirtualFlight

import echelon as ech
from echelon.core.errors import OutputError
from echelon.experiments.results.beside import beside
from echelon.experiments.results.recording import recording_of
from echelon.experiments.scenario.build import origin_of
from echelon.output.archive.flight_folder import flight_files, save_flight
from echelon.output.archive.flown import PLAN, plan_file
from echelon_flight.flight_log import find_logs, read_log
from echelon_flight.supervisor import Fault

CARTS = """
name: carts
model: {name: double-integrator}
graph: {edges: [[0, 1], [1, 2]], leaders: [0]}
formation: {offsets: {1: [1, 0], 2: [2, 0]}}
reference: {name: circle, rate: 0.5}
initial: {spread: {position: 0.3}}
follower: {law: stopping-point}
network: {rate: 25}
simulation: {horizon: 2, dt: 0.02}
"""
N = 3


def prepare(folder, text=CARTS):
    (folder / "carts.yaml").write_text(text)
    scenario = ech.load_scenario(folder / "carts.yaml")
    parts, settings = ech.build(scenario)
    files = dict(flight_files(parts, settings, "carts"))
    facts = json.loads(files["flight.json"])
    # A cart that nobody brakes never rests.
    facts["parameters"]["longest_descent"] = 1.0
    files["flight.json"] = json.dumps(facts)
    save_flight(files | {PLAN: plan_file(parts, settings, origin_of(scenario))}, folder / "flight")
    return folder / "flight"


def flown(folder, key, monkeypatch, skews=(0.0,) * N, meanwhile=lambda flight: None):
    """Fly, and return the flight and its number."""
    with monkeypatch.context() as patch:
        flight = VirtualFlight(folder, key, patch)
        for k, skew in enumerate(skews):
            flight.start_agent(k, skew=skew, logs=True)
        flight.take_off(*range(N))
        meanwhile(flight)
        flight.fly(8.0)
        assert len(flight.ended) == N, flight.ended
        return flight, flight.ground.wire.flight


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    return prepare(tmp_path_factory.mktemp("flown"))


@pytest.fixture
def flight(prepared, tmp_path, monkeypatch):
    """A folder with the logs of one flight, whose clocks agree."""
    folder = tmp_path / "flight"
    shutil.copytree(prepared, folder)
    flown(folder, tmp_path / "key", monkeypatch)
    return folder


def logs_of(folder):
    [files] = find_logs(folder).values()
    return [read_log(file) for file in files]


def test_frames_are_what_the_logs_say_at_their_times(flight):
    """States between two ticks are on the line between them, and inputs hold."""
    result = ech.load(flight)
    logs = logs_of(flight)
    assert result.times == pytest.approx(0.02 * np.round(result.times / 0.02), abs=1e-12)
    for k, log in enumerate(logs):
        ticks = [tick for tick in log.ticks if tick.mode == 1]
        assert 90 < len(ticks) and len(ticks) - len(result.times) in range(4)
        for t, x, u in zip(result.times, result.states[:, k], result.inputs[:, k]):
            before = [tick for tick in ticks if tick.time <= t + 1e-9][-1]
            after = next((tick for tick in ticks if tick.time > t + 1e-9), before)
            share = (t - before.time) / max(1e-12, after.time - before.time)
            line = np.array(before.x) + share * (np.array(after.x) - np.array(before.x))
            assert x == pytest.approx(line, abs=1e-9) and u == pytest.approx(before.u, abs=1e-12)
    assert result.outcome is ech.Outcome.COMPLETED and not result.warnings
    # Built from the scenario in `plan.nc` when it is first read.
    assert result.graph.agents == N and result.model.state_names == ("x", "y", "vx", "vy")


def test_errors_ages_and_losses_are_those_of_the_logs(flight):
    run, logs = recording_of(ech.load(flight)), logs_of(flight)
    places = run.states[:, :, :2] - run.states[:, :1, :2]
    goals = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    assert run.formation_errors == pytest.approx(np.linalg.norm(places - goals, axis=2), abs=1e-12)
    for e, end in np.argwhere(run.heard):
        receiver, sender = int(run.edges[e, end]), int(run.edges[e, 1 - end])
        heard = [x for tick in logs[receiver].ticks for x in tick.received if x.sender == sender]
        for t, age in zip(run.times, run.messages.edges[:, e, end]):
            stamps = [x.row[0] for x in heard if x.arrived <= t + 1e-9]
            assert np.isnan(age) if not stamps else age == pytest.approx(t - stamps[-1], abs=1e-9)
    # What its theorems say of a model is no claim about a flight.
    assert run.guarantee == {} and run.rate is None and run.error_bound() is None


def test_two_flights_in_a_folder_are_told_apart_by_their_numbers(flight, tmp_path, monkeypatch):
    [first] = find_logs(flight)
    _, second = flown(flight, tmp_path / "key", monkeypatch)
    assert second > first
    with pytest.raises(OutputError) as refused:
        ech.load(flight)
    told = f"`{flight}` has the logs of 2 flights; give one, such as `{flight}/logs/{first}`."
    assert str(refused.value) == told
    for number in (first, second):
        assert str(number) in ech.load(flight / "logs" / str(number)).message


def test_a_damaged_log_is_used_up_to_there_and_named(flight):
    [files] = find_logs(flight).values()
    whole = files[2].read_bytes()
    files[2].write_bytes(whole[: len(whole) // 2])
    result = ech.load(flight)
    [warning] = result.warnings
    until = float(warning.split("up to ")[1].split(" s;")[0])
    assert warning.startswith(f"The log `{files[2].name}` is whole") and 0.5 < until < 1.5
    run = recording_of(result)
    assert run.presence is not None and run.presence[:, :2].all()
    assert run.times[run.presence[:, 2]].max() == pytest.approx(until, abs=0.03)
    assert np.isfinite(run.states).all()


def test_a_follower_without_a_log_did_not_fly_and_a_leader_without_one_is_refused(flight):
    [files] = find_logs(flight).values()
    files[1].unlink()
    run = recording_of(ech.load(flight))
    assert not run.presence[:, 1].any() and run.presence[:, [0, 2]].all()
    files[0].write_bytes(b"nothing")
    with pytest.raises(OutputError, match="has no log of its leader, agent 0; copy the folder"):
        ech.load(flight)


def test_logs_of_another_formation_and_folders_without_any_are_refused(flight, prepared):
    [files] = find_logs(flight).values()
    facts = json.loads((flight / "flight.json").read_text())
    (flight / "flight.json").write_text(json.dumps(facts | {"formation": "ab" * 32}))
    with pytest.raises(OutputError, match="is of another formation than its folder"):
        ech.load(flight)
    with pytest.raises(OutputError, match="has no logs yet; `echelon fly` writes them"):
        ech.load(prepared)
    (flight / "flight.json").write_text(json.dumps(facts))
    (flight / PLAN).unlink()
    with pytest.raises(OutputError, match="has no `plan.nc`, which `echelon fly SCENARIO"):
        ech.load(flight)


@pytest.mark.parametrize("skew", [0.04, -0.03])
def test_clocks_that_differ_are_found_from_letters_both_ways(prepared, tmp_path, monkeypatch, skew):
    folder = tmp_path / "flight"
    shutil.copytree(prepared, folder)
    flown(folder, tmp_path / "key", monkeypatch, skews=(0.0, 0.0, skew))
    [warning] = [x for x in ech.load(folder).warnings if "both ways" in x]
    ahead, behind = (2, 1) if skew > 0.0 else (1, 2)
    assert f"the clock of agent {ahead} is" in warning and f"of agent {behind}'s" in warning
    # Letters wait for the receiver's next tick, up to half a period longer one way.
    assert float(warning.split(" is ")[1].split(" s ")[0]) == pytest.approx(abs(skew), abs=0.011)


def test_an_agent_that_was_killed_is_absent_until_it_is_back(prepared, tmp_path, monkeypatch):
    folder = tmp_path / "flight"
    shutil.copytree(prepared, folder)
    gap = []

    def kill(flight):
        flight.fly(0.8)
        gap.append(flight.time)
        flight.kill(1)
        flight.fly(0.4)
        flight.start_agent(1, logs=True)
        while flight.agents[1].context.clock.now is None:
            flight.fly(0.02)
        gap.append(flight.agents[1].context.clock.now)

    flown(folder, tmp_path / "key", monkeypatch, meanwhile=kill)
    run = recording_of(ech.load(folder))
    away = run.times[~run.presence[:, 1]]
    assert away.min() == pytest.approx(gap[0], abs=0.05)
    assert away.max() == pytest.approx(gap[1], abs=0.15) and run.presence[-1, 1]
    assert len(find_logs(folder)[int(run.attributes["flight"])]) == N + 1


def test_errors_are_beside_the_leader_of_the_moment(tmp_path, monkeypatch):
    """By the leader that the followers' logs name: a backup leader, once the first one is gone."""
    text = CARTS + "leadership: {backups: [1], timeout: 0.3}\n"
    folder = prepare(tmp_path, text.replace("[1, 2]]", "[1, 2], [0, 2]]"))

    def kill(flight):
        flight.fly(0.8)
        flight.ended[0] = Fault.NONE
        flight.kill(0)

    flown(folder, tmp_path / "key", monkeypatch, meanwhile=kill)
    run, logs = recording_of(ech.load(folder)), logs_of(folder)
    assert run.presence[:, 1:].all() and not run.presence[-1, 0]
    taken = next(tick.time for tick in logs[2].ticks if tick.leader == 1)
    nearest = run.nearest_then[:, 2]
    assert (nearest == np.where(run.times < taken - 1e-9, 0, 1)).all() and nearest[-1] == 1
    away = run.states[-1, 2, :2] - run.states[-1, 1, :2] - [1.0, 0.0]
    assert run.formation_errors[-1, 2] == pytest.approx(np.linalg.norm(away), abs=1e-12)


def test_a_law_that_is_not_the_one_that_flew_is_named(flight):
    file = flight / "law-1" / "law.json"
    facts = json.loads(file.read_text())
    file.write_text(json.dumps(facts | {"sha256": {"law.py": "cd" * 32}}))
    [warning] = ech.load(flight).warnings
    assert warning == f"The law of agent 1 in `{flight}` is not the one that flew."


def test_an_early_end_says_why(prepared, tmp_path, monkeypatch):
    folder = tmp_path / "flight"
    shutil.copytree(prepared, folder)
    flight, _ = flown(
        folder, tmp_path / "key", monkeypatch,
        meanwhile=lambda flight: (flight.fly(1.0), flight.ground.stop()),
    )  # fmt: skip
    assert set(flight.ended.values()) == {Fault.STOP}
    result = ech.load(folder)
    assert result.outcome is ech.Outcome.STOPPED and "3 of 3 agents ended early" in result.message
    report = recording_of(result).attributes["flight_report"]
    assert report.count("a signed stop command arrived") == N


def test_a_flight_beside_a_run_is_measured_at_the_times_of_the_run(flight, echelon, tmp_path):
    (tmp_path / "carts.yaml").write_text(CARTS)
    run = ech.simulate(*ech.build(ech.load_scenario(tmp_path / "carts.yaml")))
    ech.save_run(run, tmp_path / "sim", figures=False)
    logs, both = logs_of(flight), beside(recording_of(ech.load(flight)), recording_of(run))
    ticks = [tick for tick in logs[2].ticks if tick.mode == 1]
    times = [tick.time for tick in ticks]
    places = [np.interp(both.times, times, [tick.x[k] for tick in ticks]) for k in (0, 1)]
    rows = np.searchsorted(run.times, both.times - 1e-9)
    away = np.hypot(*(places[k] - run.states[rows, 2, k] for k in (0, 1)))
    # A line through frames that lie on lines through ticks.
    assert both.away[:, 2] == pytest.approx(away, abs=2e-3)
    code, out, _ = echelon("report", flight, "--beside", tmp_path / "sim")
    assert code == 0 and out.startswith(f"Beside {tmp_path / 'sim'}\n")
    assert f"{np.nanmax(both.away[:, 2]):.3g}" in out.splitlines()[5]
    assert "No guarantee is stated" in out
    code, _, err = echelon("report", tmp_path / "sim", "--beside", flight)
    assert code == 2 and "the first is no flight" in err


def test_every_command_that_shows_a_run_shows_a_flight(flight, echelon, tmp_path):
    code, out, _ = echelon("report", flight)
    assert code == 0 and "the flight is over" in out and "version_" not in out
    code, out, _ = echelon(
        "plot", flight, "--what", "formation,ages", "--out", tmp_path / "figures"
    )
    assert code == 0 and (tmp_path / "figures" / "ages.pdf").is_file()
    for name in ("run.csv", "run.npz", "run.nc"):
        assert echelon("export", flight, "--out", tmp_path / name)[0] == 0
    rows = (tmp_path / "run.csv").read_text().splitlines()
    result = ech.load(flight)
    for words in (("--out", tmp_path / "x.mcap"), ("--to", "rosbag2", "--out", tmp_path / "bag")):
        assert echelon("export", flight, *words)[0] == 0
        bag = ech.load(words[-1], agents={k: f"/agent{k}/odom" for k in range(N)})
        assert bag.times == pytest.approx(result.times, abs=1e-9)
        names = [bag.state_names.index(name) for name in ("x", "y", "vx", "vy")]
        assert bag.states[:, :, names] == pytest.approx(result.states, abs=1e-9)
    assert len(rows) == 1 + N * len(result.times)
    again = ech.load(tmp_path / "run.nc")
    assert np.array_equal(again.states, result.states)
    with pytest.raises(OutputError, match="a flight has no sums over steps"):
        ech.metrics(again)
    assert len(ech.table(result)) == N * len(result.times)
