"""Native code against JAX and against long doubles: functions, loops, choices, what is refused."""

import itertools
import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lanes import lowered, run, text_of
from scipy.special import erf

from echelon.agents.models import Quadrotor
from echelon.core.numerics import precision, rk4
from echelon.simulation.codegen import factored, machine_code
from echelon.simulation.scalars import ScalarGraph, Unsupported, needed
from echelon.simulation.scalars.scalar_graph import OPERATIONS

EPS = np.finfo(float).eps
rng = np.random.default_rng(7)
WIDE = rng.normal(size=4000) * 10.0 ** rng.uniform(-8.0, 1.0, 4000)
FUNCTIONS = {
    "sin": (jnp.sin, np.sin, rng.uniform(-1e3, 1e3, 4000), 1.6),
    "cos": (jnp.cos, np.cos, rng.uniform(-10.0, 10.0, 4000), 1.6),
    "tan": (jnp.tan, np.tan, rng.uniform(-10.0, 10.0, 4000), 3.5),
    "exp": (jnp.exp, np.exp, rng.uniform(-80.0, 80.0, 4000), 1.1),
    "exp2": (jnp.exp2, np.exp2, rng.uniform(-1.0, 1.0, 4000), 1.6),
    "expm1": (jnp.expm1, np.expm1, WIDE, 2.0),
    "log": (jnp.log, np.log, 10.0 ** rng.uniform(-30.0, 30.0, 4000), 1.0),
    "log near 1": (jnp.log, np.log, 1.0 + 0.1 * rng.normal(size=4000), 1.0),
    "log1p": (jnp.log1p, np.log1p, np.abs(WIDE), 1.5),
    "tanh": (jnp.tanh, np.tanh, WIDE, 2.5),
    "sinh": (jnp.sinh, np.sinh, WIDE, 2.8),
    "cosh": (jnp.cosh, np.cosh, WIDE, 2.0),
    "arcsinh": (jnp.arcsinh, np.arcsinh, WIDE, 2.5),
    "arccosh": (jnp.arccosh, np.arccosh, rng.uniform(1.0, 30.0, 4000), 2.5),
    "arctanh": (jnp.arctanh, np.arctanh, rng.uniform(-1.0, 1.0, 4000), 2.5),
    "arctan": (jnp.arctan, np.arctan, WIDE, 3.0),
    "arcsin": (jnp.arcsin, np.arcsin, rng.uniform(-1.0, 1.0, 4000), 3.5),
    "arccos": (jnp.arccos, np.arccos, rng.uniform(-1.0, 1.0, 4000), 3.5),
    "cbrt": (jnp.cbrt, np.cbrt, WIDE, 1.0),
    "erf": (jax.lax.erf, erf, rng.normal(size=4000), 6.0),
    "rsqrt": (jax.lax.rsqrt, lambda x: x**-0.5, 10.0 ** rng.uniform(-30.0, 30.0, 4000), 2.0),
    "sqrt": (jnp.sqrt, np.sqrt, rng.uniform(0.0, 9.0, 4000), 0.5),
    "sigmoid": (jax.nn.sigmoid, lambda x: 1.0 / (1.0 + np.exp(-x)), WIDE, 2.5),
}


def units(found, wanted):
    """How far a result is off, in units of the last place of what is wanted."""
    info = np.finfo(found.dtype)
    unit = np.ldexp(np.longdouble(info.eps), np.frexp(np.abs(wanted))[1] - 1)
    return np.abs(found.astype(np.longdouble) - wanted) / np.maximum(unit, info.tiny * info.eps)


@pytest.mark.parametrize("bits", [64, 32])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_right_to_a_few_units_of_the_last_place(name, bits):
    function, wanted, x, most = FUNCTIONS[name]
    x = x.astype(np.float64 if bits == 64 else np.float32)
    [found] = run(lambda v: function(v[0]), x[None], bits)
    exact = wanted(x.astype(float) if name == "erf" else x.astype(np.longdouble))
    assert units(found, exact).max() <= most


