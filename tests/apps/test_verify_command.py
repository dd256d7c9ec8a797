"""`echelon verify`: honest runs are verified, forged folders never, and what is open is named."""

import json
import os
import shutil

import h5netcdf
import h5py
import numpy as np
import pytest
import xarray as xr
from runs import OWN_PENDULUM

import echelon as ech
from echelon.experiments.scenario.scenario import bundled_scenarios

SMALL = """
seed: 0
name: small
model: {name: double-integrator, parameters: {dimension: 2}}
graph: {name: path, agents: 4}
follower: {gain: {method: riccati}}
initial: {spread: {position: 1.0}}
simulation: {horizon: 0.2, dt: 0.01}
"""
T5 = SMALL.replace(
    "follower: {gain: {method: riccati}}", "follower: {law: stopping-point}"
).replace("follower:", "leader: {law: stopping-point}\nfollower:")
ALONE = SMALL.replace("{gain: {method: riccati}}", "{law: agreement}").replace("double", "single")
ALONE += "leader: {law: agreement}\n"


LOOSE = SMALL.replace("riccati", "riccati, coupling: 500.0")
# Guaranteed near its goals, and starts far from them.
FALLS = """
name: small
model: {name: quadrotor, parameters: crazyflie-2.1+}
graph: {name: path, agents: 3}
follower: {gain: {method: riccati}}
initial: {spread: {position: 30.0, attitude: 2.0}}
simulation: {horizon: 1.0, dt: 0.005, limits: true}
seed: 0
"""
TURNS = ALONE.replace("law: agreement", "gain: {method: riccati}", 1).replace(
    "agreement", "passive"
)
TURNS = TURNS.replace(
    "{name: path, agents: 4}",
    "{agents: 3, leaders: [0], edges: [[0, 1], [1, 2]], period: 0.2, "
    "schedule: [{at: 0.1, edges: [[0, 2], [2, 1]]}]}",
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The folders of runs: with a gain, under T5 without borders, without either, and switching."""
    place = tmp_path_factory.mktemp("runs")
    for name, text in (
        ("gain", SMALL),
        ("tube", T5),
        ("alone", ALONE),
        ("turns", TURNS),
        ("loose", LOOSE),
        ("falls", FALLS),
    ):
        (place / f"{name}.yaml").write_text(text)
        result = ech.run(ech.load_scenario(place / f"{name}.yaml"))
        ech.save_run(result, place / name, figures=False)
    return place


@pytest.mark.parametrize("name", ["gain", "tube", "alone", "turns", "loose", "falls"])
def test_an_honest_run_is_verified_by_all_that_it_states(runs, echelon, name):
    code, out, err = echelon("verify", runs / name)
    assert (code, err) == (0, "") and "Verified: " in out
    assert max(map(len, out.splitlines())) <= 80 or str(runs) in max(out.splitlines(), key=len)
    assert "Computed again from the scenario" in out and "Not covered: " in out
    assert echelon("verify", runs / name / "summary.json")[0] == 0
    code, out, _ = echelon("verify", runs / name, "--json")
    found = json.loads(out)
    verdicts = {x["verdict"] for x in found["findings"]}
    assert code == 0 and found["holds"] and verdicts <= {"holds", "recomputed"}
    by = {x["claim"]: x["means"] for x in found["findings"]}
    assert by["promise.sentence"] == by["promise.rate"] == "scenario"
    assert ("independent code" in by.values()) is (name in ("gain", "turns", "loose", "falls"))


def in_json(name, change):
    """Change the mapping in a file of a run."""

    def act(folder):
        file = folder / name
        document = json.loads(file.read_text())
        change(document)
        file.write_text(json.dumps(document))

    return act


def in_text(name, old, new):
    """Replace a text in a file of a run, once."""

    def act(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return act


def in_data(**attributes):
    """Change attributes of the dataset of a run."""

    def act(folder):
        with h5py.File(folder / "run.nc", "r+") as data:
            for name, change in attributes.items():
                data.attrs[name] = change(data.attrs.get(name))

    return act


def in_both(old, new):
    """Replace a text in the scenario and in its copy in the dataset."""

    def act(folder):
        in_text("scenario.yaml", old, new)(folder)
        in_data(scenario_text=lambda text: text.replace(old, new, 1))(folder)

    return act


def scaled(name):
    """Halve the last numbers of a variable in the dataset of a run."""

    def act(folder):
        with h5py.File(folder / "run.nc", "r+") as data:
            data[name][-1:] *= 0.5

    return act


def moved(name):
    """Add to the first numbers of a variable in the dataset of a run."""

    def act(folder):
        with h5py.File(folder / "run.nc", "r+") as data:
            data[name][:1] += 0.5

    return act


def marked(place, name, value):
    """Add an attribute to a variable or group in the dataset of a run, or change it."""

    def act(folder):
        with h5py.File(folder / "run.nc", "r+") as data:
            data[place].attrs[name] = value

    return act


def added(group, name="flown"):
    """Add a variable to a group of the dataset of a run, as xarray does."""

    def act(folder):
        extra = xr.Dataset({name: (("trial",), np.zeros(3))})
        extra.to_netcdf(folder / "run.nc", mode="a", group=group, engine="h5netcdf")

    return act


def retyped(name):
    """Store a variable of the dataset of a run in single precision."""

    def act(folder):
        with h5netcdf.File(folder / "run.nc", "r+") as data:
            old = data.variables[name]
            values, over, attributes = old[...], old.dimensions, dict(old.attrs)
            del data._h5file[name]
        with h5netcdf.File(folder / "run.nc", "r+") as data:
            new = data.create_variable(name, over, "f4", fillvalue=np.float32(np.nan))
            new[...] = values
            new.attrs.update({k: v for k, v in attributes.items() if k != "_FillValue"})

    return act


def without(name):
    """Remove a variable from the dataset of a run."""

    def act(folder):
        with h5py.File(folder / "run.nc", "r+") as data:
            del data[name]

    return act


def dimension(folder):
    """Add a dimension that no variable has to the dataset of a run."""
    with h5netcdf.File(folder / "run.nc", "r+") as data:
        data.dimensions["trial"] = 3


def link(folder):
    """A link to the gain file of another run, which is a correct gain."""
    other = ech.load_scenario(folder / "scenario.yaml", ["graph.agents=5"])
    ech.save_run(ech.run(other), folder.parent / "other", figures=False)
    (folder / "gain.json").unlink()
    os.symlink(folder.parent / "other" / "gain.json", folder / "gain.json")


def weaken(document):
    document["coupling"] *= 1e-6
    document["anywhere"] = {"format": "echelon tube 1", "borders": []}


def hide(document):
    weaken(document)
    document["promise"] = {"anywhere": document.pop("anywhere")}


FORGED = {
    # Of a gain, with what once led elsewhere.
    "a gain with a tube": ("gain", in_json("gain.json", weaken), 2),
    "a gain in a promise": ("gain", in_json("gain.json", hide), 2),
    "a gain of another run": ("gain", link, 1),
    "no gain": ("gain", lambda folder: (folder / "gain.json").unlink(), 2),
    "no data": ("gain", lambda folder: (folder / "run.nc").unlink(), 5),
    "no summary": ("gain", lambda folder: (folder / "summary.json").write_text("{}"), 2),
    "a gain doubled in all files": (
        "gain",
        lambda folder: [
            in_json("gain.json", lambda d: d.update(R=[[4 * x for x in row] for row in d["R"]]))(
                folder
            ),
            in_json("summary.json", lambda d: d["gain"].update(coupling=9.0))(folder),
        ],
        1,
    ),
    # JSON that readers take in different ways.
    "a key twice": ("tube", in_text("summary.json", '"borders":', '"borders": [1], "borders":'), 2),
    "a tube twice": (
        "tube",
        in_text("summary.json", '"anywhere":', '"anywhere": {}, "anywhere":'),
        2,
    ),
    "NaN": ("tube", in_text("summary.json", '"rate": ', '"rate": NaN, "x": '), 2),
    "Infinity": ("tube", in_text("summary.json", '"edge": null', '"edge": -Infinity'), 2),
    "an overflow": ("tube", in_text("summary.json", '"edge": null', '"edge": 1e999'), 2),
    "a long number": ("tube", in_text("summary.json", '"agents": 4', '"agents": 4' + "0" * 400), 2),
    "a longer number": (
        "tube",
        in_text("summary.json", '"agents": 4', '"agents": 4' + "0" * 40),
        1,
    ),
    "deep": ("tube", in_text("summary.json", '"edge": null', '"edge": ' + "[" * 10**5), 2),
    # One statement each.
    "a faster rate": ("tube", in_json("summary.json", lambda d: d["promise"].update(rate=9.0)), 1),
    "a sentence": (
        "tube",
        in_json("summary.json", lambda d: d["promise"].update(sentence="All is well.")),
        1,
    ),
    "an arrival": (
        "tube",
        in_json("summary.json", lambda d: d["promise"]["anywhere"].update(within_1_cm_from=0.01)),
        1,
    ),
    "no tube": ("tube", in_json("summary.json", lambda d: d["promise"].update(anywhere=None)), 1),
    "another tube": ("tube", in_json("summary.json", lambda d: d["promise"].update(anywhere=3)), 1),
    "no promise": ("tube", in_json("summary.json", lambda d: d.pop("promise")), 2),
    "more promises": ("alone", in_json("summary.json", lambda d: d.update(proved="stable")), 1),
    "another seed": ("alone", in_json("summary.json", lambda d: d.update(seed=1)), 1),
    # What the run was of.
    "another scenario": ("tube", in_text("scenario.yaml", "agents: 4", "agents: 3"), 1),
    "a scenario twice": ("tube", in_text("scenario.yaml", "agents: 4", "agents: 4, agents: 4"), 2),
    "another start": ("alone", in_text("scenario.yaml", "position: 1.0", "position: 2.0"), 1),
    "a start in the data": ("alone", moved("states"), 1),
    "a time in the data": ("alone", moved("time"), 2),
    "a time of inputs in the data": ("alone", moved("inputs/time"), 2),
    "a weight in the data": ("alone", moved("graph/edge_weight"), 1),
    "an offset in the data": ("gain", moved("offset"), 1),
    "a P in the data": ("gain", moved("gain/P"), 1),
    "a step in the data": ("alone", in_data(dt=lambda dt: 2.0 * dt), 1),
    "the data's promise": (
        "tube",
        in_data(promise=lambda text: text.replace('"rate": ', '"rate": 1')),
        1,
    ),
    "the data's scenario twice": (
        "alone",
        in_data(scenario_text=lambda text: text + "seed: 0\nseed: 1\n"),
        1,
    ),
    # What the run observed.
    "a distance": ("alone", in_json("summary.json", lambda d: d.update(minimum_distance=3.0)), 1),
    "an outcome": ("gain", in_json("summary.json", lambda d: d["outcome"].update(message="!")), 1),
    "an error": (
        "gain",
        in_json("summary.json", lambda d: d["followers"][0].update(rmse=1e-3)),
        1,
    ),
    "later states": ("gain", scaled("states"), 1),
    "later inputs": ("gain", scaled("inputs/inputs"), 1),
    "later errors": ("gain", scaled("error"), 1),
    "V": ("gain", scaled("lyapunov"), 1),
    "a sum": ("gain", scaled("sums/errors/sum_errors"), 1),
    "poles": ("gain", moved("modes/pole_real"), 1),
    "inputs that are stated to be others": ("gain", in_data(inputs=lambda _: "a.csv:0"), 1),
    "an engine": ("gain", in_json("summary.json", lambda d: d.update(engine="native")), 1),
    "a version": ("gain", in_json("summary.json", lambda d: d["versions"].update(jax="9")), 1),
    "an attribute": ("gain", in_data(proved=lambda _: "stable"), 1),
    "a report": ("gain", in_text("report.txt", "reached", "passed"), 1),
    "a last digit of a report": ("gain", in_text("report.txt", "0.2", "0.1"), 5),
    "a number of a report": ("gain", in_text("report.txt", "0.2", "0.9"), 1),
    # What readers of the dataset see beside its arrays.
    "a scale": ("gain", marked("error", "scale_factor", 1e-9), 1),
    "a shift": ("gain", marked("error", "add_offset", -0.1), 1),
    "a missing value": ("gain", marked("error", "missing_value", 1.0), 1),
    "another missing value": ("gain", marked("error", "_FillValue", 0.0), 1),
    "a scale of inputs": ("gain", marked("inputs/inputs", "scale_factor", 0.5), 1),
    "a long name": ("gain", marked("states", "long_name", "measured by cameras"), 1),
    "another unit": ("gain", marked("time", "units", "ms"), 1),
    "a unit of another variable": ("gain", marked("states", "units", "s"), 1),
    "a unit of a group's time": ("gain", marked("inputs/time", "units", "m"), 1),
    "other coordinates": ("gain", marked("error", "coordinates", "time"), 1),
    "an attribute of a group": ("gain", marked("graph", "comment", "flown"), 1),
    "a group": ("gain", added("/flight"), 1),
    "a group in a group": ("gain", added("/sums/flight"), 1),
    "a variable": ("gain", added("/"), 1),
    "a variable of a group": ("gain", added("/modes"), 1),
    "a dimension": ("gain", dimension, 1),
    "another type": ("gain", retyped("saturated"), 1),
    "a variable less": ("gain", without("lyapunov_drift"), 1),
    "a scale without a guarantee": ("loose", marked("error", "scale_factor", 1e-9), 1),
    "a variable without a guarantee": ("loose", added("/"), 1),
    # Without a guarantee rounding may grow, and a difference proves nothing.
    "states without a guarantee": ("loose", scaled("states"), 5),
    "states where errors grow": ("falls", scaled("states"), 5),
    "a run that is said to be stopped": ("gain", in_data(outcome=lambda _: "stopped"), 1),
    "other inputs of a consistent run": ("gain", in_both("seed: 0", "seed: 1"), 1),
    "another horizon of all": ("gain", in_both("0.2", "0.4"), 1),
    "the data's graph": (
        "alone",
        in_data(scenario_text=lambda text: text.replace("agents: 4", "agents: 400")),
        1,
    ),
}


@pytest.mark.parametrize("what", FORGED)
def test_no_forged_folder_is_verified(runs, echelon, here, what):
    name, forge, code = FORGED[what]
    shutil.copytree(runs / name, here / "run")
    forge(here / "run")
    found, out, err = echelon("verify", "run")
    assert found == code, out + err
    assert ("Incomplete: " in out) is (code == 5)
    assert ("Verified" in out) is (code == 0) and ("Refused: " in out) is (code == 1)
    assert err.count("\n") == (code == 2)


# Another law, a model of another kind, a late network; the rest is a study.
DRAWN = {"unicycle", "van-der-pol", "paper-radio"}
EVERY = [
    pytest.param(name, marks=pytest.mark.slow if name in DRAWN else pytest.mark.study)
    for name in sorted(bundled_scenarios())
]


@pytest.mark.parametrize("name", EVERY)
def test_a_run_of_every_bundled_scenario_is_verified(echelon, here, name):
    short = "simulation.horizon=0.5"
    assert echelon("run", name, "--set", short, "--no-figures", "--out", "run")[0] == 0
    code, out, _ = echelon("verify", "run")
    assert code == 0, out
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("stops", [1, 7])
def test_a_run_that_was_stopped_is_repeated_until_then(echelon, here, stops):
    (here / "small.yaml").write_text(SMALL.replace("horizon: 0.2", "horizon: 4.0"))
    count = 0

    def progress(run):
        nonlocal count
        count += 1
        if count == stops:
            raise KeyboardInterrupt

    result = ech.run(ech.load_scenario("small.yaml"), progress)
    assert result.outcome is ech.Outcome.INTERRUPTED and len(result.times) < 100
    ech.save_run(result, "run", figures=False)
    assert echelon("verify", "run")[0] == 0
    code, out, _ = echelon("verify", "run", "--no-repeat")
    assert code == 5 and "not checked: what the run observed" in " ".join(out.split())
    scaled("states")(here / "run")
    assert echelon("verify", "run")[0] == 1
    # Between two chunks no run ends by itself.
    in_data_of_sums(here / "run")
    code, out, _ = echelon("verify", "run")
    assert code == 5 and "at a step that is not repeated" in " ".join(out.split())


def in_data_of_sums(folder):
    with h5py.File(folder / "run.nc", "r+") as data:
        data["sums/steps/sum_steps"][0] += 1


def test_what_another_version_made_is_refused_with_a_hint(runs, echelon, here):
    shutil.copytree(runs / "alone", here / "run")
    in_json("summary.json", lambda d: d["versions"].update(echelon="0.0.1"))(here / "run")
    in_data(version_echelon=lambda _: "0.0.1")(here / "run")
    assert echelon("verify", "run")[0] == 0
    in_json("summary.json", lambda d: d["promise"].update(sentence="Old words."))(here / "run")
    code, out, _ = echelon("verify", "run")
    told = " ".join(out.split())
    assert code == 1 and "echelon 0.0.1 (" in told and "which may state more, or the same" in told
    assert "To compute it again by this one: echelon run run --out OTHER" in told
    assert max(map(len, out.splitlines())) <= 80


def test_a_file_outside_of_the_folder_is_not_read_for_a_verification(runs, echelon, here):
    shutil.copytree(runs / "gain", here / "run")
    shutil.copy(runs / "gain" / "gain.json", here / "elsewhere.json")
    in_text("scenario.yaml", "{method: riccati}", "{file: ../elsewhere.json}")(here / "run")
    code, out, _ = echelon("verify", "run")
    assert code == 5 and "the scenario names a file outside of its folder" in " ".join(out.split())


def test_code_is_executed_for_a_verification_only_where_it_is_named(echelon, here):
    (here / "pendulum.py").write_text(OWN_PENDULUM)
    text = SMALL.replace(
        "{name: double-integrator, parameters: {dimension: 2}}", "{python: 'pendulum.py:Pendulum'}"
    )
    (here / "own.yaml").write_text(text.replace("position: 1.0", "angle: 0.1"))
    assert echelon("run", "own.yaml", "--no-figures", "--out", "own")[0] == 0
    code, out, err = echelon("verify", "own")
    assert (code, err) == (5, "") and "promise.verdict; " in out
    assert out.splitlines()[-1].endswith("echelon verify own --scenario own")
    assert echelon("verify", "own", "--scenario", "own")[0] == 0
    assert echelon("verify", "own", "--scenario", "own.yaml")[0] == 0
    # Another scenario gives the class, and says nothing about this run.
    (here / "own.yaml").write_text(text.replace("position: 1.0", "angle: 0.2"))
    code, out, _ = echelon("verify", "own", "--scenario", "own.yaml")
    assert code == 5 and "the scenario is not that of the run" in " ".join(out.split())
    # The folder's code is not executed, whatever it would say.
    (here / "own" / "inputs" / "pendulum.py").write_text("raise SystemExit(0)")
    assert echelon("verify", "own")[0] == 5


def test_the_output_of_a_check_is_verified_with_its_scenario(echelon, here):
    (here / "t5.yaml").write_text(T5)
    code, out, _ = echelon("check", "t5.yaml", "--json")
    (here / "check.json").write_text(out)
    code, out, _ = echelon("verify", "check.json")
    assert code == 5 and "promise.anywhere" in out
    assert out.splitlines()[-1].endswith("echelon verify check.json --scenario SCENARIO")
    assert echelon("verify", "check.json", "--scenario", "t5.yaml")[0] == 0
    in_json("check.json", lambda d: d["lines"][3].update(text="every graph"))(here)
    assert echelon("verify", "check.json", "--scenario", "t5.yaml")[0] == 1
