"""Array aliases and the letters that name dimensions throughout echelon.

T frames, N agents (leaders included), n states, m inputs, q outputs, E edges.
"""

import os
from typing import TypeAlias

import jax
import numpy as np
from jaxtyping import Float

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
