"""Laws of states that sum errors of outputs: gains, modes, pushes, limits, and who may sum."""

import dataclasses
import functools

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_agents import as_python, compare

import echelon as ech
from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import Limits
from echelon.core.errors import EchelonError
from echelon.core.statement import Hypothesis, Topic, Verdict
from echelon.experiments.studies.check import check
from echelon.experiments.studies.design import design
from echelon.guarantees.promises.promise import guarantee
from echelon.laws.law import gain_of
from echelon.simulation.onboard.agent_functions import agent_functions

SQUARE = ech.Graph.from_edges([(0, 1), (0, 2), (1, 3), (2, 3)])
PLANAR = ech.models.PlanarQuadrotor()
VEHICLES = PLANAR, ech.models.Quadrotor.crazyflie()
LINE = ech.references.Line(velocity=(0.5, 0.2, 0.0))
STEPS = ech.Settings(horizon=2.0, dt=0.005)


@functools.cache
def gain_for(model, graph=SQUARE, coupling=None):
    return ech.synthesize(model, graph, ech.gains.Riccati(coupling=coupling))


def follower(model, integral, graph=SQUARE, coupling=None, **more):
    return ech.laws.Consensus(gain_for(model, graph, coupling), integral=integral, **more)


def parts_of(model, leads, follows, graph=SQUARE, **more):
    formation = ech.Formation.line(model, graph, spacing=1.0)
    return ech.Parts(model, graph, formation, ech.Laws(leads, follows), **more)


def augmented(model, weights):
    """A_a, B_a, K_a at coupling 1, and the sums' rows, by SciPy from the model's own weights."""
    A, B = linearize(model)
    rows = [*model.position_indices()]
    rows += [model.state_names.index("yaw")] if "yaw" in model.state_names else []
    n, q = len(A), len(rows)
    Q, R = map(np.diag, model.weights)
    Aa, Ba = np.zeros((n + q, n + q)), np.vstack([B, np.zeros((q, B.shape[1]))])
    Aa[:n, :n], Aa[n:, :n] = A, np.eye(n)[rows]
    P = scipy.linalg.solve_continuous_are(Aa, Ba, scipy.linalg.block_diag(Q, np.diag(weights)), R)
    return Aa, Ba, np.linalg.solve(R, Ba.T @ P)


def rk4_step(A, B, dt):
    """The step of Runge-Kutta's method is Taylor's polynomial of degree 4."""
    F, G, power = np.eye(len(A)), np.zeros_like(A), np.eye(len(A))
    for k in range(1, 5):
        G = G + dt * power / k
        power = dt * A @ power / k
        F = F + power
    return F, G @ B


def own_rate(model, graph, weights, coupling, dt):
    """The rate of a step of all followers behind a leader at rest, as one matrix made by hand."""
    A, B = linearize(model)
    Aa, _, K = augmented(model, weights)
    n, C = len(A), Aa[len(A) :, : len(A)]
    (F, G), L, K = rk4_step(A, B, dt), graph.laplacian().toarray()[1:, 1:], coupling * K
    one = np.eye(len(L))
    top = np.kron(one, F) - np.kron(L, G @ K[:, :n]), -np.kron(one, G @ K[:, n:])
    step = np.block([[*top], [np.kron(L, dt * C), np.eye(len(L) * len(C))]])
    return float(np.log(np.abs(np.linalg.eigvals(step)).max()) / dt)


