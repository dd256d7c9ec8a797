"""Plans for a whole formation: agents plan in the order of the graph, after their neighbours."""

import time
from collections.abc import Callable
from typing import NamedTuple, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.tree import shares
from echelon.agents.references.flatness import (
    Targets,
    mean_targets,
    reference_targets,
    shifted_targets,
)
from echelon.agents.references.guide import Guide
from echelon.core.errors import PlanError
from echelon.core.types import Array
from echelon.simulation.optimal.objectives import (
    PlanTimes,
    TrackingOptions,
    coarse,
    spacing,
    tracking,
)
from echelon.simulation.optimal.problem import OptimalControl
from echelon.simulation.optimal.solver import Solver, Trajectory

_EASIER = (1e2, 1e4)
"""Factors on the input weight of the problems that lead to one that its solver fails on."""

_PATIENCE = {"ipopt.max_iter": 300}
"""A problem that takes more iterations is better begun elsewhere."""

_RESUMED = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-6,
    "ipopt.warm_start_bound_push": 1e-9,
    "ipopt.warm_start_bound_frac": 1e-9,
    "ipopt.warm_start_slack_bound_push": 1e-9,
    "ipopt.warm_start_slack_bound_frac": 1e-9,
    "ipopt.warm_start_mult_bound_push": 1e-9,
}
"""What makes IPOPT go on from a solution instead of first leaving its limits."""


class FormationPlan(NamedTuple):
    """The plans of all agents, by agent, and what making them took.

    Attributes:
        grid: the times.
        plans: one for each agent; states on the grid and inputs held between.
        seconds: of solving, for each agent.
        iterations: of the solver, for each agent.
        failures: how many solutions failed on the way, each followed by another attempt.
        setup_seconds: of making the solvers ready.
    """

    grid: PlanTimes
    plans: tuple[Trajectory, ...]
    seconds: tuple[float, ...]
    iterations: tuple[int, ...]
    failures: int
    setup_seconds: float


def plan_formation(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    states: Array,
    grid: PlanTimes,
    *,
    reference: Guide | None,
    planning: TrackingOptions,
    limits: bool,
) -> FormationPlan:
    """Return the plans of all agents from their states (N, n), leaders first.

    A follower plans given the plans of its neighbours that come before it, breadth first from the
    leaders. A leader without a reference keeps its trim.

    Raises:
        PlanError: an agent's plan misses a constraint, with which and by how much.
        MissingExtraError: casadi is not installed.
    """
    targets = reference_targets(model, reference, grid.times)
    desk = _Desk(model, planning, grid, limits)
    plans: dict[int, Trajectory] = {}
    for agent, earlier in graph.outward():
        if not earlier:
            goals = shifted_targets(model, targets, formation.offsets[agent])
            plans[agent] = desk.follow(agent, states[agent], goals)
            continue
        goals = _neighbour_targets(model, graph, formation, agent, {j: plans[j] for j in earlier})
        if planning.specification == "offset":
            plans[agent] = desk.follow(agent, states[agent], goals)
        else:
            neighbours = [plans[j].states for j in earlier]
            displacements = [formation.displacement(j, agent) for j in earlier]
            plans[agent] = desk.keep_apart(agent, states[agent], goals, neighbours, displacements)
    order = range(graph.agents)
    return FormationPlan(
        grid,
        tuple(plans[agent] for agent in order),
        tuple(desk.seconds[agent] for agent in order),
        tuple(desk.iterations[agent] for agent in order),
        desk.failures,
        desk.setup_seconds,
    )


def plan_tracking(
    model: ControlAffine,
    start: Array,
    targets: Targets,
    grid: PlanTimes,
    planning: TrackingOptions,
    limits: bool,
) -> Trajectory:
    """Return the plan of one agent that follows targets.

    Raises:
        PlanError: it misses a constraint, with which and by how much.
        MissingExtraError: casadi is not installed.
    """
    return _Desk(model, planning, grid, limits).follow(0, start, targets)


def _neighbour_targets(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    agent: int,
    plans: dict[int, Trajectory],
) -> Targets:
    """Return the targets that the plans of earlier neighbours leave an agent."""
    states = np.stack([p.states - formation.displacement(agent, j) for j, p in plans.items()])
    inputs = np.stack([model.normalized(p.inputs) for p in plans.values()])
    # Inputs are held between times, and targets have one at each: the last is held on.
    last = np.concatenate([inputs, inputs[:, -1:]], axis=1)
    return mean_targets(model, states, last, shares(graph, agent, tuple(plans)))


