"""What happens during a run: agents are lost or join, links are cut, backup leaders take the lead.

All of it is stated before the run, so that a graph with events is one that switches.
"""

import dataclasses
import math
import numbers
from collections.abc import Iterator, Sequence
from typing import NamedTuple, final

import numpy as np

from echelon.agents.network.edges import name_agents
from echelon.agents.network.matrices import GraphMatrices, nearest_leaders, unreached
from echelon.agents.network.switching import Schedule
from echelon.agents.part import Event
from echelon.core.errors import GraphError, is_number
from echelon.core.trace import error_summary
from echelon.core.types import Array


@final
@dataclasses.dataclass(frozen=True)
class Lose(Event):
    """An agent falls silent, and its body is gone.

    Args:
        agent: its number.
        at: time, s.
    """

    agent: int
    at: float
    comes = False

    @property
    def agents(self) -> tuple[int, ...]:
        """The agent."""
        return (self.agent,)

    def uncovered(self, graph: GraphMatrices) -> str:
        """Return that it leads; of others nothing is lost but their links."""
        schedule = graph.schedule
        assert schedule is not None and schedule.nearest is not None
        before = max(schedule.row(self.at) - 1, 0)
        if not (schedule.nearest[before] == self.agent).any():
            return ""
        return f"{self} at {self.at:g} s while it leads, and until a backup takes over nobody does"

    def __str__(self) -> str:
        return f"agent {self.agent} is lost"


@final
@dataclasses.dataclass(frozen=True)
class Join(Event):
    """An agent joins in its initial state; before, it is neither heard nor anywhere.

    Args:
        agent: its number.
        at: time, s.
    """

    agent: int
    at: float
    comes = True

    @property
    def agents(self) -> tuple[int, ...]:
        """The agent."""
        return (self.agent,)

    def uncovered(self, graph: GraphMatrices) -> str:
        """Return that it may be anywhere."""
        return f"{self} at {self.at:g} s, and nothing bounds how far from its goal it is then"

    def __str__(self) -> str:
        return f"agent {self.agent} joins"


@final
@dataclasses.dataclass(frozen=True)
class Cut(Event):
    """A link carries nothing, either way.

    Args:
        link: the two agents.
        at: time, s.
        duration: s; None for ever.
    """

    link: tuple[int, int]
    at: float
    duration: float | None = None

    @property
    def agents(self) -> tuple[int, ...]:
        """The two agents."""
        return tuple(self.link)

    @property
    def end(self) -> float:
        """When the link is restored, s."""
        return math.inf if self.duration is None else self.at + self.duration

    def faults(self, graph: GraphMatrices) -> Iterator[str]:
        """Yield that there is no such link."""
        if frozenset(self.link) not in {frozenset(edge) for edge in graph.edges.tolist()}:
            yield "the graph has no such link"

    def carried(self, graph: GraphMatrices, weights: Array) -> Array:
        """Return the weights without the link."""
        return np.where(np.isin(graph.edges, self.link).all(axis=1), 0.0, weights)

    def uncovered(self, graph: GraphMatrices) -> str:
        """Return nothing: it is of a graph that switches."""
        return ""

    def __str__(self) -> str:
        i, j = self.link
        span = "for ever" if self.duration is None else f"for {self.duration:g} s"
        return f"the link between agents {i} and {j} is cut {span}"


def check_backups(graph: GraphMatrices, backups: Sequence[int]) -> None:
    """Raise `GraphError` unless these agents may lead after the only leader of a graph."""
    for k, backup in enumerate(backups):
        if not _is_agent(backup, graph.agents):
            last = graph.agents - 1
            raise GraphError(
                f"backup leader {backup} is no agent; agents are numbered from 0 to {last}."
            )
        if backup in graph.leaders:
            raise GraphError(f"backup leader {backup} is the leader itself; name followers.")
        if backup in backups[:k]:
            raise GraphError(f"backup leader {backup} is named twice.")
    if backups and len(graph.leaders) > 1:
        raise GraphError(
            f"got backup leaders of {len(graph.leaders)} leaders, and there must be one."
        )


class EventFault(NamedTuple):
    """What is wrong with the event of a number, in words."""

    event: int
    text: str


def event_faults(
    graph: GraphMatrices, events: Sequence[Event], backups: Sequence[int], horizon: float = math.inf
) -> Iterator[EventFault]:
    """Yield what is wrong with each event; of those alone in order, whom they cut off.

    Args:
        graph: without events.
        events: in any order.
        backups: who takes the lead when the leader is lost, the first that is present.
        horizon: of the run, s.
    """
    faults = [*_alone(graph, events, horizon)]
    faults = faults or [*_in_order(graph, events, backups)]
    yield from faults or _cut_off(graph, events, backups)


def _alone(graph: GraphMatrices, events: Sequence[Event], horizon: float) -> Iterator[EventFault]:
    for k, event in enumerate(events):
        strange = [x for x in event.agents if not _is_agent(x, graph.agents)]
        if not (_is_time(event.at) and event.at < event.end):
            yield EventFault(k, f"{event} at {event.at} s, and times must be positive and finite")
        elif event.at >= horizon:
            yield EventFault(k, f"{event} at {event.at:g} s, and the run ends at {horizon:g} s")
        elif strange:
            last = graph.agents - 1
            yield EventFault(k, f"{event}, and agents are numbered from 0 to {last}")
        else:
            faults = (*event.faults(graph), *_misfits(event, graph))
            yield from (EventFault(k, f"{event}, and {text}") for text in faults[:1])


