"""Users' own laws, references and gain methods in a scenario, and errors for bad ones."""

import h5netcdf
import numpy as np
import pytest

import echelon as ech

MINE = """
import jax.numpy as jnp
import numpy as np
import echelon as ech
from echelon.synthesis.gains import Feedback

class Pull(ech.Law):
    strength: float = 1.0

    def update(self, model, view, memory):
        return -self.strength * view.disagreement, memory

class Steer(ech.Law):
    reference: ech.Reference

    def start(self, model):
        return self.reference(jnp.zeros(()))[:2]

    def update(self, model, view, memory):
        return jnp.asarray(self.reference.velocity, view.x.dtype), memory

class Ray(ech.Reference):
    velocity: tuple = (1.0, 0.0)

    def __check_init__(self):
        if len(self.velocity) != 2:
            raise ValueError("`velocity` must be two numbers")

    def __call__(self, t):
        v = jnp.asarray(self.velocity, t.dtype)
        return jnp.concatenate([v * t, jnp.zeros(2, t.dtype)])

class Heavy(ech.Method):
    name = "heavy"
    weight: float = 1.0

    def feedback(self, model, linear):
        n, m = linear.B.shape
        return Feedback(self.weight * np.eye(n), np.eye(m), None)

class Fails(Heavy):
    def feedback(self, model, linear):
        return np.linalg.inv(np.zeros((2, 2)))

class Restless(ech.Law):
    def prepared(self, model, graph):
        return {}["nothing"]

    def update(self, model, view, memory):
        return view.x, memory
"""

SCENARIO = {
    "name": "own",
    "model": {"name": "single-integrator", "parameters": {"dimension": 2}},
    "graph": {"name": "path", "agents": 3},
    "reference": {"python": "mine.py:Ray", "velocity": [0.5, 0.25]},
    "leader": {"law": {"python": "mine.py:Steer"}},
    "follower": {"law": {"python": "mine.py:Pull", "strength": 2.0}},
    "simulation": {"horizon": 1.0, "dt": 0.1},
}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    return tmp_path


def own(folder, **sections):
    data = {key: value for key, value in {**SCENARIO, **sections}.items() if value is not None}
    return ech.scenario_from_mapping(data, folder)


def test_a_law_a_reference_and_a_leader_of_ones_own_run(folder):
    run = ech.run(own(folder, initial={"states": {1: [0.0, 0.1]}}))
    assert run.states[-1, 0] == pytest.approx([0.5, 0.25])
    # u = -2 z over one step of 0.1 s from rest, with one neighbour at the origin and one 0.1 off.
    assert run.inputs[0, 1] == pytest.approx([0.0, -0.4])
    assert run.inputs[0, 2] == pytest.approx([0.0, 0.2])


def test_a_method_of_ones_own_makes_the_gain_and_a_reference_leads_the_law_that_tracks(folder):
    follower = {"gain": {"python": "mine.py:Heavy", "weight": 3.0, "coupling": 0.5}}
    gain = ech.build(own(folder, follower=follower)).parts.drive.gain
    assert np.array_equal(gain.P, 3.0 * np.eye(2)) and gain.coupling == 0.5
    assert gain.method == "heavy"
    run = ech.run(own(folder, leader=None, follower=None))
    assert run.states[-1, 0] == pytest.approx([0.5, 0.25])


def law(name, **numbers):
    return {"follower": {"law": {"python": f"mine.py:{name}"} | numbers}}


def gain(method):
    return {"follower": {"gain": {"python": method}}}


SENTENCES = {
    "follower: `Pul` in `{folder}/mine.py` is not a `Law` class; it has `Pull`, `Steer`, "
    "`Restless` (did you mean `Pull`?).": law("Pul"),
    "reference: `Pull` in `{folder}/mine.py` is not a `Reference` class; it has `Ray`.": {
        "reference": {"python": "mine.py:Pull"}
    },
    "follower.gain: got a key that the law `mine.py:Pull` does not take, allowed are the "
    "arguments of its class.": {
        "follower": law("Pull")["follower"] | {"gain": {"method": "riccati"}}
    },
    "follower.gain: the file `{folder}/yours.py` does not exist; a `python` path is relative to "
    "the scenario file, and on the command line to the working folder.": gain("yours.py:Heavy"),
    "follower: got the parameter `strenght` of `mine.py:Pull`, allowed is `strength` (did you "
    "mean `strength`?).": law("Pull", strenght=1.0),
    "reference: `mine.py:Ray` refuses these parameters: ValueError: `velocity` must be two "
    "numbers.": {"reference": {"python": "mine.py:Ray", "velocity": [1, 2, 3]}},
    "leader: got a `reference`, but the law `mine.py:Pull` takes none.": {
        "leader": law("Pull")["follower"]
    },
    "follower.gain: `mine.py:Fails` fails: LinAlgError: Singular matrix.": gain("mine.py:Fails"),
    "follower: `mine.py:Restless` fails: KeyError: 'nothing'.": law("Restless"),
}


def test_each_fault_of_ones_own_code_has_its_sentence(folder):
    for sentence, sections in SENTENCES.items():
        with pytest.raises(ech.EchelonError) as caught:
            ech.build(own(folder, **sections))
        assert str(caught.value) == "mapping: " + sentence.replace("{folder}", str(folder))