# ---- gains and modes -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "model", [PLANAR, ech.models.Quadrotor.crazyflie()], ids=["plane", "space"]
)
@pytest.mark.parametrize("weight", [0.3, 4.0])
def test_the_gain_is_that_of_the_augmented_riccati_equation(model, weight):
    sums = follower(model, weight).prepared(model, SQUARE).integral
    Aa, Ba, K = augmented(model, sums.used)
    strengths = sums.gain.coupling * SQUARE.spectrum().eigenvalues
    for strength, loop in zip(strengths, sums.loops(model, strengths), strict=True):
        expected = Aa - strength * Ba @ K
        np.testing.assert_allclose(loop, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


def test_a_default_weight_costs_at_most_a_quarter_of_the_rate():
    for model in (PLANAR, ech.models.Quadrotor.crazyflie(), ech.models.DoubleIntegrator()):
        gain, law = gain_for(model), follower(model, True).prepared(model, SQUARE)
        strengths = gain.coupling * SQUARE.spectrum().eigenvalues
        slowest = law.integral.slowest(model, strengths)
        assert slowest <= 0.75 * gain.certificate.abscissa < 0.0
        # And no smaller weight does: half of it costs more.
        half = tuple(0.4 * x for x in law.integral.used)
        less = follower(model, half).prepared(model, SQUARE).integral
        assert less.slowest(model, strengths) > 0.75 * gain.certificate.abscissa


def test_weights_are_found_for_gains_of_other_methods_too():
    gain = ech.synthesize(PLANAR, SQUARE, ech.gains.InnerLoop())
    law = ech.laws.Consensus(gain, integral=True).prepared(PLANAR, SQUARE)
    strengths = gain.coupling * SQUARE.spectrum().eigenvalues
    assert law.integral.slowest(PLANAR, strengths) <= 0.75 * gain.certificate.abscissa


@settings(max_examples=6, deadline=None)
@given(
    weight=st.floats(0.05, 50.0),
    factor=st.floats(0.2, 3.0),
    dt=st.sampled_from([0.005, 0.02, 0.1]),
    directed=st.booleans(),
)
def test_the_guarantee_is_that_of_the_whole_matrix(weight, factor, dt, directed):
    model, edges = ech.models.DoubleIntegrator(dimension=1), [(0, 1), (1, 2), (0, 2)]
    graph = ech.Graph.from_edges(edges, directed=directed)
    coupling = factor / (2.0 * graph.spectrum().low)
    law = follower(model, weight, graph, coupling)
    stated = guarantee(parts_of(model, ech.laws.TrimInput(), law, graph), STEPS._replace(dt=dt))
    rate = own_rate(model, graph, [weight], coupling, dt)
    assert stated.claimed == (rate < 0.0)
    assert stated.slowest == pytest.approx(rate, rel=1e-6, abs=1e-8)


def test_the_guarantee_is_local_and_not_that_of_the_law_without_sums():
    plain, summed = (
        guarantee(parts_of(PLANAR, ech.laws.Tracking(LINE), follower(PLANAR, x)), STEPS)
        for x in (None, True)
    )
    assert plain.theorem is None and plain.promised
    assert summed.promised and summed.theorem is None and summed.certified is None
    assert not summed.governed and summed.edge is None and summed.region is None
    used = follower(PLANAR, True).prepared(PLANAR, SQUARE).integral.used
    rate = own_rate(PLANAR, SQUARE, used, gain_for(PLANAR).coupling, STEPS.dt)
    assert summed.rate == pytest.approx(-rate, rel=1e-6) and summed.rate < plain.rate
    # The last step with which the whole matrix decays, whose border is the number of `design`.
    longest = summed.longest_step(STEPS)
    low, high = (
        own_rate(PLANAR, SQUARE, used, gain_for(PLANAR).coupling, factor * longest)
        for factor in (0.999, 1.001)
    )
    assert low < 0.0 < high


@pytest.mark.slow
def test_no_region_of_the_gain_is_stated_of_sums():
    model = ech.models.DoubleIntegrator(dimension=1)
    method = ech.gains.RobustLQR(domain={"x": 1.0, "vx": 1.0})
    gain = ech.synthesize(model, SQUARE, method)
    plain, summed = (
        guarantee(
            parts_of(model, ech.laws.TrimInput(), ech.laws.Consensus(gain, integral=x)), STEPS
        )
        for x in (None, 1.0)
    )
    assert plain.theorem is not None and plain.certified is not None
    assert summed.promised and summed.theorem is None and summed.region is None


# ---- pushes, and limits --------------------------------------------------------------------------


def ends(parts, horizon=25.0):
    """Errors (N,) at the end, m: of the leader against its path, of others against the leader."""
    result = ech.simulate(parts, ech.Settings(horizon=horizon, dt=0.005, store_every=100))
    place = list(parts.model.position_indices())
    errors = np.abs(result.errors[-1][:, place]).max(axis=1)
    errors[0] = np.abs((result.states[-1, 0] - result.reference[-1])[place]).max()
    return errors


@pytest.mark.parametrize("sums", [None, True])
def test_a_constant_wind_leaves_less_than_a_millimetre(sums):
    wind = ech.World(disturbance=ech.Disturbance(constant={"vy": 0.3}))
    leads = ech.laws.Tracking(LINE, integral=sums)
    errors = ends(parts_of(PLANAR, leads, follower(PLANAR, sums), world=wind))
    # Without sums the leader is 113 mm off its path.
    assert errors.max() < 1e-4 if sums else 0.11 < errors.max() < 0.12


@pytest.mark.parametrize("path", [LINE, ech.references.Circle(radius=1.0, rate=0.6)])
def test_another_mass_is_held_on_lines_and_leaves_a_lag_on_curves(path):
    heavy = ech.World(plants={1: dataclasses.replace(PLANAR, mass=1.2 * PLANAR.mass)})
    plain, summed = (
        ends(parts_of(PLANAR, ech.laws.Tracking(path), follower(PLANAR, x), world=heavy))
        for x in (None, True)
    )
    assert plain.max() > 0.1
    assert summed.max() < (1e-4 if path is LINE else 1e-2)
    assert path is LINE or summed.max() > 1e-6


class Weak(ech.models.DoubleIntegrator):
    """A point that is pushed by 1 m/s^2 at most."""

    input_limits = Limits(((1.0,),), (-1.0,), (1.0,))


@pytest.mark.parametrize("start", [2.0, 10.0])
def test_a_limit_that_acts_for_long_does_not_wind_up_the_sums(start):
    model, graph = Weak(dimension=1), ech.Graph.from_edges([(0, 1)])
    law, far = follower(model, True, graph), {1: np.array([start, 0.0])}
    formation = ech.Formation.from_offsets(model, graph, {})
    parts = ech.Parts(model, graph, formation, ech.Laws(ech.laws.TrimInput(), law), initial=far)
    over = {}
    for limits in (True, False):
        result = ech.simulate(parts, ech.Settings(horizon=40.0, dt=0.01, limits=limits))
        over[limits] = max(0.0, -float(result.states[:, 1, 0].min())) / start
        assert abs(result.states[-1, 1, 0]) < 1e-6
        assert bool(result.saturated.max() > 0.0) is limits
    assert over[True] < over[False] + 0.02


# ---- everywhere that laws run --------------------------------------------------------------------


def test_without_the_key_no_bit_changes_and_the_law_has_its_gain():
    law, none = follower(PLANAR, None), follower(PLANAR, False)
    assert law.integral is none.integral is None and law.init() is None
    assert gain_of(law) is law.gain and gain_of(follower(PLANAR, True)) is None


@pytest.mark.parametrize(
    "model", [PLANAR, ech.models.Quadrotor.crazyflie()], ids=["plane", "space"]
)
def test_native_code_and_jax_take_the_same_steps(model):
    leads = ech.laws.Tracking(ech.references.Circle(), integral=True)
    parts = parts_of(model, leads, follower(model, True), initial={"position": 1.0})
    jax, native = (
        ech.simulate(parts, STEPS._replace(engine=engine)) for engine in ("jax", "native")
    )
    assert native.engine == "native" and jax.saturated.max() > 0.0
    np.testing.assert_allclose(native.states, jax.states, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("number", [0, 1])
def test_an_exported_law_sums_as_its_agent_does(number):
    leads = ech.laws.Tracking(ech.references.Circle(), integral=True)
    agent = ech.Agent(parts_of(PLANAR, leads, follower(PLANAR, True)), number, 0.005)
    [memory] = compare(agent, [as_python(agent_functions(agent.own_law).values())], 20, 0.005)
    assert np.abs(memory).max() > 1e-4


def test_at_another_heading_the_sums_act_as_at_the_trim():
    model, graph = ech.models.Quadrotor.crazyflie(), ech.Graph.from_edges([(0, 1)])
    wind = 0.3
    runs = []
    for angle in (0.0, 1.0):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        push = dict(zip(("vx", "vy"), (turn @ [wind, 0.0]).tolist(), strict=True))
        world = ech.World(disturbance=ech.Disturbance(constant=push))
        path = ech.references.Hover(position=(0.0, 0.0, 0.0), yaw=angle)
        law = follower(model, True, graph, feedforward="none")
        offsets = ech.Formation.from_offsets(model, graph, {})
        drive = ech.Laws(ech.laws.Tracking(path, integral=True), law)
        far = np.zeros(12)
        far[:2], far[8] = turn @ [0.2, 0.1], angle
        parts = ech.Parts(model, graph, offsets, drive, initial={1: far}, world=world)
        result = ech.simulate(parts, ech.Settings(horizon=3.0, dt=0.01))
        runs.append(result.states[:, :, :2] @ turn)
    np.testing.assert_allclose(*runs, atol=1e-9)


# ---- what is stated, and what is refused ---------------------------------------------------------


def test_check_and_design_state_what_sums_cost():
    parts = parts_of(PLANAR, ech.laws.Tracking(LINE, integral=True), follower(PLANAR, True))
    lines = [x for x in check(parts, STEPS).lines if x.statement is Topic.INTEGRAL]
    assert [round(x.number, 2) for x in lines] == [0.23, 0.19]
    assert "the followers sum errors of `y`, `z`" in lines[0].text
    assert "and a lag on curves" in lines[0].text
    designs = design((parts, STEPS), "riccati")
    assert "With `integral` the slowest mode decays at 1" in designs.because
    [best] = designs.designs
    assert best.stable and best.promise.slowest == pytest.approx(-1.0085, abs=1e-3)
    assert 0.005 < best.step < 0.1 and best.delay > 0.0


class Deaf(ech.laws.Consensus):
    """A law of a user's own that is given sums, and does not use them."""

    def update(self, model, view, memory):
        v = self.gain.feedback(model, view.x, view.disagreement, self.angle)
        return model.physical(-v, trim=True), memory


def test_nothing_is_claimed_of_sums_that_do_not_act_or_of_loops_that_grow():
    leader, tree = ech.laws.Tracking(LINE), ech.Graph.path(4)
    own = Deaf(gain_for(PLANAR, tree), integral=True)
    # A fifth of the least coupling, 1/(2 lambda_min).
    weak = follower(PLANAR, True, tree, 0.1 / tree.spectrum().low)
    for follows, said in ((own, []), (weak, ["not needed"])):
        parts = parts_of(PLANAR, leader, follows, tree)
        lines = [x for x in check(parts, STEPS).lines if x.statement is Topic.INTEGRAL]
        assert [str(x.verdict) for x in lines] == said
        assert not any("constant pushes" in x.text for x in lines)


class Stubborn(ech.models.DoubleIntegrator):
    """A point of which the force moves both coordinates alike, but the second twice as much."""

    input_names, input_units = ("force",), ("m/s^2",)

    def input_map(self, x):
        return super().input_map(x) @ np.array([[1.0], [2.0]])


POINT = ech.models.DoubleIntegrator()
REACTS = ech.laws.Tracking(LINE, reaction=gain_for(POINT), integral=True)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: follower(POINT, -1.0), "weights that are not negative"),
        (lambda: follower(POINT, (1.0, np.inf, 1.0)), "weights that are not negative"),
        (lambda: follower(POINT, 0.0), "at least one above 0"),
        (lambda: parts_of(POINT, ech.laws.TrimInput(), follower(POINT, (1.0,) * 3)), "3 weights"),
        (lambda: parts_of(POINT, REACTS, follower(POINT, True)), "reacts to its neighbours"),
        (
            lambda: parts_of(POINT, follower(POINT, None), follower(POINT, True)),
            "the mean of all agents would drift",
        ),
        (
            lambda: parts_of(POINT, follower(POINT, True), follower(POINT, None)),
            "the mean of all agents would drift",
        ),
    ],
)
def test_what_cannot_be_summed_is_refused_before_the_run(make, message):
    with pytest.raises(EchelonError, match=message):
        guarantee(make(), STEPS)


