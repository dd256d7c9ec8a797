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


class Slopes(NamedTuple):
    """Slopes (..., k, n) of a function by differences to both sides."""

    forward: Array
    backward: Array

    @property
    def middle(self) -> Array:
        """The slopes by central differences."""
        return 0.5 * (self.forward + self.backward)


def difference_slopes(function: _Function, points: Array, step: float) -> Slopes:
    """Return slopes at points (K, n) by differences over `step` times max(1, |x|)."""
    points = np.asarray(points, float)
    n = points.shape[1]
    # A power of two, so that x + h - x is h.
    h = 2.0 ** np.round(np.log2(step * np.maximum(1.0, np.abs(points))))
    moves = np.eye(n)[None] * h[:, None, :]
    with precision("float64"):
        values = jax.jit(jax.vmap(function))
        at, up, down = (
            np.asarray(values(jnp.asarray(x.reshape(-1, n))))
            for x in (points, points[:, None] + moves, points[:, None] - moves)
        )
    up, down = (x.reshape(len(points), n, -1) for x in (up, down))
    scale = h[:, :, None]
    pair = ((up - at[:, None]) / scale, (at[:, None] - down) / scale)
    forward, backward = (np.moveaxis(x, 1, 2) for x in pair)
    return Slopes(forward, backward)


class Gap(NamedTuple):
    """A derivative that JAX says of an entry, and what differences show."""

    said: float
    seen: float
    entry: int
    variable: int


_WIDE, _NARROW = 1e-4, 1e-6
_TOLERANCE = 1e-3


def check_slopes(function: _Function, points: Array) -> Gap | None:
    """Return where JAX's derivative of a function is not its slope, or None where it is.

    Args:
        function: (n,) -> (k,), traceable by JAX.
        points: (K, n), where to look.
    """
    with precision("float64"):
        said = np.asarray(jax.jit(jax.vmap(jax.jacfwd(function)))(jnp.asarray(points, float)))
    wide, narrow = (difference_slopes(function, points, h).middle for h in (_WIDE, _NARROW))
    gaps = np.where(_persist(said - wide, said - narrow, said), np.abs(said - narrow), 0.0)
    if not gaps.any():
        return None
    k, entry, variable = np.unravel_index(np.argmax(gaps), gaps.shape)
    jax_s, seen = (float(a[k, entry, variable]) for a in (said, narrow))
    return Gap(jax_s, seen, int(entry), int(variable))


def find_bends(function: _Function, point: Array) -> Array:
    """Return (k, n) whether the slopes of a function at a point (n,) differ between its sides."""
    wide, narrow = (difference_slopes(function, point[None], h) for h in (_WIDE, _NARROW))
    far, near = ((s.forward - s.backward)[0] for s in (wide, narrow))
    return _persist(far, near, narrow.middle[0])


def _persist(wide: Array, narrow: Array, slopes: Array) -> Array:
    """Tell which gaps stay as differences get a hundred times narrower, and so are no curvature."""
    scale = 1.0 + np.abs(slopes).max()
    return (np.abs(narrow) > _TOLERANCE * scale) & (np.abs(narrow) > 0.1 * np.abs(wide))
