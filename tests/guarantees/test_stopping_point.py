"""The law `stopping-point` and theorem T5: second computations, and attacks on the proof."""

import itertools
import json
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from in_words import in_words

import echelon as ech
from echelon.agents.models.chains import Chains, chains_of, differentiate, look_for_chains, to_flat
from echelon.agents.models.model import FlatBound
from echelon.core.digits import at_least
from echelon.core.errors import EchelonError
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis
from echelon.core.words import Kind, Theorem, Verdict
from echelon.guarantees.promises.promise import guarantee
from echelon.guarantees.stopping.borders import Push, clearance_of
from echelon.guarantees.stopping.chain_response import Chain, largest_between, spread_between, value
from echelon.guarantees.stopping.stopping_run import stopping_run_of
from echelon.guarantees.stopping.tube import _falling, _in_turns, tube_of
from echelon.guarantees.verifier.verify import verify
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.sequence import begin, step

SLOW_ROOTS, FAST_ROOTS = (2.0, 2.5, 3.0), (4.0, 4.5, 5.0)
QUADROTOR = ech.models.Quadrotor()
PAPER_TREE = ech.Graph([(0, 1), (1, 2), (1, 3)])
LAWS = StoppingLeader, StoppingPoint


def companion(roots):
    """xdot = A x + b w for x = (v, v', ..) of q(D) v = -k0 w."""
    A = np.eye(len(roots), k=1)
    A[-1] = -np.poly(-np.array(roots))[:0:-1]
    return A, np.eye(len(roots))[-1] * A[-1, 0]


def kernels(roots, times):
    """The responses of v, v', .. to an impulse of w, (T, p), by matrix exponentials."""
    return along(*companion(roots), times)


def along(A, x, times):
    """x(t) of xdot = A x at equal times from 0 on, (T, p)."""
    flow, found = scipy.linalg.expm(A * times[1]), [x]
    for _ in times[1:]:
        found.append(flow @ found[-1])
    return np.stack(found)


KNOWN_GAINS = {
    SLOW_ROOTS: (1.0, 1.316872427983539, 3.712144786533218, 36.78897017202196),
    FAST_ROOTS: (1.0, 2.415919104, 12.392482658350794, 221.20388078803998),
}


@pytest.mark.parametrize(
    "roots", [SLOW_ROOTS, FAST_ROOTS, (1.0, 2.0), (3.0,), (0.7, 1.1, 1.9, 3.2)]
)
def test_gains_are_those_of_quadrature(roots):
    chain, p = Chain.of(roots), len(roots)
    gains = [float(chain.gain(k)) for k in range(p + 1)]
    times = np.linspace(0.0, 25.0 / min(roots), 20_001)
    responses = kernels(roots, times)
    areas = scipy.integrate.trapezoid(np.abs(responses), times, axis=0)
    # v^(p) = -k0 w - (the rest), so its kernel has an impulse of k0 beside that of A's last row.
    last = responses @ companion(roots)[0][-1]
    areas = np.append(areas, np.prod(roots) + scipy.integrate.trapezoid(np.abs(last), times))
    np.testing.assert_allclose(gains, areas, rtol=2e-5)
    np.testing.assert_allclose(gains, KNOWN_GAINS.get(roots, gains), rtol=1e-9)


def test_bounds_of_polynomials_are_above_and_near():
    draw = np.random.default_rng(0)
    for _ in range(20):
        terms = zip(draw.permutation(9)[:4] + 1, draw.integers(-9, 9, 4), strict=True)
        p = {int(n): Fraction(int(c)) for n, c in terms}
        low, high = sorted(Fraction(int(x), 16) for x in draw.permutation(17)[:2])
        values = [value(p, low + (high - low) * Fraction(k, 500)) for k in range(501)]
        assert 0 <= largest_between(p, low, high) - max(values) < Fraction(1, 50)
        moved = sum(abs(b - a) for a, b in itertools.pairwise(values))
        assert 0 <= spread_between(p, low, high) - moved < Fraction(1, 50)


def test_a_start_without_any_push_decays_as_its_matrix_says():
    chain, start = Chain.of(FAST_ROOTS), (Fraction(2), Fraction(-3), Fraction(5))
    p = chain.free(start)
    for t in (0.0, 0.3, 1.1):
        x = Fraction(np.exp(-float(chain.unit) * t))
        exact = scipy.linalg.expm(companion(FAST_ROOTS)[0] * t) @ np.array(start, float)
        ours = [float(value(chain.derivative(p, k), x)) for k in range(3)]
        np.testing.assert_allclose(ours, exact, atol=1e-12)


