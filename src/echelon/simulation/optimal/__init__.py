"""Agents that solve optimization problems: plans, receding horizons, and a leader with a plan."""

from echelon.simulation.optimal.drives import Plans, RecedingHorizon
from echelon.simulation.optimal.horizon import MPC
from echelon.simulation.optimal.leader import OptimalTracking
from echelon.simulation.optimal.objectives import TrackingOptions
from echelon.simulation.optimal.planar_baseline import PlanarBaseline
from echelon.simulation.optimal.problem import Constraint, OptimalControl
from echelon.simulation.optimal.solver import Solver, Trajectory, solve
from echelon.simulation.step.solver_stats import SolverStats

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
