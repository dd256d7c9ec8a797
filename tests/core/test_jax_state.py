"""What keeps JAX from running is said in one sentence; its other settings change nothing."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from processes import without_status

import echelon as ech
from echelon.core.numerics import precision

GAIN = """
import echelon as ech
def coupling(_=0):
    try:
        found = ech.synthesize(ech.models.Pendulum(), ech.Graph.path(3), ech.gains.Riccati())
        return f"c = {found.coupling:.3f}"
    except ech.EchelonError as error:
        return f"EchelonError: {error}"
"""
FORK = "JAX had started before this process was forked, and would hang in it"


def process(code, *arguments, **environment):
    """Run Python code, or the command line, in a process of its own: code, output, errors."""
    command = [sys.executable, *(("-c", code) if code else ("-m", "echelon")), *arguments]
    env = {**os.environ, **environment}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=100)
    return done.returncode, done.stdout, without_status(done.stderr)


@pytest.mark.parametrize(
    ("variable", "device"),
    [("JAX_PLATFORMS", "none,cpu"), ("JAX_PLATFORM_NAME", "gpu"), ("JAX_DEFAULT_DEVICE", "gpu")],
)
def test_a_device_that_is_missing_is_named_with_its_variable(variable, device):
    code, out, err = process("", "check", "paper", **{variable: device})
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"echelon: `{variable}` asks JAX for `{device}`, which this machine")


def test_doctor_reports_a_missing_device_as_a_finding():
    code, out, err = process("", "doctor", JAX_PLATFORMS="none")
    assert code == 1 and not err
    assert "FAIL  JAX runs in this process (`JAX_PLATFORMS` asks JAX for `none`" in out
    assert "devices      none" in out


def test_a_device_that_python_asks_for_is_named_with_its_setting():
    code = "import jax\njax.config.update('jax_platforms', 'none')" + GAIN + "print(coupling())"
    assert process(code)[1].startswith("EchelonError: `jax_platforms` asks JAX for `none`, which")


def test_a_value_that_jax_refuses_is_no_internal_error():
    code, out, err = process("", "check", "paper", JAX_ENABLE_X64="foo")
    assert (code, out, err.count("\n")) == (2, "", 1) and "JAX_ENABLE_X64" in err


def test_jax_without_compiling_is_named_and_not_the_model():
    with jax.disable_jit(), pytest.raises(ech.EchelonError, match="`JAX_DISABLE_JIT`") as caught:
        ech.run(ech.load_scenario("paper", ["simulation.horizon=1"]))
    assert "derivative" not in str(caught.value)


@pytest.mark.parametrize("before", ["print(coupling())", "jax.numpy.ones(2).sum()"])
def test_a_fork_of_a_process_that_used_jax_is_told_and_does_not_hang(before):
    pool = "import multiprocessing, jax\n" + GAIN + "import echelon.core.numerics\n" + before
    pool += "\nwith multiprocessing.get_context('fork').Pool(2) as pool:\n"
    out = process(pool + "    print(*pool.map(coupling, [1, 2]), sep='\\n')")[1]
    assert out.count(f"EchelonError: {FORK}") == 2 and "`echelon sweep`" in out


def test_a_fork_before_jax_starts_computes():
    code = "import multiprocessing\n" + GAIN + "import echelon.core.numerics\n"
    code += (
        "with multiprocessing.get_context('fork').Pool(1) as pool: print(pool.map(coupling, [1]))"
    )
    found = process(code + "\nprint(coupling())")[1].splitlines()
    assert found[0] == f"['{found[1]}']" and found[1].startswith("c = ")


UNUSUAL = {
    "NaN": lambda: jax.debug_nans(True),
    "infinite": lambda: jax.debug_infs(True),
    "types": lambda: jax.numpy_dtype_promotion("strict"),
    "ranks": lambda: jax.numpy_rank_promotion("raise"),
    "x64": lambda: jax.enable_x64(True),
    "products": lambda: jax.default_matmul_precision("bfloat16"),
}
DIVERGES = {
    "name": "far",
    "model": {"name": "van-der-pol"},
    "graph": {"name": "path", "agents": 2},
    "follower": {"gain": {"method": "riccati", "coupling": 5000.0}},
    "initial": {"spread": {"position": 3.0}},
    "simulation": {"horizon": 1.0, "dt": 0.1, "engine": "jax"},
    "seed": 0,
}


@pytest.fixture(scope="module")
def usual():
    return ech.run(DIVERGES)


@pytest.mark.parametrize("setting", UNUSUAL)
def test_settings_of_jax_change_no_bit_of_a_run_that_diverges(usual, setting):
    with UNUSUAL[setting]():
        run = ech.run(DIVERGES)
    assert run.outcome is usual.outcome is ech.Outcome.DIVERGED
    assert np.array_equal(run.states, usual.states, equal_nan=True)


def test_integers_of_two_types_add_where_jax_would_refuse_them():
    with jax.numpy_dtype_promotion("strict"), precision("float64"):
        assert jax.numpy.ones((), int) + jax.numpy.ones((), np.int32) == 2
