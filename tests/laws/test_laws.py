"""Control laws: the form for one agent equals the paper's block form; Theorem 1 in simulation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import adjacency, connected, disagreements, laplacian, quadrotor_input_map, spd
from runs import simulate

from echelon.agents.models import (
    DoubleIntegrator,
    Linear,
    PlanarQuadrotor,
    Quadrotor,
    QuadrotorEuler,
    QuadrotorThrust,
    SingleIntegrator,
    Unicycle,
    UnicyclePoint,
)
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.references import Circle, Hover, Lemniscate, Line
from echelon.core import numerics
from echelon.core.errors import EchelonError, LawError
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.scenario.sections import FollowerSpec
from echelon.laws import Agreement, Consensus, Law, LocalView, Tracking, TrimInput
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.gains import FixedGain, InnerLoop, Riccati
from echelon.synthesis.gains.gain import synthesize

LINE = Graph.path(4)
QUAD = Quadrotor()


def input_of(law, model, *, x, z=None, offset=None, said=None, t=0.0):
    """The input of one agent that knows what is given, in float64; zeros for what is not."""
    n, m = len(model.state_names), len(model.input_names)
    with numerics.precision("float64"):
        known = LocalView(
            t=jnp.asarray(t),
            x=jnp.asarray(x),
            offset=jnp.zeros(n) if offset is None else jnp.asarray(offset),
            disagreement=jnp.zeros(n) if z is None else jnp.asarray(z),
            feedforward=jnp.zeros(m) if said is None else jnp.asarray(said),
        )
        u, memory = law.update(model, known, law.init())
        assert memory is None
        return np.asarray(u)


def prepared(law, model, graph=LINE):
    with numerics.precision("float64"):
        return law.prepared(model, graph)


def input_map_of(model, x):
    """g at a state, written again."""
    if isinstance(model, Quadrotor):
        return quadrotor_input_map(x, model.mass, model.inertia)
    if isinstance(model, PlanarQuadrotor):
        push = np.array([-np.sin(x[2]), np.cos(x[2]), 0.0]) / model.mass
        spin = np.array([0.0, 0.0, 1.0 / model.inertia])
        return np.vstack([np.zeros((3, 2)), np.column_stack([push, spin])])
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.array([[c, -model.ahead * s], [s, model.ahead * c], [0.0, 1.0]])


MODELS = [UnicyclePoint(ahead=0.4), PlanarQuadrotor(), QUAD]
every_model = pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)


# ---- the paper's law ----


@every_model
@given(connected(most=6), st.integers(0, 10**6))
@settings(max_examples=8)
def test_one_agent_s_law_is_its_row_of_the_block_law(model, parts, seed):
    edges, leaders, agents = parts
    graph, rng = Graph.from_edges(*parts), np.random.default_rng(seed)
    n, m = len(model.state_names), len(model.input_names)
    x, xi = rng.uniform(-1.0, 1.0, (2, agents, n))
    P, R, c = spd(rng, n), spd(rng, m), rng.uniform(0.5, 3.0)
    law = Consensus(synthesize(model, graph, FixedGain(P=P, R=R, coupling=c)), "none")

    # The block form over followers: u = -c (I kron R^-1) G^T (I kron P) (e + d), in normalized
    # inputs, with e from the follower rows of the Laplacian and d from the displacements.
    pairs, weights = [edge[:2] for edge in edges], [edge[2] for edge in edges]
    rows = [k for k in range(agents) if k not in leaders]
    L = laplacian(agents, pairs, weights)[rows]
    e = np.kron(L, np.eye(n)) @ x.ravel()
    d = -(L @ xi).ravel()
    S, trim = np.array(model.input_scale), np.array(model.trim[1])
    G = scipy.linalg.block_diag(*[input_map_of(model, x[k]) @ S for k in rows])
    blocks = np.kron(np.eye(len(rows)), np.linalg.inv(R)) @ G.T @ np.kron(np.eye(len(rows)), P)
    v = (-c * blocks @ (e + d)).reshape(-1, m)

    with numerics.precision("float64"):
        z = np.asarray(graph.disagreement(jnp.asarray(x - xi)))
    for k, wanted in zip(rows, v, strict=True):
        u = input_of(law, model, x=x[k], z=z[k], offset=xi[k])
        assert np.linalg.solve(S, u - trim) == pytest.approx(wanted, rel=1e-9, abs=1e-9)


def test_at_unit_coupling_and_weight_it_is_the_printed_law():
    model, rng = Linear(np.eye(2), [[1.0, 0.5], [0.0, 2.0]]), np.random.default_rng(0)
    P = spd(rng, 2)
    law = Consensus(synthesize(model, LINE, FixedGain(P=P)), "none")
    z = rng.normal(size=2)
    wanted = -np.array([[1.0, 0.0], [0.5, 2.0]]) @ P @ z
    assert input_of(law, model, x=np.ones(2), z=z) == pytest.approx(wanted)


def test_on_a_quadrotor_the_printed_law_is_weighted_by_the_squares_of_its_scale():
    law = Consensus(synthesize(QUAD, LINE, FixedGain()), "none", trim=False)
    x, z = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 12))
    S = np.diag([QUAD.mass, *QUAD.inertia])
    wanted = -S @ S @ quadrotor_input_map(x, QUAD.mass, QUAD.inertia).T @ z
    assert input_of(law, QUAD, x=x, z=z) == pytest.approx(wanted, rel=1e-9, abs=1e-18)


@every_model
def test_the_trim_and_what_the_leader_says_are_added(model):
    gain = synthesize(model, LINE, FixedGain(coupling=2.0))
    rng = np.random.default_rng(2)
    n, m = len(model.state_names), len(model.input_names)
    x, z, said = rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), rng.uniform(-1, 1, m)
    S, trim = np.array(model.input_scale), np.array(model.trim[1])
    bare = input_of(Consensus(gain, "none", trim=False), model, x=x, z=z)
    assert input_of(Consensus(gain, "none"), model, x=x, z=z) == pytest.approx(
        bare + trim, rel=1e-12
    )
    told = input_of(Consensus(gain, feedforward="relay"), model, x=x, z=z, said=said)
    assert told == pytest.approx(bare + trim + S @ said, rel=1e-12)
    assert input_of(Consensus(gain, "none"), model, x=x) == pytest.approx(trim, abs=1e-15)


def test_a_law_says_what_it_needs_from_others():
    gain = synthesize(QUAD, LINE, FixedGain())
    others, leader = "neighbours' states", "the leader's input of the same step"
    assert Consensus(gain, "none").information == (others,)
    assert Consensus(gain, feedforward="relay").information == (others, leader)
    assert Agreement().information == (others,) and TrimInput().information == ()
    assert Tracking(Hover()).information == ("the reference",)
    assert Tracking(Hover(), reaction=gain).information == ("the reference", others)
    asked = [
        Consensus(gain, "none").feedforward,
        Consensus(gain, "relay").feedforward,
        TrimInput().feedforward,
    ]
    assert [str(each) for each in asked] == ["none", "relay", "none"]


def test_a_scenario_and_a_program_have_the_same_default_feedforward():
    gain = synthesize(QUAD, LINE, FixedGain())
    assert FollowerSpec().feedforward == str(Consensus(gain).feedforward) == "relay"


def test_laws_carry_the_metric_of_their_lyapunov_function():
    gain = synthesize(QUAD, LINE, Riccati())
    assert np.array_equal(Consensus(gain, "none").metric(QUAD), gain.P)
    assert np.array_equal(Agreement().metric(SingleIntegrator(2)), np.eye(2))
    assert TrimInput().metric(QUAD) is None and Tracking(Hover()).metric(QUAD) is None


# ---- the leader's law ----


@pytest.mark.parametrize("reacts", [False, True])
def test_the_leader_tracks_with_unit_coupling_and_reacts_with_the_followers_gain(reacts):
    rng = np.random.default_rng(3)
    model = DoubleIntegrator(2, drag=0.4)
    P, R, Pr, Rr = spd(rng, 4), spd(rng, 2), spd(rng, 4), spd(rng, 2)
    gain = synthesize(model, LINE, FixedGain(P=P, R=R, coupling=7.0))
    reaction = synthesize(model, LINE, FixedGain(P=Pr, R=Rr, coupling=3.0)) if reacts else None
    path = Circle(center=(1.0, 0.0, 0.0), radius=2.0, rate=0.5)
    law = prepared(Tracking(path, gain, reaction), model)

    t, (x, z, offset) = 1.3, rng.normal(size=(3, 4))
    th = 0.5 * t
    p = np.array([1.0 + 2.0 * np.cos(th), 2.0 * np.sin(th)])
    v, a = np.array([-np.sin(th), np.cos(th)]), -0.5 * np.array([np.cos(th), np.sin(th)])
    x_r, u_r = np.concatenate([p, v]), a + 0.4 * v
    g = np.vstack([np.zeros((2, 2)), np.eye(2)])
    wanted = u_r - np.linalg.solve(R, g.T @ P @ (x - x_r - offset))
    if reacts:
        wanted = wanted - 3.0 * np.linalg.solve(Rr, g.T @ Pr @ z)
    assert input_of(law, model, x=x, z=z, offset=offset, t=t) == pytest.approx(wanted)


def test_a_leader_on_its_reference_flies_the_feedforward_alone():
    law = prepared(Tracking(Lemniscate()), QUAD)
    with numerics.precision("float64"):
        x, u = map(np.asarray, law.target(QUAD, jnp.asarray(2.0)))
    assert input_of(law, QUAD, x=x, t=2.0) == pytest.approx(u, abs=1e-15)
    assert u[0] > 0.0


@pytest.mark.parametrize("model", [QuadrotorEuler(), QuadrotorThrust()])
def test_under_computed_torque_a_leader_stays_on_its_circle_but_for_held_inputs(model):
    law, formation = (
        Tracking(Circle(radius=1.5, rate=0.8)),
        Formation(np.zeros((2, len(model.trim[0])))),
    )

    def largest(dt):
        run = {"leader": law, "follower": TrimInput(), "horizon": 2.0, "dt": dt, "store_every": 10}
        result = simulate(model, Graph.path(2), formation, **run)
        return np.abs(result.states[:, 0] - result.reference)[:, :3].max()

    # An input that is held over a step is half a step late on the whole: half the step, half of it.
    late, less = largest(0.02), largest(0.01)
    assert late < 5e-5 and late == pytest.approx(2.0 * less, rel=0.05)


def test_a_tracking_gain_is_the_model_s_riccati_gain_unless_given():
    law = prepared(Tracking(Hover()), QUAD)
    assert np.array_equal(law.regulator.P, synthesize(QUAD, LINE, Riccati()).P)
    assert law.gain is None and law.regulator.coupling == 1.0


def test_headings_of_a_tracking_leader_are_compared_by_the_shorter_way():
    model = UnicyclePoint(ahead=0.4)
    law = prepared(Tracking(Circle(), synthesize(model, LINE, FixedGain())), model)
    with numerics.precision("float64"):
        x = np.asarray(law.target(model, jnp.asarray(0.3))[0]) + [0.1, 0.2, 0.3]
    turned = x + [0.0, 0.0, 4.0 * np.pi]
    once = input_of(law, model, x=x, t=0.3)
    assert input_of(law, model, x=turned, t=0.3) == pytest.approx(once, abs=1e-12)


def test_a_leader_starts_where_its_law_says():
    with numerics.precision("float64"):
        assert np.asarray(TrimInput().start(QUAD)).tolist() == [0.0] * 12
        start = np.asarray(Tracking(Line((1, 2, 3), (0.5, 0, 0))).start(QUAD))
        rows = np.asarray(Tracking(Line()).reference_states(QUAD, jnp.array([0.0, 2.0])))
    assert start == pytest.approx([1, 2, 3, 0.5, *[0.0] * 8])
    assert rows[:, :4] == pytest.approx(np.array([[0, 0, 1, 1], [2, 0, 1, 1]]))


def test_the_passive_law_is_the_trim():
    assert input_of(TrimInput(), QUAD, x=np.ones(12)) == pytest.approx([0.028 * 9.81, 0, 0, 0])


# ---- what an agent may know ----


@given(connected(most=6), st.integers(0, 10**6))
@settings(max_examples=10)
def test_an_agent_hears_its_neighbours_and_nobody_else(parts, seed):
    graph, rng = Graph.from_edges(*parts), np.random.default_rng(seed)
    y = rng.normal(size=(graph.agents, 2))
    moved = int(rng.integers(graph.agents))
    there = y.copy()
    there[moved] += 1.0
    with numerics.precision("float64"):
        before, after = (np.asarray(graph.disagreement(jnp.asarray(v))) for v in (y, there))
    changed = {k for k in range(graph.agents) if not np.array_equal(before[k], after[k])}
    assert changed == {moved, *graph.neighbours(moved)}


# ---- Theorem 1 ----


def test_theorem_1_all_agents_settle_at_the_mean_of_their_starts():
    edges = [(0, 1, 2.0), (1, 2, 1.0), (2, 3, 0.5), (0, 3, 1.0)]
    graph, model = Graph(edges), SingleIntegrator(2)
    rng = np.random.default_rng(4)
    x0, xi = rng.normal(size=(2, 4, 2))
    law = Agreement()
    run = simulate(
        model, graph, Formation(xi), leader=law, follower=law, initial=x0, horizon=25.0, dt=0.01
    )
    tau = (x0 - xi).mean(axis=0)
    assert run.states[-1] - xi == pytest.approx(np.tile(tau, (4, 1)), abs=1e-9)
    # On the way the mean stays, and each step is that of x + dt u exactly.
    assert (run.states - xi).mean(axis=1) == pytest.approx(np.tile(tau, (len(run.times), 1)))
    L = laplacian(4, [e[:2] for e in edges], [e[2] for e in edges])
    wanted = np.linalg.matrix_power(np.eye(4) - 0.01 * L, 100) @ (x0 - xi)
    assert run.states[100] - xi == pytest.approx(wanted, abs=1e-12)


def test_the_corollary_s_sign_is_wrong_the_error_that_vanishes_is_e_plus_d():
    graph, model = Graph.path(3), SingleIntegrator(2)
    xi = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    law = Agreement()
    run = simulate(
        model,
        graph,
        Formation(xi),
        leader=law,
        follower=law,
        initial={"position": 1.0},
        horizon=30.0,
        dt=0.02,
        store_every=10,
    )
    A = adjacency(3, graph.edges)
    e = disagreements(A, run.states[-1], np.zeros_like(xi))
    d = disagreements(A, np.zeros_like(xi), xi)
    assert np.abs(d).max() == 1.0
    assert e + d == pytest.approx(np.zeros((3, 2)), abs=1e-9)
    assert d - e == pytest.approx(2.0 * d, abs=1e-9)


# ---- angles ----

TURNED = [
    (Unicycle(), FixedGain(), 2),
    (UnicyclePoint(ahead=0.4), FixedGain(), 2),
    (QUAD, InnerLoop(), 8),
]


@pytest.mark.parametrize(("model", "method", "angle"), TURNED, ids=lambda m: type(m).__name__)
def test_an_agent_that_begins_a_whole_turn_off_moves_as_one_that_does_not(model, method, angle):
    graph, n = Graph.path(2), len(model.state_names)
    gain = synthesize(model, graph, method)
    runs = []
    for turns in (0.0, 1.0):
        start = np.zeros((2, n))
        start[1, :2], start[1, angle] = (0.2, -0.1), 0.3 + 2.0 * np.pi * turns
        runs.append(
            simulate(
                model,
                graph,
                Formation(np.zeros((2, n))),
                leader=TrimInput(),
                follower=Consensus(gain, "none"),
                initial=start,
                horizon=1.0,
                dt=0.01,
            )
        )
    plain, turned = runs
    away = turned.states - plain.states
    away[:, 1, angle] -= 2.0 * np.pi
    assert np.abs(away).max() < 1e-9
    assert lyapunov(turned).value == pytest.approx(lyapunov(plain).value, abs=1e-9)


def test_a_domain_of_half_a_turn_is_refused_where_differences_wind():
    with pytest.raises(EchelonError) as caught:
        Domain.about(QUAD, {"yaw": 1.6})
    assert str(caught.value) == (
        "the domain of `yaw` is 3.2 wide, and `Quadrotor` takes differences of it the shorter way "
        "round; allowed is less than 3.142 in all."
    )
    Domain.about(QUAD, {"yaw": 1.5, "attitude": 0.5})


# ---- a law of one's own ----


class Sound(Law):
    """A law that every test below spoils in one way."""

    def update(self, model, view, memory):
        return -view.disagreement, memory


def flown(**changes):
    """A run of two single integrators under the spoiled law."""
    law = type("Sound", (Sound,), {"__module__": __name__, "__doc__": "Spoiled.", **changes})()
    model = SingleIntegrator(1)
    return simulate(
        model,
        Graph.path(2),
        Formation(np.zeros((2, 1))),
        leader=TrimInput(),
        follower=law,
        horizon=0.2,
        dt=0.1,
    )


def wanders(self, model, view, memory):
    return -view.disagreement * np.random.default_rng().uniform(), memory


WRITTEN = "; it must be written with `jax.numpy` and take what one agent knows."
SPOILED = {
    "an input alone": (
        {"update": lambda self, model, view, memory: view.x},
        "`update` of `Sound` returns one thing, and must return two, the input and the next "
        "memory: `return u, memory`.",
    ),
    "a list for an input": (
        {"update": lambda self, model, view, memory: ([0.0], memory)},
        "the input of `Sound` has the type `list`, and must be one array, such as "
        "`jnp.stack([...])` makes.",
    ),
    "an input of another size": (
        {"update": lambda self, model, view, memory: (jnp.zeros(3), memory)},
        "the input of `Sound` has shape (3,), and must have shape (1,).",
    ),
    "a complex input": (
        {"update": lambda self, model, view, memory: (view.x * 1j, memory)},
        "the input of `Sound` has the type complex128, and must have that of its argument, "
        "float64; write `jnp.asarray(..., x.dtype)`.",
    ),
    "an input in single precision": (
        {"update": lambda self, model, view, memory: (view.x.astype(jnp.float32), memory)},
        "`update` of `Sound` casts float64 numbers to fewer digits, and must keep the type of "
        "its argument, `x.dtype`.",
    ),
    "a drawn input": (
        {"update": wanders},
        "`update` of `Sound` differs from one call to the next, as a clock or a random number "
        "makes it, and must be a function of its arguments alone.",
    ),
    "a lost memory": (
        {
            "init": lambda self: jnp.zeros(2),
            "update": lambda self, model, view, memory: (view.x, None),
        },
        "the memory of `Sound` is float64 (2,) at first and nothing after a step, and must keep "
        "its form.",
    ),
    "a memory that grows": (
        {
            "init": lambda self: jnp.zeros(2),
            "update": lambda self, model, view, memory: (view.x, jnp.append(memory, 1.0)),
        },
        "the memory of `Sound` is float64 (2,) at first and float64 (3,) after a step, and must "
        "keep its form.",
    ),
    "a memory of words": (
        {"init": lambda self: "nothing yet"},
        "`init` of `Sound` returns 'nothing yet', and must return arrays, numbers or nothing.",
    ),
    "a feed-forward by its name": (
        {"feedforward": "relay"},
        "`feedforward` of `Sound` is 'relay', and must be a member of `Feedforward`, such as "
        "`Feedforward.RELAY`.",
    ),
    "a completion that is none": (
        {"prepared": lambda self, model, graph: None},
        "`prepared` of `Sound` returns a `NoneType`, and must return the completed law.",
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_law_of_ones_own_is_checked_as_a_model_is(name):
    changes, sentence = SPOILED[name]
    with pytest.raises(LawError) as caught:
        flown(**changes)
    assert str(caught.value) == sentence


@pytest.mark.parametrize(
    ("update", "kind"),
    [
        (
            lambda self, model, view, memory: (view.x if view.x[0] > 0.0 else -view.x, memory),
            "TracerBoolConversionError",
        ),
        (
            lambda self, model, view, memory: (np.sin(view.x), memory),
            "TracerArrayConversionError",
        ),
        (lambda self, model, view, memory: (view.velocity, memory), "AttributeError"),
    ],
)
def test_errors_inside_a_law_are_told_with_their_kind(update, kind):
    with pytest.raises(LawError) as caught:
        flown(update=update)
    assert str(caught.value).startswith(f"`update` of `Sound` fails with {kind}: ")
    assert str(caught.value).endswith(WRITTEN)


def test_a_sound_law_with_a_memory_of_whole_numbers_flies():
    run = flown(
        init=lambda self: (jnp.asarray(0), 0.0),
        update=lambda self, model, view, memory: (
            jnp.ones(1) * memory[0],
            (memory[0] + 1, memory[1]),
        ),
    )
    assert run.inputs[:, 1, 0].tolist() == [0.0, 1.0, 2.0]


def test_a_law_that_is_called_by_hand_computes_in_double_or_not_at_all():
    model = SingleIntegrator(1)
    gain = synthesize(model, LINE, Riccati(coupling=0.3))
    law = Consensus(gain, "none")

    def known():
        zero = jnp.zeros(1)
        return LocalView(jnp.zeros(()), zero, zero, jnp.asarray([0.1]), zero)

    with pytest.raises(LawError, match="inside `with jax.enable_x64"):
        known()
    with jax.enable_x64(True):
        u, _ = law.update(model, known(), law.init())
    assert u.dtype == np.float64
    assert float(u[0]) == pytest.approx(-0.3 * float(gain.P[0, 0]) * 0.1, rel=1e-15)


@pytest.mark.parametrize("feedforward", ["none", "relay"])
def test_an_inner_loop_pulls_back_to_the_trim_and_is_not_told_to_others(feedforward):
    model = DoubleIntegrator(1)
    gain = synthesize(model, Graph.path(3), InnerLoop())
    law, (K,) = Consensus(gain, feedforward=feedforward), gain.inner
    with jax.enable_x64(True):
        x, sent = jnp.array([0.3, -0.7]), jnp.array([0.2 if feedforward == "relay" else 0.0])
        view = LocalView(jnp.zeros(()), x, jnp.zeros(2), jnp.zeros(2), sent)
        u, _ = law.update(model, view, None)
        told = law.broadcast(model, x, u)
    # At one with its neighbours, what is left is the loop and what it was sent, which it hands on.
    assert float(u[0]) == pytest.approx(float(sent[0]) - K @ [0.3, -0.7], rel=1e-12)
    assert float(told[0]) == pytest.approx(float(sent[0]), abs=1e-15)
    assert abs(K @ [0.3, -0.7]) > 0.1