def _misfits(event: Event, graph: GraphMatrices) -> Iterator[str]:
    """Yield that weights of edges are none."""
    try:
        weights = np.asarray(event.carried(graph, graph.weights.copy()), float)
    # It is anyone's code, which may raise whatever it likes.
    except Exception as error:
        yield f"its `carried` fails with {error_summary(error)}"
        return
    shape = graph.weights.shape
    if weights.shape != shape or not ((weights >= 0.0) & (weights < math.inf)).all():
        yield "its `carried` must return the weights of all edges, finite and not negative"


def _is_time(value: object) -> bool:
    return is_number(value) and 0.0 < float(value) < math.inf


def _is_agent(value: object, agents: int) -> bool:
    return isinstance(value, numbers.Integral) and 0 <= int(value) < agents


def _in_order(
    graph: GraphMatrices, events: Sequence[Event], backups: Sequence[int]
) -> Iterator[EventFault]:
    absent = {x for event in events for x in event.agents if _joins_first(x, events)}
    if graph.schedule is not None and graph.schedule.period is not None and events:
        yield EventFault(0, "a graph with a `period` takes no events")
        return
    for k in _by_time(events):
        event = events[k]
        if event.comes is None:
            continue
        [agent] = event.agents
        if event.comes != (agent in absent):
            already = "present" if event.comes else "absent"
            yield EventFault(k, f"{event} at {event.at:g} s, when it is {already} already")
            return
        leads = agent in graph.leaders
        if leads and len(graph.leaders) > 1:
            yield EventFault(k, f"{event}, and one of several leaders cannot be lost, nor join")
            return
        if leads and event.comes and _joins_first(agent, events):
            yield EventFault(k, f"{event}, and nobody leads before")
            return
        absent ^= {agent}
        if {*graph.leaders} <= absent and {*backups} <= absent:
            remedy = "keep one of them" if backups else "name `backups` in `leadership`"
            yield EventFault(k, f"{event}, and nobody leads afterwards; {remedy}")
            return


def _by_time(events: Sequence[Event]) -> list[int]:
    return sorted(range(len(events)), key=lambda k: events[k].at)


def _joins_first(agent: int, events: Sequence[Event]) -> bool:
    ordered = (events[k] for k in _by_time(events))
    own = [event for event in ordered if event.comes is not None and agent in event.agents]
    return bool(own) and own[0].comes is True


def _cut_off(
    graph: GraphMatrices, events: Sequence[Event], backups: Sequence[int]
) -> Iterator[EventFault]:
    """Yield the event that cuts somebody off until the end."""
    order, cause = _by_time(events), None
    for count in range(len(order), 0, -1):
        so_far = [events[k] for k in order[:count]]
        schedule = schedule_of(graph, so_far, backups)
        lost = unreached(graph, schedule, len(schedule.starts) - 1)
        if not len(lost):
            break
        cause = order[count - 1], name_agents(lost)
    if cause is not None:
        k, who = cause
        after = f"from {events[k].at:g} s on"
        yield EventFault(k, f"{events[k]}, and {who} no path to the leader {after}")


def schedule_of(
    graph: GraphMatrices,
    events: Sequence[Event],
    backups: Sequence[int] = (),
    absent: Sequence[int] = (),
) -> Schedule:
    """Return the schedule of links, presence and leaders; `absent` agents are so until the end."""
    base = graph.schedule or Schedule(np.zeros(1), graph.weights[None], None)
    times = [*base.starts.tolist(), *(at for event in events for at in (event.at, event.end))]
    starts = np.unique([at for at in times if at < math.inf])
    weights = base.weights[[base.row(at) for at in starts.tolist()]].copy()
    for event in events:
        for row in np.flatnonzero((starts >= event.at) & (starts < event.end)):
            weights[row] = event.carried(graph, weights[row])
    if all(event.comes is None for event in events) and not absent:
        return Schedule(starts, weights, None)
    present = _present(starts, graph.agents, events)
    present[:, list(absent)] = False
    weights[~present[:, graph.edges].all(axis=2)] = 0.0
    nearest = np.tile(nearest_leaders(graph), (len(starts), 1))
    if len(graph.leaders) == 1:
        nearest[:] = _acting(present, graph.leaders[0], backups)[:, None]
    for array in (starts, weights, present, nearest):
        array.setflags(write=False)
    return Schedule(starts, weights, None, present, nearest)


def _present(starts: Array, agents: int, events: Sequence[Event]) -> Array:
    """Return who is present from each start on, (S, N)."""
    present = np.ones((len(starts), agents), bool)
    for k in _by_time(events):
        event = events[k]
        if event.comes is None:
            continue
        if event.comes and _joins_first(event.agents[0], events[: k + 1]):
            present[starts < event.at, event.agents] = False
        present[starts >= event.at, event.agents] = event.comes
    return present


def _acting(present: Array, leader: int, backups: Sequence[int]) -> Array:
    """Return who leads in each stretch, (S,): who did, or else the first backup leader there."""
    acting = list[int]()
    for here in present:
        # One that returns follows whoever leads by then.
        last = acting[-1] if acting else leader
        left = [agent for agent in (last, *backups) if here[agent]]
        acting.append(left[0] if left else last)
    return np.array(acting)
