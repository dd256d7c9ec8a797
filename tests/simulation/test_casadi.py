"""CasADi expressions of models against the numbers of JAX."""

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_family import FLAT_MODELS, MODELS

import echelon as ech
from echelon.core.errors import MissingExtraError, ModelError
from echelon.core.numerics import precision
from echelon.simulation.optimal.casadi import casadi_function


def both(function, lengths):
    """The value and Jacobian of a function of vectors: by CasADi, and by JAX."""
    made = casadi_function("f", function, *lengths)
    symbols = [casadi.SX.sym(f"a{k}", n) for k, n in enumerate(lengths)]
    value = made(*symbols)
    slopes = [casadi.jacobian(value, s) for s in symbols]
    theirs = casadi.Function("g", symbols, [value, *slopes])

    def flat(*arguments):
        return jnp.ravel(function(*arguments))

    ours = jax.jit(lambda *a: (flat(*a), *jax.jacfwd(flat, tuple(range(len(a))))(*a)))

    def of(*arguments):
        with precision("float64"):
            wanted = [np.asarray(w) for w in ours(*map(jnp.asarray, arguments))]
        got = theirs(*arguments)
        return [np.array(g).reshape(w.shape) for g, w in zip(got, wanted, strict=True)], wanted

    return of


def assert_equal(pair):
    for got, wanted in zip(*pair, strict=True):
        size = max(1.0, float(np.abs(wanted).max(initial=0.0)))
        assert got == pytest.approx(wanted, rel=1e-12, abs=1e-12 * size)


def assert_equal_at_many(draw, *compared):
    """Compare functions at arguments that `draw` makes of random numbers, one tuple for each."""

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=20)
    def check(seed):
        for compare, arguments in zip(compared, draw(np.random.default_rng(seed)), strict=True):
            assert_equal(compare(*arguments))

    check()


def state(model, rng):
    """A random state inside the model's chart, away from its edge by a tenth."""
    x = rng.uniform(-2.0, 2.0, len(model.state_names))
    for name, (low, high) in model.chart.items():
        x[model.state_names.index(name)] = rng.uniform(0.9 * low, 0.9 * high)
    return x


def control(model, rng):
    size = np.array(model.trim[1]) + np.diag(model.input_scale)
    return size * rng.uniform(-2.0, 2.0, len(size))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_the_motion_of_every_model_is_jax_s_with_its_slopes(model):
    n, m = len(model.state_names), len(model.input_names)
    compared = [both(model.velocity, (n, m)), both(model.output, (n,)), both(model.limit, (m,))]
    compared += [both(model.difference, (n, n)), both(model.input_map, (n,))]

    def draw(rng):
        x, y, u = state(model, rng), 5.0 * state(model, rng), control(model, rng)
        return (x, u), (x,), (u,), (x, y), (x,)

    assert_equal_at_many(draw, *compared)


@pytest.mark.parametrize("model", FLAT_MODELS.values(), ids=FLAT_MODELS)
def test_the_flat_state_and_input_are_jax_s_with_their_slopes(model):
    rows, columns = model.flat_order + 1, len(model.flat_outputs)

    def flown(path):
        return jnp.concatenate(model.flat(path.reshape(rows, columns)))

    def draw(rng):
        # Accelerations below gravity and speeds above zero, where flatness has its meaning.
        path = rng.uniform(-2.0, 2.0, (rows, columns))
        path[1] = 1.0 + rng.uniform(0.0, 1.0, columns)
        return [(path.ravel(),)]

    assert_equal_at_many(draw, both(flown, (rows * columns,)))


