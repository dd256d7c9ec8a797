"""Bad input from Python: each fault has its sentence, and none passes or fails in another way."""

from typing import Any

import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from runs import simulate

from echelon.agents.models import (
    DoubleIntegrator,
    Linear,
    Pendulum,
    PlanarQuadrotor,
    PrintedQuadrotor,
    Quadrotor,
    SingleIntegrator,
    Unicycle,
    UnicyclePoint,
    VanDerPol,
)
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.references import (
    Circle,
    FigureEight,
    Hover,
    Lemniscate,
    Line,
    Reference,
    Waypoints,
)
from echelon.agents.world.disturbance import Disturbance
from echelon.core.errors import (
    EchelonError,
    FormationError,
    GainError,
    GraphError,
    LawError,
    ModelError,
    ReferenceError,
    ScenarioError,
    SimulationError,
)
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.build import run as run_scenario
from echelon.laws import Agreement, Consensus, Tracking, TrimInput
from echelon.synthesis.gains import Feedback, FixedGain, InnerLoop, Method, Riccati, RobustLQR
from echelon.synthesis.gains.gain import synthesize

NAN, INF = float("nan"), float("inf")
QUAD, CART, ONE = Quadrotor(), DoubleIntegrator(1), SingleIntegrator(1)
PAIR, PATH = Graph.path(2), Graph.path(4)


def run(model=ONE, graph=PAIR, **options):
    """A run of two single integrators, spoiled by what is given."""
    parts = {
        "leader": TrimInput(),
        "follower": TrimInput(),
        "horizon": 1.0,
        "dt": 0.1,
        "formation": Formation(np.zeros((graph.agents, len(model.state_names)))),
    } | options
    formation = parts.pop("formation")
    return simulate(model, graph, formation, **parts)


def gain_of(model, graph=PAIR, **options):
    return synthesize(model, graph, FixedGain(**options))


class Own(Method):
    """A gain method that returns what it is told."""

    found: Any
    name = "own"

    def feedback(self, model, linear):
        return self.found


class Flat(Reference):
    """A reference in the plane alone."""

    def __call__(self, t):
        return jnp.stack([t, t])


class HalfFlat(SingleIntegrator):
    """An agent whose flatness map forgets the input."""

    dimension: int = 1

    def flat(self, derivatives):
        return derivatives[0]


class LongFlat(HalfFlat):
    """An agent whose flatness map is another agent's."""

    def flat(self, derivatives):
        return jnp.zeros(2), derivatives[1]


