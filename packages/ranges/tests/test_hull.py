"""The hull of Jacobians: what it must contain, how tight it is, and what it refuses."""

import decimal
import math
import operator
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hull_checks import (
    NO_INPUTS,
    about_zero,
    assert_supported,
    euler_rate_quadrotor,
    points_of,
    quadrotor_box,
    values,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from echelon_ranges import (
    ELEMENTARY,
    Box,
    Interval,
    JumpError,
    RangeError,
    UnboundedError,
    point,
    slope_columns,
    slope_hull,
    value_hull,
)
from echelon_ranges.atoms import (
    Atoms,
    constant,
    corner_values,
    divides,
    power_points,
    wave_points,
)
from echelon_ranges.interval import circle, pi
from echelon_ranges.jaxpr import float64


def pendulum(x, v):
    return jnp.stack([x[1], 9.81 * jnp.sin(x[0]) - 0.3 * x[1]])


def oscillator(x, v):
    return jnp.stack([x[1], (1.0 - x[0] ** 2) * x[1] - x[0] + v[0]])


def planar_quadrotor(x, v):
    lift = 9.81 + v[0]
    return jnp.stack([*x[3:], -lift * jnp.sin(x[2]), lift * jnp.cos(x[2]) - 9.81, 20.0 * v[1]])


def unicycle(x, v):
    return jnp.stack([(1.0 + v[0]) * jnp.cos(x[2]), (1.0 + v[0]) * jnp.sin(x[2]), v[1]])


FIELDS = {
    "pendulum": (pendulum, Box([-1.2, -2], [0.4, 2]), about_zero(0), 2),
    "van-der-pol": (oscillator, Box([-1, -2], [3, 1]), about_zero(1), 6),
    "planar-quadrotor": (
        planar_quadrotor,
        Box([0, 0, -0.2, 0, 0, 0], [0, 0, 0.7, 0, 0, 0]),
        about_zero(3, 1),
        8,
    ),
    "unicycle": (unicycle, Box([-1, -1, -2.5], [1, 1, 0.3]), about_zero(0.5, 1), 8),
}
SYSTEMS = {name: (jax.jacfwd(f), *rest) for name, (f, *rest) in FIELDS.items()}
SYSTEMS["euler-rates"] = (euler_rate_quadrotor, quadrotor_box(), NO_INPUTS, 128)


@pytest.fixture(scope="module")
def hulls():
    return {name: value_hull(*system[:3]) for name, system in SYSTEMS.items()}


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_hull_holds_all_jacobians_by_as_many_vertices_as_its_polygons_have(hulls, name):
    jacobian, states, inputs, vertices = SYSTEMS[name]
    hull, matrices = (
        hulls[name],
        values(jacobian, states, inputs, points_of(states, inputs, seed=1)),
    )
    assert_supported(hull, matrices)
    assert len(hull.vertices) == vertices
    zero = (matrices == 0.0).all(axis=0)
    assert zero.any()
    assert (hull.vertices[:, zero] == 0.0).all() and (hull.error[zero] == 0.0).all()


def test_the_error_is_that_of_rounding(hulls):
    for hull in hulls.values():
        assert (hull.error <= 2.0**-53 * (1.0 + 2 * np.abs(hull.vertices).max(axis=0))).all()
    assert (hulls["van-der-pol"].error == 0.0).all()


def test_the_error_is_no_less_than_what_was_rounded_away():
    factors = np.random.default_rng(0).uniform(0.1, 1.0, (3, 40))

    def products(x, v):
        # Of three, so that what is rounded away has more digits than a float itself.
        return (x * factors[0] * factors[1] * factors[2])[None]

    hull = value_hull(products, Box([1.0], [1.0]), NO_INPUTS)
    exact = [math.prod(map(Fraction, some)) for some in factors.T.tolist()]
    [[values]], [errors] = hull.vertices.tolist(), hull.error.tolist()
    for value, error, number in zip(values, errors, exact, strict=True):
        lost = abs(Fraction(value) - number)
        assert Fraction(math.nextafter(error, 0.0)) < lost <= Fraction(error) or lost == error == 0


def test_what_is_not_known_of_a_number_is_part_of_the_error():
    angles = np.random.default_rng(1).uniform(0.1, 1.5, 20)
    hull = value_hull(lambda x, v: jnp.cos(x)[None], Box(angles, angles), NO_INPUTS)
    [[values]], [errors] = hull.vertices.tolist(), hull.error.tolist()
    for angle, value, error in zip(angles.tolist(), values, errors, strict=True):
        cosine = circle(Fraction(angle))[0]
        assert cosine.lo < cosine.hi
        assert all(abs(Fraction(value) - end) <= Fraction(error) for end in (cosine.lo, cosine.hi))


def test_numbers_that_are_not_rational_leave_a_slack():
    atoms, angles = Atoms(), (Fraction(3, 10), Fraction(4, 7))
    (c, _), (_, s) = (atoms.circle(constant(angle)) for angle in angles)
    p = c * s * constant(-7) + c
    corners = {atom: atoms.corners(atom, used) for atom, used in p.exponents().items()}
    found = corner_values(p, corners)
    cosine, sine = circle(angles[0])[0], circle(angles[1])[1]
    for a in (cosine.lo, cosine.hi):
        for b in (sine.lo, sine.hi):
            assert 0 < abs(a - 7 * a * b - found.array[0, 0]) <= found.slack < Fraction(1, 2**80)


@st.composite
def systems(draw):
    """A Jacobian of sums of products of powers and waves of n <= 4 states, and a box."""
    n = draw(st.integers(1, 4))
    index, sizes = st.integers(0, n - 1), st.floats(-3, 3, allow_subnormal=False)
    factor = st.tuples(
        st.sampled_from(["power", "cos", "sin", "sum"]), index, index, st.integers(1, 2)
    )
    term = st.tuples(index, sizes, st.lists(factor, min_size=1, max_size=3))
    terms = draw(st.lists(term, min_size=1, max_size=4))

    def value(x, kind, i, j, k):
        if kind == "power":
            return x[i] ** k
        return (
            jnp.cos(k * x[i])
            if kind == "cos"
            else jnp.sin(k * x[i] + (x[j] if kind == "sum" else 0.0))
        )

    def drift(x):
        rows = [jnp.zeros(())] * n
        for row, c, factors in terms:
            rows[row] += c * math.prod(value(x, *f) for f in factors)
        return jnp.stack(rows)

    ends = st.lists(st.floats(-1.5, 1.5, allow_subnormal=False), min_size=2, max_size=2)
    sides = np.array([sorted(draw(ends)) for _ in range(n)])
    return lambda x, v: jax.jacfwd(drift)(x), Box(*sides.T)


@settings(max_examples=15)
@given(system=systems(), seed=st.integers(0, 99))
def test_jacobians_of_any_drift_lie_in_the_hull(system, seed):
    jacobian, box = system
    try:
        hull = value_hull(jacobian, box, NO_INPUTS)
    except RangeError as error:
        assert "vertices" in str(error)
        assume(False)
    assert_supported(hull, values(jacobian, box, NO_INPUTS, points_of(box, NO_INPUTS, seed)), seed)


@pytest.mark.parametrize("frequencies", [(0.7, 1.3), (1.0, 40.0), (0.3, 0.9, np.pi)])
def test_waves_without_a_low_common_frequency_are_enclosed_apart(frequencies):
    def jacobian(x, v):
        waves = [jnp.cos(w * x[0]) + x[1] * jnp.sin(w * x[0]) for w in frequencies]
        return jnp.stack([jnp.stack([sum(waves), waves[0] * waves[-1]]), x])

    box = Box(np.array([-0.4, 0.0]), np.array([0.9, 0.5]))
    hull = value_hull(jacobian, box, NO_INPUTS)
    assert_supported(hull, values(jacobian, box, NO_INPUTS, points_of(box, NO_INPUTS, 0)), 0)


def test_too_many_waves_and_vertices_are_refused_and_not_counted_out(monkeypatch):
    def jacobian(x, v):
        return sum(jnp.cos(w * x[0]) + jnp.sin(w * x[0]) for w in np.sqrt(np.arange(2.0, 20.0)))

    with pytest.raises(RangeError, match="has 65536 vertices"):
        value_hull(lambda x, v: jacobian(x, v)[None, None], Box([0.1], [0.5]), NO_INPUTS)
    monkeypatch.setattr("echelon_ranges.atoms.MOST_VERTICES", 100)
    with pytest.raises(RangeError, match="has 128 vertices, and may have 100"):
        value_hull(euler_rate_quadrotor, quadrotor_box(), NO_INPUTS)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_box_shrunk_about_its_middle_has_a_hull_inside(hulls, name):
    jacobian, states, inputs, _ = SYSTEMS[name]

    def shrunk(box):
        middle, half = (np.add(*box) / 2, np.subtract(box[1], box[0]) / 2)
        return Box(middle - 0.7 * half, middle + 0.7 * half)

    inner = value_hull(jacobian, shrunk(states), shrunk(inputs))
    assert_supported(hulls[name], inner.vertices)


def scalar_hull(function, low, high):
    """The smallest and largest vertex, with the error, of a function of one number."""
    hull = value_hull(lambda x, v: function(x).reshape(1, 1), Box([low], [high]), NO_INPUTS)
    return hull.vertices.min() - hull.error.max(), hull.vertices.max() + hull.error.max()


@pytest.mark.parametrize(
    ("function", "value"),
    [
        (lambda x: jnp.cos(x) ** 2 + jnp.sin(x) ** 2, 1.0),
        (lambda x: jnp.sin(2 * x) - 2 * jnp.sin(x) * jnp.cos(x), 0.0),
        (lambda x: jnp.cos(3 * x) - 4 * jnp.cos(x) ** 3 + 3 * jnp.cos(x), 0.0),
        (lambda x: jnp.sin(x - x), 0.0),
        (lambda x: jnp.sin(-x) + jnp.sin(x), 0.0),
        (lambda x: jnp.cos(1 - 3 * x) - jnp.cos(3 * x - 1), 0.0),
        (lambda x: 2 * jnp.sin(x) * jnp.cos(2 * x) - jnp.sin(3 * x) + jnp.sin(x), 0.0),
        (lambda x: 2 * jnp.cos(x) * jnp.sin(2 * x) - jnp.sin(3 * x) - jnp.sin(x), 0.0),
        (lambda x: 2 * jnp.sin(x) * jnp.sin(2 * x) - jnp.cos(x) + jnp.cos(3 * x), 0.0),
        (lambda x: jnp.sin(0.5 * x) * jnp.cos(-0.5 * x) - jnp.sin(x) / 2, 0.0),
        (lambda x: (x + 1) * (x - 1) - x * x + 3, 2.0),
        (lambda x: jnp.exp(x) * x - x * jnp.exp(x), 0.0),
        (lambda x: x / 3.0 * 3.0 - x, 0.0),
    ],
)
def test_identities_hold_exactly(function, value):
    assert scalar_hull(function, -0.6, 0.9) == (value, value)


FUNCTIONS = {
    "exp": (jnp.exp, -3, 2),
    "expm1": (jnp.expm1, -1, 2),
    "log": (jnp.log, 0.1, 5),
    "log1p": (jnp.log1p, -0.5, 2),
    "sqrt": (jnp.sqrt, 0.0, 7),
    "rsqrt": (jax.lax.rsqrt, 0.2, 7),
    "power": (lambda x: x**1.5, 0.5, 3),
    "negative power": (lambda x: x**-3, 0.5, 3),
    "reciprocal": (lambda x: 1 / x, -3, -0.5),
    "tan": (jnp.tan, -1.2, 1.4),
    "asin": (jnp.arcsin, -0.9, 1.0),
    "acos": (jnp.arccos, -0.9, 1.0),
    "atan": (jnp.arctan, -4, 0.5),
    "atan2": (lambda x: jnp.arctan2(x, 2.0), -4, 0.5),
    "sinh": (jnp.sinh, -2, 3),
    "cosh": (jnp.cosh, -2, 3),
    "tanh": (jnp.tanh, -2, 3),
    "logistic": (jax.nn.sigmoid, -2, 3),
    "abs": (jnp.abs, -2, 3),
    "sign": (jnp.sign, -2, 3),
    "even power": (lambda x: x**4, -2, 3),
    "max": (lambda x: jnp.maximum(x, 1.0), -2, 3),
    "clip": (lambda x: jnp.clip(x, -1.0, 1.0), -2, 3),
    "sin": (jnp.sin, 1, 4),
    "sin with a phase": (lambda x: jnp.sin(2 * x + 0.3), 0.1, 0.5),
    "falling phase": (lambda x: jnp.cos(1.0 - 3 * x), -0.1, 0.2),
    "far cos": (jnp.cos, 1e6, 1e6 + 1),
    "whole circle": (jnp.cos, -4, 4),
    "sin of a square": (lambda x: jnp.sin(x * x), -1, 1),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_range_of_a_function_is_enclosed_and_tight(name):
    function, low, high = FUNCTIONS[name]
    lower, upper = scalar_hull(function, low, high)
    with float64():
        reached = np.asarray(function(jnp.linspace(low, high, 20001)))
    width = np.ptp(reached)
    assert lower <= reached.min() + 1e-14 * width and reached.max() - 1e-14 * width <= upper
    assert lower >= reached.min() - 1e-7 * width and upper <= reached.max() + 1e-7 * width


def test_a_choice_that_the_box_does_not_decide_holds_both():
    def step(x):
        return jnp.where((x > 0.5) & ~(x > 0.9), jnp.cos(x) + 2.0, x)

    assert scalar_hull(step, -1.0, 0.4) == (-1.0, 0.4)
    lower, upper = scalar_hull(step, 0.0, 0.6)
    assert lower <= 0.0 and upper >= 2.0 + math.cos(0.5)
    assert scalar_hull(lambda x: 1.0 * (x > 0), -1.0, 1.0) == (0.0, 1.0)

    def both(x):
        return jnp.where(jnp.where(x > 1.5, x > 0.0, x > -1.0), x, 100.0)

    assert scalar_hull(both, 1.0, 2.0) == (1.0, 2.0)
    assert scalar_hull(lambda x: jnp.where(x > 1.5, x + 1.0, 1.0 + x), 1.0, 2.0) == (2.0, 3.0)


CONDITIONS = [lambda x: x > 0.0, lambda x: x > 5.0, lambda x: x > 1.5]
"""On [1, 2]: true, false, and not decided."""


@pytest.mark.parametrize("one", CONDITIONS)
@pytest.mark.parametrize("other", CONDITIONS)
@pytest.mark.parametrize("join", [operator.and_, operator.or_, operator.xor])
def test_conditions_that_are_joined_choose_what_is_chosen_somewhere(one, other, join):
    def chosen(x):
        first, second = one(x), other(x)
        # Exclusive or, of the other two.
        same = (
            join(first, second)
            if join is not operator.xor
            else (first | second) & ~(first & second)
        )
        return jnp.where(same, 100.0, x)

    reached = np.asarray(jax.vmap(chosen)(jnp.linspace(1.0, 2.0, 101)))
    lower, upper = scalar_hull(chosen, 1.0, 2.0)
    assert lower <= reached.min() and upper >= reached.max()
    if join is not operator.xor:
        assert (upper == 100.0) is (reached.max() == 100.0)
        assert (lower == 100.0) is (reached.min() == 100.0)


def test_a_condition_is_joined_and_a_number_cut_entry_by_entry():
    def chosen(x):
        # The first is decided and the second is not, so that neither is a constant of the trace.
        low, high = jnp.stack([x > 0.0, x > 1.5]), jnp.stack([x > 5.0, x > 1.5])
        return jnp.where(low & high, 100.0, x)[0]

    assert scalar_hull(chosen, 1.0, 2.0) == (1.0, 2.0)
    assert scalar_hull(lambda x: x * (x - x + 2.7).astype(int), 1.0, 2.0) == (2.0, 4.0)
    assert scalar_hull(lambda x: x * (x - x - 2.7).astype(int), 1.0, 2.0) == (-4.0, -2.0)
    assert scalar_hull(lambda x: x * (x - x + 2.7).astype(bool), 1.0, 2.0) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("function", "low", "high"),
    [
        (lambda x: jnp.abs(x) + x, -1.0, 0.0),
        (lambda x: jnp.abs(x) - x, 0.0, 1.0),
        (lambda x: jnp.maximum(x, 2.0 * x) - x, -1.0, 0.0),
        (lambda x: jnp.maximum(x, 2.0 * x) - 2.0 * x, 0.0, 1.0),
        (lambda x: jnp.minimum(x, 2.0 * x) - 2.0 * x, -1.0, 0.0),
    ],
)
def test_a_side_is_known_up_to_its_edge(function, low, high):
    assert scalar_hull(function, low, high) == (0.0, 0.0)


@pytest.mark.parametrize("name", ["lt", "le", "gt", "ge", "eq", "ne"])
@pytest.mark.parametrize("other", [-2.0, -1.0, 0.0, 1.0, 2.0])
def test_a_comparison_is_decided_exactly_where_it_can_be(name, other):
    compare = getattr(operator, name)
    answers = {float(compare(x, other)) for x in (-1.0, -0.5, 0.0, 0.5, 1.0)}
    found = scalar_hull(lambda x: 1.0 * compare(x, other), -1.0, 1.0)
    assert found == (min(answers), max(answers))


SHUFFLES = {
    "add": lambda x: x[jnp.array([2, 0, 1, 2])].at[jnp.array([0, 0, 3])].add(x[1:]),
    "roll": lambda x: jnp.roll(jnp.pad(x[::-1], (1, 2))[1:5], 1).at[1].set(x[0] * x[2]),
    "cumsum": jnp.cumsum,
    "outer": lambda x: (x[:, None] * x[None, :]).sum(axis=1) - x.mean() * x.prod(),
    "matrix": lambda x: jnp.einsum("bij,bjk->bik", x.reshape(1, 2, 2), x.reshape(1, 2, 2)).ravel(),
    "cross": lambda x: jnp.append(jnp.cross(x[:3], x[1:]), jnp.dot(x, x)),
    "inverse": lambda x: jnp.linalg.inv(jnp.diag(jnp.array([2.0, 3.0, 4.0, 5.0]))) @ x**2,
    "slice": lambda x: jax.lax.dynamic_update_slice(x, jax.lax.dynamic_slice(x, (2,), (2,)), (1,)),
    "fixed": lambda x: jnp.sin(0.3) * x**3 + jnp.sqrt(2.0) * x**2 / jnp.exp(x[0]),
    "checkpoint": jax.checkpoint(lambda x: jnp.tile(jnp.stack([x[0] * x[1], x[2]]), 2)),
}


@pytest.mark.parametrize("name", SHUFFLES)
def test_at_a_point_the_hull_is_the_jacobian(name):
    jacobian = jax.jacfwd(SHUFFLES[name])
    x = np.array([0.7, -0.4, 1.3, 0.2])
    hull = value_hull(lambda x, v: jacobian(x), Box(x, x), NO_INPUTS)
    with float64():
        expected = np.asarray(jacobian(jnp.asarray(x)))
    assert len(hull.vertices) == 1 and (hull.error < 1e-14).all()
    np.testing.assert_allclose(hull.vertices[0], expected, rtol=1e-14, atol=1e-15)


angles = st.floats(-7, 7, allow_subnormal=False)


@given(ends=st.tuples(angles, angles), degree=st.integers(1, 3), seed=st.integers(0, 99))
def test_waves_on_an_arc_lie_in_their_polygon(ends, degree, seed):
    low, high = sorted(ends)
    points = wave_points(Interval(Fraction(low), Fraction(high)), range(1, degree + 1))
    P = np.array([[float(v) for v in p.values()] for p in points])
    t = np.linspace(low, high, 101)[:, None] * np.arange(1, degree + 1)
    curve = np.stack([np.cos(t), np.sin(t)], axis=-1).reshape(101, -1)
    C = np.random.default_rng(seed).normal(size=(P.shape[1], 50))
    assert ((curve @ C).max(axis=0) <= (P @ C).max(axis=0) + 1e-13).all()


def test_an_arc_gets_the_trapezoid_of_chord_and_tangents():
    half = 0.5
    points = wave_points(Interval(Fraction(-half), Fraction(half)), [1])
    slope = math.tan(half / 2)
    expected = [(math.cos(half), -math.sin(half)), (1, -slope), (1, slope)]
    expected.append((math.cos(half), math.sin(half)))
    np.testing.assert_allclose(
        [[float(v) for v in p.values()] for p in points], expected, rtol=1e-15
    )
    assert points[1][1, 0] == points[2][1, 0] == 1


@given(ends=st.tuples(angles, angles))
def test_an_arc_ends_on_the_circle_and_outside_of_itself(ends):
    low, high = sorted(ends)
    assume(0 < high - low < 6)
    points = wave_points(Interval(Fraction(low), Fraction(high)), [1])
    for end, found, turn in [(low, points[0], 1), (high, points[-1], -1)]:
        c, s = found[1, 0], found[1, 1]
        cosine, sine = circle(Fraction(end))
        turned = sine * point(c) + cosine * point(-s)
        assert c * c + s * s == 1
        assert 0 <= turn * float(turned.lo) <= 2.0**-57 and turned.lo * turned.hi >= 0


@given(ends=st.tuples(angles, angles), degree=st.integers(2, 4), seed=st.integers(0, 99))
def test_powers_lie_in_their_polygon(ends, degree, seed):
    low, high = sorted(ends)
    points = power_points(Interval(Fraction(low), Fraction(high)), range(1, degree + 1))
    P = np.array([[float(p[k]) for k in range(1, degree + 1)] for p in points])
    curve = np.linspace(low, high, 101)[:, None] ** np.arange(1, degree + 1)
    C = np.random.default_rng(seed).normal(size=(degree, 50))
    assert len(points) == degree + 1
    assert ((curve @ C).max(axis=0) <= (P @ C).max(axis=0) + 1e-10).all()


def test_pi_is_known_to_fifty_digits():
    digits = Fraction("3.14159265358979323846264338327950288419716939937510")
    assert abs(pi().lo - digits) < Fraction(1, 10**50) and 0 < pi().hi - pi().lo < Fraction(
        1, 2**300
    )


@pytest.mark.parametrize(
    ("name", "oracle", "numbers"),
    [
        ("exp", decimal.Decimal.exp, ["-20.5", "-0.25", "0.125", "3", "300.5"]),
        ("log", decimal.Decimal.ln, ["0.0009765625", "0.75", "3", "1000000.5"]),
        ("sqrt", decimal.Decimal.sqrt, ["0.0009765625", "2", "9", "1000000.5"]),
    ],
)
def test_enclosures_hold_the_values_of_decimal_arithmetic(name, oracle, numbers):
    with decimal.localcontext(prec=60):
        for number in numbers:
            found = ELEMENTARY[name].range(point(Fraction(number)))
            value = Fraction(oracle(decimal.Decimal(number)))
            slack = abs(value) / 10**55
            assert found.lo - slack <= value <= found.hi + slack
            assert found.hi - found.lo <= abs(value) / 10**23


@given(x=st.fractions(-200, 200, max_denominator=1000))
def test_circular_enclosures_agree_with_double_angles_and_the_library(x):
    (c, s), (cosine, sine) = circle(x), circle(2 * x)
    for identity in [
        c * c + s * s + point(-1),
        c * c + (s * s).scale(Fraction(-1)) + cosine.scale(Fraction(-1)),
        (c * s).scale(Fraction(2)) + sine.scale(Fraction(-1)),
    ]:
        assert identity.holds(0) and identity.hi - identity.lo < Fraction(1, 2**90)
    assert abs(float(c.lo) - math.cos(float(x))) < 1e-13


@given(x=st.floats(-1.5, 1.5), y=st.floats(0.01, 3))
def test_inverse_functions_undo_each_other(x, y):
    def there_and_back(outer, inner, at):
        return ELEMENTARY[outer].range(ELEMENTARY[inner].range(point(Fraction(at))))

    for outer, inner, at in [
        ("atan", "tan", x),
        ("tan", "atan", x),
        ("log", "exp", x),
        ("exp", "log", y),
    ]:
        found = there_and_back(outer, inner, at)
        assert found.holds(Fraction(at)) and found.hi - found.lo < Fraction(1, 2**80)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (jax.scipy.special.erf, "uses `erf`, which the hull of Jacobians does not know"),
        (jnp.floor, "uses `floor`"),
        (lambda x: jax.lax.fori_loop(0, 3, lambda k, y: y * x, x), "uses `scan`"),
        (lambda x: jnp.stack([x, x]).at[1].apply(jnp.sin)[1], "uses `scatter`"),
        (jnp.log, "takes `log` of an expression of `x[0]`"),
        (jnp.sqrt, "must not be negative"),
        (lambda x: jnp.tan(2 * x), "two odd multiples of 90 degrees"),
        (lambda x: jnp.arctan2(1.0, x), "takes `atan2`"),
        (lambda x: jnp.exp(3000 * x), "must be at most 2048"),
        (lambda x: 10.0**200 * jnp.exp(600 * x), "exceeds float64"),
        (lambda x: jnp.exp(x) ** x, "raises to a power that varies"),
        (lambda x: x[x.astype(int)], "turns a state into a whole number"),
        (lambda x: jnp.arange(3.0)[jnp.where(x > 0, 1, 2)], "picks a whole number"),
        (lambda x: x * jnp.inf, "not finite"),
        (lambda x: jnp.asarray(1j) * x, "complex"),
    ],
)
def test_what_cannot_be_enclosed_is_named(function, words):
    with pytest.raises(RangeError) as caught:
        scalar_hull(function, -1.0, 1.0)
    assert words in str(caught.value)
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("states", "words"),
    [
        (Box([1, 0], [0, 0]), "`x[0]` are 1 and 0, and must be in rising order."),
        (Box([0, math.nan], [0, 1]), "`x[1]` are nan and 1"),
        (Box([0, 0], [math.inf, 0]), "leaves `x[0]` unbounded, and must give it a bound"),
        (Box([0, 0], [1]), "two vectors of the same length"),
    ],
)
def test_a_box_that_is_none_is_refused(states, words):
    with pytest.raises(RangeError) as caught:
        value_hull(SYSTEMS["pendulum"][0], states, about_zero(1))
    assert words in str(caught.value)
    with pytest.raises(RangeError, match="has 2 entries, and must have 3"):
        value_hull(SYSTEMS["pendulum"][0], about_zero(1, 1), about_zero(1), ["angle", "rate"])


