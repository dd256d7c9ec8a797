"""Drives by optimization: plans applied open loop, and model predictive control."""

import abc
import time
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.network.matrices import shares
from echelon.agents.references.flatness import (
    followed_states,
    reference_targets,
    reference_warnings,
)
from echelon.agents.references.reference import Guide, check_kind_of
from echelon.core.types import Array, State
from echelon.simulation.engine.host_stepper import HostStepper
from echelon.simulation.optimal.formation_plan import plan_formation
from echelon.simulation.optimal.horizon import MPC, Answer, Course, Horizon
from echelon.simulation.optimal.objectives import TrackingOptions, grid
from echelon.simulation.step.drive import Drive, Information, Problem, Stepper, Stopped
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats, solver_stats

_SETTLING = 20
"""Most quadratic programs of an agent's first plan, which has no earlier plan as its guess."""


class _Optimized(Drive):
    """A drive whose leaders follow a reference, or keep their trim."""

    reference: eqx.AbstractVar[Guide | None]

    def __check_init__(self) -> None:
        """Check the type of the reference."""
        if self.reference is not None:
            check_kind_of(self.reference)

    @property
    @abc.abstractmethod
    def neighbour_information(self) -> str:
        """What followers receive from their neighbours."""

    @property
    def information(self) -> Information:
        """The reference for the leaders, plans of others for the followers."""
        return Information(
            () if self.reference is None else ("the reference",), (self.neighbour_information,)
        )

    def warnings(self, model: ControlAffine, graph: Graph, settings: Settings) -> tuple[str, ...]:
        """Return a warning for each part of the reference that the agents cannot follow."""
        if self.reference is None:
            return ()
        return reference_warnings(model, self.reference, settings.horizon, settings.limits)

    def start(self, model: ControlAffine) -> State:
        """Return the reference's state at time zero, or the trim."""
        return jnp.asarray(reference_targets(model, self.reference, np.zeros(1)).states[0])

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array | None:
        """Return the reference's states (T, n); None without a reference."""
        return None if self.reference is None else followed_states(model, self.reference, times)


