"""References for leaders: the interface `Reference` and the bundled members."""

from echelon.references.periodic import Circle, FigureEight, Lemniscate
from echelon.references.reference import Reference
from echelon.references.state_path import StatePath
from echelon.references.straight import Hover, Line
from echelon.references.waypoints import Waypoints

__all__ = [
    "Circle",
    "FigureEight",
    "Hover",
    "Lemniscate",
    "Line",
    "Reference",
    "StatePath",
    "Waypoints",
]
