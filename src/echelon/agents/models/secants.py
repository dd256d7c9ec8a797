"""What differences of a function's values show of its slopes, without any derivative.

JAX derives a trace, not a function: of a jump it sees the slope 0, and of `stop_gradient` or a rule
written by hand what these say. Differences see neither more nor less than what is simulated.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.numerics import precision
from echelon.core.types import Array

_Function: TypeAlias = Callable[[jax.Array], jax.Array]

_PARTS = 32
_LEVELS = 6
"""A segment is cut in 32 parts six times: to a billionth, far above what rounding moves."""


class Jump(NamedTuple):
    """Two points (n,) all but the same, at which a function differs by `size` in entry `entry`."""

    before: Array
    after: Array
    entry: int
    size: float


def find_jump(function: _Function, starts: Array, ends: Array) -> Jump | None:
    """Return a jump of a function on one of some segments, or None where none is found.

    Of each segment the part over which the function changes most is cut again. Over a part 1,000
    times shorter a function with slopes changes 1,000 times less, and a jump stays.

    Args:
        function: (n,) -> (k,), traceable by JAX.
        starts: (K, n), where the segments begin.
        ends: (K, n), where they end.
    """
    low, high, changes = np.asarray(starts, float), np.asarray(ends, float), []
    size = np.zeros(())
    shares = np.linspace(0.0, 1.0, _PARTS + 1)[:, None]
    with precision("float64"):
        values = jax.jit(jax.vmap(jax.vmap(function)))
        for _ in range(_LEVELS):
            points = low[:, None] + shares * (high - low)[:, None]
            found = np.asarray(values(jnp.asarray(points)))
            steps = np.abs(np.diff(found, axis=1))
            most = np.argmax(steps.max(axis=2), axis=1)
            rows = np.arange(len(low))
            low, high = points[rows, most], points[rows, most + 1]
            changes.append(steps[rows, most])
            size = np.abs(found).max(axis=1)
    # What rounding of the values may feign is left out.
    jumps = (changes[-1] > 0.5 * changes[-3]) & (changes[-1] > 1e-7 * (1e-3 + size))
    if not jumps.any():
        return None
    k, entry = np.unravel_index(np.argmax(np.where(jumps, changes[-1], 0.0)), jumps.shape)
    return Jump(low[k], high[k], int(entry), float(changes[-1][k, entry]))


class Gap(NamedTuple):
    """A derivative that JAX says of an entry in a variable, and what differences show."""

    said: float
    seen: float
    entry: int
    variable: int


_STEPS = (1e-4, 1e-6)
_TOLERANCE = 1e-3


class Sides(NamedTuple):
    """Slopes (2, k, n) of a function at a point, over a wide step and a hundredth of it.

    What is only curved shows less as steps get shorter, and what bends, jumps or is no derivative
    shows the same or more.
    """

    forward: Array
    backward: Array

    def gap(self, said: Array) -> Gap | None:
        """Return where a derivative (k, n) is most clearly no slope, or None."""
        # Where it bends, any slope between those of the sides is as good.
        low, high = np.minimum(*self), np.maximum(*self)
        away = said - np.clip(said, low, high)
        no_slope = self._stays(away, 1.0 + np.abs(said).max()) & ~self.jumps()
        stays = np.where(no_slope, np.abs(away[1]), 0.0)
        if not stays.any():
            return None
        entry, variable = np.unravel_index(np.argmax(stays), stays.shape)
        seen = 0.5 * (self.forward + self.backward)[1, entry, variable]
        return Gap(float(said[entry, variable]), float(seen), int(entry), int(variable))

    def bends(self) -> Array:
        """Return (k, n) whether the slopes of both sides differ, or the values do."""
        scale = 1.0 + np.minimum(np.abs(self.forward[1]), np.abs(self.backward[1])).max()
        return self._stays(self.forward - self.backward, scale) | self.jumps()

    def jumps(self) -> Array:
        """Return (k, n) whether values differ between the sides, however near."""
        wide, narrow = (np.maximum(np.abs(f), np.abs(b)) for f, b in zip(*self, strict=True))
        # A jump over a step a hundred times shorter is a slope a hundred times steeper.
        return narrow > 50.0 * (wide + 1e-3)

    @staticmethod
    def _stays(away: Array, scale: float) -> Array:
        wide, narrow = np.abs(away)
        return (narrow > _TOLERANCE * scale) & (narrow > 0.1 * wide)


def stencil(point: Array) -> Array:
    """Return (1 + 4 n, n) a point (n,), and what lies around it for its `sides`."""
    steps = [np.diag(_widths(point, step)) for step in _STEPS]
    moves = np.concatenate([m for step in steps for m in (step, -step)])
    return np.concatenate([point[None], point + moves])


def sides(point: Array, values: Array) -> Sides:
    """Return the slopes at a point (n,) from the values (1 + 4 n, k) of its `stencil`."""
    n, here = len(point), values[0]
    around = values[1:].reshape(len(_STEPS), 2, n, -1)
    widths = np.array([_widths(point, step) for step in _STEPS])[:, :, None]
    # What is not finite is found by whoever checks values, and compares as false here.
    with np.errstate(invalid="ignore", over="ignore"):
        forward, backward = (around[:, 0] - here) / widths, (here - around[:, 1]) / widths
    return Sides(np.moveaxis(forward, 1, 2), np.moveaxis(backward, 1, 2))


def _widths(point: Array, step: float) -> Array:
    # A power of two, so that x + h - x is h.
    return 2.0 ** np.round(np.log2(step * np.maximum(1.0, np.abs(point))))


def find_gap(function: _Function, points: Array) -> Gap | None:
    """Return where JAX's derivative of a function is not its slope, or None where it is.

    Args:
        function: (n,) -> (k,), traceable by JAX.
        points: (K, n), where to look.
    """
    with precision("float64"):
        around = jnp.asarray(np.stack([stencil(point) for point in points]))
        values = np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(around))
        said = np.asarray(jax.jit(jax.vmap(jax.jacfwd(function)))(jnp.asarray(points)))
    found = (sides(p, v).gap(s) for p, v, s in zip(points, values, said, strict=True))
    return next((gap for gap in found if gap is not None), None)
