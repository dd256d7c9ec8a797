"""Leaders that wait for stragglers: how far these are off their places, and what leaders follow."""

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.types import Scalar
from echelon.simulation.step.loop import Loop, Moment, goals_at, nearest_at, present_at, time_of
from echelon.simulation.step.plan_phase import Followed, PlanPhase


def next_plan(loop: Loop, now: Moment) -> PlanPhase | None:
    """Return the plan of leaders after a step; None where they do not wait."""
    if loop.patience is None:
        return None
    return now.world.plan.after(_farthest(loop, now), loop.patience, loop.motion.dt)


def plan_time(now: Moment, t: Scalar) -> tuple[Scalar, Scalar | None]:
    """Return the time on the leaders' plan at a time t (s), and its pace; None for 1."""
    plan = now.world.plan
    return (t, None) if plan is None else (t - plan.late, plan.pace)


def followed_at(loop: Loop, now: Moment) -> Followed:
    """Return what leaders that wait follow at a moment."""
    late = now.world.plan.late
    states = loop.leader.reference_states(loop.model, (time_of(loop, now) - late)[None])
    return Followed(late, None if states is None else states[0])


def _farthest(loop: Loop, now: Moment) -> jax.Array:
    """Return how far the farthest agent that is there is off its place, as agents measure it."""
    here, goals = present_at(loop, now.step), goals_at(loop, now)
    y = now.states - (jnp.asarray(loop.offsets, now.states.dtype) if goals is None else goals)
    nearest = loop.meter.nearest if here is None else nearest_at(loop, now.step)
    away = jnp.linalg.norm((y - y[nearest])[:, np.array(loop.meter.measured)], axis=1)
    return (away if here is None else jnp.where(here, away, 0.0)).max()
