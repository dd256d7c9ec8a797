"""Drives by optimization: plans applied open loop, and model predictive control."""

import abc
import time
from collections.abc import Callable, Sequence
from typing import TypeAlias, final

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
from echelon.agents.references.reference import LeaderPath, check_kind_of
from echelon.core.errors import SimulationError
from echelon.core.types import Array, Input, State
from echelon.laws.law import Law, LocalView
from echelon.simulation.optimal.formation_plan import plan_formation
from echelon.simulation.optimal.horizon import MPC, Answer, Course, Horizon
from echelon.simulation.optimal.objectives import TrackingOptions, grid
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.drive import Chunk, Controller, Information, Problem, Stepper, Stopped
from echelon.simulation.step.meter import Sums, on_host
from echelon.simulation.step.records import LawMemories, LoopState
from echelon.simulation.step.sequence import advance, begin
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats, solver_stats

_SETTLING = 20
"""Most quadratic programs of an agent's first plan, which has no earlier plan as its guess."""


class _Optimized(Controller):
    reference: eqx.AbstractVar[LeaderPath | None]

    def __check_init__(self) -> None:
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

    reference: LeaderPath | None = None
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
        plan = plan_formation(
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
        inputs = np.stack([each.inputs for each in plan.plans], axis=1)
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

    reference: LeaderPath | None = None
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
    def __init__(self, problem: Problem, reference: LeaderPath | None, mpc: MPC, hold: int) -> None:
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
        """Return the inputs (N, m); raise `Stopped` if a solver fails and `on_failure` says so."""
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


# ---- inputs that are computed on the host every few steps and held between -----------------------


Pilot: TypeAlias = Callable[[int, Array], Array]
"""(step, states (N, n)) -> desired physical inputs (N, m) from that step on."""

_PLANS = 64
"""Plans of one agent per chunk; a solver takes about 20 ms for each."""


@final
class HeldInput(Law):
    """u = the input (m,) in the agent's memory, which the pilot writes."""

    size: int = eqx.field(static=True)

    def init(self) -> Input:
        """Return no input, before the pilot gives one."""
        return jnp.zeros(self.size)

    def update(self, model: ControlAffine, view: LocalView, memory: Input) -> tuple[Input, Input]:
        """Return the input in the memory."""
        return memory, memory


@final
class HostStepper(Stepper):
    """The closed loop under the inputs of a pilot, which gives them every `hold` steps.

    Args:
        problem: the agents and how they move.
        pilot: gives the inputs.
        hold: steps for which they are held.
        work: returns what solving took so far.
    """

    def __init__(
        self,
        problem: Problem,
        pilot: Pilot,
        hold: int,
        work: Callable[[], SolverStats],
    ) -> None:
        law = HeldInput(len(problem.model.input_names))
        self.loop, self.states = assemble(problem, law, law), problem.states
        self.pilot, self.hold, self._work = pilot, hold, work
        self._queried = -1

    @property
    def work(self) -> SolverStats:
        """The work of the solvers so far."""
        return self._work()

    @property
    def repeats(self) -> bool:
        """Whether steps can be taken again: no, since a pilot's plans are not part of a moment."""
        return False

    @property
    def longest(self) -> int:
        """Steps in which a few dozen plans are made."""
        return self.hold * max(1, _PLANS // len(self.states))

    def recall(self, leaves: Sequence[Array]) -> LoopState:
        """Raise `SimulationError`: the plans of a pilot are not part of a moment."""
        raise SimulationError(
            "a run with planned inputs cannot be continued from stored data; start it again."
        )

    def start(self) -> LoopState:
        """Return the moment at which the run begins, before the pilot gives any input."""
        self._queried = -1
        return begin(self.loop, self.states)

    def advance(self, now: LoopState, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps, until a pilot stops or a state is not finite."""
        chunk = _HeldChunk(now, self.loop.meter.zero_sums(), reference)
        try:
            for count in counts:
                self._frame(chunk, int(count))
                if not np.isfinite(chunk.states[-1]).all():
                    break
        except Stopped as reason:
            return chunk.close(f"The run was stopped, since {reason}")
        except KeyboardInterrupt:
            return chunk.close("The run was interrupted")
        return chunk.close(None)

    def _frame(self, chunk: "_HeldChunk", count: int) -> None:
        """Store a frame and take `count` steps; query the pilot wherever a hold begins."""
        end = chunk.step + count
        try:
            # The last frame has no steps after it, and needs no plan.
            if count:
                self._query_pilot(chunk)
        finally:
            # If the pilot stops the run here, the frame has the inputs that led to it.
            if chunk.step or self._queried == 0:
                self._take(chunk, 0, store=True)
        while chunk.step < end:
            self._query_pilot(chunk)
            # Up to the next frame or the next plan, whichever is first.
            self._take(chunk, min(end, (chunk.step // self.hold + 1) * self.hold) - chunk.step)
            if not np.isfinite(np.asarray(chunk.now.states)).all():
                return

    def _query_pilot(self, chunk: "_HeldChunk") -> None:
        if chunk.step % self.hold or chunk.step == self._queried:
            return
        # Solvers work in float64, and so are the states that they start from.
        states = chunk.now.states
        start = np.asarray(states, np.float64)
        if not np.isfinite(start).all():
            # Solvers fail on such states, which must not count as their failures.
            return
        desired = jnp.asarray(self.pilot(chunk.step, start))
        desired = desired.astype(states.dtype)
        self._queried = chunk.step
        laws = LawMemories(*(desired[agents] for _, agents in self.loop.laws.groups))
        chunk.now = chunk.now._replace(memory=chunk.now.memory._replace(laws=laws))

    def _take(self, chunk: "_HeldChunk", count: int, store: bool = False) -> None:
        # As an array, so that another count does not compile again.
        counts = np.array([count], np.int32)
        chunk.now, frames, sums = advance(
            self.loop, chunk.now, counts, chunk.reference, chunk.first
        )
        chunk.step += count
        chunk.sums = chunk.sums.plus(sums)
        if store:
            for stored, frame in zip((chunk.states, chunk.inputs), frames[:2], strict=True):
                stored.append(np.asarray(frame[0], np.float64))


@final
class _HeldChunk:
    def __init__(self, now: LoopState, sums: Sums, reference: Array | None) -> None:
        self.now, self.step, self.first = now, int(now.step), now.step
        self.sums, self.reference = sums, reference
        self.states: list[Array] = []
        self.inputs: list[Array] = []

    def close(self, stopped: str | None) -> Chunk:
        """Return what was computed, and why it ended early."""
        shapes = self.now.states.shape, self.now.cut.shape
        states, inputs = (
            np.array(rows).reshape(len(rows), *shape)
            for rows, shape in zip((self.states, self.inputs), shapes, strict=True)
        )
        return Chunk(self.now, states, inputs, on_host(self.sums).split(1), stopped)
