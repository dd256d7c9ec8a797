"""Array aliases, and the letters that name dimensions in shapes such as `Float[Array, "N n"]`.

T frames, N agents (leaders included), n states, m inputs, q outputs, E edges, k of anything else. A
shape is written `Float[Array, "N n"]` for NumPy and `Float[jax.Array, "N n"]` for JAX, with `Float`
from jaxtyping and a leading space where there is one dimension, `Float[Array, " n"]`. The tests
check every shape that a function declares; within one call a letter stands for one length.
"""

import os
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Float
from jaxtyping import PyTree as PyTree

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