# What is done -> the kind of error, and the whole sentence.
GRAPHS = {
    "follower without a path": (
        lambda: Graph.from_edges([(0, 1), (2, 3)]),
        "the graph is disconnected: agents 2, 3 have no path to a leader (leader 0).",
    ),
    "one lonely agent": (
        lambda: Graph.from_edges([(0, 1), (1, 2)], agents=4),
        "the graph is disconnected: agent 3 has no path to a leader (leader 0).",
    ),
    "many lonely agents": (
        lambda: Graph.from_edges([(0, 1)], agents=20, leaders=[0, 1]),
        "the graph is disconnected: agents 2, 3, 4, 5, 6, 7, 8, 9, ... have no path to a leader "
        "(leaders 0, 1).",
    ),
    "two parts with a leader each": (
        lambda: Graph.from_edges([(0, 1), (2, 3)], leaders=[0, 2]),
        "the graph is disconnected: agents 2, 3 have no path to agent 0.",
    ),
    "self-loop": (
        lambda: Graph.from_edges([(0, 1), (1, 1)]),
        "edge [1, 1] links agent 1 to itself, and an edge must link two agents.",
    ),
    "repeated edge": (
        lambda: Graph.from_edges([(0, 1), (1, 2), (1, 0)]),
        "edge [0, 1] is given twice, and may be given once.",
    ),
    "edge out of range": (
        lambda: Graph.from_edges([(0, 1), (1, 4)], agents=3),
        "an edge names agent 4, and with 3 agents the last is 2.",
    ),
    "negative agent": (
        lambda: Graph.from_edges([(0, 1), (1, -1)]),
        "an edge is [1, -1], and agents are whole numbers from 0 to 1.",
    ),
    "half an agent": (
        lambda: Graph.from_edges([(0, 1), (1, 1.5)]),
        "an edge is [1, 1.5], and agents are whole numbers from 0 on.",
    ),
    "negative weight": (
        lambda: Graph.from_edges([(0, 1, -0.5)]),
        "the weight of edge [0, 1] is -0.5, and must be positive and finite.",
    ),
    "zero weight": (
        lambda: Graph.from_edges([(0, 1, 0)]),
        "the weight of edge [0, 1] is 0, and must be positive and finite.",
    ),
    "NaN weight": (
        lambda: Graph.from_edges([(0, 1, NAN)]),
        "the weight of edge [0, 1] is nan, and must be positive and finite.",
    ),
    "infinite weight": (
        lambda: Graph.from_edges([(0, 1, INF)]),
        "the weight of edge [0, 1] is inf, and must be positive and finite.",
    ),
    "edge of four": (
        lambda: Graph.from_edges([(0, 1, 2, 3)]),
        "an edge is [0, 1, 2, 3], and must be [i, j] or [i, j, weight].",
    ),
    "edge of one": (
        lambda: Graph.from_edges([(0,)]),
        "an edge is [0], and must be [i, j] or [i, j, weight].",
    ),
    "no leader": (
        lambda: Graph.path(3, leaders=[]),
        "the graph has no leader; name at least one agent in `leaders`.",
    ),
    "unknown leader": (
        lambda: Graph.path(3, leaders=[3]),
        "leader 3 is no agent; agents are numbered from 0 to 2.",
    ),
    "nothing but leaders": (
        lambda: Graph.path(2, leaders=[0, 1]),
        "all 2 agents are leaders, and at least one must follow.",
    ),
    "no edges": (
        lambda: Graph.from_edges([]),
        "a graph needs at least 2 agents, and has 1.",
    ),
    "a path of one": (
        lambda: Graph.path(1),
        "a path needs at least 2 agents, and has 1.",
    ),
    "a ring of two": (
        lambda: Graph.ring(2),
        "a ring needs at least 3 agents, and has 2.",
    ),
    "an empty grid": (
        lambda: Graph.grid(0, 5),
        "a grid needs at least 2 agents, and has 0.",
    ),
    "points too far apart": (
        lambda: Graph.geometric(3, 1e-6),
        "the graph is disconnected: agents 1, 2 have no path to a leader (leader 0); a `radius` of "
        "0.667 connects these points, and another `seed` draws others.",
    ),
    "a leader that is no list": (
        lambda: Graph.ring(4, leaders=0),
        "`leaders` is 0, and must be a list of agents, such as [0].",
    ),
    "leaders by name": (
        lambda: Graph.ring(4, leaders="0"),
        "`leaders` is '0', and must be a list of agents, such as [0].",
    ),
    "weights that rounding cannot tell apart": (
        lambda: Graph.from_edges([(0, 1, 1e-300), (1, 2)]).spectrum(),
        "the weights of the graph range from 1e-300 to 1, too far apart to distinguish the "
        "smallest eigenvalue from 0; choose weights of similar size.",
    ),
    "edges for a graph": (
        lambda: synthesize(CART, [(0, 1)], Riccati()),
        "`graph` is a `list`, and must be a `Graph`.",
    ),
    "directed networkx graph that nobody leads": (
        lambda: Graph.from_networkx(nx.DiGraph([(1, 0), (1, 2)])),
        "the graph leaves agents behind: agents 1, 2 have no path to a leader (leader 0) along its "
        "arrows; an edge [i, j] lets j receive from i, so add one, or reverse one.",
    ),
    "networkx graph with names": (
        lambda: Graph.from_networkx(nx.Graph([("a", "b")])),
        "the nodes of the networkx graph must be the whole numbers from 0 on, without a gap.",
    ),
}