@pytest.mark.parametrize(
    ("model", "gain", "weights", "message"),
    [
        (ech.models.Pendulum(), None, True, "positions and headings, and `Pendulum` has none"),
        (Stubborn(dimension=2), np.eye(4), True, "its inputs can hold 1 at most"),
        (ech.models.Quadrotor.crazyflie(), None, (1.0, 0.0, 1.0, 1.0), "one of `x`, `y`"),
        (POINT, np.ones(4), True, "needs a gain whose P satisfies"),
    ],
)
def test_outputs_that_inputs_cannot_hold_are_refused(model, gain, weights, message):
    method = ech.gains.Riccati() if gain is None else ech.gains.FixedGain(P=gain)
    law = ech.laws.Consensus(ech.synthesize(model, SQUARE, method), integral=weights)
    with pytest.raises(EchelonError, match=message):
        law.prepared(model, SQUARE)


def test_speeds_of_a_trim_that_moves_are_stated_with_sums_too():
    parts, settings = ech.build(ech.load_scenario("boats", ["follower.integral=true"]))
    line = guarantee(parts, settings).hypotheses[Hypothesis.SPEEDS]
    # A thruster at its limit ends the range, with sums and without.
    assert line.verdict is Verdict.HOLDS and line.number_text == "0 to 3.08 m/s"
