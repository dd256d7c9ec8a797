"""The optimization-based method of arXiv 2301.05841 on planar quadrotors, printed and repaired.

An agent plans its whole flight off-line and open loop, with the plans of the neighbours before it
in the graph. The printed problem has three errors, each of which can be repaired. The distance term
beta (d - |G_i - G_j|) is linear, so the farther apart the better; the terminal cost x(T)' P x(T)
pulls to the origin, wherever the path ends; and an open loop adds up the noise.
"""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from echelon.agents.models.planar_quadrotor import LinearPlanarQuadrotor
from echelon.agents.network.graph import Graph
from echelon.core.errors import PlanError
from echelon.core.types import Array, Input, Scalar, State
from echelon.simulation.optimal.problem import Constraint, OptimalControl, Stage, Terminal
from echelon.simulation.optimal.problem_check import check_choice
from echelon.simulation.optimal.solver import Trajectory, solve

TERMINALS = ("origin", "error", "none")
SEPARATIONS = ("linear", "penalty", "constraint")


@dataclasses.dataclass(frozen=True)
class PlanarBaseline:
    """The problem of the source; `literal()` as printed and `repaired()` as meant.

    Leader: min of the integral of u'Ru + (G - G_r)'Q(G - G_r) dt, plus the terminal cost, where
    G = (y, z), from rest at the reference's first point. Followers: Q = 0, and a term or constraint
    on the distance from each neighbour that planned before. R = Q = I_2 (R on physical inputs) and
    P = I_6. The reference is z = sin y, y from -pi to pi at constant speed. The noise on the roll
    acceleration has zero mean and enters linearly, so that the expectation of the leader's cost is
    the cost of the mean flight plus a constant, and the plan ignores it.

    Args:
        terminal: `origin` for x(T)'P x(T) as printed, `error` for P on the deviation from the
            reference's state (a follower's: on its velocity, roll and rate relative to its
            neighbours), `none`.
        separation: `linear` for beta (d - |G_i - G_j|) as printed, `penalty` for its square,
            `constraint` for |G_i - G_j| = d.
        model: of all agents.
        horizon, steps: T (s) and the grid of the trapezoidal rule.
        distance: d, m.
        beta: weight of the distance term of followers.
        noise: standard deviation of the roll acceleration, rad/s^2.

    Raises:
        PlanError: an option is unknown.
    """

    terminal: Literal["origin", "error", "none"] = "origin"
    separation: Literal["linear", "penalty", "constraint"] = "linear"
    model: LinearPlanarQuadrotor = LinearPlanarQuadrotor()
    horizon: float = 10.0
    steps: int = 100
    distance: float = 0.5
    beta: float = 1.0
    noise: float = 0.2

    def __post_init__(self) -> None:
        check_choice("terminal", self.terminal, TERMINALS)
        check_choice("separation", self.separation, SEPARATIONS)

    @classmethod
    def literal(cls, **changes: Any) -> "PlanarBaseline":
        """Return the problem as printed; `changes` replace fields."""
        return cls(**changes)

    @classmethod
    def repaired(cls, **changes: Any) -> "PlanarBaseline":
        """Return the problem with its distances as constraints and its last cost on the error."""
        return cls(**{"terminal": "error", "separation": "constraint", **changes})

    @property
    def reference(self) -> Array:
        """The leader's reference states on the grid, (steps + 1, 6)."""
        # The source gives the curve and T only; a constant speed along y is our assumption.
        speed = 2.0 * np.pi / self.horizon
        y = np.linspace(-np.pi, np.pi, self.steps + 1)
        zeros = np.zeros_like(y)
        rows = [y, zeros + speed, np.sin(y), speed * np.cos(y), zeros, zeros]
        return np.stack(rows, axis=1)

    def leader(self) -> OptimalControl:
        """Return the leader's problem; its parameters are the reference's state."""

        def stage(x: State, u: Input, p: jax.Array) -> Scalar:
            # (y, z) are states 0 and 2: Q is I on them, and R is I.
            return u @ u + jnp.sum((x - p)[0:3:2] ** 2)

        def terminal(x: State, p: jax.Array) -> Scalar:
            # 0 x is an array, so that all three are summed alike.
            return jnp.sum({"origin": x, "error": x - p, "none": 0.0 * x}[self.terminal] ** 2)

        return self._problem(stage, terminal, (), 6)

    def follower(self, neighbours: int) -> OptimalControl:
        """Return the problem of a follower; its parameters are its neighbours' states in a row."""
        # All but (y, z), since a distance does not fix the position relative to a neighbour.
        others = np.array([1, 3, 4, 5])

        def squared_distances(x: State, p: jax.Array) -> jax.Array:
            return jnp.sum((x[None, 0:3:2] - p.reshape(neighbours, 6)[:, 0:3:2]) ** 2, axis=1)

        def stage(x: State, u: Input, p: jax.Array) -> Scalar:
            if self.separation == "constraint":
                return u @ u
            gap = self.distance - jnp.sqrt(squared_distances(x, p))
            return u @ u + self.beta * jnp.sum(gap if self.separation == "linear" else gap**2)

        def terminal(x: State, p: jax.Array) -> Scalar:
            error = (x[None] - p.reshape(neighbours, 6))[:, others]
            return jnp.sum({"origin": x, "error": error, "none": 0.0 * x}[self.terminal] ** 2)

        # Squares, which have derivatives everywhere; a distance has none at zero.
        d = self.distance**2
        exact = (Constraint("squared distance", squared_distances, d, d),)
        constraints = exact if self.separation == "constraint" else ()
        return self._problem(stage, terminal, constraints, 6 * neighbours)

    def _problem(
        self, stage: Stage, terminal: Terminal, constraints: tuple[Constraint, ...], parameters: int
    ) -> OptimalControl:
        return OptimalControl(
            self.model,
            self.horizon,
            self.steps,
            stage,
            terminal,
            constraints,
            parameters=parameters,
            transcription="collocation",
        )

    def plans(self, graph: Graph, offsets: Array) -> tuple[Trajectory, ...]:
        """Return each agent's plan by IPOPT, planned outward from the leader.

        Args:
            graph: which agents know whose plans.
            offsets: (N, 2) starts relative to the leader's, all at rest.

        Raises:
            PlanError: the offsets do not fit the graph.
            MissingExtraError: casadi is not installed.
        """
        offsets = np.asarray(offsets, float)
        if offsets.shape != (graph.agents, 2):
            raise PlanError(
                f"`offsets` has shape {offsets.shape}, and {graph.agents} agents need "
                f"({graph.agents}, 2)."
            )
        starts = np.zeros((graph.agents, 6))
        starts[:, [0, 2]] = self.reference[0, [0, 2]] + offsets
        plans: dict[int, Trajectory] = {}
        for agent, earlier in graph.outward():
            if not earlier:
                plans[agent] = solve(self.leader(), starts[agent], self.reference)
                continue
            first = plans[earlier[0]]
            parameters = np.hstack([plans[j].states for j in earlier])
            # The guess, the first neighbour's plan shifted, meets all constraints but the distances
            # from other neighbours.
            guess = first.states + starts[agent] - starts[earlier[0]], first.inputs
            plans[agent] = solve(
                self.follower(len(earlier)), starts[agent], parameters, guess=guess
            )
        return tuple(plans[agent] for agent in range(graph.agents))

    def tracking_rmse(self, states: Array) -> float:
        """Return the root-mean-square distance of a leader's states (N, 6) from the reference."""
        return float(np.sqrt(((states - self.reference)[:, [0, 2]] ** 2).sum(axis=1).mean()))

    def with_noise(self, plan: Trajectory, seed: int) -> Array:
        """Return the states (steps + 1, 6) of a plan flown open loop under the noise.

        The roll acceleration is drawn anew at each step and held over it. The agent is linear, so
        what the noise adds to the plan does not depend on the plan.
        """
        # yddot = -g phi, phiddot = w: with w as a seventh, constant state the step is exact.
        flow = np.zeros((7, 7))
        flow[0, 1] = flow[2, 3] = flow[4, 5] = flow[5, 6] = 1.0
        flow[1, 4] = -self.model.gravity
        step = scipy.linalg.expm(flow * self.horizon / self.steps)
        added = np.zeros((self.steps + 1, 6))
        draws = np.random.default_rng(seed).normal(0.0, self.noise, self.steps)
        for k, w in enumerate(draws):
            added[k + 1] = (step @ np.append(added[k], w))[:6]
        return plan.states + added
