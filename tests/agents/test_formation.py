"""Formations: displacements, drawn shapes, rigidity and the symmetries that offsets need."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import adjacency, disagreements

from echelon import Formation, Graph
from echelon.agents import models
from echelon.core import numerics

DRAWN = {1: (1, 0, 0), 2: (1, 0.8, 0), 3: (1, -0.8, 0)}
TREE = Graph.from_edges([(0, 1), (1, 2), (1, 3)])
QUAD = models.Quadrotor()
PLANE = models.SingleIntegrator(2)


def points(formation, axes=2):
    return formation.offsets[:, :axes]


def test_the_drawn_formation_has_the_distances_of_the_paper():
    formation = Formation.from_offsets(QUAD, TREE, DRAWN)
    assert formation.offsets.shape == (4, 12)
    assert formation.offsets[:, :3].tolist() == [[0, 0, 0], [1, 0, 0], [1, 0.8, 0], [1, -0.8, 0]]
    assert not formation.offsets[:, 3:].any()
    assert formation.distances(TREE) == pytest.approx([1.0, 0.8, 0.8])


@given(st.integers(0, 10**6))
@settings(max_examples=20)
def test_displacements_point_from_an_agent_s_goal_to_its_neighbour_s(seed):
    rng = np.random.default_rng(seed)
    graph = Graph([(0, 1, 2.0), (1, 2, 0.5), (0, 2, 1.5), (2, 3, 1.0)])
    xi = rng.normal(size=(4, 2))
    formation = Formation(xi)
    for i, j in itertools.permutations(range(4), 2):
        assert formation.displacement(i, j) == pytest.approx(xi[j] - xi[i])
        assert formation.displacement(i, j) == pytest.approx(-formation.displacement(j, i))
    A = adjacency(4, graph.edges, graph.weights)
    d = np.array([sum(A[i, j] * (xi[j] - xi[i]) for j in range(4)) for i in range(4)])
    # z = e + d is the disagreement of the states minus their offsets.
    x = rng.normal(size=(4, 2))
    e = np.array([sum(A[i, j] * (x[i] - x[j]) for j in range(4)) for i in range(4)])
    with numerics.precision("float64"):
        z = np.asarray(graph.disagreement(jnp.asarray(x - xi)))
    assert z == pytest.approx(e + d, abs=1e-12)
    assert z == pytest.approx(disagreements(A, x, xi), abs=1e-12)


def test_offsets_may_be_given_over_all_states_and_are_kept_from_change():
    whole = np.arange(12.0)
    given_offsets = {2: whole, 3: [1, 2, 3]}
    formation = Formation.from_offsets(QUAD, TREE, given_offsets)
    assert formation.offsets[2].tolist() == whole.tolist()
    assert formation.offsets[3].tolist() == [1, 2, 3] + [0] * 9
    with pytest.raises(ValueError, match="read-only"):
        formation.offsets[0, 0] = 1.0
    whole[0] = 99.0
    assert formation.offsets[2, 0] == 0.0


def test_offsets_of_a_position_in_the_middle_of_the_state_go_there():
    class Cart(Carried):
        state_names = ("charge", "x", "speed", "y")
        position = ("x", "y")

    formation = Formation.from_offsets(Cart(), Graph.path(2), {1: (3, 4)})
    assert formation.offsets[1].tolist() == [0.0, 3.0, 0.0, 4.0]


def drawn(kind, agents, model=PLANE, **options):
    return getattr(Formation, kind)(model, Graph.path(agents), **options)


KINDS = ("triangle", "line", "wedge", "circle", "grid")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("agents", [2, 3, 4, 7, 12])
def test_drawn_formations_start_at_the_leader_and_keep_their_spacing(kind, agents):
    where = points(drawn(kind, agents, spacing=1.5))
    assert where[0].tolist() == [0.0, 0.0]
    if kind != "circle":
        assert where[:, 0].max() <= 0.0, "nobody stands before the leader"
    gaps = [np.linalg.norm(p - q) for p, q in itertools.combinations(where, 2)]
    # On a circle of many, neighbours on the ring are the nearest; of few, the hub is.
    ring = agents - 1
    hub = 1.5 if ring < 3 else 0.75 / np.sin(np.pi / ring)
    assert min(gaps) == pytest.approx(min(1.5, hub) if kind == "circle" else 1.5)
    assert len(np.unique(where.round(9), axis=0)) == agents
    # One metre unless said otherwise.
    assert where == pytest.approx(1.5 * points(drawn(kind, agents)))


BACK, H = 2.0 * np.sqrt(0.75), np.sqrt(0.5)


@pytest.mark.parametrize(
    ("kind", "options", "rows"),
    [
        (
            "triangle",
            {"spacing": 2.0},
            [[0, 0], [-BACK, -1], [-BACK, 1], [-2 * BACK, -2], [-2 * BACK, 0], [-2 * BACK, 2]],
        ),
        ("line", {"spacing": 0.5}, [[0, 0], [-0.5, 0], [-1, 0], [-1.5, 0]]),
        ("wedge", {}, [[0, 0], [-H, H], [-H, -H], [-2 * H, 2 * H], [-2 * H, -2 * H]]),
        ("grid", {"columns": 2}, [[0, 0], [0, 1], [-1, 0], [-1, 1], [-2, 0]]),
        ("grid", {}, [[-(k // 3), k % 3] for k in range(9)]),
    ],
)
def test_drawn_shapes_have_their_places(kind, options, rows):
    assert points(drawn(kind, len(rows), **options)) == pytest.approx(np.array(rows))


def test_a_circle_surrounds_the_leader_with_equal_chords():
    where = points(drawn("circle", 7, spacing=2.0))
    assert np.linalg.norm(where[1:], axis=1) == pytest.approx([2.0] * 6)
    chords = np.linalg.norm(np.roll(where[1:], -1, axis=0) - where[1:], axis=1)
    assert chords == pytest.approx([2.0] * 6)


def test_formations_are_drawn_on_the_first_two_position_coordinates():
    high = Formation.triangle(QUAD, TREE, spacing=2.0)
    assert not high.offsets[:, 2:].any()
    upright = Formation.wedge(models.PlanarQuadrotor(), TREE)
    assert not upright.offsets[:, 2:].any() and upright.offsets[1, 1] != 0.0
    single = Formation.line(models.SingleIntegrator(1), TREE, spacing=2.0)
    assert single.offsets.ravel().tolist() == [0.0, -2.0, -4.0, -6.0]


def numeric_rigidity(where, edges):
    """Jacobian of half the squared edge lengths, by differences."""
    flat, h = where.ravel(), 1e-6

    def lengths(flat):
        p = flat.reshape(where.shape)
        return np.array([0.5 * np.sum((p[i] - p[j]) ** 2) for i, j in edges])

    columns = [(lengths(flat + h * e) - lengths(flat - h * e)) / (2 * h) for e in np.eye(flat.size)]
    return np.column_stack(columns)


def test_the_rigidity_matrix_is_the_slope_of_the_edge_lengths():
    formation = Formation.from_offsets(QUAD, TREE, DRAWN)
    R = formation.rigidity_matrix(QUAD, TREE)
    assert R.shape == (3, 12)
    wanted = numeric_rigidity(formation.offsets[:, :3], TREE.edges)
    assert R == pytest.approx(wanted, abs=1e-8)


def test_the_drawn_formation_is_not_rigid_and_a_complete_tetrahedron_is():
    formation = Formation.from_offsets(QUAD, TREE, DRAWN)
    assert np.linalg.matrix_rank(formation.rigidity_matrix(QUAD, TREE)) == 3
    assert not formation.is_rigid(QUAD, TREE)
    complete = Graph.complete(4)
    # Even with every edge it is not, since four points of a plane can bend out of it.
    assert not formation.is_rigid(QUAD, complete)
    solid = Formation.from_offsets(QUAD, complete, {**DRAWN, 3: (1, 0, 0.8)})
    assert np.linalg.matrix_rank(solid.rigidity_matrix(QUAD, complete)) == 6
    assert solid.is_rigid(QUAD, complete)


@pytest.mark.parametrize(
    ("offsets", "edges", "rigid"),
    [
        ({1: (1, 0), 2: (0, 1)}, [(0, 1), (1, 2), (0, 2)], True),
        ({1: (1, 0), 2: (2, 0)}, [(0, 1), (1, 2), (0, 2)], False),
        ({1: (1, 0), 2: (1, 1), 3: (0, 1)}, [(0, 1), (1, 2), (2, 3), (0, 3)], False),
        ({1: (1, 0), 2: (1, 1), 3: (0, 1)}, [(0, 1), (1, 2), (2, 3), (0, 3), (0, 2)], True),
        ({1: (1, 0)}, [(0, 1)], True),
        ({}, [(0, 1)], False),
        # Few agents in space have fewer motions to spare.
        ({1: (1, 0, 0)}, [(0, 1)], True),
        ({1: (1, 0, 0), 2: (0, 1, 0)}, [(0, 1), (1, 2), (0, 2)], True),
    ],
)
def test_rigidity_is_that_of_rods_and_triangles(offsets, edges, rigid):
    graph, model = Graph.from_edges(edges), models.SingleIntegrator(len(offsets.get(1, (0, 0))))
    assert Formation.from_offsets(model, graph, offsets).is_rigid(model, graph) is rigid


def test_agents_with_one_goal_are_named_in_pairs():
    graph = Graph.star(5)
    offsets = {1: (1, 0), 2: (0, 0), 3: (1, 0), 4: (1, 0)}
    assert Formation.from_offsets(PLANE, graph, offsets).coincident() == ((0, 2), (1, 3), (1, 4))
    assert Formation.line(PLANE, graph).coincident() == ()


SYMMETRIC = [
    (QUAD, (1.0, -2.0, 0.5)),
    (models.PlanarQuadrotor(), (1.0, -2.0)),
    (models.DoubleIntegrator(2, drag=0.3), (1.0, 2.0)),
    (models.SingleIntegrator(3), (1.0, 2.0, 3.0)),
    (models.UnicyclePoint(), (1.0, 2.0)),
    (models.Linear([[0.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]]), (5.0, 0.0)),
]


@pytest.mark.parametrize(("model", "offset"), SYMMETRIC, ids=lambda v: type(v).__name__)
def test_position_offsets_are_symmetries_of_vehicles(model, offset):
    formation = Formation.from_offsets(model, TREE, {1: offset, 2: (0,) * len(offset)})
    assert formation.is_invariant(model)
    assert formation.broken_symmetries(model) == {}


def over(names, **values):
    return [values.get(name, 0.0) for name in names]


@pytest.mark.parametrize(
    ("model", "moved", "sentence"),
    [
        (QUAD, "roll", "it changes the drift of `"),
        (QUAD, "vx", "it changes the drift of `x`"),
        (models.PlanarQuadrotor(), "roll", "it changes the input map of `v"),
        (models.DoubleIntegrator(2), "vy", "it changes the drift of `y`"),
        (models.UnicyclePoint(), "heading", "it changes the input map of `"),
        (models.VanDerPol(), "position", "it changes the drift of `velocity`"),
        (models.Pendulum(), "angle", "it changes the drift of `rate`"),
    ],
    ids=lambda v: v if isinstance(v, str) else type(v).__name__,
)
def test_offsets_that_change_the_dynamics_are_named_with_agent_and_reason(model, moved, sentence):
    bad = over(model.state_names, **{moved: 0.3})
    formation = Formation.from_offsets(model, TREE, {2: bad})
    broken = formation.broken_symmetries(model)
    assert list(broken) == [2]
    assert broken[2].startswith(sentence)
    assert not formation.is_invariant(model)


YAW = over(QUAD.state_names, yaw=0.4)


@pytest.mark.parametrize(
    ("offsets", "broken"),
    [
        # What counts is the offset from the leader, whose own breaks that of all others.
        (dict.fromkeys(range(4), YAW), []),
        ({0: YAW}, [1, 2, 3]),
        # Zeros count whatever their sign bit.
        ({1: (-0.0, 0.0, 0.0)}, []),
        ({1: (1.0, 0.0, 0.0), 2: (1.0, -0.0, 0.0)}, []),
        ({1: YAW, 2: [value or -0.0 for value in YAW]}, [1, 2]),
    ],
)
def test_broken_symmetries_are_those_of_offsets_from_the_leader(offsets, broken):
    formation = Formation.from_offsets(QUAD, TREE, offsets)
    assert list(formation.broken_symmetries(QUAD)) == broken
    assert formation.is_invariant(QUAD) is (not broken)


class Carried(models.SingleIntegrator):
    """Points that a wind carries along x, and that push with some strength."""

    wind: object = staticmethod(jnp.zeros_like)
    push: object = staticmethod(jnp.ones_like)

    def drift(self, x):
        return self.wind(x)

    def input_map(self, x):
        return self.push(x[0]) * jnp.eye(len(self.state_names))


@pytest.mark.parametrize(
    ("changes", "fine"),
    [
        ({"wind": lambda x: 1e-6 * x}, False),
        ({"wind": lambda x: 1e-6 * x - 1e-6 * x}, True),
        ({"push": lambda x: 1e6 + x}, False),
        ({"push": lambda x: 1e8 * (jnp.sin(x) ** 2 + jnp.cos(x) ** 2)}, True),
        ({"push": lambda x: 1e8 * (jnp.sin(x) ** 2 + 1.0001 * jnp.cos(x) ** 2)}, False),
        # A ripple too low to be seen by its height.
        ({"wind": lambda x: 1e-10 * jnp.sin(1e4 * x)}, False),
        # Of a wave of the offset's length nothing changes, and of half of it the sign alone.
        ({"wind": lambda x: jnp.sin(2.0 * jnp.pi * x)}, True),
        ({"wind": lambda x: jnp.sin(jnp.pi * x)}, False),
        ({"wind": lambda x: jnp.sin(jnp.pi * x) ** 2 + 1e-5 * jnp.sin(jnp.pi * x)}, False),
    ],
)
def test_small_changes_count_and_rounding_does_not(changes, fine):
    model = Carried(1, **changes)
    formation = Formation.from_offsets(model, TREE, {1: (1.0,), 2: (0.0,)})
    assert formation.is_invariant(model) is fine


def test_a_whole_turn_is_a_symmetry_of_a_pendulum():
    # f(x + d) = f(x) for all x, which is all that the theorem needs.
    formation = Formation.from_offsets(models.Pendulum(), TREE, {2: (2.0 * np.pi, 0.0)})
    assert formation.is_invariant(models.Pendulum())


def test_formations_of_the_same_offsets_are_equal_and_hash_alike():
    one, same, other = (Formation([[0.0, 0.0], [x, 1.0]]) for x in (0.0, -0.0, 2.0))
    assert one == same and hash(one) == hash(same) and len({one, same, other}) == 2
    assert one != other != one.offsets.tolist()
