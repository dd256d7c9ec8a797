"""Formations that change with time: their offsets, assignments, and what is refused."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echelon import Formation, Graph
from echelon.agents.models import DoubleIntegrator, Pendulum, PlanarQuadrotor, Quadrotor, Unicycle
from echelon.agents.network.formation_motion import (
    OffsetMotion,
    Reshape,
    Rotate,
    Scale,
    nearest_places,
)
from echelon.core.errors import FormationError

MODEL, GRAPH = DoubleIntegrator(3), Graph.star(5)
WEDGE = Formation.wedge(MODEL, GRAPH)


class Wave(OffsetMotion):
    """Heights that rise and fall."""

    size: float = 0.2

    def __call__(self, place, t):
        return place.at[-1].add(self.size * jnp.sin(t))


class Kinked(OffsetMotion):
    """A rise that begins suddenly, in a derivative of some order."""

    order: int = eqx.field(static=True, default=1)

    def __call__(self, place, t):
        return place.at[-1].add(jnp.where(t > 3.1, t - 3.1, 0.0) ** self.order)


def derivatives(formation, times, order):
    """Return the derivatives of positions (order + 1, T, N, d) by the motion itself."""
    motion = formation.motion
    with jax.enable_x64(True):
        rows = jnp.asarray(motion.places)
        one = jax.vmap(lambda row, t: motion.derivatives(row, t, order), (0, None))
        values = jax.jit(jax.vmap(one, (None, 0)))(rows, jnp.asarray(times))
    return np.moveaxis(np.asarray(values), 2, 0)


def test_a_shape_turns_and_breathes_about_its_leader():
    moving = WEDGE.moving(MODEL, GRAPH, [Rotate(0.5), Scale(0.4, 0.7)])
    for t in (0.0, 1.3, 7.0):
        [offsets] = moving.offsets_at([t])
        cos, sin, size = np.cos(0.5 * t), np.sin(0.5 * t), 1.0 + 0.4 * np.sin(0.7 * t)
        turned = WEDGE.offsets[:, :2] @ np.array([[cos, sin], [-sin, cos]])
        assert offsets[:, :2] == pytest.approx(size * turned, abs=1e-14)
        # The velocities of the goals are in the states of the velocity.
        h = 1e-6
        before, after = moving.offsets_at([t - h, t + h])[:, :, :3]
        assert offsets[:, 3:] == pytest.approx((after - before) / (2 * h), abs=1e-8)
    assert not moving.offsets_at([3.0])[0, 0].any()
    assert moving != WEDGE and moving == WEDGE.moving(MODEL, GRAPH, [Rotate(0.5), Scale(0.4, 0.7)])


def test_a_reshape_begins_and_ends_at_rest_with_five_derivatives():
    circle = Formation.circle(MODEL, GRAPH).offsets
    line = Formation.line(MODEL, GRAPH).offsets
    changes = [Reshape(circle, 4.0, 2.0), Reshape(line, 1.0, 3.0)]
    moving = WEDGE.moving(MODEL, GRAPH, changes)
    values = moving.offsets_at([0.5, 1.0, 4.0, 6.0, 50.0])
    shapes = np.stack([WEDGE.offsets, WEDGE.offsets, line, circle, circle])
    assert values[:, :, :3] == pytest.approx(shapes[:, :, :3], abs=1e-13)
    edges = derivatives(moving, [1.0, 4.0, 6.0], 5)
    assert np.abs(edges[1:]).max() < 1e-9
    # And all derivatives are continuous: each is the integral of the next.
    times = np.linspace(0.9, 6.1, 2081)
    values = derivatives(moving, times, 5)
    whole = np.trapezoid(values[1:], times, axis=1) - values[:-1, -1] + values[:-1, 0]
    assert (np.abs(whole).max(axis=(1, 2)) < 1e-4 * np.abs(values[1:]).max(axis=(1, 2, 3))).all()


def test_the_nearest_places_have_the_smallest_sum_of_squares():
    draw = np.random.default_rng(1)
    for _ in range(5):
        before, after = draw.normal(size=(2, 6, 3))
        order = nearest_places([2], before, after)

        def total(places, before=before, after=after):
            return ((before - after[list(places)]) ** 2).sum()

        least = min(total(p) for p in itertools.permutations(range(6)) if p[2] == 2)
        assert order[2] == 2 and total(order) == pytest.approx(least)


def test_assigned_ways_never_meet_and_others_are_named():
    swapped = WEDGE.offsets[[0, 2, 1, 4, 3]]
    ways = WEDGE.moving(MODEL, GRAPH, [Reshape(swapped, 1.0, 2.0)]).motion.meetings()
    [(begin, i, j, apart)] = ways
    assert (begin, apart) == (1.0, pytest.approx(0.0)) and {i, j} in ({1, 2}, {3, 4})
    draw = np.random.default_rng(0)
    for _ in range(20):
        goals = draw.normal(size=(5, 6))
        moving = WEDGE.moving(MODEL, GRAPH, [Reshape(goals, 1.0, 2.0, nearest=True)])
        [(_, i, j, apart)] = moving.motion.meetings()
        shares = np.linspace(0.0, 1.0, 2001)[:, None, None]
        first, last = moving.motion.places[:, 0], moving.motion.places[:, 1]
        rows = first + shares * (last - first)
        seen = np.linalg.norm(rows[:, i] - rows[:, j], axis=1).min()
        assert 0.0 < apart < seen + 1e-12 < apart + 1e-3


def test_a_first_formation_takes_the_places_nearest_to_its_starts():
    goals = WEDGE.offsets
    starts = {agent: goals[5 - agent] for agent in (1, 2, 3, 4)}
    assert np.array_equal(WEDGE.nearest(MODEL, GRAPH, starts).offsets[1:], goals[:0:-1])
    assert WEDGE.nearest(MODEL, GRAPH, {}) == WEDGE


def test_a_motion_of_one_s_own_moves_the_shape():
    moving = WEDGE.moving(MODEL, GRAPH, [Wave()])
    [offsets] = moving.offsets_at([2.0])
    assert offsets[:, 2] == pytest.approx(0.2 * np.sin(2.0))
    assert offsets[:, 5] == pytest.approx(0.2 * np.cos(2.0))


def test_velocities_are_states_of_their_own_where_they_are_derivatives():
    for model, speeds in (
        (Quadrotor(), (3, 4, 5)),
        (PlanarQuadrotor(), (3, 4)),
        (Unicycle(), (-1, -1)),
    ):
        graph = Graph.star(3)
        moving = Formation.line(model, graph).moving(model, graph, [Scale(0.1, 1.0)])
        assert moving.motion.speeds == speeds


@pytest.mark.parametrize(
    ("model", "changes", "message"),
    [
        (Pendulum(), [Scale(0.1, 1.0)], "`Pendulum` has no position"),
        (MODEL, [Reshape(np.zeros((4, 6)), 1.0, 1.0)], "offsets of shape (4, 6), and must"),
        (MODEL, [Reshape(np.zeros((5, 6)), -1.0, 1.0)], "`at` of a reshape is -1.0"),
        (MODEL, [Reshape(np.zeros((5, 6)), 1.0, 0.0)], "`over` of a reshape is 0.0"),
        (
            MODEL,
            [Reshape(np.zeros((5, 6)), 1.0, 3.0), Reshape(np.zeros((5, 6)), 2.0, 3.0)],
            "the reshape at 2 s begins before that at 1 s ends, at 4 s",
        ),
        (MODEL, [Scale(1.0, 1.0)], "`amplitude` of `Scale` is 1.0, and must be between -1 and 1"),
        (MODEL, [Rotate(np.inf)], "`rate` of `Rotate` is inf"),
        (PlanarQuadrotor(), [Rotate(1.0)], "the vertical axis, and the position of"),
        (MODEL, ["turn"], "a motion of a formation is `str`"),
        (MODEL, [Kinked(1)], "has no five derivatives: its derivative of order 1 jumps near 3"),
        (MODEL, [Kinked(4)], "has no five derivatives: its derivative of order 4 jumps near 3"),
        (MODEL, [Wave(np.nan)], "is not finite"),
    ],
)
def test_what_cannot_move_is_refused(model, changes, message):
    graph = Graph.star(5)
    formation = Formation(np.zeros((5, len(model.state_names))))
    with pytest.raises(FormationError) as error:
        formation.moving(model, graph, changes)
    assert message in str(error.value)


def test_a_sixth_power_has_five_derivatives():
    assert WEDGE.moving(MODEL, GRAPH, [Kinked(6)]).motion is not None


@pytest.mark.parametrize("size", [1e-70, 1.0, 1e70])
def test_places_of_any_size_are_assigned_and_their_meetings_are_known(size):
    before = size * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 3.0]])
    after = size * np.array([[0.0, 0.0], [0.0, 3.5], [1.0, 0.5]])
    assert nearest_places((0,), before, after).tolist() == [0, 2, 1]
    model, graph = DoubleIntegrator(2), Graph.star(3)
    to = np.zeros((3, 4))
    to[:, :2] = after
    formation = Formation(np.pad(before, ((0, 0), (0, 2))))
    moving = formation.moving(model, graph, [Reshape(to, 1.0, 2.0)])
    [(begin, i, j, apart)] = moving.motion.meetings()
    # Agents 1 and 2 cross: (1 - s, 3.5 s) and (s, 3 - 2.5 s) are nearest at s = 1/2.
    assert (begin, i, j) == (1.0, 1, 2) and apart == pytest.approx(0.0, abs=1e-12 * size)
