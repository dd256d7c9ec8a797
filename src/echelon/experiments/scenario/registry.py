"""The table of all names that a scenario file may use, each with its class and a summary.

It holds only text, so that names are listed and checked without importing JAX. A new member of a
family adds one entry here; its keys are declared in `sections`.
"""

from typing import Literal, NamedTuple


class Entry(NamedTuple):
    """A named part of a scenario: the class that it means and what that is, in one line.

    Attributes:
        target: `module:Attribute`.
        reference: of a leader law, whether it needs a reference, takes one, or takes none.
        leader: of a follower law, the leader law that goes with it by default; None where that
            depends on the reference alone.
    """

    target: str
    summary: str
    reference: Literal["needed", "taken", "none"] = "none"
    leader: str | None = None


def _family(module: str, **entries: tuple[str, str]) -> dict[str, Entry]:
    return {
        name.replace("_", "-"): Entry(f"echelon.{module}:{cls}", text)
        for name, (cls, text) in entries.items()
    }


MODELS = _family(
    "agents.models",
    single_integrator=("SingleIntegrator", "position driven by velocity, in any dimension"),
    double_integrator=(
        "DoubleIntegrator",
        "position and velocity driven by acceleration, with linear drag",
    ),
    linear=("Linear", "A, B, C given as matrices"),
    van_der_pol=("VanDerPol", "Van der Pol oscillator with a force input"),
    pendulum=("Pendulum", "damped pendulum with a torque input"),
    unicycle=("Unicycle", "planar vehicle with speed and turn rate, seen at its axle"),
    unicycle_point=("UnicyclePoint", "the same vehicle, seen at a point ahead of its axle"),
    bicycle=("Bicycle", "car or bicycle without slip, at a speed"),
    boat=("Boat", "boat with two thrusters, at a speed"),
    fixed_wing=("FixedWing", "airplane in coordinated flight, in space, at an airspeed"),
    planar_quadrotor=("PlanarQuadrotor", "quadrotor in a vertical plane, 6 states"),
    quadrotor=("Quadrotor", "quadrotor in space, 12 states, ZYX Euler angles, per-motor limits"),
    quadrotor_euler=("QuadrotorEuler", "quadrotor under computed torque, inputs are accelerations"),
    quadrotor_thrust=("QuadrotorThrust", "the same with its thrust as a 13th state: g is constant"),
    crazyflie_attitude=(
        "CrazyflieAttitude",
        "Crazyflie under its own attitude controller, inputs are angles, yaw rate and thrust",
    ),
    quadrotor_printed=(
        "PrintedQuadrotor",
        "literal: the paper's equations, without gravity or thrust rotation",
    ),
)

REFERENCES = _family(
    "agents.references",
    lemniscate=("Lemniscate", "the paper's loop (lemniscate of Bernoulli)"),
    figure_eight=("FigureEight", "sin and sin 2 figure eight"),
    circle=("Circle", "circle at constant height"),
    hover=("Hover", "one fixed point"),
    line=("Line", "straight line at constant velocity"),
    waypoints=("Waypoints", "smooth path through timed points, from the scenario, a table or GPX"),
    polynomials=("Polynomials", "pieces of degree 7, from a CSV file as Crazyswarm2 reads it"),
    states=("StatePath", "states and inputs over time, from a table, of any model"),
)

METHODS = _family(
    "synthesis.gains",
    riccati=("Riccati", "Riccati equation at the trim, coupling 1/lambda_min"),
    given=("FixedGain", "a P (and R, coupling) of your own"),
    inner_loop=("InnerLoop", "damp all but position, then any coupling works"),
    monotone=("Monotone", "the paper's Assumption 5 on a domain, as an SDP"),
    robust_lqr=("RobustLQR", "one P for all Jacobians of a domain, as an SDP"),
    contraction=("Contraction", "weakest gain of a given rate on a domain"),
    printed_lmi=("PrintedLMI", 'literal: Algorithm 1\'s "solve (LMI)", which has no solution'),
)
DEFAULT_METHOD = "riccati"

FOLLOWER_LAWS = {
    "consensus": Entry("echelon.laws:Consensus", "u = u_ff - c R^-1 g(x)^T P (e + d)"),
    "stopping-point": Entry(
        "echelon.laws:StoppingPoint",
        "agree on where each would come to rest; converges from anywhere",
        # Its agents exchange what no other law sends.
        leader="stopping-point",
    ),
    "agreement": Entry(
        "echelon.laws:Agreement", "the single-integrator law of Theorem 1, u = -(e + d)"
    ),
    "passive": Entry("echelon.laws:TrimInput", "the trim input, nothing else"),
}
DEFAULT_FOLLOWER_LAW = "consensus"

LEADER_LAWS = {
    "tracking": Entry(
        "echelon.laws:Tracking",
        "flatness feed-forward and Riccati feedback on the reference",
        reference="needed",
    ),
    "lqr": Entry(
        "echelon.laws:PathLQR",
        "time-varying LQR along the reference, of any model",
        reference="needed",
    ),
    "optimal-tracking": Entry(
        "echelon.simulation.optimal.leader:OptimalTracking",
        "a plan of least tracking error, and feedback about it",
        reference="needed",
    ),
    "stopping-point": Entry(
        "echelon.laws:StoppingLeader",
        "the followers' law of that name, led by the reference",
        reference="taken",
    ),
    "agreement": FOLLOWER_LAWS["agreement"],
    "passive": FOLLOWER_LAWS["passive"],
}
TRACKING_LAWS = [name for name, entry in LEADER_LAWS.items() if entry.reference != "none"]
"""The leader laws that follow a reference."""


def default_leader_law(follower: object, reference: bool) -> str:
    """Return the leader's law where the file names none."""
    entry = FOLLOWER_LAWS.get(follower) if isinstance(follower, str) else None
    if entry is not None and entry.leader is not None:
        return entry.leader
    return "tracking" if reference else "passive"


GRAPHS = {
    "path": "agents in a line, each linked to the next",
    "ring": "a path whose ends are linked",
    "star": "every agent linked to agent 0",
    "complete": "every agent linked to every other",
    "grid": "rows and columns, linked to the nearest four",
    "geometric": "random points of the unit square, linked within a radius",
}

FORMATIONS = {
    "triangle": "three agents in a triangle behind the leader",
    "line": "agents in a straight line",
    "wedge": "two arms behind the leader",
    "circle": "agents on a circle around the leader",
    "grid": "rows and columns",
}

MOTIONS = {
    "rotate": "the shape turns",
    "scale": "the shape grows and shrinks",
    "reshape": "agents move to the places of another shape",
    "python": "a class of yours",
}
ASSIGNMENTS = ("number", "nearest")
"""Of agents to places."""

INTEGRATORS = {
    "rk4": "classical Runge-Kutta of order 4, input held over the step",
    "euler": "x + dt (f + g u)",
    "printed": "literal: Algorithm 1 as printed, x <- f + g u, no dt",
}


def families() -> dict[str, dict[str, str]]:
    """Return all names, each with its summary, under the titles of their families."""
    classes = {
        "models": MODELS,
        "references": REFERENCES,
        "leader laws": LEADER_LAWS,
        "follower laws": FOLLOWER_LAWS,
        "gain methods": METHODS,
    }
    summaries = {
        title: {name: entry.summary for name, entry in entries.items()}
        for title, entries in classes.items()
    }
    texts = {"graphs": GRAPHS, "formations": FORMATIONS, "integrators": INTEGRATORS}
    return summaries | {title: dict(entries) for title, entries in texts.items()}
