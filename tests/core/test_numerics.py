"""What keeps JAX from running is said in one sentence; its other settings change nothing."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import without_status

import echelon as ech
from echelon.core.numerics import Draw, key_of, normals, precision, uniform

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


@pytest.mark.slow
def test_a_device_that_is_missing_is_named_with_its_variable_or_setting():
    for variable in ("JAX_PLATFORMS", "JAX_DEFAULT_DEVICE"):
        code, out, err = process("", "check", "paper", **{variable: "gpu"})
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith(f"echelon: `{variable}` asks JAX for `gpu`, which this machine")
    code = "import jax\njax.config.update('jax_platforms', 'none')" + GAIN + "print(coupling())"
    assert process(code)[1].startswith("EchelonError: `jax_platforms` asks JAX for `none`, which")


def test_doctor_reports_a_missing_device_as_a_finding():
    code, out, err = process("", "doctor", JAX_PLATFORMS="none")
    assert code == 1 and not err
    assert "FAIL  JAX runs in this process (`JAX_PLATFORMS` asks JAX for `none`" in out
    assert "devices      none" in out


def test_a_value_that_jax_refuses_is_no_internal_error():
    code, out, err = process("", "check", "paper", JAX_ENABLE_X64="foo")
    assert (code, out, err.count("\n")) == (2, "", 1) and "JAX_ENABLE_X64" in err


def test_jax_without_compiling_is_named_and_not_the_model():
    with jax.disable_jit(), pytest.raises(ech.EchelonError, match="`JAX_DISABLE_JIT`") as caught:
        ech.run(ech.load_scenario("paper", ["simulation.horizon=1"]))
    assert "derivative" not in str(caught.value)


@pytest.mark.slow
def test_a_fork_of_a_process_that_used_jax_is_told_and_does_not_hang():
    code = f"""
import multiprocessing, jax
{GAIN}
import echelon.core.numerics
context = multiprocessing.get_context("fork")
with context.Pool(1) as pool:
    print(*pool.map(coupling, [1]))
print(coupling())
with context.Pool(2) as pool:
    print(*pool.map(coupling, [1, 2]), sep="\\n")
"""
    # One that is forked before JAX starts computes.
    first, second, *told = process(code)[1].splitlines()
    assert first == second and first.startswith("c = ") and len(told) == 2
    assert all(line.startswith(f"EchelonError: {FORK}") for line in told)
    assert "`echelon sweep`" in told[0]
    used = "import jax\n" + GAIN + "import echelon.core.numerics, multiprocessing\n"
    used += "jax.numpy.ones(2).sum()\n"
    used += "print(*multiprocessing.get_context('fork').Pool(1).map(coupling, [1]))"
    assert process(used)[1].startswith(f"EchelonError: {FORK}")


DIVERGES = {
    "name": "far",
    "model": {"name": "van-der-pol"},
    "graph": {"name": "path", "agents": 2},
    "follower": {"gain": {"method": "riccati", "coupling": 5000.0}},
    "initial": {"spread": {"position": 3.0}},
    "simulation": {"horizon": 1.0, "dt": 0.1, "engine": "jax"},
    "seed": 0,
}


def test_settings_of_jax_change_no_bit_of_a_run_that_diverges():
    usual = ech.run(DIVERGES)
    with (
        jax.debug_nans(True),
        jax.debug_infs(True),
        jax.numpy_dtype_promotion("strict"),
        jax.numpy_rank_promotion("raise"),
        jax.enable_x64(True),
        jax.default_matmul_precision("bfloat16"),
    ):
        run = ech.run(DIVERGES)
    assert run.outcome is usual.outcome is ech.Outcome.DIVERGED
    assert np.array_equal(run.states, usual.states, equal_nan=True)


def test_integers_of_two_types_add_where_jax_would_refuse_them():
    with jax.numpy_dtype_promotion("strict"), precision("float64"):
        assert jax.numpy.ones((), int) + jax.numpy.ones((), np.int32) == 2


@given(st.integers(0, 2**63 - 1), st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**31 - 1))
@settings(max_examples=20)
def test_draws_have_the_bits_of_those_of_jax(seed, step, agent):
    key, step, agent = key_of(seed), np.int32(step), np.int32(agent)
    folded = jax.random.wrap_key_data(jnp.asarray(key), impl="threefry2x32")
    for number in (Draw.GUST, step, agent):
        folded = jax.random.fold_in(folded, number)
    ours = normals(key, Draw.GUST, step, agent, size=5), uniform(key, Draw.GUST, step, agent)
    theirs = jax.random.normal(folded, (5,), jnp.float32), jax.random.uniform(folded)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a, np.asarray(b, np.float32))
