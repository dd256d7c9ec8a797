"""Agents that are lost or join while a live loop runs, and formations that take another shape."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.events import Join, Lose
from echelon.agents.network.formation_motion import Reshape
from echelon.agents.network.graph import Graph
from echelon.agents.part import Event
from echelon.core.errors import SimulationError
from echelon.core.types import Array, JsonObject
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.roster import ActiveAgents, roster_of
from echelon.simulation.step.settings import Settings

KINDS = {"lose": Lose, "join": Join}
"""What may happen to an agent, by the name of the request."""
ROOMY = (*KINDS, "reshape")
"""Requests that need a loop with room for them."""
RESHAPE = 3.0
"""s, over which agents move to the places of another shape."""
_STRETCHES = (-2, -1, -1)
"""Of a graph with events a live loop has the last two stretches, in three rows."""


class Attendance(NamedTuple):
    """Who is there before the last event and after it, in three rows.

    Attributes:
        nearest: whom it follows.
        since: since when it has been there, s.
    """

    weights: Float[Array, "3 K"]
    present: Bool[Array, "3 N"]
    nearest: Int[Array, "3 N"]
    since: Float[Array, "3 N"]
    step: int

    def put_into(self, loop: Loop) -> Loop:
        """Return a loop in which so many are there; its weights are left alone."""
        steps = np.array([0, self.step, self.step])

        def numbers(loop: Any) -> tuple[Any, ...]:
            here, graph = loop.roster, loop.graph.switches
            return here.rows, here.nearest, here.times, here.switches.steps, graph.steps

        rows = self.present, self.nearest, self.since, steps, steps
        types = (np.asarray(old).dtype for old in numbers(loop))
        return eqx.tree_at(numbers, loop, tuple(map(np.asarray, rows, types)))


def attendance(graph: Graph, events: Sequence[Event], leaderward: bool, dt: float) -> Attendance:
    """Return who is there after events that are possible, with steps of dt (s)."""
    if not events:
        weights = graph.before.exchange(leaderward).weights
        here = np.ones(graph.agents, bool), np.array(graph.nearest_leader()), np.zeros(graph.agents)
        return Attendance(*(np.tile(np.asarray(x), (3, 1)) for x in (weights, *here)), step=0)
    after = graph.with_events(events, graph.backups)
    roster = roster_of(after, Settings(horizon=events[-1].at + dt, dt=dt), False)
    weights = np.asarray(after.exchange(leaderward).weights)
    assert isinstance(roster, ActiveAgents)
    rows = (weights, roster.rows, roster.nearest, roster.times)
    return Attendance(*(row[[*_STRETCHES]] for row in rows), step=round(events[-1].at / dt))


def room_for_events(parts: Parts, dt: float) -> Parts:
    """Return parts whose loop has numbers for who is there and for a reshape, if these can be."""
    graph, model, formation = parts.graph.before, parts.model, parts.formation
    if model.position and formation.motion is None:
        still = Reshape(formation.offsets, 0.0, RESHAPE)
        parts = parts.replace(formation=formation.moving(model, graph, [still]))
    if graph.schedule is not None:
        return parts
    agent = graph.followers[-1]
    return parts.replace(events=(Lose(agent, dt), Join(agent, 2.0 * dt)))


def happened(
    graph: Graph, events: Sequence[Event], name: str, agent: Any, at: float
) -> tuple[Event, ...]:
    """Return events and another one, of the name `lose` or `join`, at a time (s).

    Raises:
        SimulationError: it is of no agent.
        GraphError: it is not possible, as the loss of a leader without backup leaders.
    """
    if type(agent) is not int or not 0 <= agent < graph.agents:
        raise SimulationError(f"`{name}` got `{agent}`, and must be the number of an agent.")
    if graph.before.schedule is not None:
        raise SimulationError("agents of a graph that switches cannot be lost or join.")
    own = [each for each in events if each.agents == (agent,)]
    if name == "join" and not (own and own[-1].comes is False):
        raise SimulationError(f"agent {agent} cannot join, since it is there.")
    after = (*events, KINDS[name](agent, at))
    graph.with_events(after, graph.backups)
    return after


def as_entries(events: Sequence[Event]) -> list[JsonObject]:
    """Return losses and arrivals as a scenario states them."""
    pairs = ((each, each.agents[0]) for each in events)
    return [{"at": each.at, type(each).__name__.lower(): agent} for each, agent in pairs]


def moments_of(events: Sequence[Event], changes: Sequence[JsonObject]) -> list[tuple[float, str]]:
    """Return when who was lost or joined, and the shape changed, in words, by time."""
    moments = [(event.at, str(event)) for event in events]
    shapes = [(each["at"], each["reshape"]) for each in changes if "reshape" in each]
    return sorted([*moments, *((at, f"the shape becomes {name}") for at, name in shapes)])


def as_changes(entries: Sequence[JsonObject]) -> list[JsonObject]:
    """Return the section `events` of a scenario as changes of a live loop."""
    changes, named = list[JsonObject](), set[int]()
    own = next((entry["python"] for entry in entries if "python" in entry), None)
    if own is not None:
        raise SimulationError(f"the event `{own}` cannot happen live; use `echelon run`.")
    for entry in sorted(entries, key=lambda entry: entry["at"]):
        agents = {entry[name] for name in KINDS if name in entry}
        if "join" in entry and not agents <= named:
            # Until it joins it is absent.
            changes.append({"at": 0.0, "lose": entry["join"]})
        named |= agents
        changes.append({name: value for name, value in entry.items() if name != "for"})
        if "for" in entry:
            changes.append({"at": entry["at"] + entry["for"], "restore": entry["cut"]})
    return changes
