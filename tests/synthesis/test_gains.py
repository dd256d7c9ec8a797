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
from echelon import Graph, synthesize
from echelon.agents import models
from echelon.agents.models.linearization import linearize
from echelon.core.errors import GainError
from echelon.core.linear import riccati, uncontrollable_modes
from echelon.core.words import Kind
from echelon.synthesis.gains import Feedback, FixedGain, InnerLoop, Method, Riccati
from echelon.synthesis.gains.gain_file import gain_as_mapping

LINE = Graph.path(4)
TREE = Graph.from_edges([(0, 1), (1, 2), (1, 3)])
QUAD = models.Quadrotor()
STABILIZABLE = [
    models.SingleIntegrator(3),
    models.DoubleIntegrator(2, drag=0.3),
    models.Linear([[0.0, 1.0], [2.0, 0.5]], [[0.0], [1.0]]),
    models.VanDerPol(),
    models.Pendulum(),
    models.PlanarQuadrotor(),
    QUAD,
]


def modes(gain, A, B, eigenvalue, coupling=None):
    """Eigenvalues of the disagreement along one eigenvector of the grounded Laplacian."""
    c = gain.coupling if coupling is None else coupling
    return np.linalg.eigvals(A - c * eigenvalue * B @ np.linalg.solve(gain.R, B.T @ gain.P))


@pytest.mark.parametrize("model", STABILIZABLE, ids=lambda m: type(m).__name__)
def test_riccati_solves_its_equation_and_stabilizes_every_mode(model):
    gain = synthesize(model, TREE, Riccati())
    A, B = linearize(model)
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
    gain = synthesize(models.DoubleIntegrator(1, drag=drag), LINE, Riccati(Q=[q, s], R=[r]))
    # For p'' = u - drag p': the middle entry from the first equation, the last from the third.
    middle = np.sqrt(q * r)
    last = r * (np.sqrt(drag**2 + (s + 2.0 * middle) / r) - drag)
    first = middle * last / r + drag * middle
    assert gain.P == pytest.approx(np.array([[first, middle], [middle, last]]), rel=1e-8)


def test_weights_may_be_numbers_or_matrices():
    # The geometric mean of a single integrator's weights.
    gain = synthesize(
        models.SingleIntegrator(2), LINE, Riccati(Q=[4.0, 9.0], R=[1.0, 4.0], coupling=2.5)
    )
    assert gain.P == pytest.approx(np.diag([2.0, 6.0])) and gain.coupling == 2.5
    Q, R = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([[3.0]])
    model = models.Linear([[0.0, 1.0], [-1.0, 0.3]], [[0.0], [2.0]])
    gain = synthesize(model, LINE, Riccati(Q=Q, R=R))
    assert gain.P == pytest.approx(scipy.linalg.solve_continuous_are(model.A, model.B, Q, R))


def test_what_is_not_coupled_is_exactly_0_in_riccati_s_solution():
    model = models.Quadrotor()
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


def test_the_quadrotor_s_weights_are_those_of_its_documentation():
    Q, R = QUAD.weights
    assert Q == (1, 1, 1, 0.25, 0.25, 0.25, 2, 2, 2, 0.04, 0.04, 0.04)
    assert R == (1 / 25, 1 / 400, 1 / 400, 1 / 400)


def test_the_coupling_edge_is_a_guarantee_and_half_of_it_loses_the_line():
    A, B = linearize(QUAD)
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
    gain = synthesize(models.Linear(A, B), LINE, Riccati(coupling=0.5 / LINE.spectrum().low))
    for lam in LINE.spectrum().eigenvalues:
        assert modes(gain, A, B, lam).real.max() < 1e-9
    assert gain.certificate.abscissa < 1e-9


def test_on_a_large_graph_the_extreme_modes_are_looked_at():
    certificate = synthesize(models.DoubleIntegrator(1), Graph.path(501), Riccati()).certificate
    assert certificate.modes == 2 and certificate.stable
    assert certificate.lambda_min == pytest.approx(2.0 - 2.0 * np.cos(np.pi / 1001), rel=1e-6)
    certificate = synthesize(models.SingleIntegrator(1), TREE, Riccati()).certificate
    ends = certificate.lambda_min, certificate.lambda_max
    assert ends == pytest.approx((2.0 - np.sqrt(3.0), 2.0 + np.sqrt(3.0)))
    assert certificate.modes == 3


def test_the_mode_of_a_unicycle_that_no_input_moves_is_named():
    with pytest.raises(GainError) as caught:
        synthesize(models.Unicycle(), LINE, Riccati())
    assert str(caught.value) == (
        "the linearization of `Unicycle` at its trim cannot be stabilized: no input moves the mode "
        "at 0 1/s, which lies along `y`; give the gain yourself (method `given`)."
    )


