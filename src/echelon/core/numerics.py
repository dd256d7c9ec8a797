"""JAX as echelon uses it: whether it can run, precision, integrators, derivatives, random draws.

None of them depends on an agent model. A draw depends only on a seed, a kind, and the numbers of a
time and of agents: not on earlier draws, nor on the engine, the batch, the chunk or the precision.
"""

import contextlib
import enum
import functools
import os
from collections.abc import Callable, Iterator
from typing import Literal, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import xla_bridge
from jax.core import Tracer
from jaxtyping import Float, UInt32

from echelon.core.errors import EchelonError

_ASKS = ("jax_platforms", "jax_platform_name", "jax_default_device")
"""Settings of JAX that choose a device; their environment variables are the same in capitals."""
_forked = False
"""Whether this process is a fork of one in which JAX had started."""


def require_jax() -> None:
    """Raise `EchelonError` if JAX would fail or hang later without saying why."""
    if _forked:
        raise EchelonError(
            "JAX had started before this process was forked, and would hang in it; start processes"
            " with `multiprocessing.get_context('spawn')`, or use `echelon sweep`."
        )
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        raise EchelonError(
            "JAX's `jax_disable_jit` (`JAX_DISABLE_JIT`) is on, which echelon does not support;"
            " turn it off, and debug a model by calling its functions alone."
        )
    _require_device()


@functools.cache
def _require_device() -> None:
    try:
        # An array, since JAX looks for its default device only when it makes one.
        jax.device_put(np.float32(0.0))
    # JAX raises errors of many types, an AssertionError without text among them.
    except Exception as error:
        for name in _ASKS:
            asked = jax.config.values.get(name)
            if asked:
                own = name.upper() if name.upper() in os.environ else name
                raise EchelonError(
                    f"`{own}` asks JAX for `{asked}`, which this machine lacks; unset it, and JAX"
                    " uses a device that exists, such as `cpu`."
                ) from error
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise EchelonError(f"JAX finds no device on this machine ({cause}).") from error


def _note_fork() -> None:
    global _forked
    _forked = _forked or bool(xla_bridge._backends)


# Windows cannot fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


_R = TypeVar("_R")
Precision: TypeAlias = Literal["float64", "float32"]
Field: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]
"""A right-hand side (x, u) -> xdot."""


_USUAL = (
    ("jax_debug_nans", False),
    ("jax_debug_infs", False),
    ("jax_numpy_dtype_promotion", "standard"),
)
"""Settings of JAX and the values with which echelon computes."""


def precision(name: Precision) -> contextlib.AbstractContextManager[object]:
    """Return a context in which JAX, if it can run, computes in `name`, whatever flags are set."""
    require_jax()
    if any(getattr(jax.config, setting) != usual for setting, usual in _USUAL):
        return _usual(name)
    # A context and no `jax.config.update`: importing or calling echelon changes no global setting.
    return jax.enable_x64(name == "float64")


@contextlib.contextmanager
def _usual(name: Precision) -> Iterator[None]:
    """Compute without what would end a run that diverges, or refuse sums of two integer types."""
    promotion = jax.numpy_dtype_promotion("standard")
    with jax.enable_x64(name == "float64"), jax.debug_nans(False), jax.debug_infs(False), promotion:
        yield


def inlined(function: Callable[..., _R]) -> Callable[..., _R]:
    """Return a function that JAX traces once for all its calls inside other traces."""
    # Under a name of its own, as JAX would hand out the first trace of one function again.
    return jax.jit(lambda *arguments: function(*arguments), inline=True)


def lesser(a: float, b: jax.Array | float) -> jax.Array | float:
    """Return the smaller of two numbers, of which the second may be traced."""
    # JAX would compile a program for two plain numbers.
    return jnp.minimum(a, b) if isinstance(b, jax.Array) else min(a, b)


def greater(a: jax.Array | float, b: float) -> jax.Array | float:
    """Return the larger of two numbers, of which the first may be traced."""
    return jnp.maximum(a, b) if isinstance(a, jax.Array) else max(a, b)