def slopes(function, half=1.0, n=1):
    """The extreme slopes of a function of one number, or the hull of one of several."""
    hull = slope_hull(lambda x, v: function(x), about_zero(*[half] * n), NO_INPUTS)
    if n > 1:
        return hull
    return hull.vertices.min() - hull.error.max(), hull.vertices.max() + hull.error.max()


@pytest.mark.parametrize("name", FIELDS)
def test_slopes_are_the_jacobians_of_jax_where_functions_are_smooth(hulls, name):
    found = slope_hull(*FIELDS[name][:3])
    np.testing.assert_array_equal(found.vertices, hulls[name].vertices)
    np.testing.assert_array_equal(found.error, hulls[name].error)


SMOOTH = [name for name in FUNCTIONS if name not in ("abs", "sign", "max", "clip", "sqrt")]


@pytest.mark.parametrize("name", [n for n in SMOOTH if n not in ("asin", "acos")])
def test_each_function_has_the_derivative_that_jax_knows(name):
    function, low, high = FUNCTIONS[name]
    hull = slope_hull(lambda x, v: function(x), Box([low], [high]), NO_INPUTS)
    with float64():
        points = jnp.linspace(low, high, 2001)
        wanted = np.asarray(jax.vmap(jax.grad(function))(points))
    lower, upper = (hull.vertices.min() - hull.error.max(), hull.vertices.max() + hull.error.max())
    size = np.abs(wanted).max()
    assert lower <= wanted.min() + 1e-12 * size and wanted.max() - 1e-12 * size <= upper
    # What is a product of several unknowns is wider than it is.
    assert upper - lower <= 4 * np.ptp(wanted) + 1e-6 * size


