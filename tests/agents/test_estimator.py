"""The filter with a constant gain, against recursions and laws that share no code with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.world.sensing import Estimator
from echelon.core.errors import EchelonError
from echelon.core.numerics import precision, rk4

CART = ech.models.DoubleIntegrator(dimension=1)
DT = 0.01


def test_the_gain_is_that_of_the_riccati_recursion():
    std = np.array([0.05, 0.2])
    with_push = np.array([[1.0, DT, DT**2 / 2], [0.0, 1.0, DT], [0.0, 0.0, 1.0]])
    push = np.array([[DT**2 / 2], [DT], [0.0]])
    Q = 0.1**2 / DT * push @ push.T + DT * np.diag([0.01**2, 0.01**2, 1.0])
    C, R, P = np.eye(2, 3), np.diag(std**2), np.eye(3)
    for _ in range(3000):
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        P = with_push @ (P - K @ C @ P) @ with_push.T + Q
    np.testing.assert_allclose(Estimator.of(CART, std, 0, DT).gain, K, rtol=1e-9)


def flown(**sensing):
    """The largest distance (m) of a follower from its goal, in the last part of a run."""
    graph = ech.Graph.path(2)
    line = ech.Formation.from_offsets(CART, graph, {1: [1.0]})
    wave = ech.references.Circle(radius=1.0, rate=0.8)
    laws = ech.Laws(ech.laws.StoppingLeader(reference=wave), ech.laws.StoppingPoint())
    world = ech.World(sensing=ech.Sensing(**sensing))
    parts = ech.Parts(CART, graph, line, laws, {"position": 0.5}, world=world)
    result = ech.simulate(parts, ech.Settings(horizon=8.0, dt=DT, engine="jax"))
    return result.formation_errors[result.times > 4.0, 1].max()


@pytest.mark.slow
def test_the_model_carries_exact_states_that_are_late_to_the_present():
    assert flown(delay=0.1, estimator="constant-gain") < 1e-4


def test_it_removes_most_of_the_noise_of_a_known_motion():
    std, steps = np.array([0.05, 0.2]), 1500
    noise = np.random.default_rng(0).normal(size=(steps, 2)) * std
    with precision("float64"):
        estimator = Estimator.of(CART, std, 0, DT)

        def one(carry, row):
            x, before, k = carry
            now, after = estimator.measure(CART, before, x + row, k == 0)
            u = jnp.sin(DT * k)[None]
            x_next = rk4(CART.velocity, x, u, DT)
            return (x_next, estimator.act(after, u), k + 1), now - x

        x = jnp.array([0.3, -0.2])
        start = x, estimator.begin(CART, x), jnp.zeros((), int)
        errors = np.asarray(jax.jit(lambda: jax.lax.scan(one, start, noise))()[1])
    assert (errors[500:].std(axis=0) < 0.3 * std).all()


def test_exact_states_and_unknown_names_are_refused():
    with pytest.raises(EchelonError, match="the states are exact"):
        ech.Sensing(estimator="constant-gain")
    with pytest.raises(EchelonError, match="allowed are `none`, `constant-gain`"):
        ech.Sensing(delay=0.1, estimator="kalman")
