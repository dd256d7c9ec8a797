"""Gains and their certificates, against closed forms and eigenvalues."""

import contextlib
import dataclasses
import itertools
import json

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon.agents.models import (
    ControlAffine,
    DoubleIntegrator,
    Linear,
    Pendulum,
    PlanarQuadrotor,
    PrintedQuadrotor,
    Quadrotor,
    SingleIntegrator,
    Unicycle,
    UnicyclePoint,
    VanDerPol,
)
from echelon.agents.models.linearization import linearize
from echelon.agents.network.graph import Graph
from echelon.core import numerics
from echelon.core.errors import GainError
from echelon.core.linear import observability_rank, riccati, uncontrollable_modes
from echelon.core.words import Kind
from echelon.synthesis.gains import Feedback, FixedGain, InnerLoop, Method, Riccati
from echelon.synthesis.gains.gain import synthesize
from echelon.synthesis.gains.gain_file import gain_as_mapping

LINE = Graph.path(4)
TREE = Graph.from_edges([(0, 1), (1, 2), (1, 3)])
QUAD = Quadrotor()
STABILIZABLE = [
    SingleIntegrator(3),
    DoubleIntegrator(2, drag=0.3),
    Linear([[0.0, 1.0], [2.0, 0.5]], [[0.0], [1.0]]),
    VanDerPol(),
    Pendulum(),
    PlanarQuadrotor(),
    QUAD,
]


def near_trim(model):
    """A and B about the trim in normalized inputs, by central differences in NumPy."""
    x, u = map(np.array, model.trim)
    S = np.array(model.input_scale)

    def moved(dx, dv):
        with numerics.precision("float64"):
            return np.asarray(model.velocity(jnp.asarray(x + dx), jnp.asarray(u + S @ dv)))

    def slope(size, place):
        still = (np.zeros(len(x)), np.zeros(len(u)))
        columns = []
        for unit in 1e-6 * np.eye(size):
            ahead, behind = list(still), list(still)
            ahead[place], behind[place] = unit, -unit
            columns.append((moved(*ahead) - moved(*behind)) / 2e-6)
        return np.column_stack(columns)

    return slope(len(x), 0), slope(len(u), 1)


def modes(gain, A, B, eigenvalue, coupling=None):
    """Eigenvalues of the disagreement along one eigenvector of the grounded Laplacian."""
    c = gain.coupling if coupling is None else coupling
    return np.linalg.eigvals(A - c * eigenvalue * B @ np.linalg.solve(gain.R, B.T @ gain.P))


# ---- linearization ----


@pytest.mark.parametrize("model", STABILIZABLE, ids=lambda m: type(m).__name__)
def test_linearization_is_the_slope_of_the_velocity_at_the_trim(model):
    A, B = linearize(model)
    wanted = near_trim(model)
    assert A == pytest.approx(wanted[0], abs=1e-8) and B == pytest.approx(wanted[1], abs=1e-8)
    assert A.dtype == B.dtype == np.float64


def test_a_hovering_quadrotor_is_four_chains_of_integrators():
    A, B = linearize(QUAD)
    wanted = np.zeros((12, 12))
    wanted[0:3, 3:6] = wanted[6:9, 9:12] = np.eye(3)
    # Pitching forward by 1 rad pushes along x with g, rolling right pushes along -y.
    wanted[3, 7], wanted[4, 6] = 9.81, -9.81
    assert A == pytest.approx(wanted, abs=1e-12)
    inputs = np.zeros((12, 4))
    inputs[5, 0] = inputs[9, 1] = inputs[10, 2] = inputs[11, 3] = 1.0
    assert B == pytest.approx(inputs, abs=1e-12)


# ---- Riccati ----