@final
class _Desk:
    """Solvers made ready once and used by all agents whose problems have the same form."""

    def __init__(
        self, model: ControlAffine, planning: TrackingOptions, grid: PlanTimes, limits: bool
    ) -> None:
        self.model, self.planning, self.grid, self.limits = model, planning, grid, limits
        self.seconds: dict[int, float] = {}
        self.iterations: dict[int, int] = {}
        self.failures, self.setup_seconds = 0, 0.0
        self._ready: dict[tuple[object, ...], tuple[Solver, Solver | None]] = {}

    def follow(self, agent: int, start: Array, targets: Targets) -> Trajectory:
        """Return the plan of an agent that follows targets."""
        key = ("targets",)
        self._prepare(
            key, lambda fine: tracking(self.model, self.planning, self.grid, self.limits, fine)
        )
        return self._plan(agent, key, start, targets.outputs, targets)

    def keep_apart(
        self,
        agent: int,
        start: Array,
        targets: Targets,
        neighbours: list[Array],
        displacements: list[Array],
    ) -> Trajectory:
        """Return the plan of an agent that keeps its distances from neighbours.

        Args:
            agent: its number.
            start: its state, (n,).
            targets: where the solver begins.
            neighbours: the neighbours' states, (T, n) each.
            displacements: displacements (n,) whose lengths are the distances.
        """
        axes = list(self.model.position_indices())
        distances = np.array([np.linalg.norm(d[axes]) for d in displacements])
        # In the key, since the distances are constants of the problem; all else is its data.
        key = ("distances", *distances.tolist())
        self._prepare(
            key, lambda fine: spacing(self.model, self.grid, self.limits, fine, distances)
        )
        positions = np.hstack([p[:, axes] for p in neighbours])
        return self._plan(agent, key, start, positions, targets)

    def _prepare(self, key: tuple[object, ...], pose: Callable[[bool], OptimalControl]) -> None:
        if key in self._ready:
            return
        began, solver = time.perf_counter(), self.planning.solver
        # These are IPOPT's own names; any other solver keeps its defaults.
        begun, resumed = (_PATIENCE, _PATIENCE | _RESUMED) if solver == "ipopt" else (None, None)
        finer = self.grid.hold > coarse(self.grid)
        finely = Solver(pose(True), solver, resumed) if finer else None
        self._ready[key] = Solver(pose(False), solver, begun), finely
        self.setup_seconds += time.perf_counter() - began

    def _plan(
        self,
        agent: int,
        key: tuple[object, ...],
        start: Array,
        parameters: Array,
        targets: Targets,
    ) -> Trajectory:
        """Solve on coarse steps, which take most iterations, and then on fine ones."""
        coarsely, finely = self._ready[key]
        self.seconds[agent], self.iterations[agent] = 0.0, 0
        # The targets, after the start, are near the solution.
        near = (
            np.vstack([start, targets.states[1:]]),
            self.model.physical(targets.inputs[:-1]),
        )
        plan = self._attempt(agent, coarsely, start, parameters, targets, near, 1.0)
        # Costly inputs keep the plan by the targets' own, where the problem is nearly quadratic;
        # its solution is then a better place to begin.
        for factor in () if plan.solved else _EASIER:
            easier = self._attempt(agent, coarsely, start, parameters, targets, near, factor)
            near = (easier.states, easier.inputs)
            plan = self._attempt(agent, coarsely, start, parameters, targets, near, 1.0)
            if plan.solved:
                break
        if finely is not None:
            plan = self._attempt(agent, finely, start, parameters, targets, plan, 1.0)
        # Judged by the constraints, not by the status of the solver: it may have stopped short of
        # its tolerance with a valid plan.
        if plan.violations:
            raise PlanError(f"there is no plan for agent {agent}: {plan.message}")
        return plan

    def _attempt(
        self,
        agent: int,
        planner: Solver,
        start: Array,
        parameters: Array,
        targets: Targets,
        guess: Trajectory | tuple[Array, Array],
        factor: float,
    ) -> Trajectory:
        # The factor is data, so that the easier problems need no solvers of their own.
        weight = np.full((len(parameters), 1), factor * self.planning.input_weight)
        plan = planner.solve(start, np.hstack([parameters, targets.inputs, weight]), guess)
        self.seconds[agent] += plan.seconds
        self.iterations[agent] += plan.iterations
        self.failures += not plan.solved
        return plan
