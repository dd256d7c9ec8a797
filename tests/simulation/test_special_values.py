"""Native code at special numbers against JAX: equal to 64 units of rounding, or left to JAX.

Numbers are 0, denormal, tiny, huge, infinite, none, of both signs, in both precisions.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from lanes import run_with_exceptions

from echelon.core.numerics import precision
from echelon.simulation.scalars import Unsupported

BITS = (64, 32)


def kind_of(bits):
    return np.dtype(np.float64 if bits == 64 else np.float32)


def special(bits):
    """Return special numbers of a precision, with both signs."""
    info = np.finfo(kind_of(bits))
    tiny, most, eps = float(info.tiny), float(info.max), float(info.eps)
    sizes = [0.0, 1e-3, 0.1, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 5.0, 7.0, 10.0, 20.0, 88.0]
    sizes += [np.pi / 2, np.pi, 6.0, 30.0, 50.0, 100.0, 700.0, 709.5, 1e3, 1e4, 3e5, 1e6, 1e10]
    sizes += [tiny / 1024, tiny / 2, tiny, 1.5 * tiny, 4.0 * tiny, 1e6 * tiny, tiny**0.5]
    sizes += [most**0.5, 4.0 * most**0.5, most / 4, most / 2, most, np.inf]
    sizes += [eps, eps**2, 1.0 / eps, 1.0 + eps, 1.0 - eps / 2]
    return np.array([*sizes, *(-size for size in sizes), np.nan], kind_of(bits))


SMOOTH = {
    name: getattr(jnp, name)
    for name in (
        *("sin", "cos", "tan", "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "tanh"),
        *("sinh", "cosh", "arcsinh", "arccosh", "arctanh", "arctan", "arcsin", "arccos", "cbrt"),
        *("sqrt", "sinc", "square", "reciprocal", "degrees"),
    )
}
SMOOTH |= {
    "erf": lax.erf,
    "erfc": lax.erfc,
    "rsqrt": lax.rsqrt,
    "sigmoid": jax.nn.sigmoid,
    "softplus": jax.nn.softplus,
    "silu": jax.nn.silu,
    "a cube": lambda x: x**3,
    "an inverse square": lambda x: x**-2,
    "a broken power": lambda x: x**1.5,
    "a power of ten": lambda x: 10.0**x,
}
ROUGH = {
    name: getattr(jnp, name)
    for name in ("floor", "ceil", "round", "trunc", "sign", "abs", "negative", "nan_to_num")
}
ROUGH |= {
    "a root by a power": lambda x: x**0.5,
    "halves away from 0": lax.round,
    "finite": lambda x: jnp.isfinite(x) * 1.0,
    "no number": lambda x: jnp.isnan(x) * 1.0,
    "a sign's bit": lambda x: jnp.signbit(x) * 1.0,
    "relu": jax.nn.relu,
    "single precision": lambda x: (x.astype(jnp.float32) * jnp.float32(0.1)).astype(x.dtype),
}


def whole(x):
    return jnp.floor(x).astype(int)


def hashed(x):
    return (x.astype(jnp.uint32) * jnp.uint32(1664525) + jnp.uint32(1013904223)) * 1.0


WHOLE = {
    "converted": lambda x: x.astype(jnp.int32) * 1.0,
    "a product": lambda x: whole(x) * whole(x) * whole(x) * 1.0,
    "a product of 32 bits": lambda x: (x.astype(jnp.int32) * jnp.int32(100_000)) * 1.0,
    "a line of 8 bits": lambda x: (x.astype(jnp.int8) * jnp.int8(7) + jnp.int8(100)) * 1.0,
    "a square of 16 bits": lambda x: jnp.square(x.astype(jnp.int16)) * 1.0,
    "below 0 without a sign": lambda x: (x.astype(jnp.uint8) - jnp.uint8(5)) * 1.0,
    "a hash": hashed,
    "by 0": lambda x: (whole(x) // jnp.zeros((), int) + whole(x) % jnp.zeros((), int)) * 1.0,
    "quotient and rest": lambda x: (whole(x) // 7 - whole(x) % -7) * 1.0,
    "a sum": lambda x: jnp.sum(jnp.stack([x, x]).astype(jnp.int8), dtype=jnp.int8) * 1.0,
    "sums": lambda x: jnp.cumsum(jnp.stack([x, x]).astype(jnp.int8), dtype=jnp.int8)[1] * 1.0,
    "the opposite": lambda x: -x.astype(jnp.int8) * 1.0,
    "a narrow type": lambda x: whole(x).astype(jnp.int8) * 1.0,
    "a type without signs": lambda x: whole(x).astype(jnp.uint32) * 1.0,
    "a shift": lambda x: (whole(x) >> 3) * 1.0,
    "a power": lambda x: whole(x) ** 3 * 1.0,
    "a successor": lambda x: (whole(x) + 1) * 1.0,
}
TRUTHS = {
    "the largest truth": lambda x: jnp.max(jnp.stack([x, -x]) > 0) * 1.0,
    "the smallest truth": lambda x: jnp.min(jnp.stack([x, -x]) > 0) * 1.0,
    "an order of truths": lambda x: ((x > 0) < (x > 1)) * 1.0 + ((x > 0) <= (x < 1)) * 2.0,
    "sorted truths": lambda x: jnp.sort(jnp.stack([x > 0, x < 1, x > 2]))[1] * 1.0,
    "the largest so far": lambda x: lax.cummax(jnp.stack([x, -x, 0.5 * x]))[2],
    "an entry multiplied": lambda x: jnp.stack([x, x]).at[1].multiply(x)[1],
    "an entry and the larger": lambda x: jnp.stack([x, x]).at[jnp.array([0, 0])].max(-x)[0],
}
PAIRS = {
    name: getattr(jnp, name)
    for name in (
        *("add", "subtract", "multiply", "divide", "maximum", "minimum", "fmax", "fmin", "power"),
        *("arctan2", "fmod", "mod", "floor_divide", "copysign", "hypot", "logaddexp", "heaviside"),
    )
}
PAIRS |= {
    "less": lambda a, b: (a < b) + 2.0 * (a <= b) + 4.0 * (a == b) + 8.0 * (a != b),
    "the rest": lax.rem,
    "a choice": lambda a, b: jnp.where(a > 0, a, b),
    "a limit": lambda a, b: jnp.clip(a, -1.0, b),
}
# JAX itself is not of one mind about what the power, angle or root of a denormal number is.
NOT_DENORMAL = {"power", "a broken power", "a root by a power", "arctan2", "cbrt", "hypot"}


def by_jax(function, columns, bits):
    with precision(f"float{bits}"):
        rows = jax.jit(jax.vmap(lambda v: function(*v)))(jnp.asarray(columns.T))
        return np.asarray(rows, float)


def check(name, function, columns, bits):
    """Check a function of numbers in columns (count, N); return which columns are left to JAX."""
    info = np.finfo(columns.dtype)
    tiny, eps = float(info.tiny), float(info.eps)
    if name in NOT_DENORMAL:
        columns = columns[:, ~((np.abs(columns) < tiny) & (columns != 0)).any(axis=0)]
    ours, left = run_with_exceptions(lambda v: function(*v)[None], columns, bits).astype(float)
    theirs = by_jax(function, columns, bits)
    tolerance = 64 * (eps * np.abs(theirs) + tiny)
    if name in SMOOTH:
        # What the last digit of the argument changes.
        ends = (np.nextafter(columns, end) for end in columns.dtype.type([np.inf, -np.inf]))
        with np.errstate(all="ignore"):
            change = np.abs(np.subtract(*(by_jax(function, end, bits) for end in ends)))
        tolerance += np.where(np.isfinite(change), change, 0.0)
    with np.errstate(invalid="ignore"):
        same = (ours == theirs) | (np.abs(ours - theirs) <= tolerance)
    same |= np.isnan(ours) & np.isnan(theirs) | (left != 0.0)
    wrong = np.flatnonzero(~same)[:5]
    assert same.all(), [(columns[:, k], ours[k], theirs[k]) for k in wrong]
    return columns[:, left != 0.0]


SINGLE = SMOOTH | ROUGH | WHOLE | TRUTHS
OFTEN_LEFT = {"a hash", "a type without signs"}
"""They are larger than what single precision has exactly."""


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", SINGLE)
def test_functions_of_special_numbers_are_those_of_jax(name, bits):
    extra = [[127, 128, -128, -129, 255, 256, 4e4, 2e6, 2**24 + 2, 3e9, 2.0**53, 2.0**54, 1e19]]
    columns = np.concatenate([special(bits)[None], np.array(extra, kind_of(bits))], axis=1)
    left = check(name, SINGLE[name], columns, bits)
    assert name in OFTEN_LEFT or (np.abs(left) > 100.0).all()


@pytest.mark.parametrize("bits", BITS)
@pytest.mark.parametrize("name", PAIRS)
def test_functions_of_two_special_numbers_are_those_of_jax(name, bits):
    numbers = special(bits)
    columns = np.array(list(itertools.product(numbers, numbers))).T
    check(name, PAIRS[name], columns, bits)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda v: lax.reduce_precision(v, 8, 10), "`reduce_precision` in"),
        (lambda v: v.astype(jnp.float16) * 1.0, "`convert_element_type` of the type float16 in"),
        (lambda v: lax.nextafter(v, v[::-1]), "`nextafter` in"),
        (lambda v: jnp.frexp(v)[0], "`bitcast_convert_type` in"),
        (lambda v: (whole(v) << whole(v)) * 1.0, "`shift_left` in"),
        (lambda v: (whole(v) >> whole(v)) * 1.0, "`shift_right_arithmetic` by a number of places"),
    ],
)
def test_what_has_other_bits_by_jax_is_refused(function, words):
    with pytest.raises(Unsupported, match=rf"{words}.*test_special_values\.py, line"):
        run_with_exceptions(function, np.ones((2, 8)))


def test_a_function_sees_the_precision_of_its_run():
    def function(v):
        assert v.dtype == jnp.float32
        return v * jnp.finfo(v.dtype).eps + 1.0 / 3.0

    columns = special(32)[None]
    [ours, _] = run_with_exceptions(function, columns, 32)
    np.testing.assert_array_equal(ours, by_jax(lambda x: function(x), columns, 32))
