"""The interpreter of JAX traces, tested with exact fractions."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echelon.core.jaxpr import Algebra, dot, evaluate, reduction, walk


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


@pytest.mark.parametrize("name", CASES)
def test_the_walk_evaluates_in_the_algebra_that_it_is_given(name):
    function, wanted = CASES[name]
    x = fractions("1/3", "2/7")
    found = evaluate(function, [x], FRACTIONS)
    wanted = [y / 2 + y * y + y for y in x] if wanted is None else [Fraction(w) for w in wanted]
    assert [list(result) for result in found] == [wanted]


def test_constants_literals_and_what_follows_from_them_are_lifted():
    lifted = []

    def keep(numbers):
        lifted.append(numbers.tolist())
        return exact(numbers)

    evaluate(lambda x: x * M[0] + 0.25, [fractions("1", "2")], FRACTIONS._replace(lift=keep))
    assert [1.0, 2.0] in lifted and 0.25 in lifted


def test_rules_of_the_algebra_go_before_the_common_ones():
    closed = jax.make_jaxpr(lambda x: x + x)(np.zeros(1))
    swapped = FRACTIONS._replace(rules={"add": lambda params, a, b: a * b})
    assert list(walk(closed.jaxpr, closed.consts, [fractions("3")], swapped)[0]) == [Fraction(9)]


def test_what_has_no_rule_and_what_lies_outside_is_for_the_algebra_to_say():
    with pytest.raises(LookupError, match="sin"):
        evaluate(lambda x: jax.jit(jnp.sin)(x), [fractions("1")], FRACTIONS)
    with pytest.raises(IndexError, match="outside"):
        evaluate(lambda x: x.at[jnp.array([3])].get(mode="fill"), [fractions("1")], FRACTIONS)


def test_what_no_result_depends_on_is_not_evaluated():
    [found] = evaluate(lambda x: (jnp.sin(x), x + x)[1], [fractions("1/3")], FRACTIONS)
    assert found.tolist() == [Fraction(2, 3)]
