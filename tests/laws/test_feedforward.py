"""Feed-forward: the parent's input on a tree, the leader's input, the leader's velocity."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from oracles import laplacian
from runs import simulate

from echelon import Formation, Graph, build, load_scenario, report, synthesize
from echelon.agents import models
from echelon.agents.references import Circle, Hover, Lemniscate
from echelon.core.digits import at_most
from echelon.core.errors import EchelonError, ScenarioError
from echelon.core.words import Feedforward
from echelon.laws import Consensus, Law, Tracking, TrimInput
from echelon.synthesis.gains import FixedGain, Riccati

# Numbered so that no parent has the number before its child's, and on several levels of unequal
# width.
BUSH = [(3, 0), (3, 5), (5, 1), (0, 2), (0, 4), (4, 6), (6, 7)]
TREE = Graph.from_edges(BUSH, leaders=[3])
PARENTS = {0: 3, 5: 3, 1: 5, 2: 0, 4: 0, 6: 4, 7: 6}


def fly(model, graph, follower, leader=None, formation=None, **more):
    """A run under two laws, by default for one step of 0.1 s behind the trim without offsets."""
    more = {"horizon": 0.1, "dt": 0.1} | more
    formation = formation or Formation(np.zeros((graph.agents, len(model.state_names))))
    return simulate(
        model, graph, formation, leader=leader or TrimInput(), follower=follower, **more
    )


def test_a_tree_knows_parents_and_depths_and_leaders_are_their_own():
    assert TREE.parents() == (3, 5, 0, 3, 0, 3, 4, 6)
    assert TREE.depths().tolist() == [1, 2, 2, 0, 2, 1, 3, 4]
    forest = Graph.from_edges([(0, 1), (1, 2), (2, 3)], leaders=[1, 2])
    assert forest.parents() == (1, 1, 2, 2)


@pytest.mark.parametrize(
    ("graph", "who"),
    [
        (Graph.ring(4), "agent 2 has"),
        (Graph.ring(5), "agents 2, 3 have"),
        (Graph.path(5, leaders=[0, 4]), "agent 2 has"),
        (Graph.complete(3), "agents 1, 2 have"),
    ],
    ids=["even ring", "odd ring", "two leaders", "triangle"],
)
def test_a_graph_that_is_no_tree_is_refused_for_parents(graph, who):
    model = models.SingleIntegrator(1)
    law = Consensus(synthesize(model, graph, FixedGain()), feedforward="parent")
    with pytest.raises(EchelonError) as caught:
        law.prepared(model, graph)
    assert str(caught.value) == (
        f"the graph is no tree: {who} more than one way to a leader, and so no one parent; "
        "the feed-forward `relay` needs none."
    )


def test_each_follower_is_sent_what_its_nearest_leader_does():
    class Own(Law):
        """A leader whose input is its place."""

        def update(self, model, view, memory):
            return view.x, memory

    class Sent(Law):
        """A follower that does what it is told."""

        feedforward = Feedforward.RELAY

        def update(self, model, view, memory):
            return view.feedforward, memory

    graph, start = Graph.path(7, leaders=[0, 3, 6]), np.arange(1.0, 8.0)[:, None]
    run = fly(models.SingleIntegrator(1), graph, Sent(), Own(), initial=start)
    # Places 1, 4 and 7 of the leaders, each beside both of its neighbours.
    assert run.inputs[0, :, 0].tolist() == [1.0, 1.0, 4.0, 4.0, 4.0, 7.0, 7.0]


@pytest.mark.parametrize("weights", [np.ones(7), np.array([0.5, 2.0, 1.0, 3.0, 0.7, 1.0, 0.4])])
def test_the_effective_matrix_of_a_tree_has_its_weights_as_eigenvalues(weights):
    graph = Graph([(*edge, w) for edge, w in zip(BUSH, weights, strict=True)], leaders=[3])
    model, c, rows = models.SingleIntegrator(1), 1.7, list(graph.followers)
    law = Consensus(synthesize(model, graph, FixedGain(coupling=c)), feedforward="parent")
    runs = [fly(model, graph, law, initial=np.eye(8)[:, [k]]) for k in rows]
    seen = np.array([-run.inputs[0, rows, 0] / c for run in runs]).T
    D = np.eye(7)  # less the matrix of parents among followers
    for child, parent in PARENTS.items():
        if parent in rows:
            D[rows.index(child), rows.index(parent)] = -1.0
    L = laplacian(8, BUSH, weights)[np.ix_(rows, rows)]
    assert seen == pytest.approx(np.linalg.solve(D, L), abs=1e-13)
    # D E D^-1 = D' W: triangular in the order of depth, so its diagonal is its spectrum.
    by_depth = np.argsort(graph.depths()[rows], kind="stable")
    similar = (D @ seen @ np.linalg.inv(D))[np.ix_(by_depth, by_depth)]
    child = {
        min(e, key=lambda a: -graph.depths()[a]): w for e, w in zip(BUSH, weights, strict=True)
    }
    assert np.abs(np.tril(similar, -1)).max() <= 1e-13
    assert np.diag(similar) == pytest.approx([child[rows[k]] for k in by_depth], abs=1e-13)


def test_linear_agents_follow_an_implementation_of_its_own():
    rng = np.random.default_rng(6)
    A, B = rng.normal(size=(3, 3)) / 2, rng.normal(size=(3, 2))
    model, dt, start = models.Linear(A, B), 0.01, rng.normal(size=(8, 3))
    gain = synthesize(model, TREE, Riccati(coupling=1.3))
    K = 1.3 * np.linalg.solve(gain.R, B.T @ gain.P)

    class Damped(Law):
        """A leader that brings itself to rest, so that its input moves."""

        def update(self, model, view, memory):
            return -(jnp.asarray(K / 1.3, view.x.dtype) @ view.x), memory

    law = Consensus(gain, feedforward="parent")
    run = fly(model, TREE, law, Damped(), initial=start, horizon=2.0, dt=dt)
    once = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((2, 5))]]))
    neighbours = {k: [a + b - k for a, b in BUSH if k in (a, b)] for k in range(8)}
    x = start
    for states, inputs in zip(run.states, run.inputs, strict=True):
        u = {3: -K / 1.3 @ x[3]}
        for k in (0, 5, 1, 2, 4, 6, 7):
            z = sum(x[k] - x[j] for j in neighbours[k])
            u[k] = u[PARENTS[k]] - K @ z
        u = np.array([u[k] for k in range(8)])
        assert states == pytest.approx(x, abs=1e-8) and inputs == pytest.approx(u, abs=1e-8)
        x = x @ once[:3, :3].T + u @ once[:3, 3:].T


@pytest.mark.parametrize(
    ("model", "path"),
    [
        (models.DoubleIntegrator(2, drag=0.2), Circle((0, 0, 0), 2.0, 0.7)),
        (models.Quadrotor(), Lemniscate()),
    ],
    ids=["carts", "quadrotors"],
)
def test_agents_on_their_goals_stay_there_behind_a_moving_leader(model, path):
    offsets = {k: (0.5 * k, -0.3 * k, 0.1 * k)[: len(model.position)] for k in range(8)}
    formation = Formation.from_offsets(model, TREE, offsets)
    law = Consensus(synthesize(model, TREE, Riccati()), feedforward="parent")
    more = {"start_error": {"x": 0.2}, "horizon": 3.0, "dt": 0.005}
    run = fly(model, TREE, law, Tracking(path), formation, **more)
    assert np.ptp(run.states[:, 3, 0]) > 0.3 and np.abs(run.inputs[:, 3]).max() > 0.1
    # The leader starts off its goal and the followers on theirs relative to it.
    assert np.abs(run.errors).max() <= 1e-12


def test_errors_decay_at_one_rate_on_any_branch_where_the_coupling_is_a_half():
    model, graph = models.DoubleIntegrator(1), Graph.path(13)
    gain = synthesize(model, graph, Riccati(coupling=0.6))
    law, start = Consensus(gain, feedforward="parent"), {"position": 1.0}
    run = fly(model, graph, law, initial=start, horizon=200.0, dt=0.05, store_every=100)
    # 0.6 is far below the 31 that the line asks for without.
    assert gain.certificate.edge > 30.0
    assert np.abs(run.states[-1]).max() <= 1e-9


def test_the_parent_says_what_its_actuators_delivered():
    model, graph, start = models.PlanarQuadrotor(), Graph.path(4), np.zeros((4, 6))
    start[1:, 0] = 8.0
    law = Consensus(synthesize(model, graph, Riccati()), feedforward="parent")
    run = fly(model, graph, law, initial=start, horizon=0.5, dt=0.005)
    # Agents 1 to 3 start together: 2 and 3 agree with their neighbours and copy what 1 got.
    assert run.saturated[1] > 0.0 and not run.saturated[2:].any()
    assert np.abs(run.inputs[:, 1] - model.trim[1]).max() > 1e-4
    assert run.states[:, 2:] == pytest.approx(run.states[:, [1, 1]], abs=1e-12)
    assert run.inputs[:, 2:] == pytest.approx(run.inputs[:, [1, 1]], abs=1e-12)


class Counting(Law):
    """Push as often as asked so far, and add what is told."""

    size: int = eqx.field(default=1, static=True)

    @property
    def feedforward(self):
        return Feedforward.PARENT

    def init(self):
        return jnp.zeros(())

    def update(self, model, view, memory):
        return view.feedforward + memory + 1.0, memory + 1.0


def test_each_agent_acts_once_a_step_and_remembers():
    run = fly(models.SingleIntegrator(1), TREE, Counting(), horizon=0.5)
    wanted = np.outer(np.arange(1.0, 7.0), TREE.depths())
    assert run.inputs[:, :, 0] == pytest.approx(wanted, abs=0.0)


def test_a_long_path_compiles_as_a_short_one_and_runs():
    model, graph = models.SingleIntegrator(1), Graph.path(400)
    law = Consensus(synthesize(model, graph, FixedGain()), feedforward="parent")
    leader = Tracking(Circle((0, 0, 0), 1.0, 0.5))
    run = fly(model, graph, law, leader, horizon=0.5, dt=0.01, store_every=10)
    assert np.abs(run.errors).max() <= 1e-12 and np.ptp(run.states[:, 399]) > 0.01


def test_the_law_says_what_it_needs_and_by_how_much_a_branch_amplifies():
    model, graph = models.DoubleIntegrator(1), Graph.path(11)
    law = Consensus(synthesize(model, graph, Riccati(coupling=1.0)), feedforward="parent")
    assert law.information == ("neighbours' states", "its parent's input of the same step")
    # One axis with Q = R = I: K = (1, sqrt 3), so T = (sqrt 3 s + 1) / (s^2 + sqrt 3 s + 1).
    s = 1j * np.linspace(0.0, 10.0, 10**6)
    T = np.abs((np.sqrt(3.0) * s + 1.0) / (s**2 + np.sqrt(3.0) * s + 1.0)).max()
    run = fly(model, graph, law)
    assert (
        "with the parent's input fed forward, each agent of a branch amplifies a push by up to "
        f"||T|| = {T:.3g}, and the 10 agents up from agent 10 by up to {T**10:.3g}; "
        "a stronger coupling brings ||T|| nearer to 1."
    ) in run.warnings
    weak = Consensus(synthesize(model, graph, FixedGain(P=[1.0, 1.0])), feedforward="parent")
    assert "too weak: a mode of the formation does not decay." in weak.warnings(model, graph)[0]
    assert Consensus(law.gain, "none").warnings(model, graph) == ()
    # The report promises the modes that parents leave: s^2 + sqrt 3 s + 1 has its roots at
    # -sqrt 3 / 2 +- i / 2, and a step in which inputs are held has them a little farther left.
    dt = run.settings.dt
    step = np.array([[1.0, dt], [0.0, 1.0]]) - np.outer([0.5 * dt**2, dt], [1.0, 3.0**0.5])
    rate = -np.log(np.abs(np.linalg.eigvals(step)).max()) / dt
    text = " ".join(report(run).split())
    said = f"rate {at_most(rate)} 1/s eventually coupling 1; any above 0.5 suffices"
    assert said in text and rate == pytest.approx(3.0**0.5 / 2.0, rel=dt)
    assert "follower: neighbours' states; its parent's input of the same step." in text


def test_a_scenario_may_ask_for_it_and_is_told_where_it_cannot():
    parts, _ = build(load_scenario("paper", ["follower.feedforward=parent"]))
    assert parts.drive.follower.feedforward is Feedforward.PARENT
    asked = ["follower.feedforward=parent", "graph={name: ring, agents: 4}"]
    with pytest.raises(ScenarioError, match="follower: the graph is no tree: agent 2 has more"):
        build(load_scenario("paper", asked))
    with pytest.raises(EchelonError) as caught:
        Consensus(parts.drive.follower.gain, feedforward="parents")
    assert str(caught.value) == (
        "`feedforward` is `parents`, allowed are `none`, `relay`, `relay-velocity`, `parent` "
        "(did you mean `parent`?)."
    )


class Backing(Law):
    """Drive backwards on a circle."""

    def update(self, model, view, memory):
        return jnp.asarray([-0.5, 0.2], view.x.dtype), memory


def test_behind_a_leader_that_backs_up_its_velocity_leads_and_its_input_misleads():
    model, graph = models.UnicyclePoint(ahead=0.1), Graph.path(3)
    # A heading of so little weight leaves the position to be matched.
    gain = synthesize(model, graph, FixedGain(P=[1.0, 1.0, 1e-9], coupling=2.0))
    row = Formation.from_offsets(model, graph, {1: (1, 0), 2: (2, 0)})
    more = {"initial": {"position": 0.5, "heading": 0.3}, "horizon": 60.0, "dt": 0.01}

    def end(feedforward):
        law = Consensus(gain, feedforward=feedforward)
        run = fly(model, graph, law, Backing(), row, **more, store_every=100)
        return np.linalg.norm(run.errors[-1, 1:, :2], axis=1).max()

    assert end("relay-velocity") <= 1e-3 < 0.3 < end("relay")


def test_where_the_input_map_is_constant_the_velocity_says_what_the_input_does():
    model, more = models.DoubleIntegrator(2, drag=0.2), {"horizon": 3.0, "dt": 0.01}
    gain = synthesize(model, TREE, Riccati())
    relay, told = (Consensus(gain, feedforward=way) for way in ("relay", "relay-velocity"))
    runs = [
        fly(model, TREE, law, Tracking(Circle()), initial={"position": 1.0}, **more)
        for law in (relay, told)
    ]
    assert np.abs(runs[0].states - runs[1].states).max() <= 1e-11
    assert told.information[1] == "the velocity that the leader's input of the same step makes"


def test_the_coupling_that_suffices_for_any_line_loses_quadrotors_on_a_long_one():
    model, more = models.Quadrotor(), {"horizon": 20.0, "dt": 0.005, "store_every": 100}
    # ||T|| = 1.49: a push grows by 3.3 along three agents, by 3000 along twenty.
    for followers, low, high in ((3, 0.0, 0.01), (20, 10.0, np.inf)):
        graph = Graph.path(followers + 1)
        law = Consensus(synthesize(model, graph, Riccati(coupling=1.0)), "parent")
        start, line = {"position": 1.0, "attitude": 0.3}, Formation.line(model, graph)
        run = fly(model, graph, law, Tracking(Hover((0, 0, 0))), line, initial=start, **more)
        assert low <= np.linalg.norm(run.errors[-1, :, :3], axis=1).max() < high
