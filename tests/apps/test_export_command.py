"""`echelon export` writes a law that runs without echelon, or says why it does not."""

import hashlib
import json
import subprocess
import sys

import jax
import numpy as np
import pytest

import echelon as ech
from echelon.guarantees.promises.coverage import watched_by
from echelon.output.archive.flight_folder import law_files

ALONE = """
import law
u, memory, message, valid = law.step(0.0, {x}, {received}, law.begin({x}))
assert valid and law.AGENT == 1 and law.DT == 0.01
print(u)
"""


def test_the_files_state_whom_an_agent_hears_and_run_without_echelon(tmp_path, echelon):
    out = tmp_path / "law"
    command = ("export", "integrators", "--set", "simulation.dt=0.01", "--agent", 1)
    code, said, errors = echelon(*command, "--out", out)
    assert code == 0 and not errors and "law.py" in said
    names = ["law.c", "law.h", "law.json", "law.py"]
    assert sorted(file.name for file in out.iterdir()) == names
    stated = json.loads((out / "law.json").read_text("utf-8"))
    parts, settings = ech.build(ech.load_scenario("integrators", ["simulation.dt=0.01"]))
    agent = ech.Agent(parts, 1, 0.01)
    assert stated["hears"] == list(agent.neighbours) and 0 in agent.neighbours
    whole = ech.guarantee(parts, settings).as_mapping()
    assert stated["guarantee"]["verdict"] == "guaranteed"
    assert stated["guarantee"].pop("while") == stated["guarantee"].pop("against") == []
    assert stated["guarantee"].pop("watched") == watched_by(parts, settings, 1)
    assert {name: whole[name] for name in stated["guarantee"]} == stated["guarantee"]
    for name, digest in stated["sha256"].items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest
    x = [0.5] * len(stated["states"])
    received = [0.0] * len(stated["hears"]) * sum(stated["message"].values())
    text = ALONE.format(x=x, received=received)
    # -S: no packages, of which echelon is one.
    done = subprocess.run(
        [sys.executable, "-S", "-c", text], cwd=out, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert np.isfinite(json.loads(done.stdout)).all()
    # Agents of one formation have one mark, and those of another have another.
    marks = [
        json.loads(law_files(parts, settings, k, text)["law.json"])["formation"]
        for k, text in ((0, "a"), (1, "a"), (1, "b"))
    ]
    assert marks[0] == marks[1] != marks[2]


@pytest.mark.slow
def test_what_cannot_be_exported_is_refused_in_one_sentence(tmp_path, echelon):
    code, _, errors = echelon("export", "integrators", "--agent", 99, "--out", tmp_path / "law")
    assert code == 2 and "agent 99 is not in this graph" in errors and errors.count("\n") == 1
    assert not (tmp_path / "law").exists()
    (tmp_path / "mine").write_text("")
    code, _, errors = echelon("export", "integrators", "--agent", 1, "--out", tmp_path)
    assert code == 2 and "is not empty" in errors


class Bends(ech.laws.Law):
    def update(self, model, view, memory):
        return jax.scipy.special.erfinv(view.disagreement)[:1] * 0.0, memory


def test_a_law_without_scalar_operations_is_refused_with_its_line():
    model, graph = ech.models.Pendulum(), ech.Graph.path(2)
    drive = ech.Laws(ech.laws.TrimInput(), Bends())
    parts = ech.Parts(model, graph, ech.Formation(np.zeros((2, 2))), drive)
    line = r"there is no code for `erf_inv` in .*test_export_command\.py, line \d+\.$"
    with pytest.raises(ech.errors.OutputError, match=line):
        law_files(parts, ech.Settings(horizon=1.0, dt=0.01), 1, "")


CONFUSED = {
    "--to law": "`--to law` needs `--agent`, the number of an agent.",
    "--agent 1 --to csv": "`--agent` is of a law, and `--to` is `csv`; use `law`",
    "--set seed=1": "`--set` is of a scenario, and a run is written as it is",
    "": "`integrators` does not exist; give the folder of a run, or its `run.nc`.",
}


def test_a_run_and_a_law_are_not_confused(echelon):
    for words, sentence in CONFUSED.items():
        code, _, errors = echelon("export", "integrators", *words.split())
        assert code == 2 and sentence in errors and errors.count("\n") == 1
