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
            # Of the whole segment at first, since it is the largest of all.
            size = np.maximum(size, np.abs(sampled).max(axis=1))
    # A change that rounding of the values can cause is no jump.
    jumps = (changes[-1] > 0.5 * changes[-3]) & (changes[-1] > 1e-10 * size)
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


_STEPS = 2.0 ** np.array([-13, -20, -33, -40])
"""Two pairs of a wide and a narrow step, in units of each state: 1e-4 and 1e-6, 1e-10 and 1e-12."""
_NEARBY = np.array([1.0, 1.37, 1.74])
"""Times a narrow step: equally far apart, so that what is not linear in them is rounding."""
_TOLERANCE = 1e-3  # relative, of a derivative
_BENT = 1e-9  # relative, of the slopes of two sides
_NOISE = 50.0  # times the rounding that is seen
_OBLIQUE = 8  # directions beside the axes, along which what bends at none of them shows


class Sides(NamedTuple):
    """Slopes (4, k, q) of a function at a point in q directions, over each of `_STEPS`.

    A difference due to curvature shrinks with the step; one due to a kink, a jump or a wrong
    derivative does not. All are compared with each other or with rounding, never with a
    number of their own units. Rounding (2, k) is that over each narrow step.
    """

    forward: Array
    backward: Array
    rounding: Array

    def combine(self, weights: Float[Array, "r k"]) -> "Sides":
        """Return the slopes of sums of the function's entries."""
        with np.errstate(invalid="ignore"):
            forward, backward = weights @ self.forward, weights @ self.backward
        return Sides(forward, backward, self.rounding @ np.abs(weights).T)

    def gap(self, derivative: Float[Array, "k n"], units: Float[Array, " n"]) -> Gap | None:
        """Return where a derivative (k, n) differs most clearly from the slopes, or None."""
        # At a kink any slope between those of the two sides is correct.
        n, scaled = derivative.shape[1], derivative * units
        axes = Sides(self.forward[..., :n], self.backward[..., :n], self.rounding)
        low, high = np.minimum(*axes[:2]), np.maximum(*axes[:2])
        away = scaled - np.clip(scaled, low, high)
        size = np.maximum(np.abs(scaled), np.maximum(np.abs(low), np.abs(high)))
        no_slope = axes._stays(away, _TOLERANCE * size) & ~axes.jumps()
        stays = np.where(no_slope, np.abs(away[1]) / units, 0.0)
        if not stays.any():
            return None
        entry, variable = np.unravel_index(np.argmax(stays), stays.shape)
        slope = (0.5 * (axes.forward + axes.backward)[1] / units)[entry, variable]
        return Gap(float(derivative[entry, variable]), float(slope), int(entry), int(variable))

    def kinks(self, n: int) -> Array:
        """Return (k, n) whether slopes of the two sides differ, or values, or they do not add up.

        What only bends between the axes is charged to the variable that moves first.
        """
        scale = _BENT * np.maximum(np.abs(self.forward), np.abs(self.backward))
        kinks = self._stays(self.forward - self.backward, scale) | self.jumps()
        axes, oblique = self.forward[..., :n], self.forward[..., n:]
        sums = axes @ _oblique(n).T
        size = _BENT * (np.abs(axes) @ np.abs(_oblique(n)).T)
        with np.errstate(invalid="ignore"):
            crooked = self._stays(oblique - sums, size)
        first = np.eye(n, dtype=bool)[0]
        beside = np.any(kinks[:, n:] | crooked, axis=1)
        return kinks[:, :n] | np.outer(beside, first)

    def jumps(self) -> Array:
        """Return (k, q) whether values differ between the sides at any distance."""
        sizes = np.maximum(np.abs(self.forward), np.abs(self.backward))
        # A jump over a step a hundred times shorter is a slope a hundred times steeper.
        with np.errstate(over="ignore"):
            steeper = sizes[1::2] > 50.0 * sizes[::2]
        return np.any(steeper & self._seen(sizes[1::2]), axis=0)

    def _stays(self, away: Array, least: Array) -> Array:
        wide, narrow = np.abs(away[::2]), np.abs(away[1::2])
        stays = (narrow > least[1::2]) & (narrow > 0.1 * wide) & self._seen(narrow)
        return np.any(stays, axis=0)

    def _seen(self, slopes: Array) -> Array:
        return slopes > _NOISE * self.rounding[..., None] / _STEPS[1::2, None, None]


def _oblique(n: int) -> Float[Array, "q n"]:
    """Return directions between the axes; no products of steps round."""
    return np.random.default_rng(0).choice([-1.0, -0.5, 0.5, 1.0], (_OBLIQUE, n))


def units_at(point: Float[Array, " n"], units: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the units of steps from a point: powers of two, so that x + h - x is h."""
    return 2.0 ** np.round(np.log2(np.maximum(units, np.abs(point))))


def stencil(point: Float[Array, " n"], units: Float[Array, " n"]) -> Float[Array, "K n"]:
    """Return a point and the points around it from which `sides` computes slopes."""
    units = units_at(point, units)
    moves = np.concatenate([np.eye(len(units)), _oblique(len(units))]) * units
    nearby = np.outer(_STEPS[1::2], _NEARBY).reshape(-1)
    steps = np.concatenate([_STEPS, -_STEPS, nearby, -nearby])
    around = point + steps[:, None, None] * moves
    return np.concatenate([point[None], around.reshape(-1, len(point))])


def sides(point: Float[Array, " n"], values: Float[Array, "K k"]) -> Sides:
    """Return the slopes at a point (n,), per unit of each state, from the values of its stencil."""
    here, widths = values[0], _STEPS[:, None, None]
    around = values[1:].reshape(-1, len(point) + _OBLIQUE, values.shape[1])
    # Other checks report values that are not finite; here they compare as false.
    with np.errstate(invalid="ignore", over="ignore"):
        forward, backward = (around[:4] - here) / widths, (here - around[4:8]) / widths
        nearby = around[8:].reshape(2, 2, 3, *around.shape[1:])
        crooked = np.abs(nearby[:, :, 0] - 2.0 * nearby[:, :, 1] + nearby[:, :, 2])
        rounding = np.maximum(crooked.max(axis=(0, 2)), np.finfo(float).eps * np.abs(here))
    return Sides(np.moveaxis(forward, 1, 2), np.moveaxis(backward, 1, 2), rounding)


def find_gap(
    function: _Function, points: Float[Array, "K n"], units: Float[Array, " n"]
) -> Gap | None:
    """Return where the derivative of a traceable function by JAX is not its slope, or None."""
    with precision("float64"):
        around = jnp.asarray(np.stack([stencil(point, units) for point in points]))
        values = np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(around))
        slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(function)))(jnp.asarray(points)))
    for point, around_it, slope in zip(points, values, slopes, strict=True):
        gap = sides(point, around_it).gap(slope, units_at(point, units))
        if gap is not None:
            return gap
    return None
