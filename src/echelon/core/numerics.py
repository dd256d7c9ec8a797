"""Numerical building blocks that know nothing of agents.

Precision, integrators and linear systems theory.
"""

import contextlib
from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from echelon.core.errors import GainError

Precision: TypeAlias = Literal["float64", "float32"]
Field: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]
"""A right-hand side (x, u) -> xdot."""


def precision(name: Precision) -> contextlib.AbstractContextManager[object]:
    """Return a context in which JAX computes in `name`, whatever the user's own flags are."""
    return jax.enable_x64(name == "float64")


def rk4(field: Field, x: jax.Array, u: jax.Array, dt: float | jax.Array) -> jax.Array:
    """Advance one step by the classical Runge-Kutta method with the input held; error O(dt^4)."""
    k1 = field(x, u)
    k2 = field(x + 0.5 * dt * k1, u)
    k3 = field(x + 0.5 * dt * k2, u)
    k4 = field(x + dt * k3, u)
    return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def euler(field: Field, x: jax.Array, u: jax.Array, dt: float) -> jax.Array:
    """Advance one step by x + dt (f + g u); error O(dt)."""
    return x + dt * field(x, u)


def printed(field: Field, x: jax.Array, u: jax.Array, dt: float) -> jax.Array:
    """Apply Algorithm 1 as the paper prints it, x <- f + g u (literal: there is no dt)."""
    return field(x, u)


INTEGRATORS: dict[str, Callable[[Field, jax.Array, jax.Array, float], jax.Array]] = {
    "rk4": rk4,
    "euler": euler,
    "printed": printed,
}


def derivatives(path: Callable[[jax.Array], jax.Array], t: jax.Array, order: int) -> jax.Array:
    """Return path(t) and its first `order` time derivatives, stacked along a new first axis."""

    def up_to(k: int) -> Callable[[jax.Array], tuple[jax.Array, ...]]:
        if k == 0:
            return lambda s: (path(s),)
        lower = up_to(k - 1)

        def raised(s: jax.Array) -> tuple[jax.Array, ...]:
            values, rates = jax.jvp(lower, (s,), (jnp.ones_like(s),))
            return (*values, rates[-1])

        return raised

    return jnp.stack(up_to(order)(t))


def held_radius(A: np.ndarray, B: np.ndarray, K: np.ndarray, dt: float) -> float:
    """Return the spectral radius of a step of xdot = A x - B K x(t_k), the input held over dt."""
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A, B
    flow = scipy.linalg.expm(block * dt)
    return float(np.abs(np.linalg.eigvals(flow[:n, :n] - flow[:n, n:] @ K)).max())


def longest_step(A: np.ndarray, B: np.ndarray, gains: Sequence[np.ndarray]) -> float:
    """Return the longest dt (s) with which every loop xdot = A x - B K x(t_k) still decays.

    The step is lengthened by tenths from a thousandth of the fastest mode's time until a loop
    grows, and that last tenth is bisected; infinite where none grows up to a thousand times the
    slowest mode's.
    """
    poles = np.concatenate([np.linalg.eigvals(A - B @ K) for K in gains])
    dt, end = 1e-3 / np.abs(poles).max(), 1e3 / max(1e-9, float(np.abs(poles.real).min()))

    def decays(dt: float) -> bool:
        return all(held_radius(A, B, K, dt) < 1.0 for K in gains)

    while decays(1.1 * dt):
        dt *= 1.1
        if dt > end:
            return float("inf")
    low, high = dt, 1.1 * dt
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if decays(middle) else (low, middle)
    return float(low)


def in_words(eigenvalue: complex) -> str:
    """Return an eigenvalue as text, without an imaginary part that is zero."""
    real = f"{eigenvalue.real + 0.0:.3g}"
    return real if eigenvalue.imag == 0.0 else f"{real} +- {abs(eigenvalue.imag):.3g}i"


def symmetric_part(matrix: np.ndarray) -> np.ndarray:
    """Return (M + M^T) / 2."""
    return 0.5 * (matrix + matrix.T)


def uncontrollable_modes(A: np.ndarray, B: np.ndarray) -> list[tuple[complex, np.ndarray]]:
    """Return the eigenvalues of A that input B cannot move, each with its left eigenvector.

    This is the PBH test: a mode counts as uncontrollable when the smallest singular value of
    [s I - A, B] is below 1e-9 times the norm of the pair.
    """
    scale = max(1.0, float(np.linalg.norm(A, 2)), float(np.linalg.norm(B, 2)))
    found = []
    for s in np.linalg.eigvals(A):
        pencil = np.hstack([s * np.eye(len(A)) - A, B])
        left, singular, _ = np.linalg.svd(pencil)
        if singular[-1] <= 1e-9 * scale:
            found.append((complex(s), left[:, -1].conj()))
    return found


def observability_rank(A: np.ndarray, C: np.ndarray) -> int:
    """Return the rank of the observability matrix [C; C A; ...], each block scaled to unit norm."""
    block, rows = C, [C]
    for _ in range(len(A) - 1):
        block = block @ A
        size = np.linalg.norm(block)
        if size == 0.0:
            break
        block = block / size
        rows.append(block)
    return int(np.linalg.matrix_rank(np.vstack(rows)))


def riccati(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the stabilizing solution P of A'P + P A - P B R^-1 B'P + Q = 0.

    Raises:
        GainError: the equation has no stabilizing solution.
    """
    if not len(A):
        return np.zeros((0, 0))
    try:
        P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise GainError(
            f"the Riccati equation has no stabilizing solution ({str(error).rstrip('.').lower()}); "
            "check that every undamped mode is weighted by `Q`."
        ) from error
    return symmetric_part(P)
