"""The certificate of the steps that run, against matrices of the whole loop by hand."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import echelon as ech
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis
from echelon.core.words import Verdict
from echelon.guarantees.local.local_certificate import Fault, LocalCertificate, local_certificate
from echelon.guarantees.local.local_lines import local_lines
from echelon.simulation.engine.prepare import prepare

SETTINGS = ech.Settings(horizon=2.0, dt=0.02)
CART = ech.models.DoubleIntegrator(dimension=1)
POINT = ech.models.SingleIntegrator(dimension=1)


def certificate(model, graph, follower, leader=None, settings=SETTINGS, **more):
    """The certificate of agents at rest behind a leader that rests."""
    laws = ech.Laws(leader or ech.laws.TrimInput(), follower)
    formation = ech.Formation(np.zeros((graph.agents, len(model.state_names))))
    parts = ech.Parts(model, graph, formation, laws, **more)
    with precision("float64"):
        return local_certificate(prepare(parts, settings))


def held(A, B, dt):
    """The exact step of xdot = A x + B u, u held."""
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    flow = scipy.linalg.expm(block * dt)[:n]
    return flow[:, :n], flow[:, n:]


def grounded(graph):
    """L_g by its definition, from the edges and weights."""
    L = np.zeros((graph.agents, graph.agents))
    for (i, j), w in zip(graph.edges, graph.weights, strict=True):
        rows = ((j, i),) if graph.directed else ((i, j), (j, i))
        for a, b in rows:
            L[a, a], L[a, b] = L[a, a] + w, L[a, b] - w
    return L[np.ix_(graph.followers, graph.followers)]


def radius(W):
    return float(np.abs(np.linalg.eigvals(W)).max())


class Beam(ech.ControlAffine):
    """x'' = -stiffness x + u: a mode that nothing damps."""

    stiffness: float = 400.0
    state_names = "x", "v"
    input_names = ("u",)

    def drift(self, x):
        return jnp.stack([x[1], -self.stiffness * x[0]])

    def input_map(self, x):
        return jnp.array([[0.0], [1.0]])


class Rover(ech.ControlAffine):
    """x' = push u."""

    push: float = 1.0
    state_names = ("x",)
    input_names = ("u",)

    def drift(self, x):
        return 0.0 * x

    def input_map(self, x):
        return jnp.full((1, 1), self.push)


class Pull(ech.Law):
    """u = -z."""

    def update(self, model, view, memory):
        return -view.disagreement, memory


class Spring(ech.Law):
    """u = -stiffness z_position - damping z_velocity."""

    stiffness: float = 2.0
    damping: float = 3.0

    def update(self, model, view, memory):
        z = view.disagreement
        return -jnp.array([self.stiffness * z[0] + self.damping * z[1]]), memory


@pytest.mark.parametrize("graph", [ech.Graph.path(4), ech.Graph.path(4, directed=True)])
@pytest.mark.parametrize("gains", [(2.0, 3.0), (-1.0, 3.0)])
def test_a_law_of_ones_own_is_judged_by_the_matrix_of_the_whole_loop(graph, gains):
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    F, G = held(A, B, SETTINGS.dt)
    W = np.kron(np.eye(3), F) - np.kron(grounded(graph), G @ np.array([gains]))
    found = certificate(CART, graph, Spring(*gains))
    # A Jordan block of a chain moves its eigenvalues by a root of the rounding.
    assert found.radius == pytest.approx(radius(W), abs=1e-4 if graph.directed else 1e-12)
    assert found.exact == pytest.approx(found.radius, abs=1e-6)
    assert found.holds is (gains[0] > 0.0)