FORMATIONS = {
    "unknown agent": (
        lambda: Formation.from_offsets(QUAD, PATH, {4: (1, 0, 0)}),
        "an offset is given for agent 4, and agents are numbered from 0 to 3.",
    ),
    "wrong length": (
        lambda: Formation.from_offsets(QUAD, PATH, {1: (1, 0)}),
        "the offset of agent 1 has 2 numbers, and must have 3 (position) or 12 (all states).",
    ),
    "wrong length without a position": (
        lambda: Formation.from_offsets(VanDerPol(), PATH, {1: (1, 0, 0)}),
        "the offset of agent 1 has 3 numbers, and must have 2 (all states).",
    ),
    "a list of offsets": (
        lambda: Formation.from_offsets(QUAD, PATH, [[0, 0]]),
        "the offsets are a `list`, and must be a mapping from agents to offsets, such as "
        "{1: (1.0, 0.0)}; a whole matrix is `Formation(offsets)`.",
    ),
    "NaN in an offset": (
        lambda: Formation.from_offsets(QUAD, PATH, {1: (1, NAN, 0)}),
        "the offset of agent 1 is [1.0, nan, 0.0], and must be finite.",
    ),
    "offsets that are no matrix": (
        lambda: Formation([1.0, 2.0]),
        "formation offsets must be a matrix of finite numbers (agents, states), and have shape "
        "(2,).",
    ),
    "no spacing": (
        lambda: Formation.triangle(QUAD, PATH, spacing=0.0),
        "the spacing of a formation is 0.0, and must be positive and finite.",
    ),
    "NaN spacing": (
        lambda: Formation.circle(QUAD, PATH, spacing=NAN),
        "the spacing of a formation is nan, and must be positive and finite.",
    ),
    "drawn without a position": (
        lambda: Formation.wedge(VanDerPol(), PATH),
        "`VanDerPol` has no position, so a geometric formation has no meaning; give `offsets`.",
    ),
}

MODELS = {
    "no mass": (
        lambda: Quadrotor(mass=0.0),
        "`mass` of `Quadrotor` is 0.0, and must be a positive finite number.",
    ),
    "negative mass": (
        lambda: PlanarQuadrotor(mass=-1.0),
        "`mass` of `PlanarQuadrotor` is -1.0, and must be a positive finite number.",
    ),
    "NaN gravity": (
        lambda: Quadrotor(gravity=NAN),
        "`gravity` of `Quadrotor` is nan, and must be a positive finite number.",
    ),
    "infinite arm": (
        lambda: Quadrotor(arm=INF),
        "`arm` of `Quadrotor` is inf, and must be a positive finite number.",
    ),
    "NaN inertia": (
        lambda: Quadrotor(inertia=(1e-6, NAN, 1e-6)),
        "`inertia[1]` of `Quadrotor` is nan, and must be a positive finite number.",
    ),
    "negative inertia": (
        lambda: PrintedQuadrotor(inertia=(1e-6, 1e-6, -1e-6)),
        "`inertia[2]` of `PrintedQuadrotor` is -1e-06, and must be a positive finite number.",
    ),
    "impossible inertia": (
        lambda: Quadrotor(inertia=(1.0, 2.0, 4.0)),
        "`inertia` is (1.0, 2.0, 4.0) kg m^2, and no rigid body has that: Izz = 4 exceeds the sum "
        "of the other two, 3; use the identified values `crazyflie`, or set `allow_unphysical` to "
        "keep it.",
    ),
    "unknown parameters": (
        lambda: Quadrotor.named("crazyfly"),
        "parameters `crazyfly` are unknown for `Quadrotor`, allowed are `crazyflie`, "
        "`crazyflie-2.1+`, `crazyflie-legacy`, `crazyflie-thrust-kit`, `paper` (did you mean "
        "`crazyflie`?).",
    ),
    "no dimension": (
        lambda: SingleIntegrator(0),
        "`dimension` of `SingleIntegrator` is 0, and must be a whole number of at least 1.",
    ),
    "half a dimension": (
        lambda: DoubleIntegrator(1.5),
        "`dimension` of `DoubleIntegrator` is 1.5, and must be a whole number of at least 1.",
    ),
    "negative drag": (
        lambda: DoubleIntegrator(2, drag=-0.1),
        "`drag` of `DoubleIntegrator` is -0.1, and must be finite and not negative.",
    ),
    "NaN damping": (
        lambda: VanDerPol(NAN),
        "`damping` of `VanDerPol` is nan, and must be finite and not negative.",
    ),
    "negative damping": (
        lambda: Pendulum(damping=-1.0),
        "`damping` of `Pendulum` is -1.0, and must be finite and not negative.",
    ),
    "no stiffness": (
        lambda: Pendulum(stiffness=0),
        "`stiffness` of `Pendulum` is 0, and must be a positive finite number.",
    ),
    "a point on the axle": (
        lambda: UnicyclePoint(ahead=0.0),
        "`ahead` of `UnicyclePoint` is 0.0, and must be a positive finite number.",
    ),
    "matrices that do not fit": (
        lambda: Linear([[1.0, 0.0], [0.0, 1.0]], [[1.0]]),
        "the shapes of `Linear` are A (2, 2), B (1, 1), C (2, 2) with 2 names, and must be "
        "A (n, n), B (n, m), C (q, n) with n names.",
    ),
    "a matrix with NaN": (
        lambda: Linear([[NAN]], [[1.0]]),
        "`A` of `Linear` must be a matrix of finite numbers, and has shape (1, 1).",
    ),
    "a matrix of words": (
        lambda: Linear([["fast"]], [[1.0]]),
        "`A` of `Linear` is [['fast']], and must be a list of rows of numbers.",
    ),
}

