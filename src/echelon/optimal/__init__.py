"""Agents that solve optimization problems: plans, receding horizons, and a leader with a plan."""

from echelon.engine.work import SolverStats, solver_stats
from echelon.optimal.horizon import MPC
from echelon.optimal.leader import OptimalTracking
from echelon.optimal.objectives import TrackingOptions
from echelon.optimal.pilots import simulate_mpc, simulate_plans
from echelon.optimal.planar_baseline import PlanarBaseline
from echelon.optimal.problem import Constraint, OptimalControl
from echelon.optimal.solver import Solver, Trajectory, solve

__all__ = [
    "MPC",
    "Constraint",
    "OptimalControl",
    "OptimalTracking",
    "PlanarBaseline",
    "Solver",
    "SolverStats",
    "TrackingOptions",
    "Trajectory",
    "simulate_mpc",
    "simulate_plans",
    "solve",
    "solver_stats",
]
