"""Array aliases and the letters that name dimensions throughout echelon.

T frames, N agents (leaders included), n states, m inputs, q outputs, E edges.
"""

import os
from typing import TypeAlias

import numpy as np
from jaxtyping import Array, Float

State: TypeAlias = Float[Array, " n"]
Input: TypeAlias = Float[Array, " m"]
Output: TypeAlias = Float[Array, " q"]
InputMap: TypeAlias = Float[Array, "n m"]
States: TypeAlias = Float[Array, "N n"]
Inputs: TypeAlias = Float[Array, "N m"]
Scalar: TypeAlias = Float[Array, ""]

Matrix: TypeAlias = np.ndarray
"""A float64 NumPy array; gains, results and files never hold JAX arrays."""

PathLike: TypeAlias = str | os.PathLike[str]