class Remembering(ech.Law):
    """u = -z, with a memory that does one thing."""

    kind: str = eqx.field(static=True)
    rate: float = 0.5

    def init(self):
        whole = self.kind == "counter"
        return jnp.zeros((), jnp.int32) if whole else jnp.zeros(1)

    def begin(self, model, x):
        return x if self.kind == "start" else self.init()

    def update(self, model, view, memory):
        z, u = view.disagreement, -view.disagreement
        if self.kind == "integral":
            memory = memory + view.period * z
            return u - self.rate * memory, memory
        if self.kind == "start":
            return u - 0.3 * memory, memory
        if self.kind == "log":
            return u, memory + z
        if self.kind == "counter":
            return jnp.where(memory > 100, -u, u), memory + 1
        if self.kind == "clock":
            return u / (1.0 + view.t) ** 2, memory
        if self.kind == "kink":
            return u - 0.5 * jnp.abs(z), memory
        if self.kind == "jump":
            return u - 0.5 * jnp.sign(z), memory
        if self.kind == "unsteady":
            return u + 0.1, memory
        return u, memory


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("start", Fault.LASTING),
        ("log", None),
        ("counter", Fault.WHOLE),
        ("clock", Fault.TIME),
        ("kink", Fault.KINK),
        ("jump", Fault.KINK),
        ("unsteady", Fault.OFF_GOALS),
    ],
)
def test_what_a_law_remembers_and_how_it_bends_decides(kind, fault):
    found = certificate(POINT, ech.Graph.path(3), Remembering(kind))
    assert found.faults == (() if fault is None else (fault,))


@pytest.mark.parametrize("rate", [0.5, -0.5])
def test_an_integral_is_part_of_the_loop(rate):
    dt, L = SETTINGS.dt, grounded(ech.Graph.path(3))
    # s = (x, area): area+ = area + dt z, x+ = x - dt (z + rate area+).
    one = np.eye(2)
    W = np.block([[one - dt * (1.0 + rate * dt) * L, -dt * rate * one], [dt * L, one]])
    found = certificate(POINT, ech.Graph.path(3), Remembering("integral", rate))
    assert found.radius == pytest.approx(radius(W), rel=1e-12)
    assert found.holds is (rate > 0.0)


def test_messages_of_one_age_have_the_matrix_of_the_engine():
    graph, k, dt = ech.Graph.ring(5), 7, SETTINGS.dt
    network = ech.Network(rate=50.0, delay=k * dt, messages="state", forget=1.0)
    found = certificate(POINT, graph, ech.laws.Agreement(), world=ech.World(network=network))
    L = grounded(graph)
    own, heard = np.diag(np.diag(L)), np.diag(np.diag(L)) - L
    # x+ = x - dt (D x - A x(t - k)), with the k states before as more numbers.
    n = len(L)
    W = np.eye(n * (k + 1), k=-n)
    W[:n] = 0.0
    W[:n, :n], W[:n, -n:] = np.eye(n) - dt * own, dt * heard
    assert found.radius == pytest.approx(radius(W), rel=1e-9)
    assert found.holds and found.steady


def test_one_step_may_damp_what_the_vehicle_amplifies():
    # w dt = 2.4, as a beam that is not damped: the engine's step says .87, the vehicle 1.78.
    beam = Beam()
    gain = ech.synthesize(beam, ech.Graph.path(4), ech.gains.Riccati())
    law = ech.laws.Consensus(gain, feedforward="none")
    found = certificate(beam, ech.Graph.path(4), law, settings=ech.Settings(12.0, dt=0.12))
    L, K = grounded(ech.Graph.path(4)), gain.R_inverse @ np.array([[0.0, 1.0]]) @ gain.P
    F, G = held(np.array([[0.0, 1.0], [-400.0, 0.0]]), np.array([[0.0], [1.0]]), 0.12)
    W = np.kron(np.eye(3), F) - gain.coupling * np.kron(L, G @ K)
    assert found.exact == pytest.approx(radius(W), rel=1e-9)
    assert found.radius < 1.0 < found.exact and Fault.GROWS_EXACTLY in found.faults


