"""Where a leader is expected, from what it last said of itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import echelon as ech
from echelon.core.numerics import precision
from echelon.laws.law import Speaks
from echelon.laws.stopping_point import saturated_decay


@settings(max_examples=40, deadline=None)
@given(
    start=st.floats(-50.0, 50.0),
    coupling=st.floats(0.1, 30.0),
    speed=st.sampled_from([0.01, 0.5, 2.5, 100.0]),
    age=st.floats(1e-6, 3.0),
)
def test_the_closed_form_solves_its_differential_equation(start, coupling, speed, age):
    def slope(_, x):
        return -coupling * x / np.sqrt(1.0 + (coupling * x / speed) ** 2)

    solved = solve_ivp(slope, (0.0, age), [start], "DOP853", rtol=1e-12, atol=1e-15)
    with jax.enable_x64(True):
        args = jnp.asarray([start]), coupling, jnp.asarray([1.0 / speed]), jnp.asarray(age)
        value = float(jax.jit(saturated_decay)(*args)[0])
    assert value == pytest.approx(solved.y[0, -1], rel=2e-10, abs=1e-13)


def test_without_a_speed_it_is_exponential_and_zero_stays():
    with jax.enable_x64(True):
        start = jnp.asarray([3.0, 0.0, -2.0, 1e-12])
        inverse = jnp.asarray([0.0, 2.0, 0.0, 0.4])
        value = saturated_decay(start, 4.0, inverse, jnp.asarray(0.7))
    np.testing.assert_allclose(value, np.asarray(start) * np.exp(-2.8), rtol=1e-14)


@pytest.mark.parametrize("name", ["paper", "paper-global", "unicycle"])
def test_a_leader_on_its_plan_is_expected_where_it_is(name):
    """Of any age: with no deviation the prediction is the plan at that time."""
    parts, _ = ech.build(ech.load_scenario(name, ["leader.start_error={}"]))
    with jax.enable_x64(True):
        leader = parts.drive.prepare(parts.model, parts.graph).leader.predictable(parts.model)
        for t, age in ((0.0, 0.0), (1.3, 0.4), (2.0, 2.0)):
            x = leader.reference_states(parts.model, jnp.asarray([t]))[0]
            memory = leader.begin(parts.model, x)
            zero = jnp.zeros_like(x)
            deviation = leader.deviation(parts.model, jnp.asarray(t), x, zero, memory)
            there = leader.expected(
                parts.model, jnp.asarray(t), 0.0 * deviation, jnp.asarray(age), 0.005
            )
            signal = Speaks.of(leader).signal(parts.model, x, zero, memory)
            if signal is None:
                np.testing.assert_allclose(there.signal, x, atol=1e-12)
                np.testing.assert_allclose(deviation, 0.0, atol=1e-12)
            else:
                # zeta_r, whatever is known of the leader's own integrators.
                path = leader.path(parts.model, jnp.asarray(t))
                np.testing.assert_allclose(there.signal, leader.ready.stop(path[:-1]), atol=1e-12)
                np.testing.assert_allclose(
                    there.feedforward, leader.ready.stop(path[1:]), atol=1e-12
                )


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_of_a_decay_all_digits_are_left_at_any_age(kind):
    """By F(v) = sqrt(1 + v^2) - arsinh(1/v), which falls by c per second, v = c |x| / s."""
    draws = np.random.default_rng(0)
    v, falls = 10.0 ** draws.uniform(-7.5, 5.0, 2_000), 10.0 ** draws.uniform(-3.0, 1.7, 2_000)
    with precision(kind):
        rows = jnp.asarray(v)[:, None], jnp.asarray(falls)
        decay = jax.vmap(lambda v, age: saturated_decay(v, 1.0, jnp.ones(1), age))
        left = np.asarray(decay(*rows), float)[:, 0]

    def fallen(v):
        return np.sqrt(1.0 + v * v) - np.log((1.0 + np.sqrt(1.0 + v * v)) / v)

    # What rounding of v at the start, of F and of the age makes of it, in float64 at most 1e-13.
    eps = float(np.finfo(kind).eps)
    before = fallen(np.asarray(v, kind).astype(float))
    off = np.abs(fallen(left) - before + np.asarray(falls, kind).astype(float))
    np.testing.assert_array_less(off, 16.0 * eps * (1.0 + np.abs(before) + falls))


@pytest.mark.parametrize(("kind", "age"), [("float32", 90.0), ("float64", 800.0)])
def test_a_decay_has_slopes_at_any_age(kind, age):
    def left(start, coupling, age):
        return saturated_decay(start[None], coupling, jnp.ones(1), age)[0]

    with precision(kind):
        for start in (1.0, 1e-9, 0.0):
            numbers = (jnp.asarray(start), jnp.asarray(1.0), jnp.asarray(age))
            slopes = jax.grad(left, argnums=(0, 1, 2))(*numbers)
            np.testing.assert_allclose([left(*numbers), *slopes], 0.0, atol=1e-30)