@pytest.mark.parametrize(
    ("function", "wanted"),
    [
        (lambda x: -x + 3 * jnp.maximum(x, -x), (-4.0, 2.0)),
        (lambda x: -x + 3 * jnp.abs(x), (-4.0, 2.0)),
        (lambda x: jnp.maximum(x, -x) - jnp.abs(x), (0.0, 0.0)),
        (lambda x: jnp.where(x > 0, x, 0.0) - jnp.maximum(0.0, x), (0.0, 0.0)),
        (lambda x: jnp.where(2 * x < 0, 0.0, 3 * x) - 3 * jax.nn.relu(x), (0.0, 0.0)),
        (lambda x: jnp.where(x >= 0, x, -x), (-1.0, 1.0)),
        (lambda x: jnp.clip(x, -0.5, 0.5), (0.0, 1.0)),
        (lambda x: -jnp.abs(x) * x, (-2.0, 0.0)),
        (lambda x: -(2 * x - 0.6) * jnp.abs(x - 0.3), (-5.2, 0.0)),
        (lambda x: jnp.where(x == 0.25, 0.25, x), (1.0, 1.0)),
        (lambda x: jnp.minimum(x, 2.0), (1.0, 1.0)),
        (lambda x: jnp.sign(x + 2.0) * x, (1.0, 1.0)),
        (lambda x: -x + 5 * jax.lax.stop_gradient(x), (4.0, 4.0)),
        (lambda x: jnp.where((x > 2.0) | (x < -0.5), x + 0.5, 0.0), (0.0, 1.0)),
        # Up to the ends of [-1, 1], one side alone.
        (lambda x: jnp.abs(x - 1.0), (-1.0, -1.0)),
        (lambda x: jnp.abs(x - 2.0), (-1.0, -1.0)),
        (lambda x: jnp.abs(x + 1.0), (1.0, 1.0)),
        (lambda x: jnp.maximum(x - 1.0, 0.0), (0.0, 0.0)),
        (lambda x: jnp.maximum(x + 1.0, 0.0), (1.0, 1.0)),
        (lambda x: jnp.where(x >= -1.0, 2 * x, 9.0), (2.0, 2.0)),
        (lambda x: jnp.where(x <= 1.0, 2 * x, 9.0), (2.0, 2.0)),
        (lambda x: jnp.where(x < -1.0, 9.0, 2 * x), (2.0, 2.0)),
        (lambda x: jnp.where(x > 1.0, 9.0, 2 * x), (2.0, 2.0)),
    ],
)
def test_what_bends_has_the_slopes_of_both_sides(function, wanted):
    np.testing.assert_allclose(slopes(function), wanted, atol=1e-15)


