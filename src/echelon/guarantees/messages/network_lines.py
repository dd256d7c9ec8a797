"""Lines of a check on late messages: what covers them, and what messages of states cost."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from echelon.agents.models.model import position_unit
from echelon.core.digits import about, at_least
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis, Statement, fails, holds
from echelon.core.words import Kind, MessageContent, NeighbourChoice
from echelon.guarantees.messages.late_messages import OFF_PLAN, LateMessages, Uncovered
from echelon.guarantees.messages.message_ages import ages_of
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

_TIMES = 2001
"""Of the leader's path, of which the mean speed is taken."""
_MUCH = 0.01
"""m of a bias that is pointed out."""


class Bias(NamedTuple):
    """How far followers lag that receive states of a mean age (s) at a mean speed."""

    age: float
    speed: float
    size: float
    unit: str

    @property
    def shown(self) -> str:
        """The size with its unit."""
        metres = self.unit == "m"
        return f"{about(1e3 * self.size)} mm" if metres else f"{about(self.size)} {self.unit}"

    def sentence(self) -> str:
        """Return it in words."""
        age, speed, size = about(1e3 * self.age), about(self.speed), about(self.size)
        return (
            f"messages contain states: at a mean age of {age} ms and a mean speed of {speed} "
            f"{self.unit}/s followers lag by {size} {self.unit}"
        )


def bias_of(parts: Parts, settings: Settings) -> Bias | None:
    """Return by how much followers lag whose messages contain states; None where they do not.

    Signals that are tau old, of a leader at a speed v, leave tau v L_g^-1 d, d the sums of weights
    that followers hear.
    """
    world, graph, follower = parts.world, parts.graph, getattr(parts.drive, "follower", None)
    network, leader = world.network, getattr(parts.drive, "leader", None)
    position = list(parts.model.position_indices())
    late = network is not None and network.messages is MessageContent.STATE
    if not late or network is None or leader is None or follower is None or not position:
        return None
    if graph.schedule is not None:
        return None
    times = np.linspace(0.0, settings.horizon, _TIMES)
    with precision("float64"):
        path = leader.reference_states(parts.model, jnp.asarray(times))
    if path is None:
        return None
    moved = np.linalg.norm(np.diff(np.asarray(path)[:, position], axis=0), axis=1).sum()
    channel = network.prepared(settings.dt, settings.horizon, 0)
    links = graph.exchange(follower.leaderward)
    age = ages_of(channel, settings.dt, settings.steps, len(links.receivers), 1).mean
    [L] = graph.stretches(follower.leaderward)
    most = float(spla.splu(sp.csc_array(L)).solve(L.diagonal()).max())
    if network.hears is NeighbourChoice.LEADERWARD:
        most = float(graph.depths().max())
    speed = float(moved) / settings.horizon
    return Bias(age, speed, age * speed * most, position_unit(parts.model) or "1")


def bias_line(parts: Parts, settings: Settings) -> Statement | None:
    """Return what late messages do under a law of states; None where no bound of it is known."""
    bias = bias_of(parts, settings)
    if bias is None or bias.size < _MUCH:
        return _swinging_line(parts)
    remedy = "set `messages: deviation`"
    number = bias.size, bias.shown
    return fails(Hypothesis.MESSAGES, Kind.LINEARIZATION, bias.sentence(), *number, remedy=remedy)


def _swinging_line(parts: Parts) -> Statement | None:
    """Say that agents with motors that lag may swing if they hear each other late."""
    actuator, graph = parts.world.actuator, parts.graph
    lag = 0.0 if actuator is None else actuator.lag
    if parts.world.network is None or not lag or graph.directed:
        return None
    text = "agents with motors that lag hear each other late and both ways, and may swing up"
    remedy = "set `graph.directed: true`, or use the law `stopping-point`"
    shown = f"lag {about(1e3 * lag)} ms"
    return fails(Hypothesis.MESSAGES, Kind.LINEARIZATION, text, lag, shown, remedy=remedy)


def messages_line(
    parts: Parts, settings: Settings, late: LateMessages | Uncovered | None
) -> Statement | None:
    """Return whether T9 covers the network of a run; None for the ideal one."""
    if late is None:
        return None
    name = Hypothesis.MESSAGES
    if isinstance(late, Uncovered):
        bias = bias_of(parts, settings)
        text = late.text if bias is None else bias.sentence()
        number = (None, "") if bias is None else (bias.size, bias.shown)
        reason = text if late.lost else ""
        return fails(name, Kind.PROOF, text, *number, remedy=late.remedy, reason=reason)
    ages = late.ages
    text = f"T9: no deviation in use is older than {at_least(1e3 * late.age)} ms"
    if ages.lost and ages.oldest < ages.forgotten:
        text += f", in all but one run in a million, with up to {ages.lost} losses in a row"
    elif ages.oldest == ages.forgotten:
        text += ", when it is forgotten"
    if late.off_plan is not None:
        text += f"; behind a leader that leaves its plan at {OFF_PLAN:g}/s in an output, followers "
        text += f"end within {at_least(late.off_plan)} of it"
    return holds(name, Kind.PROOF, text, late.age, f"{at_least(1e3 * late.age)} ms")