@pytest.mark.parametrize("model", STABILIZABLE, ids=lambda m: type(m).__name__)
def test_riccati_solves_its_equation_and_stabilizes_every_mode(model):
    gain = synthesize(model, TREE, Riccati())
    A, B = near_trim(model)
    Q, R = (np.diag(weights) for weights in model.weights)
    P = gain.P
    residual = A.T @ P + P @ A + Q - P @ B @ np.linalg.solve(R, B.T @ P)
    assert np.abs(residual).max() <= 1e-7 * max(1.0, np.abs(P).max())
    assert np.array_equal(P, P.T) and np.linalg.eigvalsh(P)[0] > 0.0
    assert gain.R == pytest.approx(R) and gain.R @ gain.R_inverse == pytest.approx(np.eye(len(R)))
    low = 2.0 - np.sqrt(3.0)
    assert gain.coupling == pytest.approx(1.0 / low, rel=1e-9)
    worst = max(modes(gain, A, B, lam).real.max() for lam in (low, 1.0, 2.0 + np.sqrt(3.0)))
    assert worst < 0.0
    assert gain.certificate.abscissa == pytest.approx(worst, rel=1e-4, abs=1e-7)
    assert gain.certificate.stable and gain.certificate.kind is Kind.LINEARIZATION
    assert gain.certificate.observable == len(model.state_names)
    assert gain.method == "riccati"
    assert {P.dtype, gain.R.dtype, gain.R_inverse.dtype} == {np.dtype(np.float64)}


@given(
    st.floats(0.1, 10.0), st.floats(0.1, 10.0), st.floats(0.1, 10.0), st.sampled_from([0.0, 0.6])
)
@settings(max_examples=20)
def test_riccati_of_a_double_integrator_has_a_closed_form(q, s, r, drag):
    gain = synthesize(DoubleIntegrator(1, drag=drag), LINE, Riccati(Q=[q, s], R=[r]))
    # For p'' = u - drag p': the middle entry from the first equation, the last from the third.
    middle = np.sqrt(q * r)
    last = r * (np.sqrt(drag**2 + (s + 2.0 * middle) / r) - drag)
    first = middle * last / r + drag * middle
    assert gain.P == pytest.approx(np.array([[first, middle], [middle, last]]), rel=1e-8)


def test_what_is_not_coupled_is_exactly_0_in_riccati_s_solution():
    model = Quadrotor()
    A, B = linearize(model)
    Q, R = (np.diag(numbers) for numbers in model.weights)
    P = Riccati().feedback(model, linearize(model)).P
    at_once = scipy.linalg.solve_continuous_are(A, B, Q, R)
    np.testing.assert_allclose(P, at_once, rtol=0, atol=1e-11 * np.abs(at_once).max())
    # x with vx, pitch and q; y with vy, roll and p; z with vz; yaw with r.
    chains = [0, 3, 7, 10], [1, 4, 6, 9], [2, 5], [8, 11]
    assert (P != 0.0).sum() == sum(len(chain) ** 2 for chain in chains)
    # A weight couples them.
    Q[0, 1] = Q[1, 0] = 0.1
    assert (Riccati(Q=Q).feedback(model, linearize(model)).P != 0.0).sum() == 64 + 4 + 4


def test_riccati_of_a_single_integrator_is_the_geometric_mean_of_its_weights():
    gain = synthesize(SingleIntegrator(2), LINE, Riccati(Q=[4.0, 9.0], R=[1.0, 4.0], coupling=2.5))
    assert gain.P == pytest.approx(np.diag([2.0, 6.0]))
    assert gain.coupling == 2.5


def test_weights_may_be_matrices():
    Q, R = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[3.0]])
    model = Linear([[0.0, 1.0], [-1.0, 0.3]], [[0.0], [2.0]])
    gain = synthesize(model, LINE, Riccati(Q=Q, R=R))
    assert gain.P == pytest.approx(scipy.linalg.solve_continuous_are(model.A, model.B, Q, R))


def test_the_quadrotor_s_weights_are_those_of_its_documentation():
    Q, R = QUAD.weights
    assert Q == (1, 1, 1, 0.25, 0.25, 0.25, 2, 2, 2, 0.04, 0.04, 0.04)
    assert R == (1 / 25, 1 / 400, 1 / 400, 1 / 400)