def test_two_borders_of_one_condition_leave_both_slopes():
    low, high = slopes(lambda x: jnp.where((x > 0.5) | (x < -0.5), x * x, 0.25))
    # Each border is an unknown of its own, and the hull is of their product.
    assert -4.0 <= low <= -2.0 and 2.0 <= high <= 4.0


def test_two_bends_are_two_unknowns():
    hull = slopes(lambda x: jnp.stack([jnp.maximum(x[0], x[1]), jnp.abs(x[0]), jnp.abs(x[1])]), n=2)
    found = {tuple(v.ravel()) for v in hull.vertices}
    one, other = ((1.0, 0.0), (0.0, 1.0))
    sides = (-1.0, 1.0)
    assert found == {(*m, a, 0.0, 0.0, b) for m in (one, other) for a in sides for b in sides}


def test_the_entries_of_which_nothing_depends_have_slope_0():
    boxes = about_zero(1, 1, 1), about_zero(1)
    assert slope_columns(lambda x, v: x[1:] * x[0] - x[0] * x[1], *boxes) == ()
    assert slope_columns(lambda x, v: (x[2] - x[2] + v[0] * jnp.sin(x[0]))[None], *boxes) == (1, 2)


def test_a_derivative_written_by_hand_is_not_believed():
    @jax.custom_jvp
    def lying(x):
        return 5 * x

    lying.defjvp(lambda primals, tangents: (lying(*primals), -tangents[0]))
    assert slopes(lambda x: lying(x) - x) == (4.0, 4.0)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: -x + 5 * jnp.where(x > 1e-3, 1.0, 0.0),
        lambda x: -x + 5 * jnp.where(x > 1e-3, 1, 0),
        lambda x: -x + 5 * (x > 1e-3),
        lambda x: 5 * jnp.sign(x),
        lambda x: jnp.heaviside(x, 0.5),
        lambda x: jnp.where((x > 0) & (x < 0.5), x, 0.0),
        lambda x: jnp.where(x == 0, 1.0, x),
        lambda x: x * (x.astype(int) + 1),
        lambda x: jnp.where(jnp.sin(x) > 0.5, jnp.sin(x), 0.0),
        # The ends belong to the domain.
        lambda x: jnp.where(x < 1.0, 0.0, 9.0),
        lambda x: jnp.where(x > -1.0, 0.0, 9.0),
        lambda x: jnp.where(x >= 1.0, 9.0, 0.0),
        lambda x: jnp.where(x <= -1.0, 9.0, 0.0),
        lambda x: jnp.sign(x - 1.0),
        lambda x: jnp.sign(x + 1.0),
    ],
)
def test_a_jump_has_no_slopes(function):
    with pytest.raises(JumpError, match="may jump with `x\\[0\\]` inside the domain"):
        slopes(function)


