"""`echelon verify`: honest runs are verified, forged folders never, and what is open is named."""

import json
import os
import re
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
STOPPING = "{law: stopping-point}\nleader: {law: stopping-point}"
T5 = SMALL.replace("{gain: {method: riccati}}", STOPPING)
ALONE = SMALL.replace("{gain: {method: riccati}}", "{law: agreement}").replace("double", "single")
ALONE += "leader: {law: agreement}\n"
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
SWITCHES = """{agents: 3, leaders: [0], edges: [[0, 1], [1, 2]], period: 0.2,
    schedule: [{at: 0.1, edges: [[0, 2], [2, 1]]}]}"""
TURNS = SMALL.replace("double", "single").replace("{name: path, agents: 4}", SWITCHES)
NAMES = {
    "gain": SMALL,
    "tube": T5,
    "alone": ALONE,
    "turns": TURNS + "leader: {law: passive}\n",
    "loose": SMALL.replace("riccati", "riccati, coupling: 500.0"),
    "falls": FALLS,
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The folders of runs: with a gain, under T5 without borders, without either, and switching."""
    place = tmp_path_factory.mktemp("runs")
    for name, text in NAMES.items():
        (place / f"{name}.yaml").write_text(text)
        result = ech.run(ech.load_scenario(place / f"{name}.yaml"))
        ech.save_run(result, place / name, figures=False)
    return place


@pytest.mark.parametrize("name", NAMES)
def test_an_honest_run_is_verified_by_all_that_it_states(runs, echelon, name):
    code, out, err = echelon("verify", runs / name)
    assert (code, err) == (0, "") and "Verified: " in out
    assert max(map(len, out.splitlines())) <= 80 or str(runs) in max(out.splitlines(), key=len)
    assert "Computed again from the scenario" in out and "Not covered: " in out
    assert name != "gain" or echelon("verify", runs / name / "summary.json")[0] == 0
    code, out, _ = echelon("verify", runs / name, "--json")
    found = json.loads(out)
    verdicts = {x["verdict"] for x in found["findings"]}
    assert code == 0 and found["holds"] and verdicts <= {"holds", "recomputed"}
    by = {x["claim"]: x["means"] for x in found["findings"]}
    assert by["guarantee.verdict"] == by["guarantee.claim"] == "scenario"
    assert ("independent code" in by.values()) is (name in ("gain", "turns", "loose", "falls"))


def forgery(change):
    """A function whose call makes `change`, with its arguments, of the folder that follows."""
    return lambda *arguments, **more: lambda folder: change(folder, *arguments, **more)


@forgery
def in_json(folder, name, change):
    document = json.loads((folder / name).read_text())
    change(document)
    (folder / name).write_text(json.dumps(document))


def in_summary(change):
    return in_json("summary.json", change)


@forgery
def in_text(folder, name, old, new):
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))


def in_tube(old, new):
    return in_text("summary.json", old, new)


def data_of(folder):
    return h5py.File(folder / "run.nc", "r+")


@forgery
def in_data(folder, **attributes):
    with data_of(folder) as data:
        for name, change in attributes.items():
            data.attrs[name] = change(data.attrs.get(name))


@forgery
def in_both(folder, old, new):
    """Replace a text in the scenario and in its copy in the dataset."""
    in_text("scenario.yaml", old, new)(folder)
    in_data(scenario_text=lambda text: text.replace(old, new, 1))(folder)


@forgery
def scaled(folder, name):
    with data_of(folder) as data:
        data[name][-1:] *= 0.5


@forgery
def moved(folder, name, by=0.5):
    """Add to the first numbers of a variable in the dataset of a run."""
    with data_of(folder) as data:
        data[name][:1] += by


@forgery
def marked(folder, place, name, value):
    with data_of(folder) as data:
        data[place].attrs[name] = value


@forgery
def added(folder, group):
    """Add a variable to a group of the dataset of a run, as xarray does."""
    extra = xr.Dataset({"flown": (("trial",), np.zeros(3))})
    extra.to_netcdf(folder / "run.nc", mode="a", group=group, engine="h5netcdf")


@forgery
def retyped(folder, name):
    """Store a variable of the dataset of a run in single precision."""
    with h5netcdf.File(folder / "run.nc", "r+") as data:
        old = data.variables[name]
        values, over, attributes = old[...], old.dimensions, dict(old.attrs)
        del data._h5file[name]
    with h5netcdf.File(folder / "run.nc", "r+") as data:
        new = data.create_variable(name, over, "f4", fillvalue=np.float32(np.nan))
        new[...] = values
        new.attrs.update({k: v for k, v in attributes.items() if k != "_FillValue"})


@forgery
def without(folder, name):
    with data_of(folder) as data:
        del data[name]


def dimension(folder):
    with h5netcdf.File(folder / "run.nc", "r+") as data:
        data.dimensions["trial"] = 3


def link(folder):
    """A link to the gain file of another run, which is a correct gain."""
    other = ech.load_scenario(folder / "scenario.yaml", ["graph.agents=5"])
    ech.save_run(ech.run(other), folder.parent / "other", figures=False)
    (folder / "gain.json").unlink()
    os.symlink(folder.parent / "other" / "gain.json", folder / "gain.json")


def last_digit(folder):
    text = (folder / "report.txt").read_text()
    found = re.search(r"\d\.\d{3}(?!\d|e)", text)
    other = f"{found[0][:-1]}{(int(found[0][-1]) + 1) if found[0][-1] != '9' else 8}"
    (folder / "report.txt").write_text(text.replace(found[0], other, 1))


def weaken(document):
    document["coupling"] *= 1e-6
    document["anywhere"] = {"format": "echelon tube 1", "borders": []}


def hide(document):
    weaken(document)
    document["guarantee"] = {"anywhere": document.pop("anywhere")}


def doubled(folder):
    in_json("gain.json", lambda d: d.update(R=[[4 * x for x in row] for row in d["R"]]))(folder)
    in_summary(lambda d: d["gain"].update(coupling=9.0))(folder)


STATED = [
    # What readers of the dataset see beside its arrays, and the parts of the run.
    {
        "run.nc: /error.scale_factor": marked("error", "scale_factor", 1e-9),
        "run.nc: /error.add_offset": marked("error", "add_offset", -0.1),
        "run.nc: /error.missing_value": marked("error", "missing_value", 1.0),
        "run.nc: /error._FillValue": marked("error", "_FillValue", 0.0),
        "run.nc: /inputs/inputs.scale_factor": marked("inputs/inputs", "scale_factor", 0.5),
        "run.nc: /states.long_name": marked("states", "long_name", "measured by cameras"),
        "run.nc: /time.units": marked("time", "units", "ms"),
        "run.nc: /graph.comment": marked("graph", "comment", "flown"),
        "run.nc: parts.offset": moved("offset"),
        "run.nc: parts.P": moved("gain/P"),
        "run.nc: parts.dt": in_data(dt=lambda dt: 2.0 * dt),
        "run.nc: parts.edge_weight": moved("graph/edge_weight"),
        "run.nc: states": moved("states"),
        "proved": in_summary(lambda d: d.update(proved="stable")),
        "seed": in_summary(lambda d: d.update(seed=1)),
    },
    # What the run observed.
    {
        "outcome.message": in_summary(lambda d: d["outcome"].update(message="!")),
        "followers.0.rmse": in_summary(lambda d: d["followers"][0].update(rmse=1e-3)),
        "minimum_distance": in_summary(lambda d: d.update(minimum_distance=3.0)),
        "engine": in_summary(lambda d: d.update(engine="native")),
        "versions.jax": in_summary(lambda d: d["versions"].update(jax="9")),
        "report.txt: text": in_text("report.txt", "reached", "passed"),
        "run.nc: observed.states": scaled("states"),
        "run.nc: observed.inputs": scaled("inputs/inputs"),
        "run.nc: observed.error": scaled("error"),
        "run.nc: observed.lyapunov": scaled("lyapunov"),
        "run.nc: observed.sum_errors": scaled("sums/errors/sum_errors"),
        "run.nc: observed.pole_real": moved("modes/pole_real"),
        "run.nc: observed.proved": in_data(proved=lambda _: "stable"),
        "run.nc: observed.lyapunov_drift": without("lyapunov_drift"),
        "run.nc: structure./states.attributes.units": marked("states", "units", "s"),
        "run.nc: structure./inputs/time.attributes.units": marked("inputs/time", "units", "m"),
        "run.nc: structure./error.attributes.coordinates": marked("error", "coordinates", "time"),
        "run.nc: structure./flight": added("/flight"),
        "run.nc: structure./sums/flight": added("/sums/flight"),
        "run.nc: structure./flown": added("/"),
        "run.nc: structure./modes/flown": added("/modes"),
        "run.nc: structure./saturated.type": retyped("saturated"),
    },
    {
        "run.nc: structure./.dimensions": dimension,
        "run.nc: observed.inputs": in_data(inputs=lambda _: "a.csv:0"),
        "report.txt: text": in_text("report.txt", "0.2", "0.9"),
    },
]
"""Claims of a run with a gain, and how each of them is forged."""


@pytest.mark.parametrize("forged", STATED)
def test_of_forged_claims_each_is_refused(runs, echelon, here, forged):
    shutil.copytree(runs / "gain", here / "run")
    for forge in forged.values():
        forge(here / "run")
    code, out, err = echelon("verify", "run", "--json")
    found = [x["claim"] for x in json.loads(out)["findings"] if x["verdict"] == "refused"]
    assert (code, err) == (1, "") and {*forged} <= {*found}, {*forged} - {*found}
    others = {*found} - {*forged}
    assert all("structure" in x for x in others), others


REFUSED, ILL_FORMED, OPEN = 1, 2, 5
FORGED = {
    ("gain", REFUSED): {
        "a gain of another run": link,
        "a gain doubled in all files": doubled,
        "a run that is said to be stopped": in_data(outcome=lambda _: "stopped"),
        "other inputs of a consistent run": in_both("seed: 0", "seed: 1"),
        "another horizon of all": in_both("0.2", "0.4"),
    },
    ("gain", ILL_FORMED): {
        "a gain with a tube": in_json("gain.json", weaken),
        "a gain in a promise": in_json("gain.json", hide),
        "no gain": lambda folder: (folder / "gain.json").unlink(),
        "no summary": lambda folder: (folder / "summary.json").write_text("{}"),
    },
    ("gain", OPEN): {
        "no data": lambda folder: (folder / "run.nc").unlink(),
        "a last digit of a report": last_digit,
    },
    ("tube", REFUSED): {
        "a longer number": in_tube('"agents": 4', '"agents": 4' + "0" * 40),
        # One statement each.
        "a faster rate": in_summary(lambda d: d["guarantee"]["numbers"]["rate"].update(value=9.0)),
        "a phrase": in_summary(lambda d: d["guarantee"].update(start=["anywhere"])),
        "an arrival": in_summary(
            lambda d: d["guarantee"]["anywhere"].update(within_1_cm_from=0.01)
        ),
        "no tube": in_summary(lambda d: d["guarantee"].update(anywhere=None)),
        "another tube": in_summary(lambda d: d["guarantee"].update(anywhere=3)),
        "another scenario": in_text("scenario.yaml", "agents: 4", "agents: 3"),
        "the data's guarantee": in_data(guarantee=lambda x: x.replace('"down"', '"up"')),
    },
    # JSON that readers take in different ways.
    ("tube", ILL_FORMED): {
        "a key twice": in_tube('"borders":', '"borders": [1], "borders":'),
        "a tube twice": in_tube('"anywhere":', '"anywhere": {}, "anywhere":'),
        "NaN": in_tube('"dt_s": ', '"dt_s": NaN, "x": '),
        "Infinity": in_tube('"domain": null', '"domain": -Infinity'),
        "an overflow": in_tube('"domain": null', '"edge": 1e999'),
        "a long number": in_tube('"agents": 4', '"agents": 4' + "0" * 400),
        "deep": in_tube('"domain": null', '"edge": ' + "[" * 10**5),
        "no guarantee": in_summary(lambda d: d.pop("guarantee")),
        "a scenario twice": in_text("scenario.yaml", "agents: 4", "agents: 4, agents: 4"),
    },
    ("alone", REFUSED): {
        "another start": in_text("scenario.yaml", "position: 1.0", "position: 2.0"),
        "the data's scenario twice": in_data(scenario_text=lambda x: x + "seed: 0\nseed: 1\n"),
        "the data's graph": in_data(scenario_text=lambda x: x.replace("agents: 4", "agents: 400")),
    },
    ("alone", ILL_FORMED): {
        "a time in the data": moved("time"),
        "a time of inputs in the data": moved("inputs/time"),
    },
    # Without a guarantee rounding may grow: how far, the same run from starts moved by 1e-12 shows.
    ("loose", REFUSED): {
        "a variable without a guarantee": added("/"),
        "states without a guarantee": scaled("states"),
        "an observed number": in_summary(lambda d: d["followers"][0].update(rmse=0.01)),
    },
    ("falls", REFUSED): {"states where errors grow": scaled("states")},
}
CASES = [(name, code, what) for (name, code), forged in FORGED.items() for what in forged]


@pytest.mark.parametrize(("name", "code", "what"), CASES)
def test_no_forged_folder_is_verified(runs, echelon, here, name, code, what):
    shutil.copytree(runs / name, here / "run")
    FORGED[name, code][what](here / "run")
    found, out, err = echelon("verify", "run")
    assert found == code, out + err
    assert ("Incomplete: " in out) is (code == OPEN) and "Verified" not in out
    assert ("Refused: " in out) is (code == REFUSED)
    assert err.count("\n") == (code == ILL_FORMED)


# Another law, a model of another kind, a late network; the rest is a study.
DRAWN = {"unicycle", "van-der-pol", "paper-radio"}
EVERY = [
    pytest.param(name, marks=pytest.mark.slow if name in DRAWN else pytest.mark.study)
    for name in sorted(bundled_scenarios())
]


@pytest.mark.parametrize("name", EVERY)
def test_a_run_of_every_bundled_scenario_is_verified(echelon, here, name):
    # Events and changes of the formation are later.
    short = [] if name in ("leader-lost", "reshape") else ["--set", "simulation.horizon=0.5"]
    assert echelon("run", name, *short, "--no-figures", "--out", "run")[0] == 0
    code, out, _ = echelon("verify", "run")
    assert code == 0, out
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.slow
def test_a_run_that_was_stopped_is_repeated_until_then(echelon, here):
    (here / "small.yaml").write_text(SMALL.replace("horizon: 0.2", "horizon: 4.0"))
    count = 0

    def progress(run):
        nonlocal count
        count += 1
        if count == 7:
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
    moved("sums/steps/sum_steps", 1)(here / "run")
    code, out, _ = echelon("verify", "run")
    assert code == 5 and "at a step that is not repeated" in " ".join(out.split())


def test_what_another_version_made_is_refused_with_a_hint(runs, echelon, here):
    shutil.copytree(runs / "alone", here / "run")
    in_summary(lambda d: d["versions"].update(echelon="0.0.1"))(here / "run")
    in_data(version_echelon=lambda _: "0.0.1")(here / "run")
    assert echelon("verify", "run")[0] == 0
    in_summary(lambda d: d["guarantee"].update(start=["old words"]))(here / "run")
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
    assert (code, err) == (5, "") and "guarantee.verdict; " in out
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
    assert code == 5 and "guarantee.anywhere" in out
    assert out.splitlines()[-1].endswith("echelon verify check.json --scenario SCENARIO")
    assert echelon("verify", "check.json", "--scenario", "t5.yaml")[0] == 0
    in_json("check.json", lambda d: d["lines"][3].update(text="every graph"))(here)
    assert echelon("verify", "check.json", "--scenario", "t5.yaml")[0] == 1
