"""echelon: leader-follower formation tracking by consensus, for any agent xdot = f(x) + g(x) u.

Parts in, one verb, one result out: `synthesize` a gain for a model on a graph, `simulate` the
closed loop, `report` what happened. Nothing heavy is imported until it is used, and importing
changes no global setting.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from echelon.certificates.domain import Domain
    from echelon.core.errors import EchelonError, Outcome
    from echelon.engine.result import Result
    from echelon.engine.simulate import simulate
    from echelon.engine.work import SolverFigures, solver_figures
    from echelon.gains import (
        Certificate,
        Contraction,
        Gain,
        Given,
        InnerLoop,
        Method,
        Monotone,
        Region,
        Riccati,
        RobustLQR,
    )
    from echelon.gains.file import load_gain, save_gain
    from echelon.gains.synthesize import synthesize
    from echelon.laws import (
        Agreement,
        Consensus,
        Law,
        LocalView,
        OptimalTracking,
        Passive,
        Tracking,
    )
    from echelon.models import (
        ControlAffine,
        DoubleIntegrator,
        Linear,
        Pendulum,
        PlanarQuadrotor,
        PrintedQuadrotor,
        Quadrotor,
        QuadrotorEuler,
        QuadrotorThrust,
        SingleIntegrator,
        Unicycle,
        UnicyclePoint,
        VanDerPol,
    )
    from echelon.models.model import Limits
    from echelon.network.formation import Formation
    from echelon.network.graph import Graph
    from echelon.network.topology import Shorter, recommend_edges, recommend_leaders, shorter
    from echelon.optimal.horizon import MPC
    from echelon.optimal.objectives import Planning
    from echelon.optimal.pilots import simulate_mpc, simulate_plans
    from echelon.optimal.planar_baseline import PlanarBaseline
    from echelon.optimal.planner import Plan, Planner, plan
    from echelon.optimal.problem import Constraint, OptimalControl
    from echelon.plots.run import figures, save_figures
    from echelon.references import (
        Circle,
        FigureEight,
        Hover,
        Lemniscate,
        Line,
        Reference,
        Waypoints,
    )
    from echelon.reports.comparison import comparison_report
    from echelon.reports.run import report
    from echelon.results.dataset import dataset, save_dataset, summary
    from echelon.results.lyapunov import Lyapunov, lyapunov
    from echelon.results.metrics import Metrics, metrics
    from echelon.scenario.build import build, run
    from echelon.scenario.scenario import (
        Scenario,
        bundled_scenarios,
        load_scenario,
        scenario_from_mapping,
    )
    from echelon.studies.compare import Comparison, compare
    from echelon.studies.finite_condition import FiniteCondition, finite_condition
    from echelon.verifier.verify import Verified, verify
    from echelon.world.disturbance import Disturbance

__version__ = "0.1.0"

_HOMES = {
    "results.dataset": ("dataset", "save_dataset", "summary"),
    "scenario.build": ("build", "run"),
    "world.disturbance": ("Disturbance",),
    "studies.compare": ("Comparison", "compare"),
    "reports.comparison": ("comparison_report",),
    "certificates.domain": ("Domain",),
    "core.errors": ("EchelonError", "Outcome"),
    "studies.finite_condition": ("FiniteCondition", "finite_condition"),
    "network.formation": ("Formation",),
    "gains.file": ("load_gain", "save_gain"),
    "network.graph": ("Graph",),
    "optimal.horizon": ("MPC",),
    "results.lyapunov": ("Lyapunov", "lyapunov"),
    "results.metrics": ("Metrics", "metrics"),
    "optimal.problem": ("Constraint", "OptimalControl"),
    "optimal.pilots": ("simulate_mpc", "simulate_plans"),
    "optimal.planner": ("Plan", "Planner", "plan"),
    "optimal.planar_baseline": ("PlanarBaseline",),
    "plots.run": ("figures", "save_figures"),
    "optimal.objectives": ("Planning",),
    "network.topology": ("Shorter", "recommend_edges", "recommend_leaders", "shorter"),
    "reports.run": ("report",),
    "engine.result": ("Result",),
    "scenario.scenario": (
        "Scenario",
        "bundled_scenarios",
        "load_scenario",
        "scenario_from_mapping",
    ),
    "engine.simulate": ("simulate",),
    "engine.work": ("SolverFigures", "solver_figures"),
    "gains.synthesize": ("synthesize",),
    "verifier.verify": ("Verified", "verify"),
    "gains": (
        "Certificate",
        "Contraction",
        "Gain",
        "Given",
        "InnerLoop",
        "Method",
        "Monotone",
        "Region",
        "Riccati",
        "RobustLQR",
    ),
    "laws": (
        "Agreement",
        "Consensus",
        "Law",
        "LocalView",
        "OptimalTracking",
        "Passive",
        "Tracking",
    ),
    "models": (
        "ControlAffine",
        "DoubleIntegrator",
        "Linear",
        "Pendulum",
        "PlanarQuadrotor",
        "PrintedQuadrotor",
        "Quadrotor",
        "QuadrotorEuler",
        "QuadrotorThrust",
        "SingleIntegrator",
        "Unicycle",
        "UnicyclePoint",
        "VanDerPol",
    ),
    "models.model": ("Limits",),
    "references": (
        "Circle",
        "FigureEight",
        "Hover",
        "Lemniscate",
        "Line",
        "Reference",
        "Waypoints",
    ),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Agreement",
    "Certificate",
    "Circle",
    "Comparison",
    "Consensus",
    "Constraint",
    "Contraction",
    "ControlAffine",
    "Disturbance",
    "Domain",
    "DoubleIntegrator",
    "EchelonError",
    "FigureEight",
    "FiniteCondition",
    "Formation",
    "Gain",
    "Given",
    "Graph",
    "Hover",
    "InnerLoop",
    "Law",
    "Lemniscate",
    "Limits",
    "Line",
    "Linear",
    "LocalView",
    "Lyapunov",
    "MPC",
    "Method",
    "Metrics",
    "Monotone",
    "OptimalControl",
    "OptimalTracking",
    "Outcome",
    "Passive",
    "Pendulum",
    "Plan",
    "PlanarBaseline",
    "PlanarQuadrotor",
    "Planner",
    "Planning",
    "PrintedQuadrotor",
    "Quadrotor",
    "QuadrotorEuler",
    "QuadrotorThrust",
    "Reference",
    "Region",
    "Result",
    "Riccati",
    "RobustLQR",
    "Scenario",
    "Shorter",
    "SingleIntegrator",
    "SolverFigures",
    "Tracking",
    "Unicycle",
    "UnicyclePoint",
    "VanDerPol",
    "Verified",
    "Waypoints",
    "build",
    "bundled_scenarios",
    "compare",
    "comparison_report",
    "dataset",
    "figures",
    "finite_condition",
    "load_gain",
    "load_scenario",
    "lyapunov",
    "metrics",
    "plan",
    "recommend_edges",
    "recommend_leaders",
    "report",
    "run",
    "save_dataset",
    "save_figures",
    "save_gain",
    "scenario_from_mapping",
    "shorter",
    "simulate",
    "simulate_mpc",
    "simulate_plans",
    "solver_figures",
    "summary",
    "synthesize",
    "verify",
]


def __getattr__(name: str) -> Any:
    """Import a public name from its home when it is first used (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module `echelon` has no attribute `{name}`")
    value = getattr(importlib.import_module(f"echelon.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