def test_a_jump_in_what_no_slope_is_taken_in_leaves_both_slopes():
    box, inputs = Box([-1.0], [1.0]), Box([0.0], [1.0])
    for switch in (lambda v: v > 0.5, lambda v: v == 0.5, lambda v: ~(v < 0.2) & (v < 0.7)):

        def switched(x, v, switch=switch):
            return jnp.where(switch(v), 2.0 * x + 1.0, 5.0 * x)

        hull = slope_hull(switched, box, inputs)
        assert (hull.vertices.min(), hull.vertices.max()) == (2.0, 5.0)
    # Two choices by one border may fall otherwise where it is 0.
    both = scalar_hull(lambda x: 1.0 * (x > 0) - 1.0 * (x >= 0), -1.0, 1.0)
    assert both[0] <= -1.0 and both[1] >= 0.0


def test_what_has_no_rule_and_a_root_at_zero_have_no_slopes():
    for function in (jnp.floor, lambda x: jnp.argmax(jnp.stack([x, -x])) * x):
        with pytest.raises(RangeError, match="does not know"):
            slopes(function)
    with pytest.raises(RangeError, match="must be positive"):
        slope_hull(lambda x, v: jnp.sqrt(x), Box([0.0], [1.0]), NO_INPUTS)


def test_an_open_state_may_stand_linearly_and_cancel_and_nothing_else():
    box = Box([-np.inf, -2.0], [np.inf, 2.0])

    def of(function):
        return slope_hull(lambda x, v: jnp.stack(function(*x)), box, NO_INPUTS)

    linear = of(lambda x, v: (v, -x - jnp.sin(v) + (x * x - x**2)))
    assert set(linear.vertices[:, 1, 0]) == {-1.0} and len(linear.vertices) == 2
    for bent in (
        lambda x, v: (v, 50 * jnp.maximum(x - 1.1, 0.0)),
        lambda x, v: (v, jnp.where(x > 1.1, x, 1.1)),
        lambda x, v: (v, jnp.abs(x)),
        lambda x, v: (v, jnp.clip(x, -1.0, 1.0)),
        lambda x, v: (v, jnp.sign(x)),
        lambda x, v: (v, jnp.sin(x)),
        lambda x, v: (v, jnp.exp(x)),
        lambda x, v: (v, x * x),
        lambda x, v: (v, x * v),
    ):
        with pytest.raises(UnboundedError, match=r"leaves `x\[0\]` unbounded"):
            of(bent)


