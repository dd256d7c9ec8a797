"""A smooth path through timed points."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.heading_symmetry import heading_of, rest_heading
from echelon.agents.models.model import ControlAffine
from echelon.agents.references.reference import Reference, check_finite, in_space, numbers_of
from echelon.core.errors import ReferenceError
from echelon.core.types import Array, Scalar


class Waypoints(Reference):
    """The spline of degree 7 through `points` at `times`, at rest at both ends.

    Before the first and after the last time the path is constant. Its derivatives are continuous up
    to the sixth, so that a quadrotor can fly it (flatness needs four). The path starts and stops
    with zero velocity, acceleration and jerk.

    Args:
        times: K >= 2 increasing times, s.
        points: K points (x, y, z), m.
        yaw: constant yaw, rad.

    Raises:
        ReferenceError: the times do not increase or the points do not match them.
    """

    knots: Array
    coefficients: Array
    yaw: float = eqx.field()

    # Six inside; at rest at both ends up to the third.
    joined = 3

    def __init__(
        self, times: Sequence[float], points: Sequence[Sequence[float]], yaw: float = 0.0
    ) -> None:
        """Fit the spline."""
        t, p = _read(times, points)
        self.yaw = yaw
        check_finite(self, yaw=(yaw, None))
        self.knots, self.coefficients = _fit(t, p)

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        knots = jnp.asarray(self.knots, t.dtype)
        inside = jnp.clip(t, knots[0], knots[-1])
        # At the last knot there is no piece to the right, so the one to its left is used.
        piece = jnp.clip(jnp.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
        s = inside - knots[piece]
        return in_space(_horner(jnp.asarray(self.coefficients, t.dtype)[:, piece], s), self.yaw)

    def parts(self, horizon: float) -> Sequence[tuple[float, Callable[[Scalar], jax.Array]]]:
        """Return the polynomials between the points, and constants before and after."""
        knots, powers = self.knots.tolist(), np.moveaxis(self.coefficients, 1, 0)
        last = _horner(self.coefficients[:, -1], knots[-1] - knots[-2])

        def polynomial(k: int) -> Callable[[Scalar], jax.Array]:
            return lambda t: in_space(_horner(powers[k], t - knots[k]), self.yaw)

        def rest(place: Array) -> Callable[[Scalar], jax.Array]:
            return lambda t: in_space(jnp.asarray(place, t.dtype), self.yaw)

        every = [(knots[0], rest(powers[0, -1]))]
        every += [(knots[k + 1], polynomial(k)) for k in range(len(powers))]
        every += [(math.inf, rest(last))]
        count = sum(end < horizon for end, _ in every) + 1
        begun = [(min(end, horizon), path) for end, path in every[:count]]
        return [(end, path) for end, path in begun if end > 0.0]

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the constant yaw differs from the trim's; a spline has no enclosure."""
        return heading_of(model).state != "yaw" or self.yaw != rest_heading(model)


def _horner(coefficients: Array | jax.Array, s: Scalar | float) -> Any:
    """Return the value of polynomials with coefficients (8, 3), highest power first."""
    value, *others = coefficients
    # In the time since the knot: powers of t would lose digits late in a run.
    for coefficient in others:
        value = value * s + coefficient
    return value


def _read(times: Sequence[float], points: Sequence[Sequence[float]]) -> tuple[Array, Array]:
    """Return times (K,) and points (K, 3), after checking both."""
    t, p = numbers_of(times), numbers_of(points)
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        listed = times.tolist() if isinstance(times, np.ndarray) else times
        raise ReferenceError(
            f"`times` of `Waypoints` is {listed}, and must be at least 2 increasing times."
        )
    if p.shape != (len(t), 3) or not np.isfinite(p).all():
        # Rows of different lengths, or text, have no shape.
        got = f"is {points}" if p.shape == (1,) else f"has shape {p.shape}"
        raise ReferenceError(
            f"`points` of `Waypoints` {got}, and must be {len(t)} finite points (x, y, z)."
        )
    return t, p


def _fit(times: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the knots (K,) and the coefficients (8, K - 1, 3), highest power first."""
    # Imported here: splines load slowly, and only this reference needs them.
    from scipy.interpolate import make_interp_spline

    # A spline of degree 7 through K points has K + 6 coefficients: three conditions more at each
    # end.
    rest = [(order, np.zeros(3)) for order in (1, 2, 3)]
    spline = make_interp_spline(times, points, k=7, bc_type=(rest, rest))
    # Taylor's coefficients at each knot, which JAX evaluates without SciPy.
    powers = [spline.derivative(k)(times[:-1]) / math.factorial(k) for k in range(7, 0, -1)]
    return times, np.stack([*powers, points[:-1]])
