"""What a leader follows: a motion of a model, or a smooth path in space with a yaw."""

import abc
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.heading_symmetry import heading_index, heading_of, rest_heading
from echelon.agents.models.model import ControlAffine
from echelon.core.cache import memoize
from echelon.core.errors import LawError, ReferenceError, check_kind, listing
from echelon.core.numerics import derivatives, precision
from echelon.core.trace import call_once_traced, check_array, checked_trace
from echelon.core.types import Array, Declared, Input, Scalar, State
from echelon_ranges import Box, RangeError, value_hull


class LeaderPath(Declared):
    """The motion that a leader follows: a path in space, or one of states and inputs."""

    @abc.abstractmethod
    def follow(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return the state (n,) and the input (m,) that follow it exactly at time t (s)."""

    def heading(self, model: ControlAffine, t: Scalar) -> Scalar:
        """Return the heading (rad) at time t of a model that states one."""
        return self.follow(model, t)[0][heading_index(model)]

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the heading may differ from the trim's at some time."""
        return True

    def variants(self) -> "Iterator[tuple[str, str, LeaderPath]]":
        """Yield what may force motion, in words, with the key that ends it and the path then."""
        yield from ()

    def remarks(self) -> tuple[str, ...]:
        """Return what is probably not meant, a sentence each."""
        return ()

    def span(self) -> tuple[float, float]:
        """Return the times (s) between which the path changes; it is constant outside."""
        return -math.inf, math.inf

    @abc.abstractmethod
    def check(self) -> None:
        """Raise `ReferenceError` if the values that the reference returns are malformed."""

    @abc.abstractmethod
    def fit(self, model: ControlAffine) -> None:
        """Raise `LawError`, which says why, unless a model can be led along it."""


COORDINATES = ("x", "y", "z", "yaw")
_MAX_TIME = 10**9
"""s; thirty years, longer than any run."""


class Reference(LeaderPath):
    """A path t -> (x, y, z, yaw), in metres and radians; t in seconds."""

    joined: ClassVar[int] = 0
    """How many derivatives are continuous where `parts` meet; one more is bounded."""

    @abc.abstractmethod
    def __call__(self, t: Scalar) -> jax.Array:
        """Return (x, y, z, yaw) at time t, smooth in t."""

    def derivatives(self, t: Scalar, order: int, coordinates: Sequence[str]) -> jax.Array:
        """Return the named coordinates and their first `order` derivatives.

        Their shape is (order + 1, len(coordinates)).
        """
        # Selected before differentiating, so that unused coordinates cost no derivatives.
        chosen = tuple(COORDINATES.index(name) for name in coordinates)
        return call_once_traced(functools.partial(_derivatives, self, chosen, order), t)

    def follow(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return the state and the input by the model's flatness map."""
        return model.flat(self.derivatives(t, model.flat_order, model.flat_outputs))

    def parts(self, horizon: float) -> Sequence[tuple[float, Callable[[Scalar], jax.Array]]]:
        """Return the smooth paths that this one is joined of until the horizon, and their ends (s).

        A class that defines parts states how they meet, by `joined`.
        """
        return ((horizon, self),)

    def heading(self, model: ControlAffine, t: Scalar) -> Scalar:
        """Return the heading (rad) at time t of a model that states one."""
        index = _heading_coordinate(model)
        return super().heading(model, t) if index is None else self(t)[index]

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the heading may change, from an enclosure; True where there is none."""
        index = _heading_coordinate(model)
        return index is None or _turns(self, index, rest_heading(model))

    def check(self) -> None:
        """Check that (x, y, z, yaw) is returned."""
        with precision("float64"):
            checked_trace(
                ReferenceError,
                f"the point of `{type(self).__name__}`",
                self,
                np.zeros(()),
                shape=(len(COORDINATES),),
                advice="it must be written with `jax.numpy` and take one time",
            )

    def fit(self, model: ControlAffine) -> None:
        """Check that the model has a flatness map for coordinates of a reference."""
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
                f"has {listing(COORDINATES)}."
            )
        _check_map(model)


def _derivatives(path: Reference, chosen: tuple[int, ...], order: int, t: Scalar) -> jax.Array:
    return derivatives(lambda s: path(s)[np.array(chosen)], t, order)


def _heading_coordinate(model: ControlAffine) -> int | None:
    name = heading_of(model).state
    return COORDINATES.index(name) if name in COORDINATES and name in model.flat_outputs else None


@memoize
def _turns(reference: Reference, index: int, rest: float) -> bool:
    """Tell whether a coordinate may differ from `rest` at some time."""

    def coordinate(t: jax.Array, no_input: jax.Array) -> jax.Array:
        return reference(t[0])[index].reshape(1, 1)

    try:
        with precision("float64"):
            hull = value_hull(coordinate, Box([0], [_MAX_TIME]), Box([0], [0]))
    except RangeError:
        return True
    return bool((hull.vertices != rest).any() or hull.error.any())


@memoize
def _check_map(model: ControlAffine) -> None:
    name, shapes = type(model).__name__, (len(model.state_names), len(model.input_names))
    with precision("float64"):
        returned = checked_trace(
            LawError,
            f"`flat` of `{name}`",
            model.flat,
            np.zeros((model.flat_order + 1, len(model.flat_outputs))),
            advice="it must be written with `jax.numpy` and take the outputs' derivatives",
        )
    if not isinstance(returned, tuple | list) or len(returned) != 2:
        raise LawError(f"`flat` of `{name}` must return a pair, a state and an input.")
    for what, value, size in zip(("state", "input"), returned, shapes, strict=True):
        check_array(LawError, f"the {what} that `flat` of `{name}` returns", value, (size,))


def check_finite(owner: Reference, **values: object) -> None:
    """Check that named parameters are finite numbers or vectors of the stated length.

    Each value is (number or sequence, length); length None means a plain number.

    Raises:
        ReferenceError: one is not.
    """
    for name, (value, length) in values.items():  # type: ignore[misc]
        array = numbers_of(value)
        if array.shape != (() if length is None else (length,)) or not np.isfinite(array).all():
            shape = "a finite number" if length is None else f"{length} finite numbers"
            raise ReferenceError(
                f"`{name}` of `{type(owner).__name__}` is {value}, and must be {shape}."
            )


def numbers_of(value: object) -> Array:
    """Return a number or nested lists of numbers as float64; a single NaN for anything else."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        return np.array([np.nan])
    # Neither text nor a truth value is a number, and an integer beyond int64 is an object.
    return array.astype(np.float64) if array.dtype.kind in "iuf" else np.array([np.nan])


def check_kind_of(reference: object) -> None:
    """Raise `ReferenceError` unless a value is a reference."""
    # A path of states is one too, but users know the name `Reference`.
    kind = LeaderPath if isinstance(reference, LeaderPath) else Reference
    check_kind("reference", reference, kind, ReferenceError)


def check_reference(reference: LeaderPath) -> None:
    """Raise `ReferenceError` unless a value is a reference, which returns what it must."""
    check_kind_of(reference)
    reference.check()


def in_space(point: jax.Array, yaw: float | jax.Array) -> jax.Array:
    """Return (x, y, z, yaw) from a point and a yaw."""
    return jnp.append(point, jnp.asarray(yaw, point.dtype))