def test_a_box_far_away_is_not_rounded_to_a_point():
    far = Fraction(10**15)
    hull = slope_hull(lambda x, v: x * x, Box([far - 1], [far + 1]), NO_INPUTS)
    assert np.ptp(hull.vertices) == 4.0


def test_polynomials_divide_exactly_and_their_range_is_that_of_the_corners_where_terms_repeat():
    atoms = Atoms()
    x, y = (atoms.variable(n, Interval(Fraction(-1), Fraction(1))) for n in "xy")
    one = constant(1)
    assert divides(x - one, x * x - one) and divides(x - y, x.power(3) - y.power(3))
    assert divides(x + y, constant(0)) and divides(x * y - one, (x * y - one) * (x + y) * x)
    assert not divides(x - one, x * x + one) and not divides(x, x + y) and not divides(x * x, x)
    sine = atoms.circle(x)[1]
    assert divides(sine - one, (sine - one) * constant(3)) and divides(y, y * sine)
    assert not divides(sine - one, sine + one) and not divides(x, sine)
    atoms = Atoms()
    x = atoms.variable("x", Interval(Fraction(-1), Fraction(1)))
    assert atoms.range(constant(1) - x * x + x) == Interval(Fraction(-1), Fraction(2))


@st.composite
def bent(draw):
    """A continuous function of two states with bends wherever they fall, and a box."""
    c = st.floats(-2, 2).map(lambda v: round(v, 3))

    def plane():
        a, b, d = draw(c), draw(c), draw(c)
        return lambda x: a * x[0] + b * x[1] + d

    joins = [
        lambda p, q: lambda x: jnp.maximum(p(x), q(x)),
        lambda p, q: lambda x: jnp.minimum(p(x), jnp.sin(q(x))),
        lambda p, q: lambda x: jnp.clip(p(x), -0.3, 0.4) * q(x),
        lambda p, q: lambda x: jnp.abs(p(x)) * p(x) - jax.nn.relu(q(x)),
        lambda p, q: lambda x: jnp.where(p(x) > 0, p(x) * q(x), 0.0),
        lambda p, q: lambda x: jnp.where((p(x) > 0) & (q(x) < 1), p(x) * (q(x) - 1), 0.0),
        lambda p, q: lambda x: jnp.where(q(x) <= p(x), jnp.abs(q(x)), jnp.abs(p(x))),
        lambda p, q: lambda x: jnp.tanh(jnp.maximum(p(x), 0.0)) + q(x),
    ]
    rows = [draw(st.sampled_from(joins))(plane(), plane()) for _ in range(2)]
    return (lambda x, v: jnp.stack([row(x) for row in rows])), draw(st.integers(0, 99))