def test_of_a_graph_that_switches_the_last_one_decides_or_the_product():
    first, last = ech.Graph.path(4), ech.Graph.star(4)
    dt = SETTINGS.dt
    each = [np.eye(3) - dt * grounded(graph) for graph in (first, last)]
    stretches = [(0.0, first.edges.tolist()), (0.5, last.edges.tolist())]
    once = ech.Graph.switching(stretches, agents=4)
    found = certificate(POINT, once, ech.laws.Agreement())
    assert found.radius == pytest.approx(radius(each[1]), rel=1e-12)
    again = ech.Graph.switching(stretches, agents=4, period=0.8)
    found = certificate(POINT, again, ech.laws.Agreement())
    whole = np.linalg.matrix_power(each[1], 15) @ np.linalg.matrix_power(each[0], 25)
    assert found.period == 40
    assert found.radius == pytest.approx(radius(whole) ** (1 / 40), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["undirected", "rings", "last"])
def test_large_formations_split_as_the_whole_matrix_does(kind):
    random, agents, model = np.random.default_rng(3), 390, ech.models.DoubleIntegrator(dimension=2)
    tree = [(int(random.integers(k)), k) for k in range(1, agents)]
    more = random.integers(1, agents, (300, 2)).tolist()
    links = sorted({(min(e), max(e)) for e in [*tree, *more] if e[0] != e[1]})
    back = [(j, i) for i, j in links if i and random.random() < 0.5]
    graph = once = ech.Graph(links, [0], agents)
    if kind == "rings":
        graph = once = ech.Graph([*links, *back], [0], agents, directed=True)
    if kind == "last":
        graph = ech.Graph.switching([(0.0, tree), (0.1, links)], [0], agents)
    one = np.eye(2)
    P, K = np.kron([[2.0, 1.0], [1.0, 2.0]], one), 0.5 * np.kron([[1.0, 2.0]], one)
    gain = ech.gains.FixedGain(P=P.tolist(), coupling=0.5)
    law = ech.laws.Consensus(ech.synthesize(model, graph, gain), feedforward="relay")
    found = certificate(model, graph, law)
    cart = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    F, G = held(*(np.kron(part, one) for part in cart), SETTINGS.dt)
    L = grounded(once)
    values, vectors = np.linalg.eig(L)
    modes, shapes = np.linalg.eig(F - values[:, None, None] * (G @ K))
    k, j = np.unravel_index(np.abs(modes).argmax(), modes.shape)
    slowest = np.kron(vectors[:, k], shapes[k][:, j])
    whole = np.kron(np.eye(len(L)), F) - np.kron(L, G @ K)
    assert np.linalg.norm(whole @ slowest - modes[k, j] * slowest) < 1e-9
    assert found.split
    assert found.radius == pytest.approx(abs(modes[k, j]), rel=1e-9)
    assert found.exact == pytest.approx(found.radius, rel=1e-9)


def test_agents_unlike_each_other_have_one_matrix():
    graph, dt = ech.Graph.path(4), SETTINGS.dt
    found = certificate(Rover(), graph, Pull(), world=ech.World(plants={2: Rover(0.4)}))
    W = np.eye(3) - dt * np.diag([1.0, 0.4, 1.0]) @ grounded(graph)
    assert found.radius == pytest.approx(radius(W), rel=1e-12) and not found.split


@pytest.mark.slow
def test_the_bundled_formation_has_the_rate_of_its_own_matrix():
    parts, settings = ech.build(ech.load_scenario("paper"))
    found = ech.guarantee(parts, settings)
    assert found.rate == pytest.approx(1.2689394572, rel=1e-9)
    assert found.hypotheses[Hypothesis.DISAGREEMENT_DECAY].verdict is Verdict.HOLDS


@pytest.mark.parametrize("radius", [None, 0.9])
@pytest.mark.parametrize("fault", Fault)
def test_no_fault_leaves_a_guarantee(fault, radius):
    """Each has a line that rules it out, whether or not a radius is known."""
    parts, settings = ech.build(ech.load_scenario("integrators"))
    exact = 1.1 if fault is Fault.GROWS_EXACTLY else None
    known = radius if exact is None else 0.9
    local = LocalCertificate((fault,), radius=known, exact=exact)
    lines = local_lines(parts, settings, local, 0.0)
    assert any(line.fails and line.reason for line in lines)
