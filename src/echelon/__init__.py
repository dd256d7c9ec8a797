"""echelon: leader-follower formation tracking by consensus, for any agent xdot = f(x) + g(x) u.

Parts in, one verb, one result out: `synthesize` a gain for a model on a graph, `simulate` the
closed loop, `report` what happened. Nothing heavy is imported until it is used, and importing
changes no global setting.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from echelon._archive import dataset, save_dataset, summary
    from echelon._build import build, run
    from echelon._compare import Comparison, compare
    from echelon._comparison_report import comparison_report
    from echelon._disturbance import Disturbance
    from echelon._domain import Domain
    from echelon._errors import EchelonError, Outcome
    from echelon._finite_condition import FiniteCondition, finite_condition
    from echelon._formation import Formation
    from echelon._gain_file import load_gain, save_gain
    from echelon._graph import Graph
    from echelon._horizon import MPC
    from echelon._lyapunov import Lyapunov, lyapunov
    from echelon._metrics import Metrics, metrics
    from echelon._optimal_control import Constraint, OptimalControl
    from echelon._optimization import simulate_mpc, simulate_plans
    from echelon._plan import Plan, Planner, plan
    from echelon._planar_baseline import PlanarBaseline
    from echelon._plots import figures, save_figures
    from echelon._posing import Planning
    from echelon._recommend import Shorter, recommend_edges, recommend_leaders, shorter
    from echelon._report import report
    from echelon._result import Result
    from echelon._scenario import Scenario, bundled_scenarios, load_scenario, scenario_from_mapping
    from echelon._simulate import simulate
    from echelon._solver_figures import SolverFigures, solver_figures
    from echelon._synthesize import synthesize
    from echelon._verify import Verified, verify
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
    from echelon.references import (
        Circle,
        FigureEight,
        Hover,
        Lemniscate,
        Line,
        Reference,
        Waypoints,
    )

__version__ = "0.1.0"

_HOMES = {
    "_archive": ("dataset", "save_dataset", "summary"),
    "_build": ("build", "run"),
    "_disturbance": ("Disturbance",),
    "_compare": ("Comparison", "compare"),
    "_comparison_report": ("comparison_report",),
    "_domain": ("Domain",),
    "_errors": ("EchelonError", "Outcome"),
    "_finite_condition": ("FiniteCondition", "finite_condition"),
    "_formation": ("Formation",),
    "_gain_file": ("load_gain", "save_gain"),
    "_graph": ("Graph",),
    "_horizon": ("MPC",),
    "_lyapunov": ("Lyapunov", "lyapunov"),
    "_metrics": ("Metrics", "metrics"),
    "_optimal_control": ("Constraint", "OptimalControl"),
    "_optimization": ("simulate_mpc", "simulate_plans"),
    "_plan": ("Plan", "Planner", "plan"),
    "_planar_baseline": ("PlanarBaseline",),
    "_plots": ("figures", "save_figures"),
    "_posing": ("Planning",),
    "_recommend": ("Shorter", "recommend_edges", "recommend_leaders", "shorter"),
    "_report": ("report",),
    "_result": ("Result",),
    "_scenario": ("Scenario", "bundled_scenarios", "load_scenario", "scenario_from_mapping"),
    "_simulate": ("simulate",),
    "_solver_figures": ("SolverFigures", "solver_figures"),
    "_synthesize": ("synthesize",),
    "_verify": ("Verified", "verify"),
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