def test_the_coupling_edge_is_a_guarantee_and_half_of_it_loses_the_line():
    A, B = near_trim(QUAD)
    gain = synthesize(QUAD, LINE, Riccati())
    spectrum = LINE.spectrum().eigenvalues
    edge = gain.certificate.edge
    assert edge == pytest.approx(0.5 / spectrum[0]) and edge == pytest.approx(2.52, abs=0.01)
    assert gain.coupling == pytest.approx(2.0 * edge)
    for coupling in (edge, 1.5 * edge, 10.0 * edge):
        assert max(modes(gain, A, B, lam, coupling).real.max() for lam in spectrum) < 0.0
    assert modes(gain, A, B, spectrum[0], 0.5 * edge).real.max() > 0.0
    below = synthesize(QUAD, LINE, Riccati(coupling=0.5 * edge))
    assert not below.certificate.stable and below.certificate.edge == edge


@given(st.integers(0, 10**6))
@settings(max_examples=15)
def test_any_coupling_above_the_edge_stabilizes_any_linear_agent(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(3, 3)), rng.normal(size=(3, 1))
    gain = synthesize(Linear(A, B), LINE, Riccati(coupling=0.5 / LINE.spectrum().low))
    for lam in LINE.spectrum().eigenvalues:
        assert modes(gain, A, B, lam).real.max() < 1e-9
    assert gain.certificate.abscissa < 1e-9


def test_the_certificate_holds_the_spectrum_of_the_graph():
    certificate = synthesize(SingleIntegrator(1), TREE, Riccati()).certificate
    assert certificate.lambda_min == pytest.approx(2.0 - np.sqrt(3.0))
    assert certificate.lambda_max == pytest.approx(2.0 + np.sqrt(3.0))
    assert certificate.modes == 3


def test_on_a_large_graph_the_extreme_modes_are_looked_at():
    graph = Graph.path(501)
    certificate = synthesize(DoubleIntegrator(1), graph, Riccati()).certificate
    assert certificate.modes == 2 and certificate.stable
    assert certificate.lambda_min == pytest.approx(2.0 - 2.0 * np.cos(np.pi / 1001), rel=1e-6)


# ---- what cannot be had ----


def test_the_mode_of_a_unicycle_that_no_input_moves_is_named():
    with pytest.raises(GainError) as caught:
        synthesize(Unicycle(), LINE, Riccati())
    assert str(caught.value) == (
        "the linearization of `Unicycle` at its trim cannot be stabilized: no input moves the mode "
        "at 0 1/s, which lies along `y`; give the gain yourself (method `given`)."
    )
    with pytest.raises(GainError, match="no input moves the mode"):
        synthesize(UnicyclePoint(), LINE, Riccati())


@pytest.mark.parametrize(("reach", "seen"), [(1e-7, True), (1e-5, True), (1e-11, False)])
def test_a_mode_that_an_input_moves_little_is_moved(reach, seen):
    A, B = np.diag([1.0, 2.0]), np.array([[1.0], [reach]])
    found = uncontrollable_modes(A, B)
    assert [s for s, _ in found] == ([] if seen else [2.0])
    for _, direction in found:
        assert np.abs(direction) == pytest.approx([0.0, 1.0], abs=1e-9)


@pytest.mark.parametrize("units", [(1e-8, 1e-8), (1e8, 1e8), (1e-2, 1e-11), (1e3, 1e-8)])
@pytest.mark.parametrize("slow", [1e-5, 1.0, 1e3])
def test_a_gain_exists_in_all_units(units, slow):
    # The same double integrator; weights state what counts as large, and R what time is.
    D = np.array(units)

    class Scaled(ControlAffine):
        state_names, input_names = ("x", "v"), ("u",)
        weights = (tuple((slow / D**2).tolist()), (1.0 / slow,))

        def drift(self, x):
            return jnp.stack([slow * D[0] / D[1] * x[1], 0.0 * x[1]])

        def input_map(self, x):
            return jnp.array([[0.0], [D[1]]])

    gain = synthesize(Scaled(), LINE, Riccati())
    expected = np.array([[np.sqrt(3.0), 1.0], [1.0, np.sqrt(3.0)]])
    assert gain.P * np.outer(D, D) == pytest.approx(expected, rel=1e-6)


