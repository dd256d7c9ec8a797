"""The interface of a reference: a smooth path in space with a yaw, as functions of time."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import ReferenceError
from echelon.core.numerics import derivatives
from echelon.core.types import Scalar

COORDINATES = ("x", "y", "z", "yaw")


class Reference(eqx.Module):
    """A path t -> (x, y, z, yaw), in metres and radians; t in seconds."""

    @abc.abstractmethod
    def __call__(self, t: Scalar) -> jax.Array:
        """Return (x, y, z, yaw) at time t, smooth in t."""

    def derivatives(self, t: Scalar, order: int, coordinates: Sequence[str]) -> jax.Array:
        """Return the named coordinates and their first `order` derivatives.

        Their shape is (order + 1, len(coordinates)).
        """
        # Before differentiating, so that what the model ignores costs no derivatives.
        picked = np.array([COORDINATES.index(name) for name in coordinates])
        return derivatives(lambda s: self(s)[picked], t, order)


def check_finite(owner: Reference, **values: object) -> None:
    """Check that named parameters are finite numbers or vectors of the stated length.

    Each value is (number or sequence, length); length None means a plain number.

    Raises:
        ReferenceError: one is not.
    """
    for name, (value, length) in values.items():  # type: ignore[misc]
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            # What is no number fails the test below as NaN does, with the same sentence.
            array = np.array([np.nan])
        wanted = () if length is None else (length,)
        if array.shape != wanted or not np.isfinite(array).all():
            shape = "a finite number" if length is None else f"{length} finite numbers"
            raise ReferenceError(
                f"`{name}` of `{type(owner).__name__}` is {value}, and must be {shape}."
            )


def in_space(point: jax.Array, yaw: float) -> jax.Array:
    """Return (x, y, z, yaw) from a point and a constant yaw."""
    return jnp.append(point, jnp.asarray(yaw, point.dtype))