W = np.array([1.0, 1.0, 1.0, 0.13, 0.0])
ALONG = np.outer(W, W) / (W @ W)


@pytest.mark.parametrize(
    ("A", "B", "names", "where"),
    [
        ([[0.5, 0.0], [0.0, 1.0]], [[0.0], [1.0]], ["lost", "driven"], "0.5 1/s, which .* `lost`"),
        ([[0.0, 2.0], [-2.0, 0.0]], np.zeros((2, 1)), "ab", r"-?0 \+- 2i 1/s, which .* `a`, `b`"),
        # All states that the mode lies along, and none of rounding's size.
        (
            0.5 * ALONG - (np.eye(5) - ALONG),
            [[1.0], [-1.0], [0.0], [0.0], [1.0]],
            "abcde",
            "0.5 1/s, which lies along `a`, `b`, `c`, `d`",
        ),
    ],
)
def test_a_mode_that_no_input_moves_is_named_with_its_states(A, B, names, where):
    with pytest.raises(GainError, match=f"no input moves the mode at {where};"):
        synthesize(models.Linear(A, B, names=list(names)), LINE, Riccati())


@pytest.mark.parametrize(
    ("reach", "seen"), [(1e-7, True), (1e-5, True), (1e-12, True), (0.0, False)]
)
def test_a_mode_that_an_input_moves_little_is_moved(reach, seen):
    A, B = np.diag([1.0, 2.0]), np.array([[1.0], [reach]])
    found = uncontrollable_modes(A, B)
    assert [s for s, _ in found] == ([] if seen else [2.0])
    for _, direction in found:
        assert np.abs(direction) == pytest.approx([0.0, 1.0], abs=1e-9)


@pytest.mark.parametrize(
    ("A", "B"),
    [
        ([[0, 1], [0, 0]], [[0], [1e-9]]),
        ([[0, 1], [1e6, 0]], [[0], [1]]),
        ([[0, 1e5], [0, 0]], [[0], [1e-5]]),
        ([[0, 1e9, 0], [0, 0, 1e-12], [0, 0, 0]], [[0], [0], [1e-7]]),
    ],
)
def test_units_hide_no_input(A, B):
    assert not uncontrollable_modes(np.array(A, float), np.array(B, float))


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), lost=st.integers(0, 3))
def test_modes_that_no_input_moves_are_found_in_any_units(seed, lost):
    random = np.random.default_rng(seed)
    n, m = lost + int(random.integers(1, 4)), int(random.integers(1, 3))
    A, B = random.standard_normal((n, n)), random.standard_normal((n, m))
    A[:lost, lost:], B[:lost] = 0.0, 0.0
    units = 10.0 ** random.uniform(-6, 6, n)
    found = uncontrollable_modes(units[:, None] * A / units, units[:, None] * B)
    assert len(found) == lost


@pytest.mark.parametrize("units", [(1e-8, 1e-8), (1e8, 1e8), (1e-2, 1e-11), (1e3, 1e-8)])
@pytest.mark.parametrize("slow", [1e-5, 1.0, 1e3])
def test_a_gain_exists_in_all_units(units, slow):
    # The same double integrator; weights state what counts as large, and R what time is.
    D = np.array(units)

    class Scaled(models.ControlAffine):
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
    certificate = synthesize(models.SingleIntegrator(1), Graph.path(2), FixedGain()).certificate
    for abscissa, stable in ((-1e-12, True), (0.0, False), (1e-12, False)):
        assert dataclasses.replace(certificate, abscissa=abscissa).stable is stable


def test_an_uncontrollable_mode_that_decays_by_itself_is_no_obstacle():
    model = models.Linear([[-1.0, 0.0], [0.0, 1.0]], [[0.0], [1.0]])
    assert synthesize(model, LINE, Riccati()).certificate.stable


@pytest.mark.parametrize(
    ("model", "method"),
    [
        (models.DoubleIntegrator(2), InnerLoop(Q=[1.0, 1.0, 1.0, 0.0], R=[1.0, 1.0])),
        (models.DoubleIntegrator(2), InnerLoop(Q=[1.0, 1.0, 0.0, 1.0], R=[1.0, 1.0])),
        (models.DoubleIntegrator(1), Riccati(Q=[0.0, 1.0])),
        (models.DoubleIntegrator(1), Riccati(Q=[0.0, 0.0])),
        (models.DoubleIntegrator(2), Riccati(Q=[0.0, 0.0, 1.0, 1.0], R=[1.0, 1.0])),
        (models.SingleIntegrator(2), Riccati(Q=[0.0, 1.0], R=[1.0, 1.0])),
        (models.SingleIntegrator(2), Riccati(Q=[0.0, 0.0], R=[1.0, 1.0])),
    ],
)
def test_an_undamped_mode_without_weight_is_refused_beside_others(model, method):
    with pytest.raises(GainError, match="has no stabilizing solution .*weighted by `Q`.$"):
        synthesize(model, LINE, method)


