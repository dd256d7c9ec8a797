"""Random draws that depend only on a seed, a kind, and the numbers of a time and of agents.

No draw depends on earlier ones, nor on the engine, the batch, the chunk or the precision.
"""

import enum
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt32


class Draw(enum.IntEnum):
    """What is drawn: folded into the key, so that one seed draws each kind independently."""

    WIND = 0
    NOISE = 1
    LOSS = 2
    JITTER = 3
    OUTAGE = 4
    SENSING = 5
    GUST = 6


def key_of(seed: int) -> UInt32[np.ndarray, "2"]:
    """Return the key of a seed."""
    # The two halves of the seed: 32-bit integers would cut it to its lower one.
    return np.array([seed >> 32 & 0xFFFFFFFF, seed & 0xFFFFFFFF], np.uint32)


def _fold(key: np.ndarray, kind: Draw | jax.Array, numbers: tuple[jax.Array, ...]) -> jax.Array:
    # By name, since the default generator of JAX is a setting of the user.
    folded = jax.random.wrap_key_data(jnp.asarray(key), impl="threefry2x32")
    for number in (kind, *numbers):
        folded = jax.random.fold_in(folded, number)
    return folded


def normals(key: np.ndarray, kind: Draw, *numbers: jax.Array, size: int) -> Float[jax.Array, " k"]:
    """Return draws (size,) from the standard normal distribution."""
    # Drawn in float32, so that draws do not depend on the precision.
    return jax.random.normal(_fold(key, kind, numbers), (size,), jnp.float32).astype(float)


def uniforms(key: np.ndarray, kinds: Sequence[Draw], *numbers: jax.Array) -> Float[jax.Array, " k"]:
    """Return a draw from [0, 1) of each kind."""

    # The code of a draw is long to compile: there is one for all kinds.
    def one(kind: jax.Array) -> jax.Array:
        return jax.random.uniform(_fold(key, kind, numbers), (), jnp.float32).astype(float)

    return jax.vmap(one)(jnp.array([int(kind) for kind in kinds]))