@pytest.mark.parametrize("roots", [SLOW_ROOTS, FAST_ROOTS])
def test_no_push_leaves_the_tube_and_the_worst_nearly_does(roots):
    # Bang-bang, matched to the impulse response backward from the time that is looked at.
    s, s0 = Fraction("1.5"), Fraction("0.5")
    start, led = (Fraction(3), Fraction(0), Fraction(0)), (Fraction(-1), Fraction(2), Fraction(0))
    found = clearance_of(Chain.of(roots), 1, (Push(led, s0), Push(start, s)), Fraction(20))
    times = np.linspace(0.0, 6.0, 3001)
    A, _ = companion(roots)
    both = np.array(start, float) + np.array(led, float)
    free = along(A, both, times)[:, 1]
    grown = scipy.integrate.cumulative_trapezoid(
        np.abs(kernels(roots, times)[:, 1]), times, initial=0.0
    )
    worst = (2.0 * grown - free).max()
    assert worst <= float(found.fall) <= 1.05 * worst


def test_the_room_of_the_quadrotors_designs():
    g = Fraction("9.81")
    for roots, s, left in ((SLOW_ROOTS, "0.7", 8.888), (FAST_ROOTS, "2.5", 3.770)):
        room = clearance_of(Chain.of(roots), 1, (Push((), Fraction(s)),), g)
        assert float(g - room.fall) == pytest.approx(left, abs=1e-3)
        # A start that is a little less steep stays in, one that is a little steeper need not.
        for factor, fits in ((Fraction(99, 100), True), (Fraction(12, 10), False)):
            start = (factor * room.steepest, Fraction(0), Fraction(0))
            pushes = (Push(start, Fraction(s)),)
            assert (clearance_of(Chain.of(roots), 1, pushes, g).fall < g) == fits


def test_the_time_of_arrival_is_that_of_its_equation():
    times = np.linspace(0.0, 8.0, 400)
    for start, c, w, s in ((30.0, 5.0, 3.0, 2.0), (0.4, 8.0, 1.5, 2.0), (3.0, 2.0, 1.0, np.inf)):
        m = _falling(start, c, w, s, times)
        exact = scipy.integrate.solve_ivp(
            lambda t, m: -c * m / np.sqrt(1.0 + (c * m / s) ** 2) / w,
            (0.0, 8.0),
            [start],
            t_eval=times,
            rtol=1e-11,
            atol=1e-14,
        ).y[0]
        np.testing.assert_allclose(m, exact, rtol=1e-6, atol=1e-10)
        assert (m >= exact * (1.0 - 1e-8) - 1e-12).all()


def test_agreement_does_on_random_graphs_what_the_theorem_says():
    # Of the equation alone, zeta' = -sigma(c z), with L and w of NumPy.
    draw = np.random.default_rng(3)
    for directed in (False, True) * 4:
        n, c, s = 5, float(draw.uniform(0.3, 4.0)), float(draw.uniform(0.2, 3.0))
        A = draw.exponential(size=(n, n)) * (draw.random((n, n)) < 0.4) * (1.0 - np.eye(n))
        A += np.eye(n, k=-1)
        A = A if directed else np.maximum(A, A.T)
        led = np.eye(n)[0] + draw.exponential(size=n) * (draw.random(n) < 0.2)
        L = np.diag(A.sum(axis=1) + led) - A
        w, d_max = np.linalg.solve(L, np.ones(n)), L.diagonal().max()
        assert (w > 0.0).all()
        x = draw.uniform(-3.0, 3.0, n)
        for _ in range(300):
            z = L @ x
            pull = c * z / np.sqrt(1.0 + (c * z / s) ** 2)
            top, scaled = np.abs(x).argmax(), (np.abs(x) / w).argmax()
            m = abs(x[scaled]) / w[scaled]
            # Statements 2, 3 and 5, and V' of the paper's V where both ends of an edge hear.
            assert pull[top] * np.sign(x[top]) >= 0.0
            fall = c * m / np.sqrt(1.0 + (c * m / s) ** 2)
            assert pull[scaled] * np.sign(x[scaled]) >= fall * (1.0 - 1e-9)
            assert np.abs(x - pull / (c * d_max)).max() <= np.abs(x).max() * (1.0 + 1e-12)
            assert directed or -(z @ pull) <= 0.0
            x = x - 0.2 / (c * d_max) * pull


MODELS = ("SingleIntegrator", "DoubleIntegrator", "Pendulum", "VanDerPol", "Unicycle")
VEHICLES = ("PlanarQuadrotor", "Quadrotor", "QuadrotorEuler", "QuadrotorThrust")


@pytest.mark.parametrize(
    "name", [*MODELS, *(pytest.param(name, marks=pytest.mark.study) for name in VEHICLES)]
)
def test_a_model_has_the_chains_that_it_states(name):
    model = getattr(ech.models, name)()
    stated = chains_of(model)
    with precision("float64"):
        found = look_for_chains(model, stated.outputs, stated.integrators)
    assert isinstance(found, Chains) and found.degrees == stated.degrees
    assert sum(found.degrees) == len(model.state_names) + sum(found.integrators)


def test_chains_are_found_where_nothing_is_stated():
    class Cart(ech.ControlAffine):
        state_names = ("place", "heading")
        input_names = ("speed", "turn")

        def drift(self, x):
            return 0.0 * x

        def input_map(self, x):
            return jnp.stack([jnp.stack([jnp.cos(x[1]), 0.0 * x[0]]), jnp.array([0.0, 1.0])])

    assert chains_of(Cart())[1:] == ((1, 1), (0, 0), ())