@pytest.mark.parametrize("method", [Riccati, InnerLoop])
def test_weights_of_any_size_give_a_gain_or_a_sentence_and_no_warning(method, recwarn):
    for model, size in itertools.product(
        (models.DoubleIntegrator(), QUAD, models.Pendulum()), (1e-300, 1e70)
    ):
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


class Half(Method):
    """P = I, which needs strength 3 for x' = 1.5 x."""

    name = "half"

    def feedback(self, model, linear):
        return Feedback(np.eye(1), np.eye(1), rho=3.0)


class Nameless(Half):
    name = ""


def test_the_coupling_is_the_edge_of_the_strength_times_the_headroom():
    growing, low = models.Linear([[1.5]], [[1.0]]), LINE.spectrum().low
    gain = synthesize(growing, LINE, Half())
    assert gain.certificate.edge == pytest.approx(1.5 / low) and gain.method == "half"
    assert gain.coupling == 2.0 * gain.certificate.edge
    at_edge = synthesize(growing, LINE, Half(coupling=gain.certificate.edge))
    assert at_edge.certificate.abscissa == pytest.approx(0.0, abs=1e-12)
    for method, said in (
        (Half(coupling=-1.0), "`coupling` is -1.0"),
        (Nameless(), "has no `name`"),
    ):
        with pytest.raises(GainError, match=said):
            synthesize(growing, LINE, method)


def test_the_paper_s_gain_sees_four_of_twelve_states():
    for model in (QUAD, models.PrintedQuadrotor()):
        gain = synthesize(model, TREE, FixedGain())
        assert np.array_equal(gain.P, np.eye(12)) and np.array_equal(gain.R, np.eye(4))
        assert (gain.coupling, gain.method) == (1.0, "given")
        assert gain.certificate.observable == 4 and gain.certificate.edge is None
        assert not gain.certificate.stable
    A, B = linearize(QUAD)
    stacked = np.vstack([B.T @ np.linalg.matrix_power(A, k) for k in range(12)])
    assert np.linalg.matrix_rank(stacked) == 4


def test_given_matrices_are_kept_as_they_are():
    P, R = np.array([[2.0, 0.1], [0.1, 1.0]]), [[4.0]]
    gain = synthesize(models.Pendulum(), LINE, FixedGain(P=P, R=R, coupling=3))
    assert np.array_equal(gain.P, P) and np.array_equal(gain.R, [[4.0]])
    assert gain.R_inverse == pytest.approx(np.array([[0.25]]))
    assert gain.coupling == 3.0 and isinstance(gain.coupling, float)
    assert np.array_equal(
        synthesize(models.Pendulum(), LINE, FixedGain(P=[2, 3])).P, np.diag([2.0, 3.0])
    )


class Shifted(models.ControlAffine):
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


def test_a_file_that_was_edited_is_refused_where_it_is_flown_and_where_it_is_verified(tmp_path):
    model, graph, file = models.DoubleIntegrator(1), Graph.path(3), tmp_path / "gain.json"
    ech.save_gain(synthesize(model, graph, Riccati()), model, graph, file)
    text = file.read_text()
    file.write_text(text.replace('"coupling":', '"coupling": 0.001, "coupling":', 1))
    for read in (lambda: ech.load_gain(file, model, graph), lambda: ech.verify(file)):
        with pytest.raises(GainError, match="`coupling` (occurs )?twice"):
            read()
    file.write_text(json.dumps(json.loads(text) | {"coupling": 1e200}))
    with pytest.raises(GainError, match="`coupling` is 1e\\+200, and must be positive"):
        ech.load_gain(file, model, graph)


@pytest.mark.parametrize(("bound", "stored"), [(2.0, {"bound": 2.0}), (np.inf, None)])
def test_parameters_that_json_cannot_hold_are_left_out_of_a_file(bound, stored):
    class Bounded(Shifted):
        bound: float = 1.0

    model, graph = Bounded(bound), Graph.path(3)
    gain = synthesize(model, graph, Riccati())
    assert gain_as_mapping(gain, model, graph)["model"]["parameters"] == stored


@pytest.mark.parametrize("exact", [True, False])
def test_a_contraction_is_coupled_as_weakly_as_its_inequality_allows(exact):
    method = ech.gains.Contraction({"angle": 0.5}, rate=0.3, exact=exact)
    gain = synthesize(models.Pendulum(), Graph.path(3), method)
    assert gain.coupling == gain.certificate.edge
