"""Checks of the numbers and names in the arguments of problems and solvers."""

import math
import numbers
from collections.abc import Sequence

import numpy as np

from echelon.core.errors import PlanError, is_number, listing
from echelon.core.types import Array


def check_seconds(name: str, value: float) -> None:
    """Raise `PlanError` unless a time is positive and finite."""
    # By its type first: a comparison with a word would raise an error of Python's own.
    if not (is_number(value) and 0.0 < value < math.inf):
        raise PlanError(f"`{name}` is {value}, and must be a positive finite number of seconds.")


def check_whole(name: str, value: object, least: int, hint: str = "") -> None:
    """Raise `PlanError`, which `hint` ends, unless a count is a whole number from `least` on."""
    # `True` is an integer to Python, and never meant as a count.
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < least:
        raise PlanError(f"`{name}` is {value}, and must be a whole number from {least} on{hint}.")


def check_choice(name: str, value: object, allowed: Sequence[str]) -> None:
    """Raise `PlanError` unless an option is one of those allowed."""
    if value not in allowed:
        raise PlanError(f"`{name}` is `{value}`, allowed are {listing(allowed)}.")


def read_weights(name: str, values: object, owners: Sequence[str]) -> Array:
    """Return a float64 weight for each owner; `PlanError` unless all are finite, none negative."""
    try:
        weights = np.asarray(values, np.float64)  # pyright: ignore
    except (TypeError, ValueError):
        weights = np.full(1, np.nan)  # refused below, where the message is
    if weights.shape != (len(owners),) or not (np.isfinite(weights) & (weights >= 0.0)).all():
        raise PlanError(
            f"`{name}` is {values}, and must be {len(owners)} finite numbers that are not "
            f"negative, one for each of {listing(owners)}."
        )
    return weights
