"""The plant: agents that differ from the model for which laws and gains are made."""

import dataclasses
import numbers
from collections.abc import Mapping
from typing import Any

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import ModelError, did_you_mean, listing


def vary_parameters(
    model: ControlAffine, parameters: Mapping[str, Any], scale: Mapping[str, float]
) -> ControlAffine:
    """Return a model with some parameters replaced and some multiplied by a factor.

    A factor on several numbers multiplies each.

    Raises:
        ModelError: the model has no such parameter, a factor has no number to scale, or the model
            rejects the values.
    """
    names = [field.name for field in dataclasses.fields(model) if field.init]
    name = type(model).__name__
    for parameter in (*parameters, *scale):
        if parameter not in names:
            has = f"it has {listing(names)}" if names else "it has none"
            raise ModelError(
                f"`{parameter}` is no parameter of `{name}`; {has}{did_you_mean(parameter, names)}."
            )
    changes = dict(parameters)
    if both := [parameter for parameter in scale if parameter in changes]:
        raise ModelError(f"`{both[0]}` of the plant has a value and a factor; give one of them.")
    for parameter, factor in scale.items():
        scaled = _scale_value(getattr(model, parameter), factor)
        if scaled is None:
            raise ModelError(
                f"`{parameter}` of `{name}` is {getattr(model, parameter)!r}, and only numbers can "
                "be scaled by a factor."
            )
        changes[parameter] = scaled
    try:
        # `replace` runs the checks of the model, so that an invalid plant is rejected.
        return dataclasses.replace(model, **changes)
    except (TypeError, ValueError) as error:
        message = (str(error).splitlines() or ["no message"])[0].rstrip(".")
        raise ModelError(f"`{name}` rejects these parameters: {message}.") from error


def _scale_value(value: Any, factor: float) -> Any:
    """Return a number, an array, or nested tuples of numbers times a factor; None where neither."""
    # True is a number to Python, but a switch cannot be scaled.
    if isinstance(value, bool | str):
        return None
    if isinstance(value, numbers.Real):
        return factor * float(value)
    if isinstance(value, np.ndarray):
        return factor * value
    if isinstance(value, tuple | list):
        scaled = tuple(_scale_value(entry, factor) for entry in value)
        return None if any(entry is None for entry in scaled) else scaled
    return None


def check_plant(model: ControlAffine, plant: ControlAffine) -> None:
    """Check that a plant has the states and inputs of the model.

    Raises:
        ModelError: it does not.
    """
    for what in ("state_names", "input_names"):
        expected, got = getattr(model, what), getattr(plant, what)
        if expected != got:
            raise ModelError(
                f"`{what}` of the plant `{type(plant).__name__}` are {listing(got)}, and must be "
                f"those of the model `{type(model).__name__}`, {listing(expected)}."
            )


def differences(model: ControlAffine, plant: ControlAffine) -> str:
    """Return in words how a plant differs from the model."""
    name = f"`{type(plant).__name__}`"
    if type(plant) is not type(model):
        return f"{name} for `{type(model).__name__}`"
    changed = [
        f"`{field.name}` {_format_value(getattr(plant, field.name))} "
        f"for {_format_value(getattr(model, field.name))}"
        for field in dataclasses.fields(plant)
        if _as_lists(getattr(plant, field.name)) != _as_lists(getattr(model, field.name))
    ]
    return ", ".join(changed) or f"{name}, which equals the model"


def _as_lists(value: Any) -> Any:
    """Return lists for tuples and arrays."""
    # Arrays compare entry by entry, lists as a whole.
    value = value.tolist() if isinstance(value, np.ndarray) else value
    return list(map(_as_lists, value)) if isinstance(value, tuple | list) else value


def _format_value(value: Any) -> str:
    """Return a parameter as text with six digits."""
    value = _as_lists(value)
    if isinstance(value, list):
        return f"({', '.join(map(_format_value, value))})"
    return f"{value:.6g}" if isinstance(value, numbers.Real) else str(value)
