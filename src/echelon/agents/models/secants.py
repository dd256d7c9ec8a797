"""Slopes of a function from differences of its values, to check the derivatives of JAX.

JAX differentiates a trace, not a function: at a jump its slope is 0, and `stop_gradient` or a
derivative written by hand replace the true slope. Differences use the values that are simulated.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.core.numerics import precision
from echelon.core.types import Array

_Function: TypeAlias = Callable[[jax.Array], jax.Array]

_PARTS = 32
_LEVELS = 6
"""A segment is cut into 32 parts six times: to a billionth, far above rounding."""


class Jump(NamedTuple):
    """Two nearly equal points (n,) at which a function differs by `size` in entry `entry`."""

    before: Array
    after: Array
    entry: int
    size: float


def find_jump(
    function: _Function, starts: Float[Array, "K n"], ends: Float[Array, "K n"]
) -> Jump | None:
    """Return a jump of a function on one of several segments, or None where none is sampled.

    In each segment the part over which the function changes most is cut again. Over a part 1,000
    times shorter a function with slopes changes 1,000 times less, and a jump stays.

    Args:
        function: (n,) -> (k,), traceable by JAX.
        starts: first points of the segments.
        ends: last points of the segments.
    """
    low, high, changes = np.asarray(starts, float), np.asarray(ends, float), []
    size = np.zeros(())
    shares = np.linspace(0.0, 1.0, _PARTS + 1)[:, None]
    with precision("float64"):
        values = jax.jit(jax.vmap(jax.vmap(function)))
        for _ in range(_LEVELS):
            points = low[:, None] + shares * (high - low)[:, None]
            sampled = np.asarray(values(jnp.asarray(points)))
            steps = np.abs(np.diff(sampled, axis=1))
            most = np.argmax(steps.max(axis=2), axis=1)
            rows = np.arange(len(low))
            low, high = points[rows, most], points[rows, most + 1]
            changes.append(steps[rows, most])
            size = np.abs(sampled).max(axis=1)
    # A change that rounding of the values can cause is no jump.
    jumps = (changes[-1] > 0.5 * changes[-3]) & (changes[-1] > 1e-7 * (1e-3 + size))
    if not jumps.any():
        return None
    k, entry = np.unravel_index(np.argmax(np.where(jumps, changes[-1], 0.0)), jumps.shape)
    return Jump(low[k], high[k], int(entry), float(changes[-1][k, entry]))


class Gap(NamedTuple):
    """A derivative of an entry in a variable: the one that JAX computes, and the secant slope."""

    derivative: float
    slope: float
    entry: int
    variable: int


_STEPS = (1e-4, 1e-6)
_TOLERANCE = 1e-3


class Sides(NamedTuple):
    """Slopes (2, k, n) of a function at a point, over a wide step and a hundredth of it.

    A difference due to curvature shrinks with the step; one due to a kink, a jump or a wrong
    derivative does not.
    """

    forward: Array
    backward: Array

    def gap(self, derivative: Float[Array, "k n"]) -> Gap | None:
        """Return where a derivative (k, n) differs most clearly from the slopes, or None."""
        # At a kink any slope between those of the two sides is correct.
        low, high = np.minimum(*self), np.maximum(*self)
        away = derivative - np.clip(derivative, low, high)
        no_slope = self._stays(away, 1.0 + np.abs(derivative).max()) & ~self.jumps()
        stays = np.where(no_slope, np.abs(away[1]), 0.0)
        if not stays.any():
            return None
        entry, variable = np.unravel_index(np.argmax(stays), stays.shape)
        slope = 0.5 * (self.forward + self.backward)[1, entry, variable]
        return Gap(float(derivative[entry, variable]), float(slope), int(entry), int(variable))

    def bends(self) -> Array:
        """Return (k, n) whether the slopes of the two sides differ, or the values do."""
        scale = 1.0 + np.minimum(np.abs(self.forward[1]), np.abs(self.backward[1])).max()
        return self._stays(self.forward - self.backward, scale) | self.jumps()

    def jumps(self) -> Array:
        """Return (k, n) whether values differ between the sides at any distance."""
        wide, narrow = (np.maximum(np.abs(f), np.abs(b)) for f, b in zip(*self, strict=True))
        # A jump over a step a hundred times shorter is a slope a hundred times steeper.
        return narrow > 50.0 * (wide + 1e-3)

    @staticmethod
    def _stays(away: Array, scale: float) -> Array:
        wide, narrow = np.abs(away)
        return (narrow > _TOLERANCE * scale) & (narrow > 0.1 * wide)


def stencil(point: Float[Array, " n"]) -> Float[Array, "K n"]:
    """Return a point and the 4 n points around it from which `sides` computes slopes."""
    steps = [np.diag(_widths(point, step)) for step in _STEPS]
    moves = np.concatenate([m for step in steps for m in (step, -step)])
    return np.concatenate([point[None], point + moves])


def sides(point: Array, values: Array) -> Sides:
    """Return the slopes at a point (n,) from the values (1 + 4 n, k) of its `stencil`."""
    n, here = len(point), values[0]
    around = values[1:].reshape(len(_STEPS), 2, n, -1)
    widths = np.array([_widths(point, step) for step in _STEPS])[:, :, None]
    # Other checks report values that are not finite; here they compare as false.
    with np.errstate(invalid="ignore", over="ignore"):
        forward, backward = (around[:, 0] - here) / widths, (here - around[:, 1]) / widths
    return Sides(np.moveaxis(forward, 1, 2), np.moveaxis(backward, 1, 2))


def _widths(point: Float[Array, " n"], step: float) -> Float[Array, " n"]:
    # A power of two, so that x + h - x is h.
    return 2.0 ** np.round(np.log2(step * np.maximum(1.0, np.abs(point))))


def find_gap(function: _Function, points: Float[Array, "K n"]) -> Gap | None:
    """Return where the derivative of a function by JAX is not its slope, or None.

    Args:
        function: (n,) -> (k,), traceable by JAX.
        points: where the two are compared.
    """
    with precision("float64"):
        around = jnp.asarray(np.stack([stencil(point) for point in points]))
        values = np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(around))
        slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(function)))(jnp.asarray(points)))
    gaps = (sides(p, v).gap(s) for p, v, s in zip(points, values, slopes, strict=True))
    return next((gap for gap in gaps if gap is not None), None)