@pytest.mark.parametrize("bits", [64, 32])
def test_the_angle_of_a_point_is_right_in_all_quarters(bits):
    y, x = rng.normal(size=(2, 4000)).astype(np.float64 if bits == 64 else np.float32)
    [found] = run(lambda v: jnp.arctan2(v[0], v[1]), np.stack([y, x]), bits)
    assert units(found, np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))).max() <= 3.0
    sides = itertools.product((0.0, -0.0, 1.0, np.inf), (0.0, -0.0, -1.0, np.inf))
    corners = np.array(list(sides))
    [found] = run(lambda v: jnp.arctan2(v[0], v[1]), corners.T)
    np.testing.assert_allclose(found, np.arctan2(*corners.T), rtol=1e-15)


@given(
    x=st.floats(1e-3, 1e3), y=st.one_of(st.floats(-20.0, 20.0), st.sampled_from([0.5, 2.0, -3.0]))
)
@settings(max_examples=20)
def test_powers_are_right_to_the_size_of_their_exponent(x, y):
    [found] = run(lambda v: v[0] ** v[1], np.array([[x], [y]]))
    wanted = np.longdouble(x) ** np.longdouble(y)
    assert units(found, np.array([wanted])).max() <= 4.0 + 2.0 * abs(y * np.log(x))
    whole = run(lambda v: jnp.stack([v[0] ** 3, v[0] ** -2]), np.array([[-x]]))
    np.testing.assert_allclose(whole[:, 0], [(-x) ** 3, (-x) ** -2.0], rtol=1e-14)


def by_jax(function, columns):
    with precision("float64"):
        rows = np.asarray(jax.vmap(function)(jnp.asarray(columns.T)), float)
        return rows.reshape(columns.shape[1], -1).T


def loop(v):
    return jax.lax.fori_loop(0, 5, lambda k, x: jnp.sin(x) + 0.1 * k, v)


def folded(v):
    return jax.lax.scan(lambda c, w: (c * 0.5 + w, c), v[0], v)[1]


def branch(v):
    return jax.lax.cond(v[0] > 0.3, lambda u: u @ u, lambda u: jnp.prod(u), v)


def much(v):
    """One side of a choice is so much that it stands behind a branch."""
    far = v
    for _ in range(12):
        far = jnp.tanh(far) + far[::-1] * 0.3
    return jnp.where(v[0] > 1.5, far, v)


def both(v):
    near, far = v, v
    for _ in range(9):
        near, far = jnp.cos(near) + 0.1 * near[::-1], jnp.exp(-far * far)
    return jnp.where(v[1] > 0.5, near, far)


def chained(v):
    """What one side needs rests on a choice by the same truth, which needs the same side."""
    first = v
    for _ in range(8):
        first = jnp.cos(first) + 0.2 * first[::-1]
    chosen = jnp.where(v[0] > 0.2, first, v) + 1.0
    second = chosen
    for _ in range(8):
        second = jnp.exp(-second * second) + 0.3 * second[::-1]
    return jnp.concatenate([jnp.where(v[0] > 0.2, second, chosen), chosen])


def metres(v):
    M = jnp.array([[2.0, 0.1, 0.0], [0.1, 3.0, 0.2], [0.0, 0.2, 1.0]]) + jnp.diag(v**2)
    return jnp.concatenate([jnp.linalg.solve(M, v), jnp.linalg.inv(M)[0]])


def pivoted(v):
    return jnp.linalg.solve(jnp.array([[0.0, 1.0], [1.0, 1e-9]]) * (1.0 + v[0] ** 2), v[:2])


def halves(v):
    return jnp.linalg.cholesky(jnp.eye(3) * 4.0 + jnp.outer(v, v))[jnp.tril_indices(3)]