def test_a_file_that_does_not_import_is_told(folder):
    for text, said in {
        "import sys; sys.exit()": "SystemExit: no message",
        "1 / 0": "ZeroDivisionError: division by zero",
        "def": "SyntaxError: invalid syntax",
    }.items():
        (folder / "mine.py").write_text(text)
        with pytest.raises(ech.EchelonError, match=f"does not import: {said}"):
            ech.build(own(folder, reference=None, leader=None))


def test_a_path_on_the_command_line_is_relative_to_the_working_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)
    own_law = "follower.law={python: mine.py:Pull, strength: 2}"
    scenario = ech.load_scenario("integrators", [own_law])
    assert scenario.follower.law.python == f"{folder}/mine.py:Pull"
    assert type(ech.build(scenario).parts.drive.follower).__name__ == "Pull"
    # Without a class it is no path, and stays as it was written.
    with pytest.raises(ech.EchelonError, match='got `"?mine.py"?`, allowed is a file and a class'):
        ech.load_scenario("paper", ["model.python=mine.py"])
    # A model takes the place of a named one.
    (folder / "line.py").write_text(
        "import echelon as ech\n\n\nclass Line(ech.models.SingleIntegrator):\n    pass\n"
    )
    scenario = ech.load_scenario("integrators", ["model.python=line.py:Line"])
    assert scenario.model.name is None
    assert type(ech.build(scenario).parts.model).__name__ == "Line"


def test_a_gain_file_or_a_method_of_ones_own_takes_the_place_of_a_method(folder, monkeypatch):
    monkeypatch.chdir(folder)
    parts = ech.build(ech.load_scenario("van-der-pol")).parts
    ech.save_gain(parts.drive.gain, parts.model, parts.graph, folder / "g.json")
    file, mine = "follower.gain.file=g.json", "follower.gain.python=mine.py:Heavy"
    gain = ech.build(ech.load_scenario("van-der-pol", [file])).parts.drive.gain
    assert np.array_equal(gain.P, parts.drive.gain.P)
    gain = ech.build(ech.load_scenario("van-der-pol", [mine])).parts.drive.gain
    assert gain.method == "heavy"
    # Both from the command line, neither gives way.
    with pytest.raises(ech.EchelonError, match="got `file`, `python`, allowed is one of them"):
        ech.load_scenario("van-der-pol", [file, mine])


def test_keys_that_only_another_law_takes_give_way_to_a_law_on_the_command_line():
    scenario = ech.load_scenario("paper", ["follower.law=passive"])
    assert scenario.data["follower"] == {"law": "passive"}
    with pytest.raises(ech.EchelonError) as caught:
        ech.load_scenario("paper", ["follower.law=passive", "follower.gain.coupling=2"])
    assert str(caught.value) == (
        "--set follower.gain.coupling=2: follower.gain: got a key that `passive` does not take, "
        "it takes no keys."
    )


def test_some_agents_start_by_the_spread_and_others_where_they_are_told(folder):
    start = {"spread": {"position": 0.5}, "states": {2: [3.0, 4.0]}}
    parts, settings = ech.build(own(folder, initial=start))
    run = ech.simulate(parts, settings)
    assert run.states[0, 2].tolist() == [3.0, 4.0]
    assert 0.0 < np.abs(run.states[0, 1]).max() <= 0.5


PART = """
import dataclasses
import echelon as ech


class Twice(ech.SensorStage):
    def read(self, model, memory, x, clock, number):
        return 2.0 * x, memory


@dataclasses.dataclass(frozen=True)
class Doubled(ech.WorldPart):
    times: int = 2

    def faults(self, model, agents):
        if self.times != 2:
            yield f"`times` of the sensor is {self.times}, and must be 2."

    def member(self, loop):
        return loop.with_sensor(Twice())

    def ignored(self):
        return "agents see double"

    def variables(self, result):
        return {"times": ((), self.times)}
"""

DOUBLED = """
name: double
model: {name: single-integrator, parameters: {dimension: 1}}
graph: {name: path, agents: 2}
parts: [{python: "double.py:Doubled"}]
initial: {states: {1: [0.5]}}
leader: {law: passive}
simulation: {horizon: 1.0, dt: 0.1, integrator: euler}
"""


def test_a_part_of_the_world_in_one_file_says_all_about_itself(echelon, tmp_path):
    (tmp_path / "double.py").write_text(PART)
    (tmp_path / "s.yaml").write_text(DOUBLED)
    code, out, _ = echelon("run", "s.yaml", "--no-figures", "--out", "o")
    assert code == 0
    run = ech.load(tmp_path / "o")
    gain = run.drive.gain
    factor = 1.0 - 0.1 * 2.0 * gain.coupling * float(gain.P[0, 0] / gain.R[0, 0])
    assert run.states[-1, 1, 0] == pytest.approx(0.5 * factor**10)
    assert "`Doubled` (times 2)" in (tmp_path / "o" / "report.txt").read_text()
    with h5netcdf.File(tmp_path / "o" / "run.nc") as file:
        assert file.variables["times"][()] == 2
    code, _, err = echelon(
        "run", "s.yaml", "--set", 'parts=[{python: "double.py:Doubled", times: 3}]'
    )
    assert code == 2 and "parts.0: `times` of the sensor is 3, and must be 2." in err
    code, _, err = echelon("run", "s.yaml", "--set", 'parts=[{python: "double.py:Twice"}]')
    assert code == 2 and "it has `Doubled`" in err
