"""Formations given by distances, against places that this test draws and matrices of its own."""

import itertools

import numpy as np
import pytest

import echelon as ech
from echelon.agents.network.distance_shapes import realize


def all_pairs(agents):
    return [*itertools.combinations(range(agents), 2)]


def lengths(places, pairs):
    return [(i, j, float(np.linalg.norm(places[i] - places[j]))) for i, j in pairs]


def table(places):
    return np.linalg.norm(places[:, None] - places[None], axis=2)


def drawn(seed):
    draws = np.random.default_rng(seed)
    axes, agents = draws.integers(1, 4), draws.integers(2, 8)
    pairs = all_pairs(agents)
    count = draws.integers(max(1, agents - 1), len(pairs) + 1)
    return draws.normal(size=(agents, axes)), [
        pairs[k] for k in draws.permutation(len(pairs))[:count]
    ]


@pytest.mark.parametrize("seed", range(25))
def test_drawn_distances_are_realized_and_a_unique_shape_is_the_drawn_one(seed):
    places, pairs = drawn(seed)
    found = realize(*places.shape, lengths(places, pairs))
    for i, j, length in lengths(places, pairs):
        assert np.linalg.norm(found.places[i] - found.places[j]) == pytest.approx(length, abs=1e-8)
    if found.unique:
        np.testing.assert_allclose(table(found.places), table(places), atol=1e-6)
    for other in found.others:
        assert np.abs(table(other) - table(found.places)).max() > 1e-6
        for i, j, length in lengths(places, pairs):
            assert np.linalg.norm(other[i] - other[j]) == pytest.approx(length, abs=1e-8)


@pytest.mark.parametrize("seed", range(25))
def test_a_shape_is_rigid_where_nothing_but_rigid_motions_keeps_squares(seed):
    places, pairs = drawn(seed)
    found = realize(*places.shape, lengths(places, pairs))
    p, (agents, axes) = found.places, found.places.shape
    rows = []
    for i, j in pairs:
        row = np.zeros((agents, axes))
        row[i], row[j] = p[i] - p[j], p[j] - p[i]
        rows.append(row.ravel())
    free = agents * axes - np.linalg.matrix_rank(np.array(rows), tol=1e-6)
    # Translations and rotations of these points: those about each plane of two axes.
    moves = [np.tile(axis, (agents, 1)).ravel() for axis in np.eye(axes)]
    for a, b in itertools.combinations(range(axes), 2):
        turn = np.zeros((axes, axes))
        turn[a, b], turn[b, a] = 1.0, -1.0
        moves.append((p @ turn).ravel())
    assert found.rigid == (free == np.linalg.matrix_rank(np.array(moves), tol=1e-6))


TRIANGLES = np.array([[0.0, 0.0], [1.0, 0.0], [0.4, 0.9], [0.5, -1.1]])


def test_two_triangles_on_an_edge_are_rigid_and_not_the_only_shape():
    pairs = [(0, 1), (0, 2), (1, 2), (0, 3), (1, 3)]
    found = realize(4, 2, lengths(TRIANGLES, pairs))
    assert (found.rigid, found.unique, len(found.others)) == (True, False, 1)
    apart = sorted(float(table(p)[2, 3]) for p in (found.places, *found.others))
    folded = TRIANGLES * [[1, 1], [1, 1], [1, 1], [1, -1]]
    assert apart == pytest.approx(sorted([table(TRIANGLES)[2, 3], table(folded)[2, 3]]))
    assert realize(4, 2, lengths(TRIANGLES, all_pairs(4))).unique


def test_what_is_flat_is_decided_by_all_distances_alone():
    line = np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0], [4.0, 0.0]])
    found = realize(4, 2, lengths(line, [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3)]))
    assert found.unique is None and not found.mirrored
    whole = realize(4, 2, lengths(line, all_pairs(4)))
    assert whole.unique and not whole.mirrored
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    assert not realize(4, 3, lengths(square, all_pairs(4))).mirrored