REFERENCES = {
    "NaN rate": (
        lambda: Lemniscate(rate=NAN),
        "`rate` of `Lemniscate` is nan, and must be a finite number.",
    ),
    "center in the plane": (
        lambda: FigureEight(center=(1.0, 2.0)),
        "`center` of `FigureEight` is (1.0, 2.0), and must be 3 finite numbers.",
    ),
    "one amplitude": (
        lambda: Lemniscate(amplitude=(1.0,)),
        "`amplitude` of `Lemniscate` is (1.0,), and must be 2 finite numbers.",
    ),
    "infinite radius": (
        lambda: Circle(radius=INF),
        "`radius` of `Circle` is inf, and must be a finite number.",
    ),
    "a velocity of words": (
        lambda: Line(velocity=("fast", 0, 0)),
        "`velocity` of `Line` is ('fast', 0, 0), and must be 3 finite numbers.",
    ),
    "NaN position": (
        lambda: Hover(position=(0.0, NAN, 1.0)),
        "`position` of `Hover` is (0.0, nan, 1.0), and must be 3 finite numbers.",
    ),
    "a radius of text": (
        lambda: Circle(radius="1"),
        "`radius` of `Circle` is 1, and must be a finite number.",
    ),
    "a yaw that is true": (
        lambda: Hover(yaw=True),
        "`yaw` of `Hover` is True, and must be a finite number.",
    ),
    "a radius of more digits than NumPy has": (
        lambda: Circle(radius=10**23),
        "`radius` of `Circle` is 100000000000000000000000, and must be a finite number.",
    ),
    "times of words": (
        lambda: Waypoints(["0", "1"], [[0, 0, 0]] * 2),
        "`times` of `Waypoints` is ['0', '1'], and must be at least 2 increasing times.",
    ),
    "points of different lengths": (
        lambda: Waypoints([0.0, 1.0], [[0, 0, 0], [1, 1]]),
        "`points` of `Waypoints` is [[0, 0, 0], [1, 1]], and must be 2 finite points (x, y, z).",
    ),
    "a function for a reference": (
        lambda: Tracking(lambda t: t),
        "`reference` is a `function`, and must be a `Reference`.",
    ),
    "nothing for a reference": (
        lambda: Tracking(None),
        "`reference` is a `NoneType`, and must be a `Reference`.",
    ),
    "a reference of two coordinates": (
        lambda: run(leader=Tracking(Flat())),
        "the point of `Flat` has shape (2,), and must have shape (4,).",
    ),
    "times that stand": (
        lambda: Waypoints([0.0, 1.0, 1.0], [[0, 0, 0]] * 3),
        "`times` of `Waypoints` is [0.0, 1.0, 1.0], and must be at least 2 increasing times.",
    ),
    "one waypoint": (
        lambda: Waypoints([0.0], [[0, 0, 0]]),
        "`times` of `Waypoints` is [0.0], and must be at least 2 increasing times.",
    ),
    "a point too few": (
        lambda: Waypoints([0.0, 1.0], [[0, 0, 0]]),
        "`points` of `Waypoints` has shape (1, 3), and must be 2 finite points (x, y, z).",
    ),
}

