"""Directed and switching graphs: spectra, decreasing norms, guarantees, second computations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
import scipy.linalg
from in_words import in_words
from oracles import delayed_abscissa

import echelon as ech
from echelon import Agent, EchelonError, check, guarantee
from echelon.agents.models.linearization import linearize
from echelon.agents.network.hearing import heard_along
from echelon.core.digits import at_most
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis, Topic
from echelon.core.words import Kind, Verdict
from echelon.guarantees.stopping.stopping_run import stopping_run_of
from echelon.guarantees.stopping.tube import tube_of
from echelon.guarantees.verifier.verify import verify
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.records import Steps
from echelon.simulation.step.sequence import begin, control, step

CARTS = ech.models.DoubleIntegrator(2)
RING = ech.Graph([(0, 1), (1, 2, 2.0), (2, 3), (3, 1, 0.5)], directed=True)
TURNS = [(0.0, [(0, 1), (1, 2)]), (0.7, [(0, 2), (2, 1, 0.5)])]


def arrows(draw, most=8):
    """Edges of a random directed graph in which agent 0 reaches everybody."""
    n = int(draw.integers(2, most + 1))
    pairs = {(int(draw.integers(k)), k) for k in range(1, n)}
    some = {tuple(map(int, pair)) for pair in draw.integers(0, n, (int(draw.integers(12)), 2))}
    pairs |= {(i, j) for i, j in some if i != j}
    order = np.append(0, 1 + draw.permutation(n - 1))
    return [(int(order[i]), int(order[j]), float(np.exp(draw.normal()))) for i, j in sorted(pairs)]


def grounded(edges, agents):
    """L_g by hand: whoever hears others has their weights on the diagonal."""
    L = np.zeros((agents, agents))
    for i, j, w in edges:
        L[j, j] += w
        L[j, i] -= w
    return L[1:, 1:]


def test_spectra_of_arrows_are_those_of_their_matrix_and_a_sum_falls_on_them():
    draw = np.random.default_rng(0)
    for _ in range(200):
        edges = arrows(draw)
        graph = ech.Graph(edges, directed=True)
        L, found = grounded(edges, graph.agents), graph.spectrum()
        np.testing.assert_allclose(graph.grounded_laplacian().toarray(), L, atol=1e-13)
        values = np.linalg.eigvals(L)
        # Half the digits where L is defective; the product of all is known to more.
        assert found.low == pytest.approx(values.real.min(), rel=1e-6)
        assert np.prod(found.eigenvalues).real == pytest.approx(np.linalg.det(L), rel=1e-9)
        W = np.diag(found.sums)
        assert found.proved >= 0.89 * found.low
        held = W @ L + L.T @ W - 2.0 * found.proved * W
        assert np.linalg.eigvalsh(held)[0] >= -1e-14 * np.abs(held).max()


def test_a_chain_heard_one_way_has_one_eigenvalue_whatever_its_order():
    order = np.append(0, 1 + np.random.default_rng(1).permutation(30))
    graph = ech.Graph([(order[k], order[k + 1]) for k in range(30)], directed=True)
    assert np.array_equal(graph.spectrum().eigenvalues, np.ones(30))
    assert graph.parents()[order[7]] == order[6] and graph.depths()[order[30]] == 30
    assert graph.neighbours(int(order[5])) == (order[4],)


def test_one_way_everybody_hears_those_that_are_nearer_to_a_leader():
    drawn = ech.Graph.geometric(30, 0.35, seed=2, leaders=(0, 7))
    heavy = ech.Graph([(i, j, 1.0 + i + 0.1 * j) for i, j in drawn.edges], drawn.leaders)
    y = np.random.default_rng(0).normal(size=(30, 2))
    for graph in (drawn, heavy, ech.Graph.grid(4, 5), ech.Graph.complete(6)):
        # NetworkX knows how far everybody is, and the sums are written out.
        far = nx.multi_source_dijkstra_path_length(
            nx.Graph(graph.edges.tolist()), set(graph.leaders)
        )
        wanted = np.zeros((graph.agents, 2))
        for (i, j), w in zip(graph.edges.tolist(), graph.weights, strict=True):
            for a, b in ((i, j), (j, i)):
                wanted[a] += w * (far[b] < far[a]) * (y[a] - y[b])
        one_way = graph.one_way()
        assert one_way.directed and one_way.leaders == graph.leaders
        with precision("float64"):
            found = one_way.disagreement(jnp.asarray(y[: graph.agents]))
        np.testing.assert_allclose(found, wanted, atol=1e-13)
        np.testing.assert_array_equal(one_way.one_way().edges, one_way.edges)
    scenario = ech.load_scenario(
        "paper", ["graph={name: grid, rows: 2, columns: 2, directed: true}"]
    )
    assert ech.build(scenario)[0].graph == ech.Graph.grid(2, 2).one_way()


def test_weights_that_floats_can_hardly_add_keep_their_smallest_eigenvalue():
    # Of a circle of two, one light way in: the determinant over the trace, to rounding.
    graph = ech.Graph([(0, 1, 1e-9), (1, 2), (2, 1)], directed=True)
    assert graph.spectrum().low == pytest.approx(1e-9 / (2.0 + 1e-9), rel=1e-6)


def test_who_hears_along_an_edge_is_who_has_the_other_as_a_neighbour():
    pairs = [[0, 1], [1, 2], [2, 1], [3, 2], [1, 3], [0, 4], [4, 3]]
    for directed, edges in ((True, pairs), (False, [[1, 0], [1, 2], [3, 2], [1, 3], [0, 4]])):
        graph = ech.Graph(edges, [0, 4], directed=directed)
        depth = graph.depths()
        for leaderward, reacts in ((False, True), (False, False), (True, False)):
            heard = heard_along(graph, leaderward, reacts)
            for pair, ends in zip(graph.edges.tolist(), heard.tolist(), strict=True):
                for (me, other), hears in zip((pair, pair[::-1]), ends, strict=True):
                    told = not directed or [other, me] == pair
                    near = depth[other] < depth[me] or not leaderward
                    assert hears == (told and near and (reacts or me not in graph.leaders))


def test_networkx_means_the_same_by_arrows():
    given = nx.DiGraph([(0, 1), (1, 2), (2, 1)])
    graph = ech.Graph.from_networkx(given)
    assert graph.directed and np.array_equal(graph.outgoing().toarray(), nx.to_numpy_array(given))
    assert np.array_equal(graph.adjacency().toarray(), nx.to_numpy_array(given).T)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: ech.Graph([(0, 1), (2, 1)], directed=True), "agent 2 has no path to a leader"),
        (lambda: ech.Graph([(0, 1), (0, 1)], directed=True), r"edge \[0, 1\] is given twice"),
        (lambda: ech.Graph([(0, 1, -1.0)], directed=True), "must be positive, at most"),
        (lambda: ech.Graph([(0, 1)], weights=[1.0, 2.0]), "1 edge and 2 weights"),
        (
            lambda: ech.Graph([(0, 1, 1.0)], weights=[1.0]),
            "must be .i, j. where `weights` are listed separately",
        ),
        (
            lambda: ech.Graph.switching([(0.0, [(0, 1), (1, 2)]), (3.0, [(0, 1)])]),
            "agent 2 has no path to a leader .leader 0. from 3 s on, after the last switch",
        ),
        (
            lambda: ech.Graph.switching([(0.0, [(0, 1)]), (1.0, [(0, 2)])], agents=4, period=2.0),
            "agent 3 has no path to a leader .leader 0. in a window of 2 s",
        ),
        (lambda: ech.Graph.switching([(0.0, [(0, 1)]), (0.0, [])]), "times must ascend from 0"),
        (lambda: ech.Graph.switching(TURNS, period=0.5), "must be longer than the last switch"),
        (lambda: ech.Graph.switching(TURNS).parents(), "no one parent for all times"),
        (lambda: RING.parents(), "agent 1 has more than one agent to hear"),
    ],
)
def test_graphs_that_leave_agents_behind_are_told_with_what_would_do(make, text):
    with pytest.raises(EchelonError, match=text):
        make()


def test_riccati_gains_hold_every_arrow_from_their_edge_on_and_a_weighted_sum_falls():
    draw = np.random.default_rng(2)
    for _ in range(40):
        n, m = int(draw.integers(1, 5)), int(draw.integers(1, 3))
        A, B = draw.normal(size=(n, n)), draw.normal(size=(n, m))
        graph = ech.Graph(arrows(draw), directed=True)
        P = scipy.linalg.solve_continuous_are(A, B, np.eye(n), np.eye(m))
        L, K, spectrum = graph.grounded_laplacian().toarray(), B.T @ P, graph.spectrum()
        edge = 0.5 / spectrum.low
        whole = np.kron(np.eye(len(L)), A) - edge * np.kron(L, B @ K)
        assert np.linalg.eigvals(whole).real.max() < 0.0
        # T7: of c with 2 c proved >= 1 the sum with weights falls at any slope of Q's.
        c = 0.5 / spectrum.proved
        whole = np.kron(np.eye(len(L)), A) - c * np.kron(L, B @ K)
        V = np.kron(np.diag(spectrum.sums), P)
        slope = V @ whole + whole.T @ V + np.kron(np.diag(spectrum.sums), np.eye(n))
        assert np.linalg.eigvalsh(slope)[-1] <= 1e-8 * np.abs(V).max() * np.abs(whole).max()


def network(graph, gain):
    """The linear network as a whole: I kron A, L kron B K."""
    A, B = linearize(CARTS)
    L = graph.grounded_laplacian().toarray()
    K = gain.coupling * gain.R_inverse @ B.T @ gain.P
    return np.kron(np.eye(len(L)), A), np.kron(L, B @ K)


def parts_of(graph, leader, law, position, model=CARTS):
    formation = ech.Formation.from_offsets(model, graph, {1: (1.0, 0.5)})
    return ech.Parts(model, graph, formation, ech.Laws(leader, law), {"position": position})


def flown(graph, gain):
    return parts_of(graph, ech.laws.TrimInput(), ech.laws.Consensus(gain), 1.0)


def lines_of(parts, settings=ech.Settings(4.0, 0.01)):
    return {line.statement: line for line in check(parts, settings).lines}


@pytest.mark.parametrize("period", [None, 1.0])
def test_graphs_take_turns_at_their_times(period):
    schedule = ech.Graph.switching(TURNS, period=period).schedule
    steps, rows = schedule.switches(0.1, 3.0)
    held = rows[np.searchsorted(steps, np.arange(30), side="right") - 1]
    phase = np.arange(30) % (10 if period else 1000)
    assert np.array_equal(held, (phase >= 7).astype(int))
    assert [schedule.row(0.1 * k) for k in range(30)] == held.tolist()


def by_hand(parts, gain, horizon, dt):
    """Followers' deviations behind a leader at rest, by the exact flow of a held input."""
    A, B = linearize(CARTS)
    K = gain.coupling * gain.R_inverse @ B.T @ gain.P
    flow = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((2, 6))]]))[:4]
    deviation = ech.simulate(parts, ech.Settings(dt, dt)).errors[0, 1:]
    for k in range(round(horizon / dt)):
        schedule = parts.graph.schedule
        row = 0 if schedule is None else schedule.row(k * dt)
        u = -parts.graph.stretches()[row] @ deviation @ K.T
        deviation = np.concatenate([deviation, u], axis=1) @ flow.T
    return deviation


