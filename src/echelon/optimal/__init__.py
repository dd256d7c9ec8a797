"""Agents that solve optimization problems: plans, receding horizons, and a leader with a plan."""

from echelon.engine.work import SolverStats
from echelon.optimal.drives import Plans, RecedingHorizon
from echelon.optimal.horizon import MPC
from echelon.optimal.leader import OptimalTracking
from echelon.optimal.objectives import TrackingOptions
from echelon.optimal.planar_baseline import PlanarBaseline
from echelon.optimal.problem import Constraint, OptimalControl
from echelon.optimal.solver import Solver, Trajectory, solve

__all__ = [
    "MPC",
    "Constraint",
    "OptimalControl",
    "OptimalTracking",
    "PlanarBaseline",
    "Plans",
    "RecedingHorizon",
    "Solver",
    "SolverStats",
    "TrackingOptions",
    "Trajectory",
    "solve",
]
