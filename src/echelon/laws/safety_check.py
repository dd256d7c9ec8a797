"""The checks of a formation whose agents keep away from each other: starts, goals and numbers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.core.compiled import cached_jit
from echelon.core.digits import at_least, at_most
from echelon.core.errors import LawError
from echelon.core.types import Array, States
from echelon.laws.flat_law import FlatLaw
from echelon.laws.law import KeepsApart, Law
from echelon.laws.safety import Safety, nearest_point

_MOST_AGENTS = 1000
"""All pairs are compared in each step."""
_ROUNDING = 1e-9


def check_numbers(
    law: FlatLaw, model: ControlAffine, graph: Graph, offsets: Float[Array, "N n"], period: float
) -> None:
    """Check that a prepared follower's law with `safety` can keep agents apart, starts aside.

    Raises:
        LawError: it cannot; the text says what is in the way.
    """
    assert law.safety is not None
    if len(graph.leaders) > 1:
        raise LawError(
            f"`safety` needs one leader, relative to which all move, and got {len(graph.leaders)}."
        )
    if graph.agents > _MOST_AGENTS:
        raise LawError(
            f"`safety` compares all pairs of agents, of which {_MOST_AGENTS} are allowed, and got "
            f"{graph.agents}."
        )
    if law.safety.gain * period > 1.0 + _ROUNDING:
        raise LawError(
            f"`gain` of `safety` is {law.safety.gain:g} 1/s, and must be at most one over the "
            f"step, {at_most(1.0 / period, 6)} 1/s."
        )
    _check_space(law.safety, law, model, offsets)


def _check_space(
    safety: Safety, law: FlatLaw, model: ControlAffine, offsets: Float[Array, "N n"]
) -> None:
    scales = safety.scales(model)
    least = safety.needed_reach(np.array([law.speed_of(k) for k in law.places(model)]), scales)
    if safety.reach < least:
        raise LawError(
            f"`reach` of `safety` is {safety.reach:g} m, and must be at least "
            f"{at_least(least, 4)} m, so that agents at their `speed` regard each other in time."
        )
    goals = offsets[:, list(model.position_indices())] * scales
    near = too_near(safety, np.linalg.norm(goals[:, None] - goals, axis=-1))
    if near is not None:
        raise LawError(
            f"the goal of agent {near.agent} is too near to that of {near.text}; move their goals "
            "apart."
        )


class TooNear(NamedTuple):
    """The first agent of the nearest pair, and the other one with its distance, in words."""

    agent: int
    text: str


def too_near(safety: Safety, apart: Float[Array, "N N"]) -> TooNear | None:
    """Return the nearest pair by the scaled distances of all, if it is nearer than allowed."""
    i, j = np.triu_indices(len(apart), 1)
    k = int(apart[i, j].argmin()) if len(i) else 0
    if not len(i) or apart[i[k], j[k]] >= safety.distance - _ROUNDING:
        return None
    near = at_most(float(apart[i[k], j[k]]), 4)
    text = f"agent {j[k]}, {near} m as `safety` measures it, and at least "
    return TooNear(int(i[k]), f"{text}{at_least(safety.distance, 4)} m are allowed")


def hulls_at(
    law: FlatLaw, model: ControlAffine, leader: Law, graph: Graph, states: Float[Array, "N n"]
) -> Float[Array, "N r d"]:
    """Return the points in whose hulls the agents stay that begin at states."""
    followers, leaders = list(graph.followers), list(graph.leaders)
    led = _hulls(leader, model, jnp.asarray(states[leaders]))
    assert led is not None, "followers follow leaders under the same law"
    first = np.empty((len(states), *led.shape[1:]))
    first[leaders] = led
    first[followers] = _hulls(law, model, jnp.asarray(states[followers]))
    return first


@cached_jit
def _hulls(law: Law, model: ControlAffine, states: States) -> Float[jax.Array, "K r d"] | None:
    return jax.vmap(lambda x: KeepsApart.of(law).hull(model, x, law.begin(model, x)))(states)


def separations(hulls: Float[Array, "N r d"]) -> Float[Array, "N N"]:
    """Return how far the hulls of differences of scaled points are from 0, for all pairs."""
    i, j = np.triu_indices(len(hulls), 1)
    apart = np.zeros((len(hulls),) * 2)
    nearest = np.asarray(_nearest(jnp.asarray(hulls[i] - hulls[j])))
    apart[i, j] = apart[j, i] = np.linalg.norm(nearest, axis=-1)
    return apart


_nearest = cached_jit(nearest_point)
