"""What NumPy makes of equations of a trace is what JAX makes of them, to the bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from echelon.core import jaxpr
from echelon.core.jaxpr import Algebra, walk
from echelon.core.numerics import precision

X = np.random.default_rng(0).normal(size=(4, 5, 3))
ROWS = np.array([3, 0, 2])
NUMBERS = Algebra({}, float, lambda n: n, lambda: np.nan, lambda *_: [])

CASES = {
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


@pytest.mark.parametrize("name", CASES)
def test_numbers_are_those_of_jax_to_the_bit_without_jax(name, monkeypatch):
    with precision("float64"):
        closed = jax.make_jaxpr(CASES[name])(jnp.asarray(X))
        [expected] = jaxpr_as_fun(closed)(jnp.asarray(X))
        monkeypatch.setattr(jaxpr, "_by_jax", None)
        [result] = walk(closed.jaxpr, closed.consts, [X], NUMBERS)
    assert result.dtype == expected.dtype and result.tobytes() == np.asarray(expected).tobytes()


OTHERS = {
    "a quotient without digits": lambda x: x / 1e308 / 1e7,
    "a power without digits": lambda x: (1e-80 * x) ** 4,
    "a power of whole numbers": lambda x: jnp.arange(-3, 3) ** 3,
    "outside": lambda x: x[0].at[jnp.array([1, 9])].get(mode="fill"),
    "written outside": lambda x: x.at[jnp.array([1, 9])].set(2.0),
    "less": lambda x: jax.lax.pad(x, 0.0, ((-1, 0, 0), (0, 0, 1), (0, 0, 0))),
    "of whole numbers": lambda x: jax.lax.div(jnp.arange(-3, 3), 2),
    "a function of an entry": lambda x: x.at[1].apply(jnp.sin),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_numpy_has_no_rule_for_is_left_to_jax(name):
    with precision("float64"):
        closed = jax.make_jaxpr(OTHERS[name])(jnp.asarray(X))
        [expected] = jaxpr_as_fun(closed)(jnp.asarray(X))
        for _ in range(2):  # the second time from memory
            [result] = walk(closed.jaxpr, closed.consts, [X], NUMBERS)
            assert result.tobytes() == np.asarray(expected).tobytes()
