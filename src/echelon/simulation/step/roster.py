"""Who hears whom and who is there, always or in stretches of time."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.network.exchange import Exchange
from echelon.agents.network.graph import Graph
from echelon.core.types import Array, PyTree, States
from echelon.simulation.step.meter import RunStatistics, Sums
from echelon.simulation.step.records import LoopState, Mask
from echelon.simulation.step.settings import Settings


class Switches(NamedTuple):
    """From which steps on (K,), ascending from 0, which rows (K,) of a table hold."""

    steps: Array
    rows: Array

    def at(self, step: jax.Array) -> jax.Array:
        """Return which row holds at a step."""
        steps, rows = map(jnp.asarray, self)
        return rows[jnp.searchsorted(steps, step, side="right") - 1]

    def stretch(self, step: int) -> tuple[int, int]:
        """Return which row holds at a step, and for how many steps from it on."""
        place = int(np.searchsorted(self.steps, step, side="right"))
        ends = np.append(self.steps, _FOREVER)
        return int(self.rows[place - 1]), int(ends[place]) - step


_FOREVER = np.iinfo(np.int64).max

# ---- who hears whom ------------------------------------------------------------------------------


class Links(eqx.Module):
    """Who hears whom: the same at all times.

    Attributes:
        exchange: receivers, senders and weights of all links.
    """

    exchange: Exchange

    def at(self, step: jax.Array) -> Exchange:
        """Return the exchange with the weights of a step."""
        return self.exchange

    def stretch(self, step: int) -> tuple[int, int]:
        """Return which row of the weights holds at a step, and for how many steps from it on."""
        return 0, int(_FOREVER)

    @classmethod
    def of(cls, graph: Graph, settings: Settings, leaderward: bool) -> "Links":
        """Return the links of a graph, which may switch."""
        exchange, schedule = graph.exchange(leaderward), graph.schedule
        if schedule is None:
            return Links(exchange)
        switches = Switches(*schedule.switches(settings.dt, settings.horizon))
        return SwitchingLinks(exchange, switches)


@final
class SwitchingLinks(Links):
    """Links with weights of stretches of time: the exchange has a row of weights for each."""

    switches: Switches

    def at(self, step: jax.Array) -> Exchange:
        """Return the exchange with the weights of a step."""
        return self.exchange.during(self.switches.at(step))

    def stretch(self, step: int) -> tuple[int, int]:
        """Return which row of the weights holds at a step, and for how many steps from it on."""
        return self.switches.stretch(step)


# ---- who is there --------------------------------------------------------------------------------

Anew: TypeAlias = Callable[[jax.Array, States], LoopState]
"""The moment in which some agents (N,) begin anew at states (N, n)."""
Beside: TypeAlias = Callable[[LoopState, jax.Array, jax.Array], LoopState]
"""The moment with the headings of those who join beside those of the first that was there."""


class Everybody(eqx.Module):
    """Who is there: all agents, always."""

    # Whether agents come or go.
    changes = False

    def begin(self, states: States | Array) -> PyTree:
        """Return what is remembered of the start (N, n)."""
        return ()

    def here(self, step: jax.Array) -> Mask:
        """Return who is there at a step."""
        return True

    def since(self, step: jax.Array) -> Float[jax.Array, " *N"]:
        """Return since when each has been there, s."""
        return jnp.zeros(())

    def arrived(self, now: LoopState, anew: Anew, beside: Beside) -> LoopState:
        """Return the moment with those who join in this step."""
        return now

    def restarting(self, step: int) -> Array | None:
        """Return which agents (N,) begin at a step, for the host; None where none ever do."""
        return None

    def measured(self, meter: RunStatistics, step: jax.Array) -> RunStatistics:
        """Return the meter of errors relative to those whom agents follow at a step."""
        return meter

    def counted(self, meter: RunStatistics, read: Sums, here: Mask) -> Sums:
        """Return the sums of a step of those who are there."""
        return read


class ActiveAgents(Everybody):
    """Some agents, in each of S stretches of the graph; who is absent stays as it is.

    Attributes:
        switches: when which stretch holds.
        rows: (S, N) whether an agent is there.
        nearest: (S, N) whom it follows.
        times: (S, N) since when it has been there, s.
    """

    switches: Switches
    rows: Array
    nearest: Array
    times: Array
    changes = True

    def here(self, step: jax.Array) -> Mask:
        """Return who is there at a step."""
        return jnp.asarray(self.rows)[self.switches.at(step)]

    def since(self, step: jax.Array) -> Float[jax.Array, " *N"]:
        """Return since when each has been there, s."""
        return jnp.asarray(self.times)[self.switches.at(step)]

    def measured(self, meter: RunStatistics, step: jax.Array) -> RunStatistics:
        """Return the meter of errors relative to those whom agents follow at a step."""
        return meter.following(jnp.asarray(self.nearest)[self.switches.at(step)])

    def counted(self, meter: RunStatistics, read: Sums, here: Mask) -> Sums:
        """Return the sums of a step of those who are there."""
        assert here is not True
        return meter.of_present(read, here)


class JoiningAgents(ActiveAgents):
    """The same, with headings that grow with every turn: who joins takes over others' turns."""

    def restarting(self, step: int) -> Array | None:
        """Return which agents (N,) begin at a step, for the host."""
        now, before = (self.rows[self.switches.stretch(k)[0]] for k in (step, max(step - 1, 0)))
        return now & ~before

    def _begun(self, new: jax.Array, now: LoopState, anew: Anew) -> LoopState:
        return now

    def arrived(self, now: LoopState, anew: Anew, beside: Beside) -> LoopState:
        """Return the moment with those who join in this step."""
        here, before = (jnp.asarray(self.here(step)) for step in (now.step, now.step - 1))
        new = here & ~before & (now.step > 0)

        def joined(now: LoopState) -> LoopState:
            return beside(self._begun(new, now, anew), new, here & before)

        return jax.lax.cond(new.any(), joined, lambda now: now, now)


@final
class ReturningAgents(JoiningAgents):
    """The same, some of which are lost and return where they began."""

    def begin(self, states: States | Array) -> PyTree:
        """Return the start."""
        return states

    def _begun(self, new: jax.Array, now: LoopState, anew: Anew) -> LoopState:
        return anew(new, now.memory.roster)


def roster_of(graph: Graph, settings: Settings, angles: bool) -> Everybody:
    """Return who is there when; `angles`: whether agents send angles, which grow with turns."""
    schedule = graph.schedule
    if schedule is None or schedule.present is None or schedule.nearest is None:
        return Everybody()
    since = np.where(schedule.present, 0.0, np.inf)
    for k in range(1, len(since)):
        stays = schedule.present[k - 1]
        since[k] = np.where(stays, since[k - 1], schedule.starts[k])
    joins = (np.diff(schedule.present.astype(int), axis=0) > 0).any(axis=0)
    kind = JoiningAgents if angles and joins.any() else ActiveAgents
    kind = ReturningAgents if (schedule.present[0] & joins).any() else kind
    switches = Switches(*schedule.switches(settings.dt, settings.horizon))
    return kind(switches, schedule.present, schedule.nearest, since)