def test_a_model_without_chains_is_told_what_is_missing():
    for model, why in (
        (ech.models.UnicyclePoint(), "hold 2 of 3 states"),
        (ech.models.PrintedQuadrotor(), "rank 2 of 4"),
    ):
        with pytest.raises(EchelonError, match=why):
            StoppingPoint().prepared(model, PAPER_TREE)


def test_a_quadrotors_flat_coordinates_are_its_derivatives_along_its_motion():
    # By finite differences of the motion itself, which share nothing with the formulas.
    draw, chains = np.random.default_rng(1), chains_of(QUADROTOR)
    with precision("float64"):
        one = jax.jit(lambda x, e: to_flat(QUADROTOR, chains, x, e).values)
        invert = jax.jit(lambda x, e, tops: to_flat(QUADROTOR, chains, x, e).invert(tops))
        move = jax.jit(lambda x, u: QUADROTOR.velocity(x, u))
        for _ in range(5):
            x, e = draw.uniform(-0.7, 0.7, 12), draw.uniform(-2.0, 2.0, 2)
            tops = draw.uniform(-5.0, 5.0, 4)
            w = np.asarray(invert(x, e, tops))
            h = 1e-5

            def along(sign):
                v = np.concatenate([e[:1] + sign * h * e[1:], w[1:]])
                middle = np.concatenate([e[:1] + 0.5 * sign * h * e[1:], w[1:]])
                half = x + 0.5 * sign * h * np.asarray(move(x, QUADROTOR.physical(v)))
                x1 = x + sign * h * np.asarray(move(half, QUADROTOR.physical(middle)))
                return np.asarray(one(x1, e + sign * h * np.array([e[1], w[0]])))

            rates = (along(1.0) - along(-1.0)) / (2.0 * h)
            values = np.asarray(one(x, e))
            np.testing.assert_allclose(rates[:3, :3], values[1:, :3], atol=1e-4)
            np.testing.assert_allclose(rates[3, :3], tops[:3], atol=1e-3)
            np.testing.assert_allclose(
                [rates[0, 3], rates[1, 3]], [values[1, 3], tops[3]], atol=1e-3
            )


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES[:2])
def test_flat_coordinates_are_those_of_automatic_differentiation(name):
    model, draw = getattr(ech.models, name)(), np.random.default_rng(1)
    chains = chains_of(model)
    with precision("float64"):
        for _ in range(3):
            sizes = (0.7, len(model.state_names)), (2.0, 2), (5.0, len(chains.degrees))
            x, e, tops = (jnp.asarray(draw.uniform(-most, most, n)) for most, n in sizes)
            ours, theirs = (f(model, chains, x, e) for f in (to_flat, differentiate))
            np.testing.assert_allclose(ours.values, theirs.values, atol=1e-12)
            np.testing.assert_allclose(ours.invert(tops), theirs.invert(tops), atol=1e-10)


CARTS = ech.models.DoubleIntegrator()
CIRCLE = ech.references.Circle(radius=2.0, rate=0.7)


def flight(graph=PAPER_TREE, model=CARTS, leader=None, world=None, offsets=None, spread=5.0, **law):
    """Parts under the law: a leader on a circle, followers up to some metres off."""
    shared = {k: law[k] for k in ("roots", "rate", "observer") if k in law}
    leading = StoppingLeader(reference=CIRCLE, **shared, **(leader or {}))
    formation = ech.Formation.from_offsets(model, graph, offsets or {1: (1.0, 0.5)})
    drive = ech.Laws(leading, StoppingPoint(**law))
    initial = {"position": spread}
    return ech.Parts(model, graph, formation, drive, initial=initial, world=world or ech.World())


def fly(parts, horizon=12.0, **settings):
    return ech.simulate(parts, ech.Settings(**{"horizon": horizon, "dt": 0.01, **settings}))


def gaps(result):
    return np.linalg.norm(result.errors[:, 1:, :2], axis=2)