@pytest.mark.slow
@settings(max_examples=25)
@given(system=bent())
def test_secants_of_what_bends_lie_in_the_hull(system):
    """f(x) - f(y) is a matrix of the hull times x - y: no functional is larger than at a vertex."""
    function, seed = system
    lower, upper = box = about_zero(1.0, 1.5)
    try:
        hull = slope_hull(function, box, NO_INPUTS)
    except JumpError:
        # A choice between equal sizes is continuous, and no polynomial division shows it.
        return
    rng = np.random.default_rng(seed)
    x = rng.uniform(lower, upper, (400, 2))
    # Near and far partners: bends are felt by both, and jumps by the near ones.
    y = np.clip(x + rng.normal(size=x.shape) * 10.0 ** rng.uniform(-4, 0.5, (400, 1)), lower, upper)
    with float64():
        value = jax.jit(jax.vmap(lambda x: function(x, None)))
        moved = np.asarray(value(jnp.asarray(x))) - np.asarray(value(jnp.asarray(y)))
    step = x - y
    C = rng.normal(size=(60, moved.shape[1]))
    reach = np.einsum("cr,krn,pn->cpk", C, hull.vertices, step).max(axis=2)
    slack = np.abs(C) @ hull.error @ np.abs(step).T + 1e-13
    assert (C @ moved.T <= reach + slack).all()
