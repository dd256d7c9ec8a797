"""References for leaders: the interface `Reference` and the bundled members."""

from echelon.agents.references.periodic import Circle, FigureEight, Lemniscate
from echelon.agents.references.polynomials import Polynomials
from echelon.agents.references.reference import Reference
from echelon.agents.references.state_path import StatePath
from echelon.agents.references.straight import Hover, Line
from echelon.agents.references.waypoints import Waypoints

__all__ = [
    "Circle",
    "FigureEight",
    "Hover",
    "Lemniscate",
    "Line",
    "Polynomials",
    "Reference",
    "StatePath",
    "Waypoints",
]