FUNCTIONS = {
    "powers": lambda x: x**3 + x**-2 + jnp.abs(x) ** 1.7 + 1.3**x + jnp.abs(x) ** x,
    "roots": lambda x: jnp.sqrt(jnp.abs(x)) + jnp.cbrt(x) + jax.lax.rsqrt(x * x),
    "angles": lambda x: jnp.tan(x) + jnp.arctan2(x, x[::-1] + 0.1) + jnp.arcsin(x / 9.0),
    "more angles": lambda x: jnp.arccos(x / 9.0) + jnp.arctan(x) + jnp.hypot(x, 2.0),
    "hyperbolic": lambda x: jnp.sinh(x) + jnp.cosh(x) * jnp.tanh(x) + jnp.arcsinh(x),
    "more hyperbolic": lambda x: jnp.arccosh(1.5 + x * x) + jnp.arctanh(x / 9.0),
    "exponentials": lambda x: jnp.exp(x) + jnp.expm1(x) + jnp.exp2(x) + jax.nn.sigmoid(x),
    "logarithms": lambda x: jnp.log(x * x) + jnp.log1p(x * x) + jax.scipy.special.erf(x),
    "signs": lambda x: jnp.sign(x) * x + jnp.abs(x),
    "rounding": lambda x: jnp.round(x) * x + jnp.floor(x) + jnp.ceil(x) * x,
    "remainders": lambda x: jnp.mod(x, 0.7) + jnp.fmod(x, 0.7) + jnp.mod(7.0, x) + x % 2.0,
    "choices": lambda x: jnp.where((x > 0.0) & (x < 1.0) | ~(x > -1.0), x, 2.0 * x),
    "equalities": lambda x: jnp.where((x == x) & (x != 0.0), x, 0.0),
    "many choices": lambda x: jax.lax.select_n((x > 0.0), x, jnp.sin(x)),
    "extremes": lambda x: jnp.max(x) - jnp.min(x) + jnp.clip(x, -0.5, 0.5) + jnp.maximum(x, 0.2),
    "truth": lambda x: jnp.where(jnp.all(x > -9.0) & ~jnp.any(x > 9.0), x, 0.0),
    "counts": lambda x: jnp.sum(x > 0.0) * x + (x > 0.5).astype(int) + jnp.trunc(x) * x,
    "sums": lambda x: jnp.sum(x) + jnp.prod(x) + jnp.cumsum(x) + jnp.mean(x),
    "matrices": lambda x: jnp.outer(x, x) @ x + jnp.einsum("ij,jk->ki", jnp.outer(x, x), A)[0],
    "batches": lambda x: jnp.einsum("bi,bij->bj", jnp.stack([x, 2.0 * x]), jnp.stack([A, A.T]))[0],
    "places": lambda x: x[jnp.array([2, 0, 1])].at[1].set(x[0]).at[0].add(x[1]) + jnp.roll(x, 1),
    "shapes": lambda x: jnp.tile(x.reshape(3, 1).T, (2, 1)).ravel()[1:6:2] + jnp.flip(x),
    "padding": lambda x: jnp.pad(x, (1, 2))[jnp.array([1, 0, 5])] + jnp.split(x, 3)[1],
    "slices": lambda x: jax.lax.dynamic_slice(x, (1,), (2,)).sum() + jnp.diag(x)[0],
    "calls": lambda x: jax.jit(jnp.sin)(x) + jax.checkpoint(jnp.cos)(x) + jax.nn.softplus(x),
    "norms": lambda x: x / jnp.linalg.norm(x) + jnp.cross(x, jnp.array([1.0, 2.0, 3.0])),
    "a slope": lambda x: jax.jvp(lambda y: jnp.sin(y) * y, (x,), (jnp.cos(x),))[1],
    "gradients": lambda x: jax.grad(lambda y: jnp.sum(jnp.sin(y) ** 2))(x) + jax.lax.square(x),
    "no entries": lambda x: jnp.sum(x[3:]) + jnp.prod(x[3:]) * x + jnp.all(x[:0] > 0.0),
    "constants": lambda x: x + jnp.linalg.inv(A) @ jnp.arange(3.0),
    "nothing": lambda x: jnp.array([1.0, 2.0]),
}
A = np.arange(9.0).reshape(3, 3) + 4.0 * np.eye(3)


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_what_a_model_may_use_is_jax_s_with_its_slopes(function):
    assert_equal_at_many(lambda rng: [(rng.uniform(-1.5, 1.5, 3),)], both(function, (3,)))


def test_halves_are_rounded_as_jax_rounds_them():
    halves = np.array([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 0.49999999999999994, -0.49999999999999994])
    for method in jax.lax.RoundingMethod:
        made = casadi_function("f", lambda x, method=method: jax.lax.round(x, method), len(halves))
        with precision("float64"):
            wanted = np.asarray(jax.lax.round(jnp.asarray(halves), method))
        assert np.array(made(halves)).ravel().tolist() == wanted.tolist()


class Looping(ech.ControlAffine):
    """A model whose drift searches for its answer, as no expression can."""

    state_names = ("angle",)
    input_names = ("push",)

    def drift(self, x):
        return jax.lax.while_loop(lambda y: jnp.all(y > 1.0), lambda y: 0.5 * y, x)

    def input_map(self, x):
        return jnp.ones((1, 1), x.dtype)


def test_a_primitive_without_an_expression_is_named_with_the_model():
    with pytest.raises(ModelError) as caught:
        casadi_function("velocity", Looping().velocity, 1, 1, owner="Looping")
    assert str(caught.value) == (
        "`Looping` uses `while`, which has no expression for the solvers; allowed are arithmetic, "
        "powers, trigonometric and hyperbolic functions, exponentials, logarithms, rounding, "
        "comparisons and choices by `where`."
    )


def test_a_missing_extra_is_told_with_its_remedy(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "casadi", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[optimal\]'"):
        casadi_function("f", jnp.sin, 1)