GAINS = {
    "P that is not symmetric": (
        lambda: gain_of(CART, P=[[1.0, 0.5], [0.0, 1.0]]),
        "`P` is not symmetric: entry [0, 1] is 0.5 and entry [1, 0] is 0.",
    ),
    "P that is not definite": (
        lambda: gain_of(CART, P=[[1.0, 2.0], [2.0, 1.0]]),
        "`P` is not positive definite: its smallest eigenvalue is -1.",
    ),
    "P of zeros": (
        lambda: gain_of(CART, P=[0.0, 1.0]),
        "`P` is not positive definite: its smallest eigenvalue is 0.",
    ),
    "NaN in P": (
        lambda: gain_of(CART, P=[1.0, NAN]),
        "`P` holds a number that is not finite.",
    ),
    "P of another size": (
        lambda: gain_of(CART, P=np.eye(3)),
        "`P` has shape (3, 3), and must be 2 numbers or 2 x 2.",
    ),
    "P by a wrong name": (
        lambda: gain_of(CART, P="identiy"),
        "`P` is `identiy`, and must be a matrix, a diagonal or `identity`.",
    ),
    "a method without a result": (
        lambda: synthesize(CART, PAIR, Own(None)),
        "`feedback` of `Own` returns a `NoneType`, and must return a `Feedback`.",
    ),
    "a method that returns a matrix": (
        lambda: synthesize(CART, PAIR, Own(np.eye(2))),
        "`feedback` of `Own` returns a `ndarray`, and must return a `Feedback`.",
    ),
    "a method with a P of another size": (
        lambda: synthesize(CART, PAIR, Own(Feedback(np.eye(3), np.eye(1), 1.0))),
        "`P` that `feedback` of `Own` returns has shape (3, 3), and must have shape (2, 2).",
    ),
    "a method with a negative strength": (
        lambda: synthesize(CART, PAIR, Own(Feedback(np.eye(2), np.eye(1), -1.0))),
        "`rho` that `feedback` of `Own` returns is -1.0, and must be finite and not negative.",
    ),
    "a coupling beyond numbers": (
        lambda: synthesize(CART, PAIR, Riccati(coupling=1e308)),
        "the feedback is too strong to compute with: the coupling times the graph's largest "
        "eigenvalue is 1e+308, P goes up to 1.73; make `coupling`, the edges' weights or P "
        "smaller.",
    ),
    "a weight beyond numbers": (
        lambda: synthesize(CART, PAIR, Riccati(Q=[1.0, 1e155])),
        "`Q` goes up to 1e+155, and must stay below 1e+75.",
    ),
    "a P beyond numbers": (
        lambda: gain_of(CART, P=[1.0, 1e155]),
        "`P` goes up to 1e+155, and must stay below 1e+75.",
    ),
    "weights of other states": (
        lambda: synthesize(DoubleIntegrator(2), PAIR, InnerLoop(symmetry_weight=(1, 2, 3))),
        "`symmetry_weight` is (1, 2, 3), and must be one positive number, or 2, one for each "
        "symmetric state.",
    ),
    "a domain of three numbers": (
        lambda: synthesize(CART, PAIR, RobustLQR(domain={"position": (0, 1, 2)})),
        "the domain of `position` is (0, 1, 2), and must be a half-width or a pair "
        "`[lower, upper]`.",
    ),
    "a domain of words": (
        lambda: synthesize(CART, PAIR, RobustLQR(domain={"position": "wide"})),
        "the domain of `position` is wide, and must be a half-width or a pair `[lower, upper]`.",
    ),
    "negative R": (
        lambda: gain_of(CART, R=[-1.0]),
        "`R` is not positive definite: its smallest eigenvalue is -1.",
    ),
    "ragged R": (
        lambda: gain_of(CART, R=[[1.0], [1.0, 2.0]]),
        "`R` is [[1.0], [1.0, 2.0]], and must be 1 numbers or 1 x 1.",
    ),
    "no coupling": (
        lambda: gain_of(CART, coupling=0.0),
        "`coupling` is 0.0, and must be positive and finite.",
    ),
    "NaN coupling": (
        lambda: gain_of(CART, coupling=NAN),
        "`coupling` is nan, and must be positive and finite.",
    ),
    "infinite coupling": (
        lambda: synthesize(CART, PAIR, Riccati(coupling=INF)),
        "`coupling` is inf, and must be positive and finite.",
    ),
    "negative coupling": (
        lambda: synthesize(CART, PAIR, Riccati(coupling=-1.0)),
        "`coupling` is -1.0, and must be positive and finite.",
    ),
    "indefinite Q": (
        lambda: synthesize(CART, PAIR, Riccati(Q=[1.0, -1.0])),
        "`Q` is not positive semidefinite: its smallest eigenvalue is -1.",
    ),
    "NaN in Q": (
        lambda: synthesize(CART, PAIR, Riccati(Q=[1.0, NAN])),
        "`Q` must be a symmetric matrix of finite numbers.",
    ),
    "lopsided Q": (
        lambda: synthesize(CART, PAIR, Riccati(Q=[[1.0, 0.5], [0.0, 1.0]])),
        "`Q` must be a symmetric matrix of finite numbers.",
    ),
    "Q beyond all numbers": (
        lambda: synthesize(CART, PAIR, Riccati(Q=[1.0, np.inf])),
        "`Q` must be a symmetric matrix of finite numbers.",
    ),
    "Q of another size": (
        lambda: synthesize(CART, PAIR, Riccati(Q=[1.0, 1.0, 1.0])),
        "`Q` has shape (3,), and must be 2 numbers or 2 x 2.",
    ),
    "a pair that cannot be stabilized": (
        lambda: synthesize(Linear([[0.3]], [[0.0]], names=["heat"]), PAIR, Riccati()),
        "the linearization of `Linear` at its trim cannot be stabilized: no input moves the mode "
        "at 0.3 1/s, which lies along `heat`; give the gain yourself (method `given`) or "
        "choose another model of the vehicle.",
    ),
}

