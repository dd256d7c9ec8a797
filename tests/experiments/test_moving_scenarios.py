"""Scenarios with formations that change with time: their keys, files and faults."""

import copy

import numpy as np
import pytest

import echelon as ech
from echelon.core.errors import ScenarioError

BASE = {
    "name": "moves",
    "model": {"name": "double-integrator"},
    "graph": {"edges": [[0, 1], [0, 2]]},
    "formation": {"name": "wedge"},
    "leader": {"law": "stopping-point"},
    "follower": {"law": "stopping-point"},
    "simulation": {"horizon": 10.0, "dt": 0.01},
}
WAVE = """
import jax.numpy as jnp
import echelon.agents.network.formation_motion as m

class Wave(m.OffsetMotion):
    size: float = 0.1

    def __call__(self, place, t):
        return place + self.size * jnp.sin(t)
"""


def built(*motion, **more):
    scenario = copy.deepcopy(BASE)
    scenario["formation"] |= {"motion": list(motion), **more.pop("formation", {})}
    return ech.build(scenario | more).parts.formation


def test_motions_of_a_scenario_are_those_of_its_formation():
    line = {"name": "line", "spacing": 2.0}
    reshape = {"reshape": line, "at": 2.0, "over": 3.0, "assign": "nearest"}
    formation = built({"rotate": 0.5}, {"scale": 0.4, "rate": 0.7}, reshape)
    assert [type(m).__name__ for m in formation.motion.motions] == ["Rotate", "Scale"]
    assert (formation.motion.begins, formation.motion.spans) == ([2.0], [3.0])
    assert {*formation.motion.places[:, 1, 0]} == {0.0, -2.0, -4.0}
    assert built().motion is None


def test_a_first_assignment_is_by_the_starts():
    places = built().offsets
    starts = {1: places[2].tolist(), 2: places[1].tolist()}
    formation = built(formation={"assign": "nearest"}, initial={"states": starts})
    assert np.array_equal(formation.offsets[[1, 2]], places[[2, 1]])


def test_a_motion_of_a_file_takes_its_parameters(tmp_path):
    (tmp_path / "wave.py").write_text(WAVE)
    text = "name: w\nmodel: {name: double-integrator}\ngraph: {edges: [[0, 1]]}\n"
    text += "formation: {motion: [{python: wave.py:Wave, parameters: {size: 0.3}}]}\n"
    text += "simulation: {horizon: 1.0, dt: 0.01}\n"
    (tmp_path / "w.yaml").write_text(text)
    formation = ech.build(tmp_path / "w.yaml").parts.formation
    assert formation.offsets_at([2.0])[0, 1, :2] == pytest.approx(0.3 * np.sin(2.0))


LINE = {"name": "line"}


def reshape(at, over, shape=LINE):
    return {"reshape": shape, "at": at, "over": over}


def test_faults_of_motions_are_a_sentence_with_their_place():
    beyond = {"offsets": {9: [1.0, 0.0]}}
    for motion, message in (
        ([{}], "got none of `rotate`, `scale`, `reshape`, `python`, one is required"),
        ([{"rotate": 1.0, "scale": 0.1}], "got `rotate`, `scale`, allowed is one of"),
        ([{"scale": 0.1}], "rate: got nothing, `scale` needs this key"),
        ([{"rotate": 0.1, "at": 1.0}], "at: got a key that `rotate` does not take"),
        ([{"reshape": LINE, "at": 1.0}], "over: got nothing, `reshape` needs this key"),
        ([reshape(1.0, 0.0)], "over"),
        ([reshape(10.0, 1.0)], "at 10 s, allowed is a time before"),
        (
            [reshape(1.0, 3.0), reshape(2.0, 1.0)],
            "the reshape at 2 s begins before that at 1 s ends, at 4 s",
        ),
        (
            [reshape(1.0, 3.0, beyond)],
            "an offset is given for agent 9, and agents are numbered from 0 to 2",
        ),
        (
            [reshape(1.0, 3.0, LINE | {"columns": 2})],
            "columns: got a key that `line` does not take",
        ),
    ):
        with pytest.raises(ScenarioError) as error:
            built(*motion)
        assert message in str(error.value) and "formation" in str(error.value)
        assert len(str(error.value).splitlines()) == 1
    with pytest.raises(ScenarioError, match="`assign: nearest` needs `initial.states`"):
        built(formation={"assign": "nearest"})


THROUGH = """
name: through
model: {name: double-integrator}
graph: {edges: [[0, 1], [0, 2]]}
formation:
  offsets: {1: [1, 1], 2: [1, -1]}
  motion: [{reshape: {offsets: {1: [1, -1], 2: [1, 1]}}, at: 0.0, over: 0.4}]
leader: {law: stopping-point}
follower: {law: stopping-point}
simulation: {horizon: 0.5, dt: 0.01}
"""
MEET = (
    "echelon: Warning: in the reshape at 0 s agents 1 and 2 come within 0 m of each other; add "
    "`safety`, or choose other places.\n"
)


@pytest.mark.parametrize("command", ["run", "sweep", "live"])
def test_a_reshape_through_itself_is_warned_of_before_it_runs(echelon, here, monkeypatch, command):
    """Nothing can be simulated, so that what is printed was printed before."""
    (here / "through.yaml").write_text(THROUGH)

    def stop(*arguments):
        raise ScenarioError("nothing runs here.")

    monkeypatch.setattr("echelon.experiments.scenario.build.run", stop)
    monkeypatch.setattr("echelon.experiments.sweeps.sweep.compute", stop)
    monkeypatch.setattr("echelon.apps.cli.show_command.keep_serving", stop)
    over = ["--over", "seed=0..1"] if command == "sweep" else []
    code, out, err = echelon(command, "through.yaml", *over)
    assert (code, out) == (2, "") and err.count(MEET) == 1 and err.endswith("nothing runs here.\n")
    if command != "live":
        assert MEET not in echelon(command, "through.yaml", *over, "--json")[2]
    assert MEET not in echelon("--quiet", command, "through.yaml", *over)[2]


def test_check_states_that_a_reshape_passes_through_itself(echelon, here):
    (here / "through.yaml").write_text(THROUGH)
    text = " ".join(echelon("check", "through.yaml")[1].split())
    assert MEET.removeprefix("echelon: ").strip() in text
    safe = ["--set", "safety={radii: [0.1, 0.1, 0.1]}"]
    code, out, err = echelon("check", "through.yaml", *safe)
    assert code == 0 and err == "" and "in the reshape" not in out