def test_without_any_chain_a_step_is_that_of_the_linear_law():
    # A velocity that is commanded is zeta' itself, so Euler makes e+ = (I - c dt L) e.
    model, c, dt, steps = ech.models.SingleIntegrator(2), 0.8, 0.05, 40
    parts = flight(model=model, coupling=c, speed=np.inf, observer=False)
    result = fly(parts, steps * dt, dt=dt, integrator="euler")
    step = np.eye(3) - c * dt * PAPER_TREE.grounded_laplacian().toarray()
    wanted = np.linalg.matrix_power(step, steps) @ result.errors[0, 1:]
    np.testing.assert_allclose(result.errors[-1, 1:], wanted, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("hears", ["leaderward", pytest.param("all", marks=pytest.mark.slow)])
def test_the_farthest_stopping_point_never_moves_away(hears):
    graph = ech.Graph([(0, 1, 0.4), (1, 2, 2.5), (2, 3), (1, 3, 0.7), (3, 4, 1.9)])
    parts, settings = flight(graph, hears=hears, observer=False), ech.Settings(6.0, 0.01)
    prepared = prepare(parts, settings)
    result = fly(parts, 6.0)
    flat = [stopping_run_of(prepared.parts, settings, x).flat for x in result.states[::20]]
    weights = prepared.parts.drive.follower.loop.weights
    stops = np.stack([np.einsum("rm,nrm->nm", weights, each) for each in flat])
    away = np.abs(stops[:, 1:] - stops[:, :1]).max(axis=1)
    assert (np.diff(away, axis=0) <= 1e-3 * away[0].max()).all()
    assert away[-1].max() < 0.05 * away[0].max()


@pytest.mark.study
def test_the_local_rate_is_the_slower_of_root_and_agreement():
    for c, rate in ((20.0, 2.0), (2.0, 2.0 * PAPER_TREE.spectrum().low)):
        result = fly(flight(roots=(2.0,), coupling=c, spread=0.05, observer=False), 8.0, dt=0.005)
        size = gaps(result).max(axis=1)
        late, later = size[1000], size[1400]
        assert np.log(late / later) / 2.0 == pytest.approx(rate, rel=0.12)


@pytest.mark.study
def test_told_by_its_parent_each_link_is_alone():
    # e' = -sigma(c e) on every link of a chain, whatever its length: 8 links take no longer than 2.
    ends = []
    for links in (2, 8):
        graph = ech.Graph.path(links + 1)
        states = np.zeros((links + 1, 4))
        states[:, 0] = np.arange(links + 1)[::-1] * 1.0
        parts = flight(graph, feedforward="parent", observer=False).replace(initial=states)
        found = gaps(fly(parts, 8.0))
        ends.append(float((found < 0.01).all(axis=1).argmax()))
    assert ends[1] <= 1.4 * ends[0]


def test_the_step_alone_limits_a_coupling_that_is_left_open():
    prepared = prepare(flight(ech.Graph.path(12)), ech.Settings(horizon=1.0, dt=0.02)).parts
    c = float(prepared.drive.follower.strength(0.02))
    # Of two neighbours, and with room for the root 4.
    assert c == pytest.approx(1.0 / (2.0 * 0.02 * 1.08))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("graph", "law"), [(PAPER_TREE, {"rate": 3.0}), (ech.Graph.path(5), {"feedforward": "parent"})]
)
def test_native_steps_are_those_of_jax(graph, law):
    runs = [fly(flight(graph, **law), 1.0, engine=engine) for engine in ("native", "jax")]
    assert [run.engine for run in runs] == ["native", "jax"]
    np.testing.assert_allclose(runs[0].states, runs[1].states, atol=1e-11)
    np.testing.assert_allclose(runs[0].inputs, runs[1].inputs, atol=1e-9)


def promised(parts, **settings):
    return guarantee(parts, ech.Settings(**{"horizon": 10.0, "dt": 0.01, **settings}))


def outside(result):
    """The seconds after which all stay within 1 cm."""
    return 0.01 * (np.flatnonzero((gaps(result) >= 0.01).any(axis=1))[-1] + 1)


@pytest.mark.parametrize(
    ("graph", "told"),
    [(PAPER_TREE, "relay"), pytest.param(ech.Graph.path(5), "parent", marks=pytest.mark.slow)],
)
def test_integrators_are_promised_from_everywhere_and_arrive_in_time(graph, told):
    parts = flight(graph, rate=3.0, feedforward=told)
    found, flown = promised(parts), outside(fly(parts))
    assert found.theorem is Theorem.T5 and found.kind is Kind.PROOF
    assert "any state of any agent" in in_words(found)
    assert flown <= found.tube.arrival + 0.02 <= 1.6 * flown


