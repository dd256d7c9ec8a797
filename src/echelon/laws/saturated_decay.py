"""The closed form of the decay of a stopping point whose speed is bounded."""

import math

import jax
import jax.numpy as jnp

from echelon.core.types import Scalar

_LINEAR = 1e-8
"""Of c |x| / s; below it sigma is linear to rounding."""
_LN2 = math.log(2.0)


def saturated_decay(
    start: jax.Array, coupling: Scalar | float, inverse: jax.Array, age: Scalar
) -> jax.Array:
    """Return x after a time (s) of x' = -sigma(c x), sigma(x) = x / sqrt(1 + (x/s)^2), entrywise.

    With v = c |x| / s the function F(v) = sqrt(1 + v^2) - arsinh(1/v) falls by c per second.

    Args:
        start: x at the beginning.
        coupling: c, 1/s.
        inverse: 1/s of each entry, 0 where sigma is linear.
        age: the time, s.
    """
    v = coupling * jnp.abs(start) * inverse
    linear = v < _LINEAR
    v = jnp.where(linear, 1.0, v)
    target = _fallen(v) - coupling * age
    # F is above ln v and above v - 1 or so; from there Newton's method in ln v has all digits soon.
    guess = jnp.where(target >= 1.0, jnp.log(jnp.maximum(target, 1.0)), target - 1.0 + _LN2)
    for _ in range(4):
        now = jnp.exp(guess)
        guess = guess - (_fallen(now) - target) / jnp.sqrt(1.0 + now**2)
    return start * jnp.where(linear, jnp.exp(-coupling * age), jnp.exp(guess) / v)


def _fallen(v: jax.Array) -> jax.Array:
    return jnp.sqrt(1.0 + v**2) - jnp.arcsinh(1.0 / v)
