"""The common base of paths that consist of polynomials of degree 7."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.heading_symmetry import heading_of, rest_heading
from echelon.agents.models.model import ControlAffine
from echelon.agents.references.reference import Reference
from echelon.core.types import Array, Scalar


class PolynomialPath(Reference):
    """Polynomials of degree 7 between times, constant before and after; abstract.

    Attributes:
        knots: (K,) increasing times, s.
        coefficients: (8, K - 1, 4) of (x, y, z, yaw) over the time since the knot, highest power
            first; metres and radians.
    """

    knots: eqx.AbstractVar[Float[Array, " K"]]
    coefficients: eqx.AbstractVar[Float[Array, "8 K-1 4"]]

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        knots = jnp.asarray(self.knots, t.dtype)
        # Not by `clip`, whose derivative at its ends is one half.
        inside = jnp.where(t < knots[0], knots[0], jnp.where(t > knots[-1], knots[-1], t))
        # At the last knot there is no piece to the right, so the one to its left is used.
        piece = jnp.clip(jnp.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
        return _horner(jnp.asarray(self.coefficients, t.dtype)[:, piece], inside - knots[piece])

    def parts(self, horizon: float) -> Sequence[tuple[float, Callable[[Scalar], jax.Array]]]:
        """Return the polynomials between the knots, and constants before and after."""
        knots, powers = self.knots.tolist(), np.moveaxis(self.coefficients, 1, 0)
        last = _horner(self.coefficients[:, -1], knots[-1] - knots[-2])

        def polynomial(k: int) -> Callable[[Scalar], jax.Array]:
            return lambda t: _horner(jnp.asarray(powers[k], t.dtype), t - knots[k])

        def rest(place: Array) -> Callable[[Scalar], jax.Array]:
            return lambda t: jnp.asarray(place, t.dtype)

        every = [(knots[0], rest(powers[0, -1]))]
        every += [(knots[k + 1], polynomial(k)) for k in range(len(powers))]
        every += [(math.inf, rest(last))]
        count = sum(end < horizon for end, _ in every) + 1
        begun = [(min(end, horizon), path) for end, path in every[:count]]
        return [(end, path) for end, path in begun if end > 0.0]

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the yaw is constant and the trim's; a polynomial path has no enclosure."""
        yaw = self.coefficients[..., 3]
        moves = bool(yaw[:-1].any() or (yaw[-1] != rest_heading(model)).any())
        return heading_of(model).state != "yaw" or moves


def _horner(coefficients: Array | jax.Array, s: Scalar | float) -> Any:
    """Return the value (4,) of polynomials with coefficients (8, 4), highest power first."""
    value, *others = coefficients
    # In the time since the knot: powers of t would lose digits late in a run.
    for coefficient in others:
        value = value * s + coefficient
    return value