LAWS = {
    "unknown feed-forward": (
        lambda: Consensus(gain_of(CART), feedforward="relai"),
        "`feedforward` is `relai`, allowed are `none`, `relay`, `relay-velocity`, `parent` "
        "(did you mean `relay`?).",
    ),
    "a gain for another model": (
        lambda: run(follower=Consensus(gain_of(CART))),
        "the gain of `Consensus` has P (2, 2) and R (1, 1), and `SingleIntegrator` needs "
        "P (1, 1) and R (1, 1).",
    ),
    "a tracking gain for another model": (
        lambda: run(leader=Tracking(Hover(), gain_of(CART))),
        "the gain of `Tracking` has P (2, 2) and R (1, 1), and `SingleIntegrator` needs P (1, 1) "
        "and R (1, 1).",
    ),
    "agreement of other agents": (
        lambda: run(CART, follower=Agreement()),
        "the law `agreement` is made for `SingleIntegrator`, and the model is "
        "`DoubleIntegrator`; use `consensus`.",
    ),
    "a flat map that returns a state alone": (
        lambda: run(HalfFlat(), leader=Tracking(Hover())),
        "`flat` of `HalfFlat` must return a pair, a state and an input.",
    ),
    "a flat map of another state": (
        lambda: run(LongFlat(), leader=Tracking(Hover())),
        "the state that `flat` of `LongFlat` makes has shape (2,), and must have shape (1,).",
    ),
    "tracking without a flat map": (
        lambda: run(Pendulum(), leader=Tracking(Hover())),
        "`Pendulum` cannot be led along a reference, since it defines no `flat` map; add "
        "`flat_outputs`, `flat_order` and `flat` to it, give its states and inputs over time "
        "(`states`), or use the law `passive`.",
    ),
}

