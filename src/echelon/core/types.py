"""Array aliases with the letters that name dimensions, and the base of the classes of users.

T frames, N agents (leaders included), n states, m inputs, q outputs, E edges, k of anything else. A
shape is written `Float[Array, "N n"]` for NumPy and `Float[jax.Array, "N n"]` for JAX, with `Float`
from jaxtyping and a leading space where there is one dimension, `Float[Array, " n"]`. The tests
check every shape that a function declares; within one call a letter stands for one length.
"""

import abc
import dataclasses
import os
import sys
from pathlib import Path
from typing import Any, TypeAlias

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from jaxtyping import PyTree as PyTree

from echelon.core.errors import EchelonError

# Of JAX, as the functions that JAX traces take and return them.
State: TypeAlias = Float[jax.Array, " n"]
Input: TypeAlias = Float[jax.Array, " m"]
Output: TypeAlias = Float[jax.Array, " q"]
InputMap: TypeAlias = Float[jax.Array, "n m"]
States: TypeAlias = Float[jax.Array, "N n"]
Inputs: TypeAlias = Float[jax.Array, "N m"]
Scalar: TypeAlias = Float[jax.Array, ""]

Array: TypeAlias = np.ndarray
"""A float64 NumPy array; gains, results and files never hold JAX arrays."""

PathLike: TypeAlias = str | os.PathLike[str]

JsonObject: TypeAlias = dict[str, Any]
"""What JSON and YAML call an object or mapping: values are numbers, texts, lists and objects."""


class Declared(eqx.Module, abc.ABC):
    """An immutable object whose parameters are annotated fields."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign a field in `__init__`; raise `EchelonError` for another name, or later."""
        try:
            super().__setattr__(name, value)
        except dataclasses.FrozenInstanceError as error:
            own, code = type(self).__name__, sys._getframe(1)
            place = f"{Path(code.f_code.co_filename).name}:{code.f_lineno}"
            if any(field.name == name for field in dataclasses.fields(self)):
                text = f"`{name}` of a `{own}` cannot be changed; make a new `{own}`"
            else:
                kind = "jax.Array" if isinstance(value, jax.Array) else type(value).__name__
                text = f"parameters are annotated fields; declare `{name}: {kind}` in `{own}`"
            raise EchelonError(f"{place}: {text}.") from error