@pytest.mark.parametrize(
    ("distances", "axes", "told"),
    [
        ([(0, 1, 1.0), (1, 2, 1.0), (0, 2, 3.0)], 2, "0 and 2 are 3 m apart, and a way over"),
        ([(*pair, 1.0) for pair in all_pairs(4)], 2, "among agents 0, 1, 2 and 3"),
        # Each triangle exists, and the tetrahedron does not.
        ([(0, 1, 1.0), (0, 2, 1.0), (1, 2, 1.0), (0, 3, 0.51), (1, 3, 0.51), (2, 3, 0.51)], 3,
         "no 4 points"),
        ([(0, 0, 1.0)], 2, "between agents 0 and 0"),
        ([(0, 9, 1.0)], 2, "between agents 0 and 9"),
        ([(0, 1, -1.0)], 2, "is -1 m, and must be above 0"),
        ([(0, 1, np.nan)], 2, "must be above 0"),
        ([(0, 1, 1.0), (1, 0, 2.0)], 2, "two distances are given between agents 1 and 0"),
        ([], 2, "is empty"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_the_reason(distances, axes, told):
    with pytest.raises(ech.errors.FormationError, match=told):
        realize(4, axes, distances)


def test_a_shape_without_a_proof_against_it_is_said_not_to_be_found():
    # Five of six edges of a wheel that is too small for its rim, without a triangle that fails.
    rim = [(k, (k + 1) % 5, 1.0) for k in range(5)]
    spokes = [(k, 5, 0.8) for k in range(5)]
    with pytest.raises(ech.errors.FormationError, match="no shape with these distances was found"):
        realize(6, 2, rim + spokes)


@pytest.mark.parametrize("axes", [2, 3])
def test_it_is_turned_to_the_starts_and_never_mirrored_away_from_them(axes):
    draws = np.random.default_rng(axes)
    near = draws.normal(size=(5, axes))
    turn, _ = np.linalg.qr(draws.normal(size=(axes, axes)))
    for image in (turn, turn @ np.diag([-1.0] + [1.0] * (axes - 1))):
        found = realize(5, axes, lengths(near @ image, all_pairs(5)), near)
        np.testing.assert_allclose(found.places, near - near[0], atol=1e-7)


def test_a_scenario_keeps_its_distances_whatever_the_seed(tmp_path):
    file = tmp_path / "own.yaml"
    lines = ["name: own", "model: {name: double-integrator, parameters: {dimension: 2}}"]
    lines += ["graph: {edges: [[0, 1], [1, 2], [1, 3]]}", "leader: {law: passive}"]
    lines += ["formation: {distances: [[0, 1, 1.0], [1, 2, 0.8], [1, 3, 0.8], [2, 3, 0.9]]}"]
    lines += ["simulation: {horizon: 8, dt: 0.02}"]
    file.write_text("\n".join(lines))
    shapes = []
    for seed in (0, 1):
        result = ech.run(ech.load_scenario(file, [f"seed={seed}"]))
        p = result.states[-1][:, :2]
        shapes.append(result.offsets)
        for i, j, length in ((0, 1, 1.0), (1, 2, 0.8), (1, 3, 0.8), (2, 3, 0.9)):
            assert np.linalg.norm(p[i] - p[j]) == pytest.approx(length, abs=1e-2)
        assert any("leave the shape flexible" in text for text in result.warnings)
    np.testing.assert_array_equal(*shapes)


def test_the_starts_of_a_scenario_choose_heading_and_mirror_image(tmp_path):
    file = tmp_path / "own.yaml"
    lines = ["name: own", "model: {name: double-integrator, parameters: {dimension: 2}}"]
    lines += ["graph: {edges: [[0, 1], [1, 2]]}", "leader: {law: passive}"]
    lines += ["formation: {distances: [[0, 1, 1.0], [1, 2, 1.0], [0, 2, 1.2]]}"]
    lines += ["simulation: {horizon: 8, dt: 0.02}"]
    lines += ["initial: {states: {0: [0, 0, 0, 0], 1: [0, 2, 0, 0], 2: [-1, 1, 0, 0]}}"]
    file.write_text("\n".join(lines))
    parts, _ = ech.build(ech.load_scenario(file))
    p = parts.formation.offsets[:, :2]
    across = (p[1] - p[0])[0] * (p[2] - p[0])[1] - (p[1] - p[0])[1] * (p[2] - p[0])[0]
    assert p[1][1] > 0.8 and across > 0.5
    again = "formation.motion=[{reshape: {distances: [[0, 1, 1.0], [1, 2, 1.0]]}, at: 2, over: 2}]"
    parts, settings = ech.build(ech.load_scenario(file, [again]))
    assert any("flexible" in text for text in ech.check(parts, settings).warnings)
    nearest = again.replace("over: 2", "over: 2, assign: nearest")
    for change in ("formation.assign=nearest", nearest):
        with pytest.raises(ech.EchelonError, match="`distances` are of agents by number"):
            ech.build(ech.load_scenario(file, [change]))


def test_rounded_distances_are_refused_with_how_far_off_they_are():
    # The diagonals of a square with sides of .8 m, to a millimetre.
    square = [(0, 1, 0.8), (1, 2, 0.8), (2, 3, 0.8), (3, 0, 0.8), (0, 2, 1.131), (1, 3, 1.131)]
    with pytest.raises(ech.errors.FormationError, match=r"found is off by 0\.000\d+ m"):
        realize(4, 2, square)
    with pytest.raises(ech.errors.FormationError, match="`near` must be 4 places of 2 finite"):
        realize(4, 2, square[:5], np.zeros((4, 3)))
