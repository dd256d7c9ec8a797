"""The interface of a reference: a smooth path in space with a yaw, as functions of time."""

import abc
from collections.abc import Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.heading_symmetry import heading_of, rest_heading
from echelon.agents.models.model import ControlAffine
from echelon.agents.references.guide import Guide
from echelon.core.enclosure.hull import Box, value_hull
from echelon.core.errors import GainError, LawError, ReferenceError, check_kind, listing
from echelon.core.memoize import memoize
from echelon.core.numerics import derivatives, precision
from echelon.core.trace import check_array, check_function, checked_trace
from echelon.core.types import Array, Input, Scalar, State

COORDINATES = ("x", "y", "z", "yaw")
_LONGEST = 10**9
"""s; thirty years, for which no run goes on."""


class Reference(Guide):
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

    def follow(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return the state (n,) and the input (m,) by the model's flatness map."""
        return model.flat(self.derivatives(t, model.flat_order, model.flat_outputs))

    def heading(self, model: ControlAffine, t: Scalar) -> Scalar:
        """Return the heading (rad) at time t of a model that states one."""
        place = _heading_place(model)
        return super().heading(model, t) if place is None else self(t)[place]

    def turns(self, model: ControlAffine) -> bool:
        """Tell it of a path whose heading is enclosed in rationals; of another it may."""
        place = _heading_place(model)
        return place is None or _turns(self, place, rest_heading(model))

    def check(self) -> None:
        """Check that (x, y, z, yaw) is returned."""
        with precision("float64"):
            check_function(
                ReferenceError,
                f"the point of `{type(self).__name__}`",
                self,
                np.zeros(()),
                shape=(len(COORDINATES),),
                advice="it must be written with `jax.numpy` and take one time",
            )

    def fit(self, model: ControlAffine) -> None:
        """Check that the model has a flatness map, of outputs that a reference gives."""
        name, unknown = type(model).__name__, set(model.flat_outputs) - set(COORDINATES)
        if not model.flat_outputs:
            raise LawError(
                f"`{name}` cannot be led along a reference, since it defines no `flat` map; add "
                "`flat_outputs`, `flat_order` and `flat` to it, give its states and inputs over "
                "time (`states`), or use the law `passive`."
            )
        if unknown:
            raise LawError(
                f"`flat_outputs` of `{name}` names {listing(sorted(unknown))}, and a reference "
                f"gives {listing(COORDINATES)}."
            )
        _check_map(model)


def _heading_place(model: ControlAffine) -> int | None:
    """Return which coordinate is the model's heading, so that no derivative is needed for it."""
    name = heading_of(model).state
    return COORDINATES.index(name) if name in COORDINATES and name in model.flat_outputs else None


@memoize
def _turns(reference: Reference, place: int, rest: float) -> bool:
    """Tell whether a coordinate may be another than `rest` at some time."""

    def there(t: jax.Array, nothing: jax.Array) -> jax.Array:
        return reference(t[0])[place].reshape(1, 1)

    try:
        with precision("float64"):
            hull = value_hull(there, Box([0], [_LONGEST]), Box([0], [0]))
    except GainError:
        return True
    return bool((hull.vertices != rest).any() or hull.error.any())


@memoize
def _check_map(model: ControlAffine) -> None:
    """Trace the flatness map, and check the state and the input that it returns."""
    name, shapes = type(model).__name__, (len(model.state_names), len(model.input_names))
    with precision("float64"):
        found = checked_trace(
            LawError,
            f"`flat` of `{name}`",
            model.flat,
            np.zeros((model.flat_order + 1, len(model.flat_outputs))),
            advice="it must be written with `jax.numpy` and take the outputs' derivatives",
        ).result
    if not isinstance(found, tuple | list) or len(found) != 2:
        raise LawError(f"`flat` of `{name}` must return two things, a state and an input.")
    for what, value, size in zip(("state", "input"), found, shapes, strict=True):
        check_array(LawError, f"the {what} that `flat` of `{name}` makes", value, (size,))


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


def check_kind_of(reference: object) -> None:
    """Check that a reference is one.

    Raises:
        ReferenceError: it is none.
    """
    # A path of states is one too, though no `Reference`, which is the name that users know.
    kind = Guide if isinstance(reference, Guide) else Reference
    check_kind("reference", reference, kind, ReferenceError)


def check_reference(reference: Guide) -> None:
    """Check that a reference is one, and what it returns.

    Raises:
        ReferenceError: it is none, or returns something else than the interface says.
    """
    check_kind_of(reference)
    reference.check()


class Yawing(Protocol):
    """A path whose yaw (rad) grows at a constant rate (rad/s)."""

    @property
    def yaw(self) -> float:
        """At time 0."""
        ...

    @property
    def yaw_rate(self) -> float:
        """Of its growth."""
        ...


def yaw_at(path: Yawing, t: Scalar) -> jax.Array:
    """Return the yaw (rad) of a path at time t."""
    return path.yaw + path.yaw_rate * t


def in_space(point: jax.Array, yaw: float | jax.Array) -> jax.Array:
    """Return (x, y, z, yaw) from a point and a yaw."""
    return jnp.append(point, jnp.asarray(yaw, point.dtype))