def test_stopping_points_stay_within_what_turns_of_graphs_bound():
    rows = [(0.0, [(0, 3)]), (0.6, [(0, 1), (1, 2), (2, 3)]), (2.6, [(0, 1), (0, 2), (2, 3)])]
    graph, c, s, dt = ech.Graph.switching(rows), 4.0, 1.5, 1e-3
    stops, times = np.array([0.5, 4.0, -1.0, 0.3]), 0.01 * np.arange(801)
    found = _in_turns(stops, graph, StoppingPoint(), c, s, times)
    Ls, x = [L.toarray() for L in graph.stretches()], stops[1:] - stops[0]
    assert (np.diff(found.bounds, axis=1) <= 0.0).all()
    for k in range(8000):
        if k % 10 == 0:
            assert (np.abs(x) <= found.bounds[:, k // 10] * (1.0 + 1e-6)).all()
        z = c * (Ls[graph.schedule.row(k * dt)] @ x)
        x = x - dt * z / np.sqrt(1.0 + (z / s) ** 2)
    assert found.bounds[:, -1].max() < 0.2 < 3.0 < found.bounds[:, 60].max()


@pytest.mark.parametrize(("begin", "end"), [(0.051, 0.053), (0.051, 0.068), (0.05, 0.053)])
def test_a_turn_that_begins_between_two_times_is_bounded_from_its_beginning(begin, end):
    # For a moment follower 1 hears follower 2 alone, which is far off, and leaps toward it.
    slow = (0, 2, 0.0003)
    rows = [(0.0, [(0, 1, 1.0), slow]), (begin, [(2, 1, 1.0), slow]), (end, [(0, 1), (0, 2)])]
    graph, c = ech.Graph.switching(rows, [0], 3, directed=True), 1000.0
    stops, times = np.array([0.0, 0.0, 1.0]), 0.01 * np.arange(21)
    found = _in_turns(stops, graph, StoppingPoint(), c, np.inf, times)
    x, dt = stops[1:], 1e-4
    flows = [scipy.linalg.expm(-c * dt * L.toarray()) for L in graph.stretches()]
    for k in range(1500):
        # All over each cell, by the bound at its beginning.
        assert (np.abs(x) <= found.bounds[:, k // 100] * (1.0 + 1e-6)).all()
        x = flows[graph.schedule.row((k + 0.5) * dt)] @ x


def test_a_switch_between_two_steps_counts_from_the_next_step_on():
    # Until the switch nobody hears the leader; it is at 0.1 s, and the run takes it at 0.4 s.
    cut, chain, dt = [(1, 2), (2, 3)], [(0, 1), (1, 2), (2, 3)], 0.4
    late = ech.Graph.switching([(0.0, cut), (0.1, chain)], agents=4)
    run = {"rate": 1.0, "coupling": 0.5, "speed": np.inf}
    one, other = (
        promised(flight(graph, **run), dt=dt, horizon=40.0).tube.arrival
        for graph in (late, late.in_steps(dt))
    )
    assert one == other > 0.0
    assert late.in_steps(dt).schedule.starts.tolist() == [0.0, 0.4]
    assert late.in_steps(0.05) is late


def test_stretches_that_no_step_reaches_are_not_counted_on():
    chain, cut = [(0, 1), (1, 2), (2, 3)], [(1, 2), (2, 3)]

    def turning(begin, period):
        rows = [(0.0, cut), (begin, chain)]
        return flight(ech.Graph.switching(rows, agents=4, period=period), rate=3.0)

    steps, rows = turning(0.002, 0.01).graph.schedule.switches(0.01, 1.0)
    assert set(rows[steps < 100].tolist()) == {0}
    none = promised(turning(0.002, 0.01))
    assert not none.promised and "rounded up to steps of 0.01 s" in in_words(none)
    assert not promised(turning(0.5, float(np.pi))).promised
    found = promised(turning(0.1, 1 / 3))
    schedule = found.run.parts.graph.schedule
    assert found.promised and schedule.period == pytest.approx(1.0)
    assert schedule.starts.tolist() == pytest.approx([0.0, 0.1, 0.34, 0.44, 0.67, 0.77])


@pytest.mark.parametrize(("period", "coupling"), [(2.0, 1e75), (1e75, 1e75)])
def test_large_couplings_and_periods_have_a_rate_that_is_no_more(period, coupling):
    chain, star = [(0, 1), (1, 2), (2, 3)], [(0, 1), (0, 2), (2, 3)]
    graph = ech.Graph.switching([(0.0, chain), (1.0, star)], period=period)
    # Warnings are errors here.
    found = promised(flight(graph, rate=3.0, coupling=coupling))
    assert found.rate is None or 0.0 <= found.rate <= 3.0


@pytest.mark.slow
@pytest.mark.parametrize("told", [True, False])
def test_graphs_that_take_turns_are_there_in_time_or_are_told_none(told):
    other = [(0, 1), (0, 2), (2, 3)] if told else [(0, 3), (3, 2)]
    graph = ech.Graph.switching([(0.0, [(0, 1), (1, 2), (2, 3)]), (1.0, other)], period=2.0)
    parts = flight(graph, rate=3.0)
    found = promised(parts)
    assert found.promised and (found.tube.arrival is not None) == told
    if told:
        flown = outside(fly(parts))
        assert flown <= found.tube.arrival + 0.02 <= 4.0 * flown


def test_a_vehicle_is_promised_as_far_as_its_thrust_reaches(tmp_path):
    found = guarantee(*ech.build(override()))
    assert found.claimed and found.kind is Kind.PROOF and found.theorem is Theorem.T5
    assert found.tube.left == pytest.approx(3.770, abs=1e-3)
    assert found.tube.steepest == pytest.approx(5.6, abs=0.05)
    assert found.tube.gains == pytest.approx((1.0, 2.4159, 12.3925, 221.2039), rel=1e-4)
    assert found.tube.arrival < 3.3
    assert "roll and pitch within 90 deg" in in_words(found)
    # What verifies it computes its tube again, and refuses a false one.
    told, file = found.as_mapping(), tmp_path / "summary.json"

    def verified():
        file.write_text(json.dumps({"guarantee": told}))
        return verify(file)

    assert verified().verdict == "incomplete"
    assert verified().sentence.startswith("Incomplete: 6 claims hold")
    [border] = told["anywhere"]["borders"]
    for place, key, factor in (
        (border, "left", 1.01),
        (border, "steepest", 1.2),
        (border, "speed", 1.6),
        (border["gains"], 2, 1.0001),
    ):
        was, place[key] = place[key], place[key] * factor
        assert verified().verdict == "refused", key
        place[key] = was


def override(*changes):
    return ech.load_scenario("paper-global", overrides=list(changes))


TOO_STEEP = "is not proved to stay above -9.81"
LOWER = "lower the `speed` of `z` below 4.06"
TOO_LONG = "the leader's step `dt` = 0.005 s is too long: c dt = 15 is above 1"
UNHELD = {
    "follower.coupling=100": (Hypothesis.SAMPLING, "c d_max dt = 1.5 is above 1"),
    "leader.coupling=3000": (Hypothesis.SAMPLING, TOO_LONG),
    "follower.coupling=66.6": (Hypothesis.SAMPLING, "lower `coupling` or `roots`"),
    "follower.speed=[1,1,5,1]": (Hypothesis.SET, LOWER),
    "follower.speed=inf": (Hypothesis.SET, LOWER),
    "initial.spread={vz: 40}": (Hypothesis.STARTS, TOO_STEEP),
    "follower.roots=[4.0123, 4.5, 5]": (Hypothesis.REGION, "common unit"),
    "leader.start_error={z: 30, vz: 4}": (Hypothesis.STARTS, TOO_STEEP),
}


@pytest.mark.parametrize("change", UNHELD)
def test_what_the_tube_does_not_hold_is_told_with_what_would(change):
    line, text = UNHELD[change]
    found = guarantee(*ech.build(override(change)))
    assert not found.promised and found.theorem is None
    assert found.hypotheses[line].verdict is Verdict.FAILS
    assert text in in_words(found)


def test_a_push_that_carries_the_leader_away_is_told():
    wind = ech.World(disturbance=ech.Disturbance(constant={"vx": 12.0}))
    parts = flight(observer=False, world=wind)
    found = promised(parts)
    assert not found.promised and "drift away for ever" in in_words(found)
    assert promised(flight(observer=True, world=wind)).promised


def drifting(model, plant, reference, speed):
    """How fast a leader alone is carried off its path in the end, m/s, and its promise."""
    leader = StoppingLeader(reference=reference, observer=False, speed=speed)
    drive = ech.Laws(leader, StoppingPoint(observer=False))
    goals, world = ech.Formation(np.zeros((2, len(model.state_names)))), ech.World(plant=plant)
    parts = ech.Parts(model, ech.Graph([(0, 1)]), goals, drive, initial=None, world=world)
    settings = ech.Settings(horizon=40.0, dt=0.01, limits=False)
    result, found = ech.simulate(parts, settings), guarantee(parts, settings)
    place = list(model.position_indices())
    off = np.linalg.norm((result.states[:, 0] - result.reference)[:, place], axis=1)
    middle = len(off) // 2
    return (off[-1] - off[middle]) / (result.times[-1] - result.times[middle]), found


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_plant_with_drag_behind_a_straight_path_demands_its_drag(share):
    # The model lacks 0.8 * 2 m/s^2 along the path, of which agreement makes up 1 / root.
    demand = 0.8 * 2.0 / 4.0
    line = ech.references.Line(velocity=(2.0, 0.0, 0.0))
    plant = ech.models.DoubleIntegrator(2, drag=0.8)
    speed, found = drifting(CARTS, plant, line, share * demand)
    assert (speed > 0.01) == (share < 1.0) != found.promised
    assert (f"demands a speed of {at_least(demand)}" in in_words(found)) == (share < 1.0)


def test_drag_that_turns_with_the_path_demands_nothing_that_lasts():
    circle = ech.references.Circle(radius=2.0, rate=1.0)
    plant = ech.models.DoubleIntegrator(2, drag=0.8)
    speed, found = drifting(CARTS, plant, circle, 0.3)
    assert speed < 0.01 and found.promised


@pytest.mark.slow
@pytest.mark.parametrize("factor", [pytest.param(0.7, marks=pytest.mark.study), 1.3])
@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_plant_of_another_mass_demands_what_it_needs_at_rest(factor, share):
    k0, k1 = np.poly(-np.array([4.0, 4.5, 5.0]))[:1:-1]
    # The thrust at which it rests makes the model fall, or rise, by this.
    demand = k1 / k0 * 9.81 * abs(factor - 1.0)
    plant = ech.models.Quadrotor(mass=factor * QUADROTOR.mass)
    speed, found = drifting(QUADROTOR, plant, ech.references.Hover(), share * demand)
    assert (speed > 0.01) == (share < 1.0) != found.promised
    assert (f"demands a speed of {at_least(demand)}" in in_words(found)) == (share < 1.0)


@pytest.mark.parametrize("observer", [True, False])
def test_a_current_that_carries_the_leader_away_is_told_with_an_observer_too(observer):
    # It moves a position with no force: x' = v + d, which no rate of v shows.
    for push, drifts in ((1.4, False), (1.6, True)):
        current = ech.World(disturbance=ech.Disturbance(constant={"x": push}))
        found = promised(flight(observer=observer, world=current))
        assert ("drift away for ever" in in_words(found)) == drifts != found.promised
    assert "observer" not in in_words(found)
    assert "raise the leader's `speed` above 1.6" in in_words(found)


def test_parents_add_their_speeds():
    chain = ech.Graph.path(4)
    offsets = {k: (0.1 * k, 0.0, 0.0) for k in range(1, 4)}
    formation = ech.Formation.from_offsets(QUADROTOR, chain, offsets)
    leader = StoppingLeader(reference=ech.references.Hover())
    for speed, fits in ((0.8, True), (2.5, False)):
        drive = ech.Laws(leader, StoppingPoint(feedforward="parent", speed=speed))
        found = promised(ech.Parts(QUADROTOR, chain, formation, drive))
        assert found.claimed is fits
    # 9.81 / 2.4159 / 3 links.
    assert "below 1.35" in in_words(found)


@pytest.mark.parametrize("roots", [SLOW_ROOTS, FAST_ROOTS])
def test_speeds_that_are_left_out_are_what_the_thrust_bears(roots):
    most, z = QUADROTOR.gravity / float(Chain.of(roots).gain(1)), 2
    lead, law = (make(roots=roots).prepared(QUADROTOR, PAPER_TREE) for make in LAWS)
    assert 0.5 * most < law.speed_of(z) + lead.speed_of(z) < most or law.speed_of(z) == 2.5
    long = StoppingPoint(roots=roots, feedforward="parent")
    assert 0.9 * most < 29 * long.prepared(QUADROTOR, ech.Graph.path(30)).speed_of(z) < most


def test_a_law_that_makes_no_loop_is_refused():
    for law, text in (
        ({"roots": (4.0, 4.0, 5.0)}, "different from each other"),
        ({"roots": (-4.0, 4.0, 5.0)}, "must be a list of positive numbers"),
        ({"roots": (4.0, 5.0), "rate": 2.0}, "allowed is one of them"),
        ({"rate": 0.0}, "must be positive, at most"),
        ({"coupling": float("nan")}, "must be positive, at most"),
        ({"speed": -1.0}, "must be positive"),
        ({"feedforward": "none"}, "a leader that moves is lost"),
        # Numbers that do not fit the model.
        ({"roots": (4.0, 5.0)}, "needs 3"),
        ({"speed": (1.0, 2.0)}, "one for each of `x`, `y`, `z`"),
    ):
        with pytest.raises(EchelonError, match=text):
            StoppingPoint(**law).prepared(QUADROTOR, PAPER_TREE)


def test_parts_that_do_not_fit_each_other_are_refused():
    start = "initial.states={%d: [0,0,1,0,0,0,%s,%s,0,0,0,0]}"
    for change, text in {
        "leader.law=tracking": "give the leader the law `stopping-point` too",
        "leader.roots=[3,4,5]": "different `roots`",
        start % (2, "0", "1.8"): "agent 2 starts where its law has no",
        start % (1, "2.0", "0"): "roll and pitch within 90 deg",
    }.items():
        with pytest.raises(EchelonError, match=text):
            prepare(*ech.build(override(change)))


@pytest.mark.slow
def test_no_graph_and_no_start_leaves_the_tube():
    draw, slack = np.random.default_rng(0), np.inf
    with precision("float64"):
        for _ in range(3):
            slack = min(slack, attack(draw))
    # None below the bound, and the worst of them near it.
    assert 0.0 <= slack < 0.5


def attack(draw, starts=5):
    """Fly far and steep starts on a random graph; return by how much z'' stays above its bound."""
    # The bound is of continuous time: held for 2 ms, the steepest starts pass it by 0.1 m/s^2.
    parts, settings = random_parts(draw), ech.Settings(horizon=1.0, dt=0.0005, limits=False)
    prepared = prepare(parts, settings)
    loop = assemble(prepared.problem, prepared.parts.drive.leader, prepared.parts.drive.follower)
    x = np.repeat(prepared.problem.states[None], starts, axis=0)
    shape = (starts, x.shape[1] - 1)
    x[:, 1:, :3] += draw.uniform(-20.0, 20.0, (*shape, 3))
    x[:, 1:, 3:5] += draw.uniform(-5.0, 5.0, (*shape, 2))
    x[:, 1:, 5] += draw.choice([-1.0, 1.0], shape) * draw.uniform(3.0, 5.3, shape)
    x[:, 1:, 6:8] = draw.uniform(-1.1, 1.1, (*shape, 2))
    x[:, 1:, 8:] = draw.uniform(-3.0, 3.0, (*shape, 4))
    least = np.asarray(least_lift(loop, jnp.asarray(x), settings.steps))
    assert np.isfinite(least).all()
    tubes = [tube_of(stopping_run_of(prepared.parts, settings, one))[0] for one in x]
    assert all(tube is not None for tube in tubes)
    return min(low + QUADROTOR.gravity - t.left for low, t in zip(least.min(axis=1), tubes))


def random_parts(draw):
    pairs = [(a, int(draw.integers(a))) for a in range(1, 5)]
    more = [pair for pair in itertools.combinations(range(5), 2) if draw.random() < 0.2]
    pairs = {tuple(sorted(pair)) for pair in [*pairs, *more]}
    graph = ech.Graph([(a, b, float(np.exp(draw.uniform(-1.2, 1.2)))) for a, b in sorted(pairs)])
    offsets = {k: tuple(draw.uniform(-3.0, 3.0, 3)) for k in range(1, 5)}
    shared, hears = (
        {"roots": FAST_ROOTS, "observer": False},
        str(draw.choice(["all", "leaderward"])),
    )
    leader = StoppingLeader(reference=ech.references.Lemniscate(), **shared)
    drive = ech.Laws(leader, StoppingPoint(hears=hears, **shared))
    return ech.Parts(QUADROTOR, graph, ech.Formation.from_offsets(QUADROTOR, graph, offsets), drive)


def least_lift(loop, starts, steps):
    """The least z'' of each follower (S, N - 1) on the way from starts (S, N, n)."""
    chains = chains_of(QUADROTOR)

    def one(x):
        def on(_, done):
            now, least = done
            x, e = now.states[loop.laws.followers], now.memory.laws.follower.chain
            lift = jax.vmap(lambda x, e: to_flat(QUADROTOR, chains, x, e).values[2, 2])(x, e)
            return step(loop, now), jnp.minimum(least, lift)

        start = begin(loop, x), jnp.full(len(loop.laws.followers), jnp.inf)
        return jax.lax.fori_loop(0, steps, on, start)[1]

    return jax.jit(jax.vmap(one))(starts)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("roots", "speed", "within", "steady"),
    [
        (FAST_ROOTS, (1.75, 1.75, 2.5, 2.5), 2.4, 1e-11),
        (SLOW_ROOTS, (1.4, 1.4, 0.7, 2.0), 4.8, 1e-5),
    ],
)
def test_the_papers_starts_are_flown_without_a_limit_in_time(roots, speed, within, steady):
    changes = f"follower.roots={list(roots)}", f"follower.speed={list(speed)}"
    (parts, settings), times = ech.build(override(*changes)), []
    for seed in range(5):
        result = ech.simulate(parts, settings._replace(seed=seed, store_every=1))
        assert result.saturated.max() == 0.0
        error = np.linalg.norm(result.errors[:, 1:, :3], axis=2)
        assert np.sqrt((error[result.times >= 8.0] ** 2).mean()) <= steady
        times.append(0.005 * (np.flatnonzero((error >= 0.01).any(axis=1))[-1] + 1))
    assert np.median(times) <= within


class ListedBound(ech.models.PlanarQuadrotor):
    """Somebody's model, which names the outputs of its border in a list."""

    flat_chains = ech.models.PlanarQuadrotor.flat_chains

    @property
    def flat_bounds(self):
        return (FlatBound(["z"], 2, -self.gravity, "roll"),)


class NamedBound(ListedBound):
    """The same in a tuple."""

    @property
    def flat_bounds(self):
        return (FlatBound(("z",), 2, -self.gravity, "roll"),)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (ListedBound(), NamedBound()),
        (
            ech.models.Quadrotor(inertia=[1.4e-5, 1.4e-5, 2.17e-5]),
            ech.models.Quadrotor(inertia=(1.4e-5, 1.4e-5, 2.17e-5)),
        ),
    ],
)
def test_models_may_contain_lists(one, other):
    def told(model):
        drive = ech.Laws(ech.laws.StoppingLeader(), ech.laws.StoppingPoint())
        goals = ech.Formation(np.zeros((3, len(model.state_names))))
        graph = ech.Graph([(0, 1), (1, 2)])
        parts = ech.Parts(model, graph, goals, drive, initial={model.position[0]: 0.1})
        found = ech.guarantee(parts, ech.Settings(horizon=5.0, dt=0.01))
        return found.kind, found.tube, {k: (x.text, x.number) for k, x in found.hypotheses.items()}

    (kind, tube, lines), (same_kind, _, same_lines) = told(one), told(other)
    assert tube is not None and kind is same_kind
    names = type(one).__name__, type(other).__name__
    assert [(t.replace(names[0], names[1]), n) for t, n in lines.values()] == [*same_lines.values()]


def test_leaders_that_stay_apart_are_said_to_whatever_the_seed():
    model = ech.models.DoubleIntegrator()
    graph = ech.Graph([(0, 1), (1, 2), (2, 3), (3, 4)], leaders=[0, 4])
    places = {k: [float(k), 0.0] for k in range(5)}
    starts = np.array([[float(k), 0.0, 0.0, 0.0] for k in range(5)])
    starts[4, 0] = 4.5
    drive = ech.Laws(ech.laws.StoppingLeader(coupling=1e-10), ech.laws.StoppingPoint())
    formation = ech.Formation.from_offsets(model, graph, places)
    parts = ech.Parts(model, graph, formation, drive, initial=starts)
    for seed in (0, 7):
        found = ech.guarantee(parts, ech.Settings(horizon=5.0, dt=0.02, seed=seed))
        assert found.hypotheses[Hypothesis.LEADERS_AGREE].fails and not found.promised
