"""Laws linearized along the leader's path: whether a gain of the trim works away from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind
from echelon.guarantees.promises.frozen_laws import ModeMatrices


def built(scenario, *changes):
    return ech.build(ech.load_scenario(scenario, list(changes)))


def line_of(found, name=Hypothesis.ALONG_PATH):
    return found.hypotheses[name]


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [1.05, -1.2])
def test_a_yaw_that_loses_the_formation_is_not_promised_unless_the_law_turns(yaw):
    turning = ech.guarantee(*built("paper", f"reference.yaw={yaw}"))
    assert turning.promised and not line_of(turning).fails
    found = ech.guarantee(*built("paper", f"reference.yaw={yaw}", "follower.frame=world"))
    line = line_of(found)
    assert not found.promised and line.fails and line.kind is Kind.SAMPLES
    assert line.number > 0.1 and f"`yaw` {yaw:.3g} rad" in found.sentence()
    assert "`yaw`" in line.remedy


@pytest.mark.parametrize("scenario", ["paper", "van-der-pol"])
def test_no_bundled_scenario_that_flies_is_taken_its_promise(scenario):
    assert not line_of(ech.guarantee(*built(scenario))).fails


def poles_at_the_steepest(parts, settings):
    """The poles of the stiffest mode about the state of the path that is tilted most."""
    model, gain = parts.model, parts.drive.gain
    with jax.enable_x64(True):
        times = jnp.linspace(0.0, settings.horizon, 2000)
        path = np.asarray(parts.drive.reference_states(model, times))
        x = jnp.asarray(path[np.abs(path[:, 6:8]).max(axis=1).argmax()])
        thrust = model.mass * model.gravity / (jnp.cos(x[6]) * jnp.cos(x[7]))
        u = jnp.zeros(4).at[0].set(thrust)
        A = np.asarray(jax.jacfwd(lambda s: model.velocity(s, u))(x))
        B = np.asarray(model.normalized_input_map(x))
    felt = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
    return np.linalg.eigvals(A - B @ (gain.inner + parts.graph.spectrum().high * felt))


@pytest.mark.slow
def test_the_longest_step_is_that_of_the_steepest_tilt():
    parts, settings = built("paper", "follower.gain={method: inner-loop}")
    steep = 2.0 / np.abs(poles_at_the_steepest(parts, settings)).max()
    found = ech.guarantee(parts, settings)
    assert found.longest_step(settings) == pytest.approx(steep, rel=0.1)
    assert found.longest_step(settings) < 0.6 * found.loop.longest_step(settings)
    too_long = settings._replace(dt=0.02)
    line = line_of(ech.guarantee(parts, too_long), Hypothesis.SAMPLING)
    assert line.fails and "along the leader's path" in line.text and "dt" in line.remedy


def test_a_step_too_long_for_the_starts_alone_takes_no_promise_away():
    changes = ["follower.gain={method: inner-loop}", "simulation.dt=0.01"]
    changes += ["initial={states: {2: [1, 0.8, 1, 0, 0, 0, 0.9, 0, 0, 0, 0, 0]}}"]
    found = ech.guarantee(*built("paper", *changes))
    line = line_of(found, Hypothesis.SAMPLING)
    assert found.promised and line.fails and "where agents start" in line.text


@pytest.mark.parametrize("horizon", [0.1, 60.0, 6e4, 1e6, 1e9])
def test_the_rate_along_a_path_is_known_however_long_a_run_is(horizon):
    # A turned frame that moves no mode: the exponent of the whole path is the slowest one's.
    draw = np.random.default_rng(0)
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    A = turn @ np.diag([-95.0, -1.25, -7.0]) @ turn.T
    laws = ModeMatrices(np.stack([A] * 192), np.zeros((192, 3, 1)), np.zeros((192, 2, 1, 3)))
    growth = laws.along(np.linspace(0.0, horizon, 192), "followers'")
    assert growth.rate == pytest.approx(-1.25, rel=1e-6) and not growth.lost
