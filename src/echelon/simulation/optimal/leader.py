"""A leader that minimizes its tracking error, as in the paper: an optimal plan with feedback.

The plan is made once, before the run, from the leader's intended start. The feedback bounds the
errors by wind and a wrong mass, which would grow in open loop.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.references.flatness import (
    followed_states,
    reference_targets,
    reference_warnings,
)
from echelon.agents.references.reference import LeaderPath
from echelon.core.cache import BoundedCache
from echelon.core.errors import LawError
from echelon.core.identity import process_key
from echelon.core.numerics import rk4
from echelon.core.types import Array, Input, Scalar, State
from echelon.laws.law import Checks, Faces, Law, LocalView, Memory, Travels
from echelon.laws.path_leader import tracking_gain
from echelon.simulation.optimal.formation_plan import plan_tracking
from echelon.simulation.optimal.objectives import TrackingOptions, grid
from echelon.simulation.optimal.solver import Trajectory
from echelon.synthesis.gains.gain import Gain

_STEP = 0.005
"""Runge-Kutta step of the plan, s."""
_BETWEEN = 4
"""Runge-Kutta steps from the beginning of an interval of the plan to now."""
_PLANS = BoundedCache[Trajectory](8)


class OptimalTracking(Law, Travels, Faces, Checks):
    """u_L = u_p(t) - S R^-1 (g S)'P (x - x_p(t)), with (x_p, u_p) a plan of least tracking error.

    The plan minimizes the integral of the squared error of the outputs, plus a little of the
    squared input. After its horizon the law follows the reference.

    Args:
        reference: the path to follow.
        horizon: of the plan, s.
        start_error: added to the leader's start, per state or group, for the start of the plan. The
            feedback brings a leader that starts elsewhere to the plan.
        limits: whether the plan keeps to the actuators' limits.
        planning: options of the planning problem.
        gain: of the feedback, used with coupling 1; the model's Riccati gain when left out.
        regulator, states, inputs: the gain in use and the plan; set by `prepared`.
    """

    reference: LeaderPath
    gain: Gain | None
    regulator: Gain | None
    states: Array | None
    inputs: Array | None
    horizon: float = eqx.field(static=True)
    start_error: tuple[tuple[str, float], ...] = eqx.field(static=True)
    limits: bool = eqx.field(static=True)
    planning: TrackingOptions = eqx.field(static=True)

    def __init__(
        self,
        reference: LeaderPath,
        horizon: float = 10.0,
        start_error: Mapping[str, float] | None = None,
        limits: bool = True,
        planning: TrackingOptions | None = None,
        gain: Gain | None = None,
    ) -> None:
        self.reference, self.gain = reference, gain
        self.regulator, self.states, self.inputs = None, None, None
        self.horizon, self.limits = horizon, limits
        self.start_error = tuple((start_error or {}).items())
        self.planning = TrackingOptions() if planning is None else planning

    @property
    def information(self) -> tuple[str, ...]:
        """The whole reference."""
        return ("the reference, all of it before the start",)

    def prepared(self, model: ControlAffine, graph: Graph) -> "OptimalTracking":
        """Complete the gain and make the plan, once.

        Raises:
            PlanError: there is no plan, or the model cannot follow a reference.
            MissingExtraError: casadi is not installed.
        """
        gain = tracking_gain(self, model, self.gain)
        own = self.reference, self.horizon, self.start_error, self.limits, self.planning
        # `simulate` prepares every law, prepared or not, and a plan takes seconds.
        plan = _PLANS.get_or_make(process_key((model, own)), lambda: self._plan(model))
        return eqx.tree_at(
            lambda law: (law.regulator, law.states, law.inputs),
            self,
            (gain, plan.states, plan.inputs),
            # None is an empty tree to JAX, and could not be replaced.
            is_leaf=lambda leaf: leaf is None,
        )

    def _plan(self, model: ControlAffine) -> Trajectory:
        times = grid(self.horizon, _STEP, self.planning.interval)
        targets = reference_targets(model, self.reference, times.times)
        start = targets.states[0] + model.per_state(dict(self.start_error))
        return plan_tracking(model, start, targets, times, self.planning, self.limits)

    def warnings(self, model: ControlAffine, graph: Graph) -> tuple[str, ...]:
        """Return a warning for each part of the reference that the leader cannot follow."""
        return reference_warnings(model, self.reference, self.horizon, self.limits)

    def target(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return (x_p, u_p) at time t, or the reference's (x_r, u_r) after the plan.

        Raises:
            LawError: there is no plan yet.
        """
        if self.states is None or self.inputs is None:
            raise LawError(
                "`OptimalTracking` has no plan yet; call `prepared(model, graph)` first."
            )
        x_r, u_r = self.reference.follow(model, t)
        dtype, count = x_r.dtype, len(self.inputs)
        span = grid(self.horizon, _STEP, self.planning.interval).interval
        # Rounding may leave a time just before the interval that it belongs to.
        k = jnp.floor(t / span + 1e-4).astype(jnp.int32)
        interval = jnp.clip(k, 0, count - 1)
        u = jnp.asarray(self.inputs, dtype)[interval]
        # The plan has states at the ends of intervals. Between them its held input is integrated,
        # since interpolation would lose the order of the method.
        x, step = jnp.asarray(self.states, dtype)[interval], jnp.maximum(t - interval * span, 0.0)
        x = jax.lax.fori_loop(
            0, _BETWEEN, lambda _, x: rk4(model.velocity, x, u, step / _BETWEEN), x
        )
        # Both are computed, since a compiled step cannot branch on a traced value.
        planned = k < count
        return jnp.where(planned, x, x_r), jnp.where(planned, u, u_r)

    def start(self, model: ControlAffine) -> State:
        """Return the reference's state at time zero."""
        return jnp.asarray(reference_targets(model, self.reference, np.zeros(1)).states[0])

    def reference_states(self, model: ControlAffine, times: jax.Array) -> jax.Array:
        """Return the reference's states (T, n), which the plan comes close to."""
        return followed_states(model, self.reference, times)

    def update(self, model: ControlAffine, view: LocalView, memory: Memory) -> tuple[Input, Memory]:
        """Return the leader's input."""
        state, u = self.target(model, view.t)
        assert self.regulator is not None  # `prepared` completes it together with the plan
        error = model.difference(view.x, state + view.offset)
        heading = None if model.heading is None else self.heading(model, view.t, view.x)
        v = self.regulator.feedback(model, view.x, error, heading)
        return u - model.physical(v, trim=False), memory
