"""References: closed forms, derivatives by differences, splines by a second linear system."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon.agents import references
from echelon.agents.references import (
    Circle,
    FigureEight,
    Hover,
    Lemniscate,
    Line,
    Polynomials,
    Reference,
    StatePath,
    Waypoints,
)
from echelon.agents.references.flatness import reference_warnings
from echelon.core import numerics
from echelon.experiments.scenario import registry

ALL = ("x", "y", "z", "yaw")
TIMES = [0.0, 1.0, 2.5, 4.0]
POINTS = [[0.0, 0.0, 1.0], [1.0, -0.5, 1.5], [2.0, 0.5, 1.0], [2.0, 0.0, 0.5]]
FAMILY = {
    "lemniscate": Lemniscate(phase=0.4, yaw=0.3),
    "figure-eight": FigureEight(center=(1.0, 2.0, 3.0), amplitude=(1.5, 0.7), rate=1.1),
    "circle": Circle(center=(1.0, -1.0, 2.0), radius=0.7, rate=-1.3, phase=0.2),
    "hover": Hover(position=(1.0, 2.0, 3.0), yaw=-0.5),
    "line": Line(start=(1.0, 2.0, 3.0), velocity=(0.5, -0.25, 0.125), yaw=0.1),
    "waypoints": Waypoints(TIMES, POINTS, yaw=0.7),
    "polynomials": Polynomials.of(Waypoints(TIMES, POINTS, yaw=0.7), 4.0),
}
every_reference = pytest.mark.parametrize("reference", FAMILY.values(), ids=FAMILY)


def at(reference, t, order=None, coordinates=ALL):
    """(x, y, z, yaw) at t in float64, or the stack of it and its derivatives."""
    with numerics.precision("float64"):
        t = jnp.asarray(float(t))
        value = reference(t) if order is None else reference.derivatives(t, order, coordinates)
        return np.asarray(value)


def test_the_family_of_these_tests_is_the_whole_family():
    members = {getattr(references, name) for name in references.__all__}
    # A path of states is not one in space, and has tests of its own.
    assert {type(reference) for reference in FAMILY.values()} == members - {Reference, StatePath}
    assert set(FAMILY) == set(registry.REFERENCES) - {"states"}


@every_reference
@pytest.mark.parametrize("t", [0.3, 1.7, 3.1])
def test_each_derivative_is_the_slope_of_the_one_before(reference, t):
    h = 1e-2
    weights = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12.0 * h)
    # The difference errs by h^4 / 30 times the fifth derivative on.
    around = np.stack([at(reference, t + k * h, order=4) for k in range(-2, 3)])
    slope = np.tensordot(weights, around, axes=1)
    size = 1.0 + np.abs(around[2]).max()
    assert around[2][1:] == pytest.approx(slope[:-1], abs=2e-5 * size)
    assert around[2][0] == pytest.approx(at(reference, t), abs=1e-15)


@every_reference
def test_coordinates_are_picked_by_name_in_the_order_of_the_names(reference):
    full = at(reference, 0.6, order=3)
    assert at(reference, 0.6, order=3, coordinates=("yaw", "y")) == pytest.approx(full[:, [3, 1]])
    assert at(reference, 0.6, order=0, coordinates=("z",)) == pytest.approx(full[:1, 2:3])
    # The yaw is constant.
    yaws = [at(reference, t)[3] for t in (0.0, 3.0, 9.0)]
    assert yaws == pytest.approx([getattr(reference, "yaw", 0.7)] * 3, abs=0.0)


@every_reference
@pytest.mark.parametrize("name", ["float64", "float32"])
def test_references_compute_in_the_precision_of_the_time(reference, name):
    with numerics.precision(name):
        value = reference(jnp.asarray(0.3))
        assert value.shape == (4,) and str(value.dtype) == name


@given(st.floats(0.0, 50.0))
@settings(max_examples=30)
def test_lemniscate_is_a_curve_of_bernoulli(t):
    path = Lemniscate(center=(0.25, -0.5, 2.0), amplitude=(3.0, 3.0), rate=0.8, phase=0.3)
    x, y, z, yaw = at(path, t) - np.array([0.25, -0.5, 2.0, 0.0])
    assert (x * x + y * y) ** 2 == pytest.approx(9.0 * (x * x - y * y), abs=1e-10)
    assert (z, yaw) == (0.0, 0.0)


def test_the_default_lemniscate_is_the_drawn_curve():
    path = Lemniscate()
    assert at(path, 0.0) == pytest.approx([1.5, 0.25, 1.0, 0.0])
    for t in (0.7, 3.0, 8.5):
        s, c = np.sin(0.646 * t), np.cos(0.646 * t)
        wanted = [0.25 + 1.25 * c / (1.0 + s**2), 0.25 + 3.54 * s * c / (1.0 + s**2), 1.0, 0.0]
        assert at(path, t) == pytest.approx(wanted, abs=1e-14)


@pytest.mark.parametrize("order", range(5))
def test_derivatives_of_a_circle_turn_by_a_right_angle_and_grow_by_the_rate(order):
    path = FAMILY["circle"]
    th = path.rate * 0.9 + path.phase + order * np.pi / 2.0
    wanted = path.radius * path.rate**order * np.array([np.cos(th), np.sin(th)])
    center = np.array(path.center[:2]) if order == 0 else 0.0
    assert at(path, 0.9, order=4)[order, :2] == pytest.approx(wanted + center, abs=1e-13)


def test_figure_eight_is_sin_and_sin_of_the_double_angle():
    th = 1.1 * 2.2
    wanted = [1.0 + 1.5 * np.sin(th), 2.0 + 0.7 * np.sin(2.0 * th), 3.0, 0.0]
    assert at(FAMILY["figure-eight"], 2.2) == pytest.approx(wanted, abs=1e-14)


def test_hover_stays_and_a_line_keeps_its_velocity():
    still, moving = at(FAMILY["hover"], 5.0, order=4), at(FAMILY["line"], 2.0, order=4)
    assert still[0] == pytest.approx([1.0, 2.0, 3.0, -0.5])
    assert not still[1:].any()
    assert moving[0] == pytest.approx([2.0, 1.5, 3.25, 0.1])
    assert moving[1] == pytest.approx([0.5, -0.25, 0.125, 0.0])
    assert not moving[2:].any()


def falling(power, order, s):
    """The derivative of s^power."""
    factor = np.prod([power - k for k in range(order)]) if order <= power else 0.0
    return factor * s ** max(power - order, 0)


def smoothest_pieces(times, values):
    """Coefficients (K - 1, 8), lowest power first, from all conditions at once, least squares."""
    pieces = len(times) - 1
    rows, right = [], []

    def require(terms, value):
        row = np.zeros(8 * pieces)
        for piece, order, s, sign in terms:
            row[8 * piece : 8 * piece + 8] += [sign * falling(p, order, s) for p in range(8)]
        rows.append(row)
        right.append(value)

    for k in range(pieces):
        length = times[k + 1] - times[k]
        require([(k, 0, 0.0, 1.0)], values[k])
        require([(k, 0, length, 1.0)], values[k + 1])
        for order in range(1, 7 if k + 1 < pieces else 4):
            following = [(k + 1, order, 0.0, -1.0)] if k + 1 < pieces else []
            require([(k, order, length, 1.0), *following], 0.0)
    for order in (1, 2, 3):
        require([(0, order, 0.0, 1.0)], 0.0)
    assert len(rows) == 8 * pieces
    return np.linalg.solve(np.array(rows), np.array(right)).reshape(pieces, 8)


def test_waypoints_are_the_smoothest_path_found_by_another_system():
    path = FAMILY["waypoints"]
    pieces = [smoothest_pieces(TIMES, [p[axis] for p in POINTS]) for axis in range(3)]
    for t in (0.2, 0.9, 1.0, 1.8, 3.3):
        k = np.searchsorted(TIMES, t, side="right") - 1
        got = at(path, t, order=4)
        for axis in range(3):
            terms = pieces[axis][k]
            wanted = [
                sum(c * falling(p, order, t - TIMES[k]) for p, c in enumerate(terms))
                for order in range(5)
            ]
            assert got[:, axis] == pytest.approx(wanted, rel=1e-9, abs=1e-9)


def test_waypoints_stay_at_both_ends():
    for t, point in ((-3.0, POINTS[0]), (9.0, POINTS[-1])):
        held = at(FAMILY["waypoints"], t, order=4)
        assert held[0, :3] == pytest.approx(point, abs=1e-12)
        assert not held[1:].any()


@given(st.floats(0.0, 1.0))
@settings(max_examples=20)
def test_two_waypoints_are_joined_by_the_known_polynomial(s):
    path = Waypoints([2.0, 5.0], [[0.0, 0.0, 0.0], [1.0, -2.0, 4.0]])
    smooth = 35.0 * s**4 - 84.0 * s**5 + 70.0 * s**6 - 20.0 * s**7
    got = at(path, 2.0 + 3.0 * s)[:3]
    assert got == pytest.approx(smooth * np.array([1.0, -2.0, 4.0]), abs=1e-11)


def test_a_path_from_rest_is_refused_for_a_unicycle_since_its_speed_is_zero():
    path = Waypoints([0.0, 5.0, 10.0], [[0, 0, 0], [2, 0, 0], [4, 1, 0]])
    model, graph = ech.models.UnicyclePoint(ahead=0.1), ech.Graph.path(2)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain([1.0, 1.0, 0.1], coupling=2.0))
    with pytest.raises(ech.EchelonError, match="its speed is 0 at t = 0 s"):
        ech.laws.Tracking(path, gain).prepared(model, graph)
    # A circle never rests.
    ech.laws.Tracking(Circle(), gain).prepared(model, graph)


def test_a_recorded_path_that_moves_at_its_ends_is_told_that_the_spline_rests_there():
    times = 0.02 * np.arange(101)
    path = Waypoints(times, np.column_stack([0.5 * times, 0.0 * times, 1.0 + 0.0 * times]))
    told = reference_warnings(ech.models.Quadrotor.crazyflie(), path, 2.0)
    [text] = [text for text in told if "too fast" in text]
    assert "the path rests at both ends, and with `ends: free` it needs" in text