PROGRAMS = {
    "moves": lambda v: jnp.roll(jnp.concatenate([v, v[::-1]]).at[2].add(1.0), 1)[1:5],
    "matrices": lambda v: jnp.cross(v, v[::-1]) @ (jnp.outer(v, v) + jnp.eye(3)),
    "extremes": lambda v: jnp.stack([v.max(), v.min(), jnp.clip(v[0], -0.2, 0.3), v.prod()]),
    "rounding": lambda v: jnp.stack([jnp.floor(v[0]), jnp.ceil(v[1]), jnp.round(v[2] * 2.5)]),
    "signs": lambda v: jnp.stack([jnp.sign(v[0]), jnp.abs(v[1]), jnp.negative(v[2])]),
    "truths": lambda v: jnp.where((v[0] > 0) & ~(v[1] > v[2]) | jnp.isnan(v[0]), 1.0, v[2]),
    "remainders": lambda v: jnp.stack([jnp.fmod(v[0] * 9.0, 0.7), jnp.mod(v[1] * 9.0, 0.7)]),
    "a smooth norm": lambda v: v / jnp.linalg.norm(v) + jax.nn.softplus(v),
    "a slope": lambda v: jax.jacfwd(lambda u: jnp.sin(u[0]) * u[1] ** 2 + jnp.tanh(u[2]))(v),
    "a loop": loop,
    "a scan": folded,
    "a branch": branch,
    "much behind a branch": much,
    "much on both sides": both,
    "much that rests on a choice by the same truth": jnp.sinc,
    "much on the one side of a choice and of the next": chained,
    "equations": metres,
    "equations that need a pivot": pivoted,
    "a root of a matrix": halves,
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_do_what_jax_does_with_the_same_bits_in_vectors_of_any_width(name):
    columns = rng.normal(size=(3, 41))
    found = run(PROGRAMS[name], columns)
    np.testing.assert_allclose(found, by_jax(PROGRAMS[name], columns), rtol=2e-14, atol=1e-14)
    for lanes in (2, 16):
        assert run(PROGRAMS[name], columns, lanes=lanes).tobytes() == found.tobytes()


KNOTS = jnp.linspace(-1.0, 1.0, 7)
TABLE = jnp.array([0.0, 1.0, 4.0, 2.0, 3.0, -1.0, 0.5])


def whole(v):
    return jnp.floor(3.0 * v[0]).astype(int)


def whole_numbers(v):
    k = whole(v)
    return jnp.stack([k // 2, k % 3, jax.lax.div(k, 2), (v[1] * 9.0).astype(int), -k]) * 1.0


def triangles(v):
    A, kinds = jnp.eye(3) * 3.0 + jnp.outer(v, v), [(True, 0), (False, 0), (True, 1), (False, 2)]
    solved = [
        jax.scipy.linalg.solve_triangular(A, v, lower=low, trans=turned, unit_diagonal=turned == 2)
        for low, turned in kinds
    ]
    right = jax.lax.linalg.triangular_solve(A, v[None], left_side=False, lower=True)
    return jnp.concatenate([*solved, right[0], jax.scipy.linalg.cho_solve((A, True), v)])


def factors(v):
    # Without a pivot it would be divided by next to nothing.
    A = jnp.array([[1e-9, 2.0, 1.0], [3.0, 0.5, 0.0], [1.0, 0.0, 4.0]]) + jnp.diag(v * v)
    P, L, U = jax.scipy.linalg.lu(A)
    sign, size = jnp.linalg.slogdet(A)
    return jnp.concatenate([P.ravel(), L.ravel(), U.ravel(), jnp.stack([sign, size])])


PICKS = {
    "a curve through points": lambda v: jnp.interp(v, KNOTS, TABLE),
    "a place among points": lambda v: jnp.searchsorted(KNOTS, v, side="right") * 1.0,
    "the largest": lambda v: jnp.stack([jnp.argmax(v), jnp.argmin(v), v[jnp.argmax(v)]]),
    "order": lambda v: jnp.concatenate([jnp.sort(v), jnp.argsort(v), -jnp.sort(-v)[:1]]),
    "a middle": jnp.median,
    "entries of a table": lambda v: jnp.concatenate(
        [
            TABLE[whole(v)][None],
            jnp.take(TABLE, whole(v) + jnp.arange(2), mode="clip"),
            TABLE[1:][jnp.array([whole(v), 1])],
        ]
    ),
    "an entry that is not there": lambda v: jnp.stack(
        [
            TABLE.at[jnp.abs(whole(v)) + 4].get(mode="fill", fill_value=jnp.nan),
            TABLE.at[jnp.abs(whole(v)) + 5].get(mode="fill", fill_value=7.0),
        ]
    ),
    "rows of a state": lambda v: jax.lax.dynamic_slice(v, (jnp.argmax(v),), (2,)),
    "an entry that is set": lambda v: jnp.concatenate(
        [v.at[whole(v)].set(7.0), v.at[whole(v)].add(0.5), v.at[jnp.argmin(v)].set(v[0])]
    ),
    "rows that are set": lambda v: jax.lax.dynamic_update_slice(v, v[1:] * 2.0, (whole(v),)),
    "an entry of a matrix": lambda v: jnp.outer(v, v)[jnp.argmax(v), jnp.argmin(v)],
    "cases": lambda v: jax.lax.switch(whole(v), [jnp.sin, lambda u: 2.0 * u, jnp.square], v),
    "cases by truths": lambda v: jnp.select([v[0] < 0.0, v[1] > 0.0], [v[0], v[1]], v[2]),
    "whole numbers": whole_numbers,
    "products": lambda v: jnp.concatenate(
        [jnp.cumprod(v), jax.lax.cumprod(v, reverse=True), jnp.cumsum(v)]
    ),
    "triangles": triangles,
    "factors": factors,
    "an exponential of a matrix": lambda v: jax.scipy.linalg.expm(jnp.outer(v, v[::-1])).ravel(),
}


@pytest.mark.parametrize("name", PICKS)
def test_what_agents_pick_is_what_jax_picks(name):
    # Of its own: rounding of an exponential grows with the matrix, so no other test may choose it.
    columns = np.random.default_rng(0).normal(size=(3, 41))
    found, wanted = run(PICKS[name], columns), by_jax(PICKS[name], columns)
    np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("bits", [64, 32])
def test_quotients_of_whole_numbers_are_whole_by_any_number(bits):
    x, by = np.arange(-600.0, 600.0)[None], (3, 41, 47, 49, 98, 103)

    def function(v):
        whole = v[0].astype(int)
        cut = [jnp.stack([whole // k, whole % k, jax.lax.rem(whole, k)]) * 1.0 for k in by]
        return jnp.concatenate([*cut, jnp.stack([jnp.fmod(v[0], 49.0), v[0] % 41.0])])

    np.testing.assert_array_equal(run(function, x, bits=bits), by_jax(function, x))
    # Where a product of floats stands for one of numbers, nothing says which side of it x is.
    turns = 0.7 * np.arange(-300.0, 300.0)[None]
    found = run(lambda v: jnp.fmod(v[0], 0.7)[None], turns)
    np.testing.assert_array_equal(found, np.fmod(turns, 0.7))


def test_what_is_no_number_is_picked_and_ordered_as_by_jax():
    columns = np.array(list(itertools.product([np.nan, 1.0, -np.inf, np.inf], repeat=3))).T

    def function(v):
        large = jnp.where(jnp.isfinite(v), v, 0.0) * 3e9
        picks, kinds = jnp.stack([jnp.argmax(v), jnp.argmin(v)]), (jnp.int32, jnp.uint32)
        whole = [v.astype(kinds[0]), large.astype(kinds[0]), (-large).astype(kinds[1])]
        parts = [picks, jnp.sort(v), jnp.argsort(v), *whole]
        return jnp.concatenate([part * 1.0 for part in parts])

    np.testing.assert_array_equal(run(function, columns), by_jax(function, columns))


LEAVES = [lambda v: v[0], lambda v: v[1], lambda v: v[2], lambda v: 0.7, lambda v: -1.3]
ONE = [jnp.sin, jnp.cos, jnp.tanh, jnp.abs, lambda a: jnp.exp(-a * a), lambda a: a / (1.0 + a * a)]
ONE += [lambda a: jnp.sqrt(a * a + 0.1), lambda a: -a, lambda a: jnp.arctan2(a, 1.3)]
TWO = [jnp.add, jnp.subtract, jnp.multiply, jnp.maximum, jnp.minimum]
TWO += [lambda a, b: jnp.where(a > b, a * 0.5, b)]


def trees(depth):
    leaf = st.sampled_from(LEAVES)
    if not depth:
        return leaf
    under = trees(depth - 1)
    one = st.builds(lambda f, a: lambda v: f(a(v)), st.sampled_from(ONE), under)
    two = st.builds(lambda f, a, b: lambda v: f(a(v), b(v)), st.sampled_from(TWO), under, under)
    return st.one_of(leaf, one, two, two)


@given(tree=trees(4))
@settings(max_examples=25)
def test_drawn_functions_are_what_jax_makes_of_them(tree):
    columns = np.random.default_rng(3).normal(size=(3, 16))
    found, wanted = run(lambda v: jnp.asarray(tree(v)) + 0.0 * v[0], columns), by_jax(tree, columns)
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-13)


def test_nothing_is_told_twice_or_unfolded_and_much_that_few_need_stands_behind_a_branch():
    [a, b] = lowered(lambda v: jnp.stack([jnp.sin(v[0]) * v[1], v[1] * jnp.sin(v[0])]), 2)
    assert a is b
    graph = ScalarGraph()
    x = graph.leaf("row", 0)
    assert (x + 0.0, x * 1.0, -(-x), x - 0.0) == (x, x, x, x)
    assert (x * 0.0).value == 0.0 and (graph.constant(2.0) * 3.0).value == 6.0
    assert "vector.reduce.or" in text_of(much, 3)[0]
    assert "vector.reduce.or" not in text_of(lambda v: jnp.where(v[0] > 1.0, -v, v), 3)[0]


def test_a_long_chain_and_shared_numbers_are_known_not_to_be_below_0():
    x = total = ScalarGraph().leaf("row", 0)
    assert not x.at_least_0
    total = x.graph.make("abs", x)
    for k in range(1200):
        total = total + total * total if k < 40 else total + 2.0
    assert total.at_least_0 and not (total - 1.0).at_least_0


def products(function, count):
    return sum(node.op == "mul" for node in needed(lowered(function, count)))


def test_what_products_have_in_common_is_multiplied_once():
    J, rates = np.array([1.0, 2.5, 4.0]), np.array([2.0, 3.0, -5.0])
    # Euler's equations: three products of two rates, and a number for each.
    assert products(lambda w: -jnp.cross(w, J * w) / J, 3) == 6
    found = run(lambda w: -jnp.cross(w, J * w) / J, rates[:, None])
    np.testing.assert_allclose(found[:, 0], -np.cross(rates, J * rates) / J, rtol=1e-15)
    # An integrator's stages, and what is the same in all of them.
    assert products(lambda v: (v[0] + 2.0 * v[1] + 2.0 * v[2] + v[3]) / 6.0, 4) == 2
    assert products(lambda v: v[0] * 0.5 * v[1] + v[2] * 0.5 * v[1] + v[3] * v[1], 4) == 2
    both = lowered(lambda v: jnp.stack([v[2] * (3.0 * v[0]), v[3] * (3.0 * v[0])]), 4)
    assert sum(node.op == "mul" for node in needed(both)) == 3


def numbers_of(results, row):
    """Return what results are of small whole numbers, where no order of sums rounds."""
    found = {}
    for node in needed(results):
        if node.op == "leaf":
            found[node] = row[node.value[1]]
        else:
            args = [found[a] for a in node.args]
            found[node] = OPERATIONS[node.op](*args) if args else node.value
    return [found[node] for node in results]


def test_sums_of_whole_numbers_stay_the_same_with_no_more_products():
    drawn, fewer = random.Random(2), 0
    for _ in range(400):
        graph = ScalarGraph()
        pool = [graph.leaf("row", k, uniform=k == 0) for k in range(4)]
        for _ in range(16):
            op = drawn.choice(["add", "add", "sub", "sub", "mul", "mul", "mul", "neg"])
            plain = graph.constant(drawn.choice([0.5, 2.0, -2.0, 3.0]))
            args = [drawn.choice([plain, *pool[-6:]]) for _ in range(1 if op == "neg" else 2)]
            pool.append(graph.make(op, *args))
        short, row = factored(pool[-2:]), [3.0, -5.0, 2.0, 7.0]
        exact = numbers_of(pool[-2:], row)
        if max(map(abs, exact)) < 2.0**40:
            assert numbers_of([short[node] for node in pool[-2:]], row) == exact
        before, after = (
            sum(node.op == "mul" and not node.uniform for node in needed(results))
            for results in (pool[-2:], short.values())
        )
        assert after <= before
        fewer += after < before
    assert fewer > 10


SMALL = np.random.default_rng(5).normal(size=(2, 64)) * 1e-7


@pytest.mark.parametrize(
    ("function", "values"),
    [
        (lambda v: v[0] - ((1.0 + v[0]) - 1.0), SMALL),
        (lambda v: (v[0] + v[1]) - v[1], SMALL),
        (lambda v: (v[0] + 1e8 * v[1]) - 1e8 * v[1], SMALL),
        (lambda v: jnp.expm1(v[0]) - jnp.sin(v[0]), SMALL),
        (lambda v: v[0] * v[1] * v[2] + (v[3] - v[4]), [1e-4, 1e-4, 1.0, 1e5, 1e5]),
        (lambda v: v[0] * v[1] * v[2] + (v[3] - v[4]), [1.0, 1.0, 0.3, 1e15, 1e15]),
        (lambda v: 0.5 * v[0] * v[1] + (1.0 - v[2]), [1e-6, 1e-6, 1.0]),
        (lambda v: 0.1 * v[3] * v[4] + (v[0] - (v[1] + v[2])), [1.0, 1e20, -1e20, 1.0, 1.0]),
        # A difference beside what does have something in common, and beneath it.
        (lambda v: (v[0] * v[1] + (v[2] - v[3])) + v[4] * v[1], [0.1, 0.3, 1e15, 1e15, 0.2]),
        (lambda v: 0.5 * v[0] + (0.5 * v[1] - 0.5 * v[2]), [1e-12, 1.0, 1.0]),
        (lambda v: v[0] * 0.5 - (v[1] * 0.5 - v[2] * 0.5), [1e-12, 1.0, 1.0]),
        # What is no number stays none where terms are the same.
        (lambda v: (2.0 * v[0]) * v[1] - v[0] * (2.0 * v[1]), [np.inf, 1.0]),
    ],
)
def test_parentheses_hold_where_nothing_is_in_common_and_rounding_is_meant(function, values):
    columns = values if values is SMALL else np.tile(np.array(values)[:, None], 8)
    precise = {"rtol": 0.0, "atol": 4e-22} if values is SMALL else {"rtol": 1e-14}
    np.testing.assert_allclose(run(function, columns), by_jax(function, columns), **precise)


@pytest.mark.parametrize(("large", "bits"), [(1e200, 64), (1e25, 32)])
def test_products_are_made_as_written_where_nothing_is_in_common(large, bits):
    def function(v):
        return (v[0] * v[2]) * v[1] + v[3]

    dtype = np.float64 if bits == 64 else np.float32
    for values in ([large, large, 1.0 / large, 1.0], [1.0 / large, 1.0 / large, large, 0.0]):
        columns = np.tile(np.array(values, dtype)[:, None], 64)
        np.testing.assert_allclose(run(function, columns, bits), columns[:1], rtol=1e-6)
    # Numbers too large to be put together are multiplied as written: no single precision has the
    # product in the middle.
    if bits == 32:
        ones = np.ones((2, 4))
        [far] = run(lambda v: 1e-30 * (1e-30 * (1e35 * v[0] * (1e30 * v[1]))), ones, bits)
        [near] = run(lambda v: 1e-30 * (1e35 * v[0] * (1e-30 * (1e30 * v[1]))), ones, bits)
        assert np.isinf(far).all()
        np.testing.assert_allclose(near, 1e5, rtol=1e-6)


@pytest.mark.parametrize("bits", [64, 32])
def test_what_is_usual_beside_a_lane_and_what_is_not_are_the_same_to_the_bit(bits):
    model, u = Quadrotor(), jnp.array([0.3, 1e-5, -2e-5, 1e-6])

    def step(v):
        angle = jnp.arctan2(v[3], 1.0 + jnp.sqrt(v[4] * v[4] + 1.0))
        return jnp.append(rk4(model.velocity, v, u.astype(v.dtype), 0.05), angle)

    small = np.random.default_rng(3).uniform(-0.3, 0.3, (12, 16 * 64 // bits))
    mixed = small.copy()
    mixed[8, 1], mixed[3, 2], mixed[6, 3] = 2.0, 3.0, np.nan
    alone, beside = (run(step, columns, bits) for columns in (small, mixed))
    assert alone[:, 4:].tobytes() == beside[:, 4:].tobytes()
    assert alone[:, 0].tobytes() == beside[:, 0].tobytes()
    # Nothing is left to LLVM, which would put together what stands in one stretch of code alone.
    assert "contract" not in text_of(step, 12, bits)[0]


def ends_by_itself(v):
    return jax.lax.while_loop(lambda x: x < 3.0, lambda x: x + 1.0, v[0])


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (ends_by_itself, "a `while` loop"),
        (lambda v: jnp.abs(jnp.fft.fft(v)), "`convert_element_type` to complex128"),
        (lambda v: jax.lax.fori_loop(0, 999, lambda k, x: jnp.sin(x), v), "a loop of 999 rounds"),
        (lambda v: v.at[1].apply(jnp.sin), "`scatter` of a function"),
        (lambda v: jnp.linalg.eigvalsh(jnp.outer(v, v)), "`eigh`"),
        (lambda v: jax.pure_callback(np.sin, v, v), "`pure_callback`"),
        (lambda v: jax.random.normal(jax.random.key(0), (3,)) * v, "a trace that no rule fits"),
        (lambda v: jnp.interp(v[0], jnp.linspace(0, 1, 99), jnp.ones(99)), "a table of 99 places"),
        (lambda v: jnp.sort(jnp.concatenate([v, v, v])), "`sort` of 9 entries"),
        (lambda v: v.at[jnp.stack([whole(v), 0])].set(1.0), "`scatter` of more than one entry"),
        (lambda v: (whole(v) & 1) * 1.0, "`and` of whole numbers"),
        (lambda v: whole(v) ** whole(v[1:]) * 1.0, "`and` of whole numbers"),
    ],
)
def test_what_has_no_code_is_told_with_file_and_line(function, told):
    with pytest.raises(Unsupported, match=f"{told}.* (in .*test_codegen.py, line|PRNGKey dtype)"):
        text_of(function, 3)


LESS = {
    "avx512": "vectors of 256 bits, with fused multiply-add",
    "avx512 avx2 avx fma": "vectors of 128 bits, without fused multiply-add",
    "avx512 avx2 avx fma sse4": "vectors of 128 bits, without fused multiply-add",
}


@pytest.mark.parametrize("without", LESS)
@pytest.mark.parametrize("bits", [64, 32])
def test_a_processor_with_less_computes_the_same_and_says_what_it_has(monkeypatch, without, bits):
    function, columns = PROGRAMS["a loop"], rng.normal(size=(3, 40))
    whole = run(function, columns, bits)
    has = machine_code.features().split(",")
    less = [f"-{x[1:]}" if x[1:].startswith(tuple(without.split())) else x for x in has]
    monkeypatch.setattr(machine_code, "features", lambda: ",".join(less))
    if "+avx512f" in has:
        assert machine_code.vectors().endswith(LESS[without])
    found = run(function, columns, bits)
    if "fma" not in without:
        assert found.tobytes() == whole.tobytes()
    np.testing.assert_allclose(found, whole, rtol=1e-13 if bits == 64 else 1e-5)


def test_what_was_compiled_is_kept_and_a_damaged_file_is_made_again(tmp_path):
    columns, before = rng.normal(size=(3, 8)), jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "c"))
    try:
        first = run(PROGRAMS["a loop"], columns)
        [file] = (tmp_path / "c").iterdir()
        whole = file.read_bytes()
        for content in (whole, whole[: len(whole) // 2], b"", whole[:40] + b"x" + whole[41:]):
            file.write_bytes(content)
            assert run(PROGRAMS["a loop"], columns).tobytes() == first.tobytes()
            assert file.read_bytes() == whole
        # A folder without room for code is no fault.
        file.unlink()
        file.parent.rmdir()
        assert run(PROGRAMS["a loop"], columns).tobytes() == first.tobytes()
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_quotients_by_one_number_share_its_inverse_and_stay_whole_where_they_are_cut():
    x = np.stack([rng.integers(1, 99, 400), rng.integers(1, 99, 400), rng.normal(size=400)])
    found = run(lambda v: jnp.stack([v[2] / v[1] + 1.0, 2.0 * (v[0] / v[1])]), x.astype(float))
    # What is added to a quotient may cancel it; the error is that of the quotient.
    quotients = np.array([x[2] / x[1], x[0] / x[1]])
    off = np.abs(found - np.array([quotients[0] + 1.0, 2.0 * quotients[1]]))
    assert (off <= 2.0 * EPS * (1.0 + 2.0 * np.abs(quotients))).all()
    cut = run(
        lambda v: jnp.stack([jnp.floor(7.0 * v[1] / v[1]), v[0] / v[1] + 1.0]), x.astype(float)
    )
    np.testing.assert_array_equal(cut[0], 7.0)