SIMULATIONS = {
    "no step": (
        lambda: run(dt=0.0),
        "`dt` is 0.0, and must be a positive finite number of seconds.",
    ),
    "negative step": (
        lambda: run(dt=-0.1),
        "`dt` is -0.1, and must be a positive finite number of seconds.",
    ),
    "NaN step": (
        lambda: run(dt=NAN),
        "`dt` is nan, and must be a positive finite number of seconds.",
    ),
    "a horizon of text": (
        lambda: run(horizon="1"),
        "`horizon` is 1, and must be a positive finite number of seconds.",
    ),
    "limits by word": (
        lambda: run(limits="no"),
        "`limits` is 'no', and must be True or False.",
    ),
    "infinite horizon": (
        lambda: run(horizon=INF),
        "`horizon` is inf, and must be a positive finite number of seconds.",
    ),
    "horizon below the step": (
        lambda: run(horizon=0.05),
        "`horizon` is 0.05 s, and must be at least one step `dt` = 0.1 s.",
    ),
    "unknown integrator": (
        lambda: run(integrator="rk5"),
        "`integrator` is `rk5`, allowed are `rk4`, `euler`, `printed` (did you mean `rk4`?).",
    ),
    "no frames": (
        lambda: run(store_every=0),
        "`store_every` is 0, and must be a whole number from 1 on.",
    ),
    "frames that are no number": (
        lambda: run(store_every=NAN),
        "`store_every` is nan, and must be a whole number from 1 on.",
    ),
    "a seed with a decimal point": (
        lambda: run(seed=2.0),
        "`seed` is 2.0, and must be a whole number from 0 on.",
    ),
    "unknown precision": (
        lambda: run(precision="float16"),
        "`precision` is `float16`, allowed are `float64`, `float32` (did you mean `float64`?).",
    ),
    "a formation of others": (
        lambda: run(formation=Formation(np.zeros((3, 1)))),
        "the formation has offsets (3, 1), and 2 agents with 1 states need (2, 1).",
    ),
    "negative spread": (
        lambda: run(initial={"x": -1.0}),
        "an initial spread is -1.0, and must not be negative.",
    ),
    "NaN spread": (
        lambda: run(initial={"x": NAN}),
        "the initial spread of `x` is nan, and must be finite.",
    ),
    "infinite start error": (
        lambda: run(start_error={"x": INF}),
        "the start error of `x` is inf, and must be finite.",
    ),
    "states of another shape": (
        lambda: run(initial=np.zeros((3, 1))),
        "initial states have shape (3, 1), and must be finite with shape (2, 1) (agents, states).",
    ),
    "NaN states": (
        lambda: run(initial=np.array([[0.0], [NAN]])),
        "initial states have shape (2, 1), and must be finite with shape (2, 1) (agents, states).",
    ),
    "a state of another length": (
        lambda: run(initial={1: [0.0, 1.0]}),
        "the initial state of agent 1 has shape (2,), and must be finite with shape (1,) "
        "(states,).",
    ),
    "a state of nobody": (
        lambda: run(initial={2: [0.0]}),
        "an initial state is given for agent 2, and agents are numbered from 0 to 1.",
    ),
}

TABLES = {
    GraphError: GRAPHS,
    FormationError: FORMATIONS,
    ModelError: MODELS,
    ReferenceError: REFERENCES,
    GainError: GAINS,
    LawError: LAWS,
    SimulationError: SIMULATIONS,
}
CASES = [
    pytest.param(kind, *case, id=f"{kind.__name__}: {name}")
    for kind, table in TABLES.items()
    for name, case in table.items()
]