def test_a_certificate_is_stable_below_zero_however_little():
    certificate = synthesize(SingleIntegrator(1), Graph.path(2), FixedGain()).certificate
    for abscissa, stable in ((-1e-12, True), (0.0, False), (1e-12, False)):
        assert dataclasses.replace(certificate, abscissa=abscissa).stable is stable


def test_an_uncontrollable_mode_that_decays_by_itself_is_no_obstacle():
    model = Linear([[-1.0, 0.0], [0.0, 1.0]], [[0.0], [1.0]])
    gain = synthesize(model, LINE, Riccati())
    assert gain.certificate.stable
    unstable = Linear([[0.5, 0.0], [0.0, 1.0]], [[0.0], [1.0]], names=["drifting", "driven"])
    with pytest.raises(GainError, match=r"mode at 0\.5 1/s, which lies along `drifting`"):
        synthesize(unstable, LINE, Riccati())


def test_a_swinging_mode_that_no_input_moves_is_named_as_a_pair():
    model = Linear([[0.0, 2.0], [-2.0, 0.0]], [[0.0], [0.0]], names=["left", "right"])
    with pytest.raises(
        GainError, match=r"mode at -?0 \+- 2i 1/s, which lies along `left`, `right`"
    ):
        synthesize(model, LINE, Riccati())


def test_a_position_without_weight_cannot_be_held():
    for Q in ([0.0, 1.0], [0.0, 0.0]):
        with pytest.raises(GainError):
            synthesize(DoubleIntegrator(1), LINE, Riccati(Q=Q))


@pytest.mark.parametrize(
    ("model", "method"),
    [
        (DoubleIntegrator(2), InnerLoop(Q=[1.0, 1.0, 1.0, 0.0], R=[1.0, 1.0])),
        (DoubleIntegrator(2), InnerLoop(Q=[1.0, 1.0, 0.0, 1.0], R=[1.0, 1.0])),
        (DoubleIntegrator(2), Riccati(Q=[0.0, 0.0, 1.0, 1.0], R=[1.0, 1.0])),
        (SingleIntegrator(2), Riccati(Q=[0.0, 1.0], R=[1.0, 1.0])),
        (SingleIntegrator(2), Riccati(Q=[0.0, 0.0], R=[1.0, 1.0])),
    ],
)
def test_an_undamped_mode_without_weight_is_refused_beside_others(model, method):
    with pytest.raises(GainError, match="has no stabilizing solution .*weighted by `Q`.$"):
        synthesize(model, LINE, method)


@pytest.mark.parametrize("method", [Riccati, InnerLoop])
def test_weights_of_any_size_give_a_gain_or_a_sentence_and_no_warning(method, recwarn):
    for model, size in itertools.product((DoubleIntegrator(), QUAD, Pendulum()), (1e-300, 1e70)):
        for name, count in (("Q", len(model.state_names)), ("R", len(model.input_names))):
            weights = np.ones(count)
            weights[-1] = size
            with contextlib.suppress(GainError):
                synthesize(model, TREE, method(**{name: weights}))
    assert not [str(each.message) for each in recwarn]


@pytest.mark.parametrize(
    ("A", "B", "Q"),
    [
        (np.diag([0.0, -1.0]), np.eye(2), np.diag([0.0, 1.0])),
        ([[0.0, 1.0], [-1.0, 0.0]], np.eye(2), np.zeros((2, 2))),
        (np.zeros((2, 2)), np.eye(2), np.ones((2, 2))),
        (np.eye(4, k=1), np.eye(4)[:, 3:], np.diag([0.0, 1.0, 1.0, 1.0])),
        (np.diag([1.0, -1.0]), [[0.0], [1.0]], np.eye(2)),
    ],
)
def test_riccati_finds_no_solution_that_does_not_stabilize(A, B, Q):
    A, B = np.array(A), np.array(B)
    with pytest.raises(GainError, match="has no stabilizing solution"):
        riccati(A, B, Q, np.eye(B.shape[1]))


