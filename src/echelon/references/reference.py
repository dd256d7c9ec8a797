"""The interface of a reference: a smooth path in space with a yaw, as functions of time."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.errors import ReferenceError, check_kind
from echelon.core.numerics import derivatives, precision
from echelon.core.trace import check_function
from echelon.core.types import Array, Scalar

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
        array = numbers_of(value)
        wanted = () if length is None else (length,)
        if array.shape != wanted or not np.isfinite(array).all():
            shape = "a finite number" if length is None else f"{length} finite numbers"
            raise ReferenceError(
                f"`{name}` of `{type(owner).__name__}` is {value}, and must be {shape}."
            )


def numbers_of(value: object) -> Array:
    """Return a number or nested lists of numbers as float64; NaN alone for anything else."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        return np.array([np.nan])
    # Text that reads as a number is none, nor is a truth value, and what no int64 holds is an
    # object.
    return array.astype(np.float64) if array.dtype.kind in "iuf" else np.array([np.nan])


def check_reference(reference: Reference) -> None:
    """Check that a reference is one, and that it returns (x, y, z, yaw).

    Raises:
        ReferenceError: it is none, or returns something else.
    """
    check_kind("reference", reference, Reference, ReferenceError)
    with precision("float64"):
        check_function(
            ReferenceError,
            f"the point of `{type(reference).__name__}`",
            reference,
            jnp.zeros(()),
            shape=(len(COORDINATES),),
            advice="it must be written with `jax.numpy` and take one time",
        )


def in_space(point: jax.Array, yaw: float) -> jax.Array:
    """Return (x, y, z, yaw) from a point and a constant yaw."""
    return jnp.append(point, jnp.asarray(yaw, point.dtype))
