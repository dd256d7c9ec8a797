"""The interpreter of JAX traces, tested with exact fractions."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from echelon_ranges import jaxpr
from echelon_ranges.jaxpr import Algebra, dot, evaluate, float64, reduction, walk


def refuse(equation, operands):
    raise LookupError(equation.primitive.name)


def outside():
    raise IndexError("outside")


def exact(numbers):
    return np.vectorize(Fraction, [object])(numbers) if numbers.dtype.kind == "f" else numbers


SUMS = {"dot_general": dot(Fraction(0)), "reduce_sum": reduction(Fraction.__add__, Fraction(0))}
FRACTIONS = Algebra(SUMS, Fraction, exact, outside, refuse)


def fractions(*numbers):
    entries = np.empty(len(numbers), object)
    entries[:] = [Fraction(text) for text in numbers]
    return entries


@jax.custom_vjp
def product(x, y):
    return x * y


product.defvjp(lambda x, y: (x * y, (x, y)), lambda kept, g: (g * kept[1], g * kept[0]))


@jax.custom_jvp
def half(x):
    return 0.5 * x


half.defjvp(lambda x, rate: (half(*x), 0.5 * rate[0]))

M = np.array([[1.0, 2.0], [0.5, -3.0]])
CASES = {
    "arithmetic": (lambda x: x * x - 3.0 * x + jnp.square(-x), ["-7/9", "-34/49"]),
    "calls": (lambda x: jax.jit(half)(x) + product(x, x) + jax.checkpoint(lambda y: y)(x), None),
    "a closed matrix": (lambda x: jnp.asarray(M) @ x, ["19/21", "-29/42"]),
    "moves": (lambda x: jnp.flip(x).at[0].add(x[0]).reshape(2, 1).T.ravel(), ["13/21", "1/3"]),
    "a sum of nothing": (lambda x: jnp.sum(x[2:])[None], ["0"]),
    "whole numbers": (lambda x: x[jnp.argsort(jnp.array([3, 1]))], ["2/7", "1/3"]),
    "a matrix of whole numbers": (lambda x: jnp.array([[1, 2], [0, -3]]) @ x, ["19/21", "-6/7"]),
    "a number outside": (
        lambda x: x.at[jnp.array([9, 1])].get(mode="fill", fill_value=0.0),
        ["0", "2/7"],
    ),
    "a cumulative sum": (lambda x: jnp.cumsum(x), ["1/3", "13/21"]),
}


def test_the_walk_evaluates_in_the_algebra_that_it_is_given():
    x, faults = fractions("1/3", "2/7"), []
    for name, (function, wanted) in CASES.items():
        [found] = evaluate(function, [x], FRACTIONS)
        wanted = [y / 2 + y * y + y for y in x] if wanted is None else [Fraction(w) for w in wanted]
        faults += [] if list(found) == wanted else [name]
    assert faults == []


def test_constants_are_lifted_and_own_rules_or_refusals_go_first():
    lifted = []

    def keep(numbers):
        lifted.append(numbers.tolist())
        return exact(numbers)

    evaluate(lambda x: x * M[0] + 0.25, [fractions("1", "2")], FRACTIONS._replace(lift=keep))
    assert [1.0, 2.0] in lifted and 0.25 in lifted
    closed = jax.make_jaxpr(lambda x: x + x)(np.zeros(1))
    swapped = FRACTIONS._replace(rules={"add": lambda params, a, b: a * b})
    assert list(walk(closed.jaxpr, closed.consts, [fractions("3")], swapped)[0]) == [Fraction(9)]
    with pytest.raises(LookupError, match="sin"):
        evaluate(lambda x: jax.jit(jnp.sin)(x), [fractions("1")], FRACTIONS)
    with pytest.raises(IndexError, match="outside"):
        evaluate(lambda x: x.at[jnp.array([3])].get(mode="fill"), [fractions("1")], FRACTIONS)
    [found] = evaluate(lambda x: (jnp.sin(x), x + x)[1], [fractions("1/3")], FRACTIONS)
    assert found.tolist() == [Fraction(2, 3)]


X = np.random.default_rng(0).normal(size=(4, 5, 3))
ROWS = np.array([3, 0, 2])
NUMBERS = Algebra({}, float, lambda n: n, lambda: np.nan, lambda *_: [])
BY_NUMPY = {
    "an entry": lambda x: x[1, 2, 0],
    "rows": lambda x: x[ROWS],
    "rows of the last axis": lambda x: x[..., jnp.array([2, 0])],
    "places": lambda x: x[ROWS, jnp.array([4, 4, 1])],
    "places apart": lambda x: x[ROWS, :, jnp.array([2, 2, 1])],
    "a table of places": lambda x: x[jnp.array([[0, 3], [1, 1]]), 2],
    "places from the end": lambda x: x[-2, ::2, jnp.array([-1])],
    "places within": lambda x: x.at[jnp.array([1, 9])].get(mode="clip"),
    "an entry of each": lambda x: jax.vmap(lambda row, k: row[k])(x, ROWS[[0, 1, 2, 1]]),
    "a window of each": lambda x: jax.vmap(
        lambda row, k: jax.lax.dynamic_slice(row, (k, 0), (2, 3))
    )(x, ROWS[[0, 1, 2, 1]]),
    "a new entry": lambda x: x.at[1, 2, 0].set(7.0),
    "new rows": lambda x: x.at[ROWS].set(x[:3] * 2.0),
    "new rows of the last axis": lambda x: x.at[..., 1:].set(0.5),
    "new places": lambda x: x.at[ROWS, jnp.array([4, 4, 1])].set(x[0, :3]),
    "new places apart": lambda x: x.at[ROWS, :, jnp.array([2, 2, 1])].set(x[:3, :, 0]),
    "a new entry of each": lambda x: jax.vmap(lambda row, k: row.at[k].set(k * 0.1))(
        x, ROWS[[0, 1, 2, 1]]
    ),
    "a border": lambda x: jnp.pad(x, ((0, 1), (2, 0), (0, 0)), constant_values=3.0),
    "truths": lambda x: ((x > 0.0) & (jnp.abs(x) < 1.0) | ~(x < 0.5)).any(axis=(0, 2)),
    "all of them": lambda x: (x > -9.0).all(axis=1),
    "a quotient": lambda x: jnp.stack([x / 3.0, 1.0 / (0.0 * x), x[0, 0, 0] / jnp.abs(x)]),
    "powers": lambda x: jnp.stack([x**k for k in (-3, -1, 2, 3, 5, 8)]),
    "bits": lambda x: (jnp.arange(6) & 3) | ~jnp.arange(6),
}
BY_JAX = {
    "a quotient without digits": lambda x: x / 1e308 / 1e7,
    "a power without digits": lambda x: (1e-80 * x) ** 4,
    "a power of whole numbers": lambda x: jnp.arange(-3, 3) ** 3,
    "outside": lambda x: x[0].at[jnp.array([1, 9])].get(mode="fill"),
    "written outside": lambda x: x.at[jnp.array([1, 9])].set(2.0),
    "less": lambda x: jax.lax.pad(x, 0.0, ((-1, 0, 0), (0, 0, 1), (0, 0, 0))),
    "of whole numbers": lambda x: jax.lax.div(jnp.arange(-3, 3), 2),
    "a function of an entry": lambda x: x.at[1].apply(jnp.sin),
}


@pytest.mark.slow
def test_numbers_are_those_of_jax_to_the_bit_and_mostly_without_jax(monkeypatch):
    faults = []
    for name, function in (BY_NUMPY | BY_JAX).items():
        with float64(), monkeypatch.context() as at:
            closed = jax.make_jaxpr(function)(jnp.asarray(X))
            [expected] = jaxpr_as_fun(closed)(jnp.asarray(X))
            if name in BY_NUMPY:
                at.setattr(jaxpr, "by_jax", None)
            # The second time from memory.
            for _ in range(2):
                [result] = walk(closed.jaxpr, closed.consts, [X], NUMBERS)
                same = result.tobytes() == np.asarray(expected).tobytes()
                faults += [] if same and result.dtype == expected.dtype else [name]
    assert faults == []