def test_riccati_keeps_loops_that_are_slow_and_fast_at_once():
    one, two = np.eye(1), np.eye(2)
    for q in (1e-24, 1e-12, 1e-4):
        assert riccati(0.0 * one, one, q * one, one).item() == pytest.approx(q**0.5)
        chain = riccati(np.eye(2, k=1), two[:, 1:], np.diag([max(q, 1e-18), 1.0]), one)
        assert chain[0, 1] == pytest.approx(max(q, 1e-18) ** 0.5)
    # An actuator of 1e8 1/s in a loop of 0.01 1/s, and a state that decays without any weight.
    fast = np.array([[0.0, 1.0], [0.0, -1e8]])
    P = riccati(fast, 1e8 * two[:, 1:], np.diag([1e-4, 0.0]), one)
    assert P[0, 0] == pytest.approx(0.01, rel=1e-6)
    assert not riccati(-one, one, 0.0 * one, one).any()


# ---- methods ----


class Half(Method):
    """P = I, which needs strength 3 for x' = 1.5 x."""

    name = "half"

    def feedback(self, model, linear):
        return Feedback(np.eye(1), np.eye(1), rho=3.0)


def test_the_coupling_is_the_edge_of_the_strength_times_the_headroom():
    growing, low = Linear([[1.5]], [[1.0]]), LINE.spectrum().low
    gain = synthesize(growing, LINE, Half())
    assert gain.certificate.edge == pytest.approx(1.5 / low) and gain.method == "half"
    assert gain.coupling == 2.0 * gain.certificate.edge
    at_edge = synthesize(growing, LINE, Half(coupling=gain.certificate.edge))
    assert at_edge.certificate.abscissa == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(GainError, match="`coupling` is -1.0"):
        synthesize(growing, LINE, Half(coupling=-1.0))


def test_a_method_without_a_name_is_refused():
    class Nameless(Method):
        def feedback(self, model, linear):
            return Feedback(np.eye(1), np.eye(1), rho=3.0)

    with pytest.raises(GainError, match="`Nameless` has no `name`"):
        synthesize(Linear([[1.5]], [[1.0]]), LINE, Nameless())


# ---- gains of one's own ----


def test_the_paper_s_gain_sees_four_of_twelve_states():
    for model in (QUAD, PrintedQuadrotor()):
        gain = synthesize(model, TREE, FixedGain())
        assert np.array_equal(gain.P, np.eye(12)) and np.array_equal(gain.R, np.eye(4))
        assert (gain.coupling, gain.method) == (1.0, "given")
        assert gain.certificate.observable == 4 and gain.certificate.edge is None
        assert not gain.certificate.stable


def test_rank_of_observability_agrees_with_counting_modes_that_never_enter_the_input():
    A, B = near_trim(QUAD)
    C = B.T
    stacked = np.vstack([C @ np.linalg.matrix_power(A, k) for k in range(12)])
    assert np.linalg.matrix_rank(stacked) == 4
    seen = observability_rank(A, B.T @ synthesize(QUAD, TREE, Riccati()).P)
    assert seen == 12


def test_given_matrices_are_kept_as_they_are():
    P, R = np.array([[2.0, 0.1], [0.1, 1.0]]), [[4.0]]
    gain = synthesize(Pendulum(), LINE, FixedGain(P=P, R=R, coupling=3))
    assert np.array_equal(gain.P, P) and np.array_equal(gain.R, [[4.0]])
    assert gain.R_inverse == pytest.approx(np.array([[0.25]]))
    assert gain.coupling == 3.0 and isinstance(gain.coupling, float)
    assert np.array_equal(synthesize(Pendulum(), LINE, FixedGain(P=[2, 3])).P, np.diag([2.0, 3.0]))