@pytest.mark.parametrize(("kind", "act", "sentence"), CASES)
def test_each_fault_has_its_sentence(kind, act, sentence):
    with pytest.raises(EchelonError) as caught:
        act()
    said = str(caught.value)
    assert said == sentence
    assert type(caught.value) is kind and caught.value.exit_code == 2
    # whole, and one
    assert said.endswith(".") and "\n" not in said
    assert ". " not in said.replace("...", "") and said.count("`") % 2 == 0


def test_spreads_and_errors_name_states_and_groups():
    for option in ("initial", "start_error"):
        with pytest.raises(ModelError) as caught:
            run(**{option: {"positon": 1.0}})
        assert str(caught.value) == (
            "`positon` is no state or group of `SingleIntegrator`, which has `position`, `x` "
            "(did you mean `position`?)."
        )


# Faults that a first user makes: each must be refused by echelon itself, naming what was got.
REFUSED = {
    "NaN agent": (lambda: Graph.from_edges([(0, 1), (1, NAN)]), "nan"),
    "infinite agent": (lambda: Graph.from_edges([(0, 1), (1, INF)]), "inf"),
    "named agents": (lambda: Graph.from_edges([("a", "b")]), "a"),
    "half a leader": (lambda: Graph.path(3, leaders=[0.5]), "0.5"),
    "NaN leader": (lambda: Graph.path(3, leaders=[NAN]), "nan"),
    "an offset for a name": (lambda: Formation.from_offsets(QUAD, PATH, {"1": (1, 0, 0)}), "1"),
    "a grid of negative columns": (lambda: Formation.grid(QUAD, PATH, columns=-1), "-1"),
    "two moments of inertia": (lambda: Quadrotor(inertia=(1e-5, 1e-5)), "`inertia`"),
    "an agent without inputs": (
        lambda: synthesize(Linear([[1.0]], [[]]), PAIR, Riccati()),
        "`Linear`",
    ),
    "a path that a vehicle cannot follow": (
        lambda: run(
            Unicycle(), leader=Tracking(Hover(), synthesize(Unicycle(), PAIR, FixedGain()))
        ),
        "`Hover`",
    ),
    "a negative seed": (lambda: run(seed=-1, initial={"x": 1.0}), "`seed`"),
    "half a frame": (lambda: run(store_every=2.5), "`store_every`"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_work_is_refused_in_one_sentence(name):
    act, fragment = REFUSED[name]
    with pytest.raises(EchelonError) as caught:
        act()
    sentence = str(caught.value)
    assert fragment in sentence
    assert sentence.endswith(".") and "\n" not in sentence


def test_rigidity_has_no_meaning_without_a_position():
    formation = Formation.from_offsets(Pendulum(), PATH, {})
    with pytest.raises(FormationError, match="has no position"):
        formation.is_rigid(Pendulum(), PATH)


def test_nothing_is_lost_by_a_refusal():
    graph, start = Graph.path(2), np.array([[0.0], [NAN]])
    with pytest.raises(SimulationError):
        run(graph=graph, initial=start)
    start[1] = 1.0
    again = run(graph=graph, initial=start)
    assert again.states[-1].tolist() == [[0.0], [1.0]]


def test_a_disturbance_that_outlasts_every_run_is_one_draw():
    winds = [Disturbance(rms={"x": 1.0}, hold=hold) for hold in (1.0, 1e308)]
    short, long = (run(horizon=0.5, disturbance=wind) for wind in winds)
    assert np.array_equal(short.states, long.states)


@pytest.mark.parametrize("verb", [build, run_scenario])
def test_a_name_is_no_scenario(verb):
    with pytest.raises(ScenarioError) as caught:
        verb("paper")
    assert str(caught.value) == (
        "`scenario` is 'paper', and must be a `Scenario`, as `load_scenario` returns it."
    )
