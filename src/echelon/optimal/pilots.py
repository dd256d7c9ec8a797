"""The optimization-based method: plans replayed open loop, and plans over a receding horizon."""

import time
from collections.abc import Mapping
from typing import final

import numpy as np

from echelon.core.numerics import Precision
from echelon.core.types import Array
from echelon.engine.host import Flight, Progress, Stopped, fly, take_off
from echelon.engine.initial import Initial
from echelon.engine.result import Result, Settings
from echelon.engine.work import stats_of, with_stats
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph, shares
from echelon.optimal.formation_plan import plan_formation
from echelon.optimal.horizon import MPC, Answer, Course, Horizon
from echelon.optimal.objectives import TrackingOptions, grid
from echelon.references.flatness import reference_targets
from echelon.references.reference import Reference
from echelon.world.disturbance import Disturbance

_SETTLING = 20
"""Most quadratic programs of an agent's first plan, which no plan precedes."""


def simulate_plans(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    *,
    reference: Reference | None = None,
    planning: TrackingOptions | None = None,
    initial: Initial = None,
    start_error: Mapping[str, float] | None = None,
    plant: ControlAffine | None = None,
    disturbance: Disturbance | None = None,
    horizon: float,
    dt: float,
    integrator: str = "rk4",
    limits: bool = True,
    store_every: int = 1,
    seed: int = 0,
    precision: Precision = "float64",
    progress: Progress | None = None,
) -> Result:
    """Plan the whole run of each agent from its start, and replay the inputs open loop.

    Leaders plan first, then the followers outward, each given the plans of the neighbours before
    it. The plans know the model; the plant and the disturbance then do what they do.

    `reference` is what the leaders follow, without one they keep their trim, and `planning` is how
    the plans are posed. `limits` says whether the actuators' limits hold, in the plans and in the
    plant. All else is as for `simulate`.

    Raises:
        EchelonError: a part is malformed, casadi is missing, or a plan misses a constraint (which,
            and by how much).
    """
    planning = TrackingOptions() if planning is None else planning
    flight = take_off(
        model,
        graph,
        formation,
        reference=reference,
        initial=initial,
        start_error=start_error,
        plant=plant,
        disturbance=disturbance,
        settings=Settings(horizon, dt, integrator, limits, store_every, precision, seed),
    )
    times = grid(horizon, dt, planning.interval)
    made = plan_formation(
        model,
        graph,
        formation,
        flight.states,
        times,
        reference=reference,
        planning=planning,
        limits=limits,
    )
    inputs = np.stack([plan.inputs for plan in made.plans], axis=1)
    result = fly(
        flight,
        lambda step, states: inputs[step // times.hold],
        times.hold,
        told=("the whole plans of the neighbours before it, before the start",),
        progress=progress,
    )
    work = (made.seconds, made.iterations, made.failures, made.setup_seconds)
    return with_stats(result, stats_of("optimization", planning.solver, *work))


def simulate_mpc(
    model: ControlAffine,
    graph: Graph,
    formation: Formation,
    *,
    reference: Reference | None = None,
    mpc: MPC | None = None,
    initial: Initial = None,
    start_error: Mapping[str, float] | None = None,
    plant: ControlAffine | None = None,
    disturbance: Disturbance | None = None,
    horizon: float,
    dt: float,
    integrator: str = "rk4",
    limits: bool = True,
    store_every: int = 1,
    seed: int = 0,
    precision: Precision = "float64",
    progress: Progress | None = None,
) -> Result:
    """Run agents that plan over a receding horizon, each from its own measured state.

    Every period the leaders plan first, then the followers outward, each given the plans that its
    neighbours before it have just made; each applies its first input. Computing takes no time in
    the run; `solver_stats` says what it took.

    `reference` is what the leaders follow, without one they keep their trim, and `mpc` is the
    receding horizon. `limits` says whether the actuators' limits hold, in the plans and in the
    plant. All else is as for `simulate`.

    Raises:
        EchelonError: a part is malformed, or casadi is missing. A solver that fails is no error.
    """
    mpc = MPC() if mpc is None else mpc
    flight = take_off(
        model,
        graph,
        formation,
        reference=reference,
        initial=initial,
        start_error=start_error,
        plant=plant,
        disturbance=disturbance,
        settings=Settings(horizon, dt, integrator, limits, store_every, precision, seed),
    )
    hold = max(1, round(mpc.period / dt))
    pilots = _Pilots(flight, mpc, hold)
    result = fly(
        flight,
        pilots,
        hold,
        told=("the plans that the neighbours before it have just made, every period",),
        progress=progress,
    )
    work = (pilots.seconds, pilots.iterations, pilots.failures, pilots.setup_seconds)
    return with_stats(result, stats_of("mpc", mpc.solver, *work))


@final
class _Pilots:
    """All agents over a receding horizon: called with the measured states, return the inputs."""

    def __init__(self, flight: Flight, mpc: MPC, hold: int) -> None:
        began = time.perf_counter()
        model, dt = flight.model, hold * flight.settings.dt
        self.flight, self.mpc, self.hold = flight, mpc, hold
        self.steps = max(1, round(mpc.horizon / dt))
        self.horizon = Horizon(model, mpc, self.steps, dt, flight.settings.limits)
        periods = -(-flight.steps // hold)
        times = dt * np.arange(periods + self.steps + 1)
        self.reference = reference_targets(model, flight.reference, times)
        self.turns = [
            (agent, earlier, shares(flight.graph, agent, earlier) if earlier else np.zeros(0))
            for agent, earlier in flight.graph.outward()
        ]
        self.courses: dict[int, Course] = {}
        self.seconds: list[float] = []
        self.iterations: list[int] = []
        self.failures = 0
        self.setup_seconds = time.perf_counter() - began

    def __call__(self, step: int, states: Array) -> Array:
        """Return the wanted inputs (N, m) of all agents, planned in the order of the graph.

        Raises:
            Stopped: a solver failed, and that was to end the run.
        """
        inputs = np.zeros((len(states), self.horizon.m))
        for agent, earlier, share in self.turns:
            targets = self._targets(agent, earlier, share, step // self.hold)
            course = self._course(agent, states[agent], targets)
            self.courses[agent] = course
            inputs[agent] = course.inputs[0]
        return self.flight.model.physical(inputs)

    def _targets(self, agent: int, earlier: tuple[int, ...], share: Array, period: int) -> Course:
        """Return what an agent follows: the reference, or the mean of what its neighbours plan."""
        formation = self.flight.formation
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
        if last is None:
            near, most = Course(np.vstack([start, targets.states[1:]]), targets.inputs), _SETTLING
        else:
            near, most = self.horizon.shifted(last, targets.inputs[-1]), self.mpc.iterations
        answer, count = Answer(None, ""), 0
        course = near
        while count < most:
            answer, count = self.horizon.solve(start, targets, course), count + 1
            if answer.course is None:
                break
            change = np.abs(answer.course.inputs - course.inputs).max()
            course = answer.course
            if change < 1e-6:
                break
        self.seconds.append(time.perf_counter() - began)
        self.iterations.append(count)
        if answer.course is not None:
            return course
        self.failures += 1
        if self.mpc.on_failure == "stop":
            raise Stopped(f"the solver of agent {agent} failed (`{answer.status}`)")
        return near