class Shifted(ControlAffine):
    """A pendulum held at an angle: trim, scale and weights of its own."""

    state_names = ("angle", "rate")
    input_names = ("torque",)
    trim = ((0.5, 0.0), (9.81 * float(np.sin(0.5)),))
    input_scale = ((2.0,),)
    weights = ((4.0, 1.0), (0.5,))

    def drift(self, x):
        return jnp.stack([x[1], -9.81 * jnp.sin(x[0])])

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]], x.dtype)


def test_a_model_s_own_trim_scale_and_weights_are_used():
    gain = synthesize(Shifted(), LINE, Riccati())
    A, B = np.array([[0.0, 1.0], [-9.81 * np.cos(0.5), 0.0]]), np.array([[0.0], [2.0]])
    wanted = scipy.linalg.solve_continuous_are(A, B, np.diag([4.0, 1.0]), [[0.5]])
    assert gain.P == pytest.approx(wanted, rel=1e-9)
    # Chosen by hand they make the same gain.
    same = synthesize(Shifted(), LINE, Riccati(Q=[4.0, 1.0], R=[0.5]))
    assert np.array_equal(gain.P, same.P)


def test_a_file_with_two_equal_keys_is_refused_where_it_is_flown_and_where_it_is_verified(tmp_path):
    model, graph, file = ech.models.DoubleIntegrator(1), ech.Graph.path(3), tmp_path / "gain.json"
    ech.save_gain(ech.synthesize(model, graph, ech.gains.Riccati()), model, graph, file)
    text = file.read_text()
    file.write_text(text.replace('"coupling":', '"coupling": 0.001, "coupling":', 1))
    for read in (lambda: ech.load_gain(file, model, graph), lambda: ech.verify(file)):
        with pytest.raises(ech.errors.GainError, match="`coupling` (occurs )?twice"):
            read()


def test_a_file_whose_coupling_was_raised_by_hand_is_refused_where_it_is_read(tmp_path):
    model, graph, file = ech.models.DoubleIntegrator(1), ech.Graph.path(3), tmp_path / "gain.json"
    ech.save_gain(ech.synthesize(model, graph, ech.gains.Riccati()), model, graph, file)
    stored = json.loads(file.read_text())
    file.write_text(json.dumps(stored | {"coupling": 1e200}))
    with pytest.raises(ech.errors.GainError, match="`coupling` is 1e\\+200, and must be positive"):
        ech.load_gain(file, model, graph)


class Bounded(ControlAffine):
    """x' = u, with a bound that may be infinite."""

    state_names, input_names = ("x",), ("u",)
    bound: float = 1.0

    def drift(self, x):
        return jnp.zeros_like(x)

    def input_map(self, x):
        return jnp.ones((1, 1), x.dtype)


@pytest.mark.parametrize(("bound", "stored"), [(2.0, {"bound": 2.0}), (np.inf, None)])
def test_parameters_that_json_cannot_hold_are_left_out_of_a_file(bound, stored):
    model, graph = Bounded(bound), ech.Graph.path(3)
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    assert gain_as_mapping(gain, model, graph)["model"]["parameters"] == stored


@pytest.mark.parametrize("exact", [True, False])
def test_a_contraction_is_coupled_as_weakly_as_its_inequality_allows(exact):
    model, graph = ech.models.Pendulum(), ech.Graph.path(3)
    method = ech.gains.Contraction({"angle": 0.5}, rate=0.3, exact=exact)
    gain = ech.synthesize(model, graph, method)
    assert gain.coupling == gain.certificate.edge


def test_all_states_that_a_lost_mode_lies_along_are_named_and_none_of_rounding_s_size():
    w = np.array([1.0, 1.0, 1.0, 0.13, 0.0])
    along = np.outer(w, w) / (w @ w)
    A, B = 0.5 * along - (np.eye(5) - along), [[1.0], [-1.0], [0.0], [0.0], [1.0]]
    with pytest.raises(GainError, match="0.5 1/s, which lies along `a`, `b`, `c`, `d`;"):
        synthesize(Linear(A, B, names=list("abcde")), LINE, Riccati())