@final
class Plans(_Optimized):
    """Plans of the whole run, one per agent, whose inputs are applied open loop.

    Leaders plan first, then the followers outward, each with the plans of the neighbours before it.
    The plans are made with the model, and ignore a different plant and the disturbance. The limits
    of the settings hold in the plans and in the plant.

    Args:
        reference: what the leaders follow; without one they keep their trim.
        options: of the planning problems.
    """

    reference: Guide | None = None
    options: TrackingOptions = eqx.field(default_factory=TrackingOptions, static=True)

    @property
    def neighbour_information(self) -> str:
        """Whole plans."""
        return "the whole plans of the neighbours before it, before the start"

    def stepper(self, problem: Problem) -> Stepper:
        """Plan the run, and return the stepper that applies the plans.

        Raises:
            PlanError: a plan violates a constraint; the message names it and the amount.
            MissingExtraError: casadi is not installed.
        """
        settings = problem.settings
        times = grid(settings.horizon, settings.dt, self.options.interval)
        formation_plan = plan_formation(
            problem.model,
            problem.graph,
            problem.formation,
            problem.states,
            times,
            reference=self.reference,
            planning=self.options,
            limits=settings.limits,
        )
        # One input per interval; the last interval may extend beyond the run's end.
        inputs = np.stack([plan.inputs for plan in formation_plan.plans], axis=1)
        plan = formation_plan
        work = plan.seconds, plan.iterations, plan.failures, plan.setup_seconds
        stats = solver_stats("optimization", self.options.solver, *work)
        return HostStepper(
            problem, lambda step, _: inputs[step // times.hold], times.hold, lambda: stats
        )


@final
class RecedingHorizon(_Optimized):
    """Model predictive control: each agent plans over a receding horizon from its measured state.

    Every period the leaders plan first, then the followers outward, each with the new plans of the
    neighbours before it; each applies its first input. Computing takes no time in the simulation;
    `Result.work` reports the time that it took. A failing solver is no error.

    Args:
        reference: what the leaders follow; without one they keep their trim.
        mpc: the receding horizon.
    """

    reference: Guide | None = None
    mpc: MPC = eqx.field(default_factory=MPC, static=True)

    @property
    def neighbour_information(self) -> str:
        """Plans, every period."""
        return "the plans that the neighbours before it have just made, every period"

    def stepper(self, problem: Problem) -> Stepper:
        """Build the solvers, and return the stepper that queries them.

        Raises:
            MissingExtraError: casadi is not installed.
        """
        # A plan is made at whole steps of the run alone.
        hold = max(1, round(self.mpc.period / problem.settings.dt))
        planners = _Planners(problem, self.reference, self.mpc, hold)
        return HostStepper(problem, planners, hold, planners.work)


@final
class _Planners:
    """The planners of all agents; called with the measured states, they return the inputs."""

    def __init__(self, problem: Problem, reference: Guide | None, mpc: MPC, hold: int) -> None:
        began = time.perf_counter()
        settings, graph = problem.settings, problem.graph
        dt = hold * settings.dt
        self.problem, self.mpc, self.hold = problem, mpc, hold
        self.steps = max(1, round(mpc.horizon / dt))
        self.horizon = Horizon(problem.model, mpc, self.steps, dt, settings.limits)
        # The last plan looks a horizon beyond the run, and so does the reference.
        periods = -(-settings.steps // hold)
        times = dt * np.arange(periods + self.steps + 1)
        self.reference = reference_targets(problem.model, reference, times)
        self.turns = [
            (agent, earlier, shares(graph, agent, earlier) if earlier else np.zeros(0))
            for agent, earlier in graph.outward()
        ]
        self.courses: dict[int, Course] = {}
        self.seconds: list[float] = []
        self.iterations: list[int] = []
        self.failures = 0
        self.setup_seconds = time.perf_counter() - began

    def work(self) -> SolverStats:
        """Return the work of the solvers so far."""
        work = self.seconds, self.iterations, self.failures, self.setup_seconds
        return solver_stats("mpc", self.mpc.solver, *work)

    def __call__(self, step: int, states: Array) -> Array:
        """Return the desired inputs (N, m) of all agents, planned in the order of the graph.

        Raises:
            Stopped: a solver failed, and `on_failure` is `stop`.
        """
        inputs = np.zeros((len(states), self.horizon.m))
        for agent, earlier, share in self.turns:
            targets = self._targets(agent, earlier, share, step // self.hold)
            course = self._course(agent, states[agent], targets)
            self.courses[agent] = course
            inputs[agent] = course.inputs[0]
        return self.problem.model.physical(inputs)

    def _targets(self, agent: int, earlier: tuple[int, ...], share: Array, period: int) -> Course:
        """Return an agent's targets: the reference, or the mean of its neighbours' plans."""
        formation = self.problem.formation
        # Only leaders have no neighbour before them, and know the reference.
        if not earlier:
            span = slice(period, period + self.steps + 1)
            x, v = self.reference.states[span], self.reference.inputs[span]
            return Course(x + formation.offsets[agent], v[:-1])
        plans = [self.courses[j] for j in earlier]
        places = [p.states - formation.displacement(agent, j) for p, j in zip(plans, earlier)]
        return Course(
            np.tensordot(share, np.stack(places), 1),
            np.tensordot(share, np.stack([p.inputs for p in plans]), 1),
        )

    def _course(self, agent: int, start: Array, targets: Course) -> Course:
        """Return an agent's plan, or its last one shifted where the solver fails."""
        began = time.perf_counter()
        last = self.courses.get(agent)
        # The first plan has no good guess and takes several linearizations; each later one starts
        # from the plan before, and one is enough (real-time iteration).
        if last is None:
            guess, most = Course(np.vstack([start, targets.states[1:]]), targets.inputs), _SETTLING
        else:
            guess, most = self.horizon.shift(last, targets.inputs[-1]), self.mpc.iterations
        answer, count = Answer(None, ""), 0
        course = guess
        while count < most:
            answer, count = self.horizon.solve(start, targets, course), count + 1
            if answer.course is None:
                break
            change = np.abs(answer.course.inputs - course.inputs).max()
            course = answer.course
            # Plan and linearization agree: another program would have the same solution.
            if change < 1e-6:
                break
        # Recorded first, since a failure that ends the run counts too.
        self.seconds.append(time.perf_counter() - began)
        self.iterations.append(count)
        if answer.course is not None:
            return course
        self.failures += 1
        if self.mpc.on_failure == "stop":
            raise Stopped(f"the solver of agent {agent} failed (`{answer.status}`)")
        return guess
