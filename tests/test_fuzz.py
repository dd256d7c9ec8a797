"""Random input is refused in whole sentences: a part of what `python3 dev.py fuzz` tries."""

import importlib.util
import random
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.core.errors import EchelonError
from echelon.experiments.scenario.scenario import load_scenario

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "fuzz.py"


def study():
    spec = importlib.util.spec_from_file_location("fuzz", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module
    spec.loader.exec_module(module)
    return module


FUZZ = study()


def judge(load):
    try:
        load()
    except EchelonError as error:
        lines = str(error).splitlines()
        assert lines and all(line.endswith(".") for line in lines)


@given(st.integers(0, 2**32))
@settings(max_examples=50)
def test_spoiled_scenario_files_load_or_are_refused_in_whole_sentences(tmp_path_factory, seed):
    rng = random.Random(seed)
    text = FUZZ.as_yaml(FUZZ.scenario(rng))
    file = tmp_path_factory.getbasetemp() / "spoiled.yaml"
    file.write_bytes(FUZZ.torn(rng, text) if rng.random() < 0.3 else text)
    judge(lambda: load_scenario(file))


@given(st.integers(0, 2**32))
@settings(max_examples=50)
def test_odd_overrides_are_laid_over_or_refused_in_whole_sentences(tmp_path_factory, seed):
    rng = random.Random(seed)
    base = rng.choice(FUZZ.BASES)
    file = tmp_path_factory.getbasetemp() / "sound.yaml"
    file.write_bytes(FUZZ.as_yaml(base))
    words = [FUZZ.setting(rng, base) for _ in range(rng.randint(1, 3))]
    judge(lambda: load_scenario(file, words))


@pytest.mark.slow
def test_a_hundred_command_lines_of_nonsense_end_well(tmp_path):
    command = [sys.executable, str(SCRIPT), "400", "--cases", "100", "--seed", "0"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "100 cases from seed 0 on, 0 of them faulty" in done.stdout
