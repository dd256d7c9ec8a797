"""Enclosures of functions of time: they hold the values and derivatives, and refuse branches."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echelon_ranges import RangeError, enclose_derivatives, enclose_finely
from echelon_ranges.jaxpr import float64


def hard(t):
    """All functions that a function may be made of, where each is defined."""
    u, v = 0.3 * jnp.sin(t) + 0.5, jnp.sqrt(1.5 + jnp.cos(2.0 * t))
    return jnp.stack(
        [
            jnp.exp(u) * v**3 + jnp.log(v) / jnp.cosh(u) + jnp.sinh(u) * jnp.expm1(v),
            jnp.arctan(u * v) + jnp.arcsin(u) - jnp.arccos(u) * jnp.tanh(v),
            jnp.tan(u) ** 2 + u**1.5 + jax.nn.sigmoid(t) - jnp.log1p(v) + 1.0 / v**2,
        ]
    )


def lemniscate(t):
    return jnp.stack([jnp.cos(t), jnp.sin(t) * jnp.cos(t)]) / (1.0 + jnp.sin(t) ** 2)


@pytest.mark.parametrize("path", [lemniscate, hard])
def test_a_function_and_its_derivatives_lie_in_their_enclosure(path):
    times = [Fraction(k, 100) for k in range(4)]
    with float64():
        rows = [path]
        for _ in range(4):
            rows.append(jax.jacfwd(rows[-1]))
        every = jax.jit(jax.vmap(lambda t: jnp.stack([row(t) for row in rows])))
        for piece, low, high in zip(enclose_derivatives(path, times, 4), times, times[1:]):
            seen = np.asarray(every(jnp.linspace(float(low), float(high), 30)))
            lows = np.array([[float(x.lo) for x in row] for row in piece])
            highs = np.array([[float(x.hi) for x in row] for row in piece])
            size = 1.0 + np.abs(seen).max(axis=0)
            assert (seen >= lows - 1e-11 * size).all() and (seen <= highs + 1e-11 * size).all()
            # Near, too: farther off by less than half of the values themselves.
            assert (highs - lows <= np.ptp(seen, axis=0) + 0.5 * size).all()


def test_a_branch_is_left_between_two_intervals_by_neither():
    # At 1 s both intervals touch the edge, which belongs to one side alone.
    for bent in (lambda t: jnp.abs(t - 1.0), lambda t: jnp.maximum(t, 1.0), jnp.floor):
        with pytest.raises(RangeError, match="passes from one branch of it to another"):
            list(enclose_derivatives(lambda t: bent(t)[None], [Fraction(k) for k in range(3)], 1))


def test_time_is_halved_until_each_piece_has_an_enclosure():
    def root(t):
        return jnp.sqrt(t * t - 2.0 * t + 1.1)[None]

    span = [Fraction(0), Fraction(2)]
    with pytest.raises(RangeError, match="sqrt"):
        list(enclose_derivatives(root, span, 1))
    ends = [Fraction(0), *(piece.end for piece in enclose_finely(root, span, 1))]
    assert ends == sorted(ends) and len(ends) > 3 and ends[-1] == 2
    for piece, low in zip(enclose_finely(root, span, 1), ends, strict=False):
        [[value], [slope]] = piece.rows
        for t in (float(low), float(piece.end)):
            exact = (t * t - 2.0 * t + 1.1) ** 0.5
            assert value.lo - Fraction(1, 10**12) <= exact <= value.hi + Fraction(1, 10**12)
            assert float(slope.lo) - 1e-12 <= (t - 1.0) / exact <= float(slope.hi) + 1e-12
    # A kink is inside of no piece.
    with pytest.raises(RangeError, match=r"passes from one branch.* between 0.333"):
        list(enclose_finely(lambda t: jnp.abs(3.0 * t - 1.0)[None], span, 1))
