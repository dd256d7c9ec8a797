"""References for leaders: the interface `Reference` and the bundled members."""

from echelon.agents.references.periodic import Circle, FigureEight, Hover, Lemniscate, Line
from echelon.agents.references.polynomials import Polynomials, Waypoints
from echelon.agents.references.reference import Reference
from echelon.agents.references.state_path import StatePath

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
