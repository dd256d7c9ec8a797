"""Control laws: the form for one agent equals the paper's block form; Theorem 1 in simulation."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import adjacency, connected, disagreements, laplacian, quadrotor_input_map, spd
from runs import simulate

import echelon as ech
from echelon import Formation, Graph, lyapunov, synthesize
from echelon.agents import models
from echelon.agents.references import Circle, Hover, Lemniscate, Line
from echelon.core import numerics
from echelon.core.errors import EchelonError, LawError
from echelon.experiments.scenario.sections import FollowerSpec
from echelon.laws import Agreement, Consensus, Law, LocalView, Tracking, TrimInput
from echelon.laws.law import Proves, Travels
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.gains import FixedGain, InnerLoop, Riccati

LINE = Graph.path(4)
QUAD = models.Quadrotor()


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
    if isinstance(model, models.Quadrotor):
        return quadrotor_input_map(x, model.mass, model.inertia)
    if isinstance(model, models.PlanarQuadrotor):
        push = np.array([-np.sin(x[2]), np.cos(x[2]), 0.0]) / model.mass
        spin = np.array([0.0, 0.0, 1.0 / model.inertia])
        return np.vstack([np.zeros((3, 2)), np.column_stack([push, spin])])
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.array([[c, -model.ahead * s], [s, model.ahead * c], [0.0, 1.0]])


def flown(model, graph, follower, leader=None, formation=None, **more):
    """A run under two laws, by default behind the trim and without offsets."""
    formation = formation or Formation(np.zeros((graph.agents, len(model.state_names))))
    return simulate(
        model, graph, formation, leader=leader or TrimInput(), follower=follower, **more
    )


MODELS = [models.UnicyclePoint(ahead=0.4), models.PlanarQuadrotor(), QUAD]
every_model = pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)


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
    asked = Consensus(gain, "none"), Consensus(gain, "relay"), TrimInput()
    assert [str(each.feedforward) for each in asked] == ["none", "relay", "none"]
    # A scenario and a program have the same default.
    assert FollowerSpec().feedforward == str(Consensus(gain).feedforward) == "relay"


def test_laws_carry_the_metric_of_their_lyapunov_function():
    gain = synthesize(QUAD, LINE, Riccati())
    assert np.array_equal(Consensus(gain, "none").metric(QUAD), gain.P)
    assert np.array_equal(Agreement().metric(models.SingleIntegrator(2)), np.eye(2))
    assert all(Proves.of(law).metric(QUAD) is None for law in (TrimInput(), Tracking(Hover())))


@pytest.mark.parametrize("reacts", [False, True])
def test_the_leader_tracks_with_unit_coupling_and_reacts_with_the_followers_gain(reacts):
    rng = np.random.default_rng(3)
    model = models.DoubleIntegrator(2, drag=0.4)
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


@pytest.mark.slow
def test_under_computed_torque_a_leader_stays_on_its_circle_but_for_held_inputs():
    model, law = models.QuadrotorThrust(), Tracking(Circle(radius=1.5, rate=0.8))

    def largest(dt):
        run = flown(model, Graph.path(2), TrimInput(), law, horizon=2.0, dt=dt, store_every=10)
        return np.abs(run.states[:, 0] - run.reference)[:, :3].max()

    # An input that is held over a step is half a step late on the whole: half the step, half of it.
    late, less = largest(0.02), largest(0.01)
    assert late < 5e-5 and late == pytest.approx(2.0 * less, rel=0.05)


def test_a_tracking_gain_is_the_model_s_riccati_gain_unless_given():
    law = prepared(Tracking(Lemniscate()), QUAD)
    assert np.array_equal(law.regulator.P, synthesize(QUAD, LINE, Riccati()).P)
    assert law.gain is None and law.regulator.coupling == 1.0
    # On its reference the leader flies the feedforward alone.
    with numerics.precision("float64"):
        x, u = map(np.asarray, law.target(QUAD, jnp.asarray(2.0)))
    assert input_of(law, QUAD, x=x, t=2.0) == pytest.approx(u, abs=1e-15)
    assert u[0] > 0.0


def test_headings_of_a_tracking_leader_are_compared_by_the_shorter_way():
    model = models.UnicyclePoint(ahead=0.4)
    law = prepared(Tracking(Circle(), synthesize(model, LINE, FixedGain())), model)
    with numerics.precision("float64"):
        x = np.asarray(law.target(model, jnp.asarray(0.3))[0]) + [0.1, 0.2, 0.3]
    turned = x + [0.0, 0.0, 4.0 * np.pi]
    once = input_of(law, model, x=x, t=0.3)
    assert input_of(law, model, x=turned, t=0.3) == pytest.approx(once, abs=1e-12)


def test_a_leader_starts_where_its_law_says():
    with numerics.precision("float64"):
        assert np.asarray(Travels.of(TrimInput()).start(QUAD)).tolist() == [0.0] * 12
        start = np.asarray(Tracking(Line((1, 2, 3), (0.5, 0, 0))).start(QUAD))
        rows = np.asarray(Tracking(Line()).reference_states(QUAD, jnp.array([0.0, 2.0])))
    assert start == pytest.approx([1, 2, 3, 0.5, *[0.0] * 8])
    assert rows[:, :4] == pytest.approx(np.array([[0, 0, 1, 1], [2, 0, 1, 1]]))
    # The passive law is the trim.
    assert input_of(TrimInput(), QUAD, x=np.ones(12)) == pytest.approx([0.028 * 9.81, 0, 0, 0])


def test_theorem_1_all_agents_settle_at_the_mean_of_their_starts():
    edges = [(0, 1, 2.0), (1, 2, 1.0), (2, 3, 0.5), (0, 3, 1.0)]
    x0, xi = np.random.default_rng(4).normal(size=(2, 4, 2))
    law, more = Agreement(), {"initial": x0, "horizon": 25.0, "dt": 0.01}
    run = flown(models.SingleIntegrator(2), Graph(edges), law, law, Formation(xi), **more)
    tau = (x0 - xi).mean(axis=0)
    assert run.states[-1] - xi == pytest.approx(np.tile(tau, (4, 1)), abs=1e-9)
    # On the way the mean stays, and each step is that of x + dt u exactly.
    assert (run.states - xi).mean(axis=1) == pytest.approx(np.tile(tau, (len(run.times), 1)))
    L = laplacian(4, [e[:2] for e in edges], [e[2] for e in edges])
    wanted = np.linalg.matrix_power(np.eye(4) - 0.01 * L, 100) @ (x0 - xi)
    assert run.states[100] - xi == pytest.approx(wanted, abs=1e-12)
    # The corollary's sign is wrong: the error that vanishes is e + d, and not e - d.
    A = adjacency(4, [e[:2] for e in edges], [e[2] for e in edges])
    e, d = (disagreements(A, *pair) for pair in ((run.states[-1], 0 * xi), (0 * xi, xi)))
    assert e + d == pytest.approx(0 * xi, abs=1e-8) and np.abs(d - e).max() > 1.0


TURNED = [
    (models.Unicycle(), FixedGain(), 2),
    (models.UnicyclePoint(ahead=0.4), FixedGain(), 2),
    (QUAD, InnerLoop(), 8),
]


@pytest.mark.parametrize(("model", "method", "angle"), TURNED, ids=lambda m: type(m).__name__)
def test_an_agent_that_begins_a_whole_turn_off_moves_as_one_that_does_not(model, method, angle):
    graph, start = Graph.path(2), np.zeros((2, len(model.state_names)))
    law, runs = Consensus(synthesize(model, graph, method), "none"), []
    for turns in (0.0, 1.0):
        start[1, :2], start[1, angle] = (0.2, -0.1), 0.3 + 2.0 * np.pi * turns
        runs.append(flown(model, graph, law, initial=start.copy(), horizon=1.0, dt=0.01))
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


class Sound(Law):
    """A law that every test below spoils in one way."""

    def update(self, model, view, memory):
        return -view.disagreement, memory


def spoiled(**changes):
    """A run of two single integrators under the spoiled law."""
    law = type("Sound", (Sound,), {"__module__": __name__, "__doc__": "Spoiled.", **changes})()
    return flown(models.SingleIntegrator(1), Graph.path(2), law, horizon=0.2, dt=0.1)


def of_update(update, sentence, **more):
    """A law of which `update` answers a view and a memory so, and the sentence that refuses it."""
    return {"update": lambda self, model, view, memory: update(view, memory), **more}, sentence


def memory_becomes(what):
    now = "the memory of `Sound` is float64 (2,) at first and"
    return f"{now} {what} after a step, and must keep its form."


TWO = {"init": lambda self: jnp.zeros(2)}


SPOILED = [
    of_update(
        lambda view, memory: view.x,
        "`update` of `Sound` returns one thing, and must return two, the input and the next "
        "memory: `return u, memory`.",
    ),
    of_update(
        lambda view, memory: ([0.0], memory),
        "the input of `Sound` has the type `list`, and must be one array, such as "
        "`jnp.stack([...])` makes.",
    ),
    of_update(
        lambda view, memory: (jnp.zeros(3), memory),
        "the input of `Sound` has shape (3,), and must have shape (1,).",
    ),
    of_update(
        lambda view, memory: (view.x * 1j, memory),
        "the input of `Sound` has the type complex128, and must have that of its argument, "
        "float64; write `jnp.asarray(..., x.dtype)`.",
    ),
    of_update(
        lambda view, memory: (view.x.astype(jnp.float32), memory),
        "`update` of `Sound` casts float64 numbers to fewer digits, and must keep the type of "
        "its argument, `x.dtype`.",
    ),
    of_update(
        lambda view, memory: (-view.disagreement * np.random.default_rng().uniform(), memory),
        "`update` of `Sound` differs from one call to the next, as a clock or a random number "
        "makes it, and must be a function of its arguments alone.",
    ),
    of_update(lambda view, memory: (view.x, None), memory_becomes("nothing"), **TWO),
    of_update(
        lambda view, memory: (view.x, jnp.append(memory, 1.0)),
        memory_becomes("float64 (3,)"),
        **TWO,
    ),
    (
        {"init": lambda self: "nothing yet"},
        "`init` of `Sound` returns 'nothing yet', and must return arrays, numbers or nothing.",
    ),
    (
        {"feedforward": 1},
        "`feedforward` of `Sound` is 1, and must be a member of `Feedforward`, such as "
        "`Feedforward.RELAY`.",
    ),
    (
        {"prepared": lambda self, model, graph: None},
        "`prepared` of `Sound` returns a `NoneType`, and must return the completed law.",
    ),
]


def test_a_class_gives_its_feedforward_by_name():
    assert type("Relayed", (Sound,), {"feedforward": "relay"}).feedforward is ech.Feedforward.RELAY
    with pytest.raises(ech.EchelonError, match=r"`relais`, allowed are `none`, `relay`"):
        type("Misspelt", (Sound,), {"feedforward": "relais"})


@pytest.mark.parametrize(("changes", "sentence"), SPOILED)
def test_a_law_of_ones_own_is_checked_as_a_model_is(changes, sentence):
    with pytest.raises(LawError) as caught:
        spoiled(**changes)
    # Of what a class is as a whole, the line where it begins comes first.
    assert re.sub(r"^test_laws.py:\d+: ", "", str(caught.value)) == sentence


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        of_update(lambda x, m: (x.x if x.x[0] > 0 else -x.x, m), "TracerBoolConversionError"),
        of_update(lambda view, memory: (np.sin(view.x), memory), "TracerArrayConversionError"),
        of_update(lambda view, memory: (view.velocity, memory), "AttributeError"),
    ],
)
def test_errors_inside_a_law_are_told_with_their_kind(changes, kind):
    with pytest.raises(LawError) as caught:
        spoiled(**changes)
    assert str(caught.value).startswith(f"`update` of `Sound` fails with {kind}: ")
    written = "; it must be written with `jax.numpy` and take what one agent knows."
    assert str(caught.value).endswith(written)


def test_a_sound_law_with_a_memory_of_whole_numbers_flies():
    def counting(self, model, view, memory):
        return jnp.ones(1) * memory[0], (memory[0] + 1, memory[1])

    run = spoiled(init=lambda self: (jnp.asarray(0), 0.0), update=counting)
    assert run.inputs[:, 1, 0].tolist() == [0.0, 1.0, 2.0]


def test_a_law_that_is_called_by_hand_computes_in_double_or_not_at_all():
    model = models.SingleIntegrator(1)
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
    model = models.DoubleIntegrator(1)
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


class Pulled(Law):
    """Toward its neighbours, by states or by a signal of a user's own."""

    speaks: bool = False

    def signal(self, model, x, offset, memory):
        y = x - offset
        return y[:1] + y[1:] if self.speaks else None

    def update(self, model, view, memory):
        return -view.disagreement.sum()[None], memory


def test_agents_send_what_the_signal_of_a_law_returns():
    cart, graph = models.DoubleIntegrator(1), Graph.path(3)
    row = Formation.from_offsets(cart, graph, {})

    def run(leader, follower):
        parts = ech.Parts(cart, graph, row, ech.Laws(leader, follower), {"position": 0.5})
        return ech.simulate(parts, ech.Settings(2.0, 0.01))

    plain, said = (run(Pulled(speaks), Pulled(speaks)) for speaks in (False, True))
    np.testing.assert_allclose(plain.states, said.states, atol=1e-12)
    for run_, word in ((plain, "states"), (said, "signals")):
        known = run_.drive.information_for(cart, graph)
        assert known.follower == known.leader == (f"neighbours' {word}",)
    with pytest.raises(LawError, match=r"send a signal of 1 number.* `TrimInput` sends none"):
        run(TrimInput(), Pulled(True))
