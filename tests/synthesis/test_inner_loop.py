"""The inner loop with which the paper's Assumption 5 holds."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from runs import simulate

import echelon as ech
from echelon.agents.models.linearization import linearize
from echelon.core.numerics import precision
from echelon.synthesis.gains.riccati import symmetric_states

AGENTS = {
    "double integrator": ech.models.DoubleIntegrator(2),
    "planar quadrotor": ech.models.PlanarQuadrotor(),
    "quadrotor": ech.models.Quadrotor.crazyflie(),
}


def closed(model, gain):
    """A - B K and B, in normalized inputs."""
    A, B = linearize(model)
    return A - B @ gain.inner, B


@pytest.fixture(scope="module")
def gains():
    graph = ech.Graph.path(4)
    return {
        name: ech.synthesize(model, graph, ech.gains.InnerLoop()) for name, model in AGENTS.items()
    }


@pytest.mark.parametrize("name", AGENTS)
def test_the_closed_drift_is_monotone_in_p(gains, name):
    model, gain = AGENTS[name], gains[name]
    A, _ = closed(model, gain)
    slope = gain.P @ A + A.T @ gain.P
    scale = np.abs(slope).max()
    assert np.linalg.eigvalsh(slope).max() <= 1e-12 * scale
    with precision("float64"):
        fixed = symmetric_states(model)
    assert [model.state_names[k] for k in fixed] == list(model.position)
    assert not gain.inner[:, fixed].any() and not A[:, fixed].any()


@pytest.mark.parametrize("name", AGENTS)
@given(
    edges=st.sets(st.tuples(st.integers(0, 5), st.integers(0, 5))), coupling=st.floats(0.01, 100)
)
def test_every_coupling_and_every_connected_graph_is_stable(gains, name, edges, coupling):
    pairs = {tuple(sorted(pair)) for pair in edges if pair[0] != pair[1]}
    graph = ech.Graph.from_edges(sorted(pairs | {(k, k + 1) for k in range(5)}))
    A, B = closed(AGENTS[name], gains[name])
    for value in graph.spectrum().eigenvalues:
        mode = A - coupling * value * B @ B.T @ gains[name].P
        assert np.linalg.eigvals(mode).real.max() < 0.0


def behind(model, graph, formation, path, gain, **more):
    law = ech.laws.Consensus(gain, feedforward="relay")
    return simulate(model, graph, formation, leader=ech.laws.Tracking(path), follower=law, **more)


@pytest.mark.slow
def test_quadrotors_converge_by_the_relay_of_the_input_beyond_the_loop(gains):
    model, graph, path = AGENTS["quadrotor"], ech.Graph.path(4), ech.references.FigureEight()
    parts = model, graph, ech.Formation.line(model, graph, 0.5), path, gains["quadrotor"]
    start = {"position": 1.0, "attitude": 0.3}
    errors = behind(*parts, initial=start, horizon=20.0, dt=0.005, store_every=20).formation_errors
    assert errors[-1].max() < 1e-9 and errors[0].max() > 0.5
    started = behind(*parts, start_error={"x": 0.7}, horizon=3.0, dt=0.005)
    assert started.formation_errors.max() < 1e-13


def test_v_never_rises_where_the_drift_is_linear():
    model, graph, path = ech.models.DoubleIntegrator(2), ech.Graph.ring(5), ech.references.Circle()
    gain = ech.synthesize(model, graph, ech.gains.InnerLoop())
    start = {"position": 1.0, "velocity": 1.0}
    circle = ech.Formation.circle(model, graph)
    result = behind(model, graph, circle, path, gain, initial=start, horizon=5.0, dt=0.01)
    v = ech.lyapunov(result)
    assert (v.drift <= 1e-9 * np.abs(v.rate).max()).all()
    assert not v.rises().any() and v.value[-1] < v.value[0]


def test_weights_replace_the_damping_that_the_model_brings():
    model, graph = AGENTS["quadrotor"], ech.Graph.path(4)
    R = 4.0 * np.diag(model.weights[1])
    plain, heavy = (ech.synthesize(model, graph, ech.gains.InnerLoop(R=r)) for r in (None, R))
    assert np.array_equal(plain.inner, model.damping)
    with precision("float64"):
        linear, fixed = linearize(model), symmetric_states(model)
    free = [k for k in range(12) if k not in fixed]
    A, B, Q = linear.A[np.ix_(free, free)], linear.B[free], np.diag(model.weights[0])
    P = scipy.linalg.solve_continuous_are(A, B, Q[np.ix_(free, free)], R)
    assert heavy.inner[:, free] == pytest.approx(np.linalg.solve(R, B.T @ P), abs=1e-9)
    assert not heavy.inner[:, fixed].any() and heavy.certificate.stable
    with pytest.raises(ech.EchelonError, match="`R` is not positive definite"):
        ech.synthesize(model, graph, ech.gains.InnerLoop(R=-R))


@pytest.mark.parametrize(
    ("model", "weight", "message"),
    [
        (ech.models.Pendulum(), None, "`Pendulum` has no symmetric state"),
        (ech.models.DoubleIntegrator(2), -1.0, "`symmetry_weight` is -1.0, and must be one"),
    ],
)
def test_an_agent_without_symmetric_states_is_refused(model, weight, message):
    with pytest.raises(ech.EchelonError, match=message):
        ech.synthesize(model, ech.Graph.path(3), ech.gains.InnerLoop(symmetry_weight=weight))


class Drifter(ech.ControlAffine):
    """A body in a fluid, whose parameters have the name of an attribute of all models."""

    damping: float | tuple[float, float] = 0.3
    state_names = ("x", "y", "vx", "vy")
    input_names = ("fx", "fy")

    def drift(self, x):
        return jnp.concatenate([x[2:], -jnp.asarray(self.damping) * x[2:]])

    def input_map(self, x):
        return jnp.concatenate([jnp.zeros((2, 2)), jnp.eye(2)])


@pytest.mark.parametrize("damping", [0.3, (0.3, 0.2)])
def test_a_parameter_called_damping_is_no_inner_loop(damping):
    model = Drifter(damping)
    gain = ech.synthesize(model, ech.Graph.path(3), ech.gains.InnerLoop())
    A, _ = closed(model, gain)
    assert gain.inner.shape == (2, 4) and not gain.inner[:, :2].any()
    # More damping than the water has: the loop of the Riccati equation, not the parameter.
    assert np.linalg.eigvals(A[2:, 2:]).real.max() < -0.5


def test_a_weight_of_one_input_may_be_a_plain_number():
    class Cart(ech.models.DoubleIntegrator):
        symmetry_inputs: float = 3.0

    gain = ech.synthesize(Cart(dimension=1), ech.Graph.path(3), ech.gains.InnerLoop())
    np.testing.assert_array_equal(gain.R, [[3.0]])


def test_its_time_constant_grows_as_the_square_of_a_line():
    graphs = [ech.Graph.path(size + 1) for size in (10, 30, 90)]
    gains = [ech.synthesize(AGENTS["double integrator"], g, ech.gains.InnerLoop()) for g in graphs]
    times = np.array([-1.0 / gain.certificate.abscissa for gain in gains])
    # First order: a position's zero eigenvalue moves by -c lambda times a constant of the loop.
    shares = times * [graph.spectrum().low for graph in graphs]
    assert shares == pytest.approx(shares[-1], rel=0.05)
    assert np.log(times[2] / times[1]) / np.log(3.0) == pytest.approx(2.0, abs=0.05)
