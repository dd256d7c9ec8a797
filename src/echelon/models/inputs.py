"""The one change of inputs, u = u* + S v: physical and normalized, of whole arrays."""

import numpy as np

from echelon.core.types import Array
from echelon.models.model import ControlAffine


def normalized(model: ControlAffine, u: Array) -> Array:
    """Return the normalized inputs (..., m) of physical ones."""
    deviation = np.asarray(u) - np.asarray(model.trim[1], float)
    return deviation @ np.linalg.inv(np.asarray(model.input_scale, float)).T


def physical(model: ControlAffine, v: Array) -> Array:
    """Return the physical inputs (..., m) of normalized ones."""
    return np.asarray(model.trim[1], float) + v @ np.asarray(model.input_scale, float).T
