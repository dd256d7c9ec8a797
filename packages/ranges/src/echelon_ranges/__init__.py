"""Rigorous ranges of functions written for JAX: of values, of slopes, of derivatives in time.

The walk through a JAX trace, on which they rest, is `echelon_ranges.jaxpr`.
"""

from echelon_ranges.errors import JumpError, RangeError, UnboundedError
from echelon_ranges.hull import Box, Hull, slope_columns, slope_hull, value_hull
from echelon_ranges.interval import ELEMENTARY, Interval, point
from echelon_ranges.taylor import enclose_derivatives, enclose_finely

__version__ = "0.1.0"

__all__ = [
    "ELEMENTARY",
    "Box",
    "Hull",
    "Interval",
    "JumpError",
    "RangeError",
    "UnboundedError",
    "enclose_derivatives",
    "enclose_finely",
    "point",
    "slope_columns",
    "slope_hull",
    "value_hull",
]
