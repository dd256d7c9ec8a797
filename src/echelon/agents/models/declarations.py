"""Whether what a class declares about its agents applies to how they move.

A subclass that changes the equations inherits what its base declares about them. A proof reads a
declaration only if nothing that it is about was changed below the class in which it stands.
"""

import dataclasses
import inspect
from collections.abc import Iterator, Mapping
from types import FunctionType

from echelon.agents.models.model import ControlAffine

_APART = {
    *("input_names", "state_units", "input_units", "state_groups", "position", "chart"),
    *("weights", "damping", "symmetry_weights", "symmetry_inputs"),
    *("difference", "heading", "flat", "flat_order"),
}
"""Attributes of every model that neither move an agent nor name its outputs."""
_LIMITS = {"limit", "input_limits"}
_OF_CLASSES = "__", "_abc_"
"""How names begin that Python gives every class."""
_ABOUT = {
    "flat_chains": set[str](),
    "flat_bounds": {"flat_chains"},
    "to_flat": {"flat_chains"},
    "initial_integrators": {"flat_chains"},
    "airframe": _LIMITS,
}
"""Declarations of a model, and what each is about beside the motion and the outputs."""


def undeclared(model: ControlAffine, *names: str) -> tuple[str, ...]:
    """Return which attributes of a model no proof may read, as nothing declares them of its motion.

    A declaration applies if no class below the one in which it stands replaces an attribute of the
    interface that it is about, or a method or property of that class or a base of it, which the
    equations may call. What was set from outside, on the instance or on a class, is below all
    classes. Parameters may differ, and units, weights and groups of states. The default of the
    interface declares nothing.

    Args:
        model: the agent.
        names: of `flat_chains`, `flat_bounds`, `to_flat`, `initial_integrators` and `airframe`,
            those that a theorem reads.
    """
    return tuple(name for name in names if _is_about_another(model, name))


def is_by_user(model: ControlAffine, name: str) -> bool:
    """Tell whether a declaration stands in a class that is not echelon's, or on the instance."""
    place = next(kind for kind in type(model).__mro__ if name in vars(kind))
    return name in vars(model) or not place.__module__.startswith("echelon.")


def _is_about_another(model: ControlAffine, name: str) -> bool:
    levels = list(_levels(model))
    place = next(k for k, level in enumerate(levels) if name in level)
    # The first level is of no class.
    owners = type(model).__mro__[max(place - 1, 0) :]
    fields = {
        field.name for field in dataclasses.fields(next(filter(dataclasses.is_dataclass, owners)))
    }
    apart = (_APART | _LIMITS | {*_ABOUT}) - _ABOUT[name] | fields
    return any(
        any(key in vars(owner) for owner in owners)
        and key not in apart
        and not _is_data(key, value)
        for level in levels[:place]
        for key, value in level.items()
    )


def _is_data(name: str, value: object) -> bool:
    plain = not callable(value) and not hasattr(type(value), "__get__")
    return plain and not hasattr(ControlAffine, name)


def _levels(model: ControlAffine) -> Iterator[Mapping[str, object]]:
    """Yield the attributes that were set from outside, then those of each class, lowest first."""
    kinds = type(model).__mro__
    fields = {field.name for field in dataclasses.fields(model)}
    outside = {name: value for name, value in vars(model).items() if name not in fields}
    for kind in kinds:
        outside |= {name: value for name, value in vars(kind).items() if _is_foreign(value, kind)}
    yield outside
    for kind in kinds:
        every = {**dict.fromkeys(inspect.get_annotations(kind)), **vars(kind)}
        yield {key: value for key, value in every.items() if not key.startswith(_OF_CLASSES)}


def _is_foreign(value: object, kind: type) -> bool:
    function = getattr(value, "fget", None) or getattr(value, "__func__", value)
    function = inspect.unwrap(function) if callable(function) else function
    if not isinstance(function, FunctionType):
        return False
    where = function.__module__, function.__qualname__.rpartition(".")[0]
    return where != (kind.__module__, kind.__qualname__)
