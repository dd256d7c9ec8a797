"""Precision, integrators and time derivatives.

None of them depends on an agent model.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Literal, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jax.core import Tracer

from echelon.core.jax_state import require_jax

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
    """Return a context in which JAX computes in `name`, whatever the user's own flags are.

    Raises:
        EchelonError: JAX cannot run in this process.
    """
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