def test_linear_agents_fly_as_their_matrices_say():
    graph = ech.Graph.switching(TURNS, directed=True, period=1.5)
    gain = ech.synthesize(CARTS, graph, ech.gains.Riccati())
    parts = flown(graph, gain)
    result = ech.simulate(parts, ech.Settings(4.0, 0.05))
    np.testing.assert_allclose(result.errors[-1, 1:], by_hand(parts, gain, 4.0, 0.05), atol=1e-12)


def test_native_steps_are_those_of_jax_however_the_run_is_cut():
    graph = ech.Graph.switching(TURNS, period=0.93)
    parts = flown(graph, ech.synthesize(CARTS, graph, ech.gains.Riccati()))
    settings = ech.Settings(3.0, 0.01, engine="jax", store_every=50)
    slow = ech.simulate(parts, settings)
    found = [
        ech.simulate(parts, settings._replace(engine="native", store_every=every))
        for every in (50, 1)
    ]
    assert found[0].engine == "native"
    np.testing.assert_allclose(found[0].states, slow.states, atol=1e-12)
    # To the bit: a stretch that is stored in between is flown as one that is not.
    assert np.array_equal(found[0].states, found[1].states[::50])


@pytest.mark.slow
@pytest.mark.parametrize("directed", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_agents_by_themselves_are_those_of_the_simulation(directed):
    turns = [(0.0, [(0, 1), (1, 2)]), (0.05, [(0, 2)]), (0.1, [(0, 1), (2, 1, 0.5), (0, 2)])]
    parts = stopping(ech.Graph.switching(turns, directed=directed), 2.0, observer=False)
    result = ech.simulate(parts, ech.Settings(0.2, 0.01))
    agents = [Agent(parts, k, 0.01) for k in range(3)]
    for k, x in enumerate(result.states[:-1]):
        messages = [agent.hello(x[agent.number]) for agent in agents]
        for agent in agents:
            for j in {*agent.neighbours, 0} - {agent.number}:
                agent.receive(messages[j])
            u, messages[agent.number] = agent.step(0.01 * k, x[agent.number])
            np.testing.assert_allclose(u, result.inputs[k, agent.number], atol=1e-9)


def late_radius(A, G, steps, dt=0.01):
    """The spectral radius of x' = A x - G x(some steps ago), inputs held for a step."""
    n = len(A)
    flow = scipy.linalg.expm(dt * np.block([[A, -G], [np.zeros((n, 2 * n))]]))[:n]
    whole = np.eye(n * (steps + 1), k=-n)
    whole[:n, :n] = flow[:, :n]
    whole[:n, n * steps :] += flow[:, n:]
    return np.abs(np.linalg.eigvals(whole)).max()


@pytest.mark.parametrize("graph", [RING, ech.Graph([(0, 1), (1, 2), (1, 3)])])
def test_the_delay_that_is_left_is_that_of_the_delayed_network(graph):
    gain = ech.synthesize(CARTS, graph, ech.gains.Riccati())
    lines, whole = lines_of(flown(graph, gain)), network(graph, gain)
    delay, spread = lines[Topic.DELAY].number, lines[Topic.EIGENVALUE_RATIO]
    steps = round(delay / 0.01)
    assert late_radius(*whole, steps) < 1.0 < late_radius(*whole, steps + 1)
    values = np.linalg.eigvals(graph.grounded_laplacian().toarray())
    ratio = np.abs(values).max() / values.real.min()
    assert spread.number == pytest.approx(ratio) and spread.fails and ratio > 4.0
    assert f"{at_most(1e3 * delay)} ms;" in spread.text


def test_agreement_bears_the_delay_that_is_told():
    parts, settings = stopping(RING), ech.Settings(4.0, 0.01)
    c = float(prepare(parts, settings).parts.drive.follower.strength(0.01))
    L, delay = c * RING.grounded_laplacian().toarray(), lines_of(parts)[Topic.DELAY].number
    assert (
        delayed_abscissa(0.0 * L, L, 0.98 * delay)
        < 0.0
        < delayed_abscissa(0.0 * L, L, 1.02 * delay)
    )


def stopping(graph, position=3.0, observer=True, **law):
    leader = StoppingLeader(rate=3.0, observer=observer)
    return parts_of(graph, leader, StoppingPoint(rate=3.0, observer=observer, **law), position)


def test_what_is_promised_of_a_linear_law_on_arrows_is_its_modes():
    gain = ech.synthesize(CARTS, RING, ech.gains.Riccati())
    parts = flown(RING, gain)
    found, (drift, feedback) = guarantee(parts, ech.Settings(4.0, 0.01)), network(RING, gain)
    assert found.kind is Kind.LINEARIZATION and found.theorem is None
    # The inputs are held over a step of 0.01 s, exactly integrated for carts.
    flow = scipy.linalg.expm(0.01 * np.block([[drift, -feedback], [np.zeros((12, 24))]]))[:12]
    held = np.abs(np.linalg.eigvals(flow[:, :12] + flow[:, 12:])).max()
    assert found.rate == pytest.approx(-np.log(held) / 0.01, rel=1e-9) == -found.slowest
    low = np.linalg.eigvals(RING.grounded_laplacian().toarray()).real.min()
    assert gain.coupling == pytest.approx(1.0 / low, rel=1e-9)
    lines = lines_of(parts)
    assert lines[Topic.GRAPH].fails and Topic.DISTURBANCE_NETWORK not in lines


def test_a_region_on_arrows_is_smaller_by_their_skew_and_verified(tmp_path):
    method = ech.gains.RobustLQR(domain={"position": 5.0, "velocity": 5.0}, exact=True)
    small, whole = (ech.synthesize(CARTS, g, method) for g in (RING, ech.Graph.path(4)))
    regions = [each.certificate.region for each in (small, whole)]
    skew = RING.spectrum().sums.max() / RING.spectrum().sums.min()
    assert regions[0].radius == pytest.approx(regions[1].radius / np.sqrt(skew), rel=1e-9)
    file = tmp_path / "gain.json"
    ech.save_gain(small, CARTS, RING, file)
    assert verify(file).verdict == "verified"
    text = file.read_text()
    for old, new in (
        ('"directed": true', '"directed": false'),
        ("[3, 1, 0.5]", "[3, 1, 0.6]"),
        (f'"sums": {RING.spectrum().sums.tolist()}', '"sums": [0.1, 1.0, 0.1]'),
    ):
        assert old in text
        file.write_text(text.replace(old, new))
        assert verify(file).verdict == "refused", old


def test_of_graphs_that_take_turns_the_last_one_decides():
    settings, turns = ech.Settings(4.0, 0.01), ech.Graph.switching(TURNS)
    strong = ech.synthesize(CARTS, turns, ech.gains.Riccati())
    weak = ech.synthesize(CARTS, turns, ech.gains.Riccati(coupling=0.2 * strong.coupling))
    A, B = linearize(CARTS)
    flow = scipy.linalg.expm(0.01 * np.block([[A, B], [np.zeros((2, 6))]]))[:4]
    L = turns.stretches()[-1].toarray()
    for gain in (strong, weak):
        K = gain.coupling * gain.R_inverse @ B.T @ gain.P
        step = np.kron(np.eye(len(L)), flow[:, :4]) - np.kron(L, flow[:, 4:] @ K)
        found = guarantee(flown(turns, gain), settings)
        radius = np.abs(np.linalg.eigvals(step)).max()
        assert found.promised is bool(radius < 1.0)
        assert found.slowest == pytest.approx(np.log(radius) / 0.01, rel=1e-9)
    # A chain of arrows of 9 holds no sum of squares alone.
    heavy = ech.Graph.switching([(0.0, [(0, 1), (1, 2, 9.0)])], directed=True)
    with pytest.raises(EchelonError, match="no sum of errors' squares"):
        ech.synthesize(CARTS, heavy, ech.gains.Riccati())
    lost = ech.Graph.switching([(0.0, [(0, 1)]), (1.0, [(1, 2)])], period=2.0)
    with pytest.raises(EchelonError, match="agent 2 has no path to a leader from 0 to 1 s"):
        ech.synthesize(CARTS, lost, ech.gains.Riccati())


@pytest.mark.slow
def test_stopping_points_wait_for_links_and_agree_at_the_rate_of_a_period():
    graph = ech.Graph.switching([(0.0, [(0, 1)]), (0.5, [(1, 2)])], period=1.0)
    parts, settings = stopping(graph, observer=False), ech.Settings(16.0, 0.01)
    found = guarantee(parts, settings)
    assert found.kind is Kind.PROOF and "in every period" in in_words(found)
    assert found.hypotheses[Hypothesis.SWITCHING].verdict is Verdict.HOLDS
    size = np.linalg.norm(ech.simulate(parts, settings).errors[:, 1:], axis=(1, 2))
    assert np.log(size[900] / size[1500]) / 6.0 == pytest.approx(found.rate, rel=0.05)


def test_heard_leaderward_each_stretch_must_reach():
    turns = [(0.0, [(0, 1), (1, 2)]), (1.0, [(0, 2), (2, 1)])]
    with pytest.raises(EchelonError, match="from 1 s on where neighbours nearer"):
        guarantee(stopping(ech.Graph.switching(turns), hears="leaderward"), ech.Settings(4.0, 0.01))


ALL = [(i, j) for i in range(5) for j in range(1, 5) if i != j]


@pytest.mark.slow
def test_no_arrows_and_no_start_leaves_the_tube():
    model, graph = ech.models.Quadrotor(), ech.Graph(ALL, directed=True)
    drive = ech.Laws(StoppingLeader(observer=False), StoppingPoint(observer=False, coupling=2.0))
    formation = ech.Formation.from_offsets(model, graph, {})
    parts, settings = ech.Parts(model, graph, formation, drive), ech.Settings(1.0, 0.001)
    with precision("float64"):
        prepared = prepare(parts, settings)
        laws = prepared.parts.drive
        loop = assemble(prepared.problem, laws.leader, laws.follower)
        draw = np.random.default_rng(6)
        weights, x = worst(draw, 40, prepared.problem.states)
        ends = np.asarray(flights(loop, jnp.asarray(weights), jnp.asarray(x), settings.steps))
        assert np.isfinite(ends).all()
        tubes = [tube_of(stopping_run_of(prepared.parts, settings, each))[0] for each in x[:4]]
        left = min(tube.left for tube in tubes if tube is not None)
    assert ends.min() + model.gravity >= left >= 0.0 and None not in tubes


def worst(draw, count, states):
    """Weights of arrows (count, K) along which agent 0 reaches all, and far starts."""
    weights = draw.exponential(size=(count, len(ALL))) * (draw.random((count, len(ALL))) < 0.3)
    for row in weights:
        for j in range(1, 5):
            row[ALL.index((int(draw.integers(j)), j))] += 0.3
    x = np.repeat(np.asarray(states)[None], count, axis=0)
    x[:, 1:, :3] += draw.uniform(-20.0, 20.0, x[:, 1:, :3].shape)
    x[:, 1:, 5] += draw.uniform(-3.0, 3.0, x[:, 1:, 5].shape)
    x[:, 1:, 6:8] = draw.uniform(-0.7, 0.7, x[:, 1:, 6:8].shape)
    return weights, x


def flights(loop, weights, starts, steps):
    """The least upward acceleration of any follower in each flight (count,)."""

    def one(weights, x):
        mine = eqx.tree_at(lambda each: each.graph.exchange.weights, loop, weights)

        def on(_, done):
            now, least = done
            acted = control(mine, now, Steps(now.step, loop.motion.dt))
            tilt = jnp.cos(now.states[1:, 6]) * jnp.cos(now.states[1:, 7])
            lift = acted.inputs[1:, 0] / loop.model.mass * tilt - loop.model.gravity
            return step(mine, now), jnp.minimum(least, lift.min())

        return jax.lax.fori_loop(0, steps, on, (begin(mine, x), jnp.inf))[1]

    return jax.jit(jax.vmap(one))(weights, starts)


def test_a_pair_in_the_midst_of_a_spectrum_counts_for_the_step():
    # Sixty agents with real eigenvalues from 1 to 100, and three in a circle: 92 and 52i.
    star = [(0, i, 1.0 + 99.0 * (i - 1) / 59.0) for i in range(1, 61)]
    circle = [(61, 62, 60.0), (62, 63, 60.0), (63, 61, 60.0)]
    graph = ech.Graph([*star, (0, 61, 60.0), *circle], directed=True)
    gain = ech.synthesize(CARTS, graph, ech.gains.Riccati())
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    offsets = ech.Formation(np.zeros((64, 4)))
    parts = ech.Parts(CARTS, graph, offsets, drive, initial={"position": 1.0})
    longest = guarantee(parts, ech.Settings(1.0, 0.002)).longest_step(ech.Settings(1.0, 0.002))
    for share, holds in ((0.95, True), (1.2, False)):
        chosen = ech.Settings(200 * share * longest, share * longest)
        assert guarantee(parts, chosen).promised is holds
        errors = np.linalg.norm(ech.simulate(parts, chosen).errors[:, 61:], axis=(1, 2))
        assert bool(errors[-1] < errors[0]) is holds