def rk4(field: Field, x: jax.Array, u: jax.Array, dt: float | jax.Array) -> jax.Array:
    """Advance one step by the classical Runge-Kutta method with the input held; error O(dt^4)."""
    if isinstance(x, Tracer):
        # Traced once for its four calls.
        field = inlined(field)
    # With u held the field is smooth within the step, which order 4 needs.
    k1 = field(x, u)
    k2 = field(x + 0.5 * dt * k1, u)
    k3 = field(x + 0.5 * dt * k2, u)
    k4 = field(x + dt * k3, u)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def euler(field: Field, x: jax.Array, u: jax.Array, dt: float) -> jax.Array:
    """Advance one step by x + dt (f + g u); error O(dt)."""
    return x + dt * field(x, u)


def printed_update(field: Field, x: jax.Array, u: jax.Array, dt: float) -> jax.Array:
    """Apply Algorithm 1 as the paper prints it, x <- f + g u (literal: there is no dt)."""
    return field(x, u)


INTEGRATORS: dict[str, Callable[[Field, jax.Array, jax.Array, float], jax.Array]] = {
    "rk4": rk4,
    "euler": euler,
    "printed": printed_update,
}


def derivatives(path: Callable[[jax.Array], jax.Array], t: jax.Array, order: int) -> jax.Array:
    """Return path(t) and its first `order` time derivatives, stacked along a new first axis."""

    def up_to(k: int) -> Callable[[jax.Array], tuple[jax.Array, ...]]:
        if k == 0:
            return lambda s: (path(s),)
        lower = up_to(k - 1)

        def append_rate(s: jax.Array) -> tuple[jax.Array, ...]:
            # One jvp of all lower orders gives them and the next; one for each order would repeat
            # them.
            values, rates = jax.jvp(lower, (s,), (jnp.ones_like(s),))
            return (*values, rates[-1])

        return append_rate

    return jnp.stack(up_to(order)(t))


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


_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)


def _hashed(
    key: tuple[jax.Array, jax.Array], high: jax.Array, low: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the hash of 64 bits, as two halves, by Threefry of 20 rounds."""
    # The bits of `jax.random`, whose rolled loop takes ten times as long to compile and to run.
    words = *key, key[0] ^ key[1] ^ np.uint32(0x1BD11BDA)
    high, low = high + words[0], low + words[1]
    for number in range(5):
        for turn in _ROTATIONS[number % 2]:
            high = high + low
            low = high ^ (low << np.uint32(turn) | low >> np.uint32(32 - turn))
        high = high + words[(number + 1) % 3]
        low = low + words[(number + 2) % 3] + np.uint32(number + 1)
    return high, low


def _bits(
    key: np.ndarray, kind: Draw | jax.Array, numbers: tuple[jax.Array, ...], places: jax.Array
) -> jax.Array:
    """Return 32 random bits of each place of a draw."""
    halves = jnp.asarray(key, jnp.uint32)
    folded = halves[0], halves[1]
    for number in (kind, *numbers, places):
        low = jnp.asarray(number).astype(jnp.uint32)
        folded = _hashed(folded, jnp.zeros_like(low), low)
    return folded[0] ^ folded[1]


def _unit(bits: jax.Array) -> Float[jax.Array, " *k"]:
    """Return numbers in [0, 1), in float32, so that draws do not depend on the precision."""
    fraction = bits >> np.uint32(9) | np.uint32(0x3F800000)
    return jax.lax.bitcast_convert_type(fraction, jnp.float32) - np.float32(1.0)


_LEAST = np.nextafter(np.float32(-1.0), np.float32(0.0), dtype=np.float32)


def normals(key: np.ndarray, kind: Draw, *numbers: jax.Array, size: int) -> Float[jax.Array, " k"]:
    """Return draws (size,) from the standard normal distribution."""
    unit = _unit(_bits(key, kind, numbers, jnp.arange(size)))
    both = jnp.maximum(_LEAST, unit * (np.float32(1.0) - _LEAST) + _LEAST)
    return (np.float32(np.sqrt(2)) * jax.lax.erf_inv(both)).astype(float)


def uniform(key: np.ndarray, kind: Draw, *numbers: jax.Array) -> Float[jax.Array, ""]:
    """Return a draw from [0, 1)."""
    return _unit(_bits(key, kind, numbers, jnp.zeros((), jnp.uint32))).astype(float)
