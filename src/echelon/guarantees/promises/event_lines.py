"""What is guaranteed through the events of a run: which of them a guarantee covers."""

from collections.abc import Iterator

from echelon.agents.network.events import Cut, Event, Join, agents_of
from echelon.agents.network.graph import Graph
from echelon.core.statement import Hypothesis, Statement, fails, holds
from echelon.core.types import JsonObject
from echelon.core.words import Kind
from echelon.guarantees.promises.promise import Promise
from echelon.simulation.engine.parts import Parts

_SEVERED = "cover", "it, as that of a graph that switches"
_BEREFT = "hold", "for all others, who do not hear it any more"
_REMEDY = "remove the event to see what is guaranteed without it"


def events_line(parts: Parts) -> Iterator[Statement]:
    """Yield whether a guarantee covers all events of a run; nothing without any."""
    graph, name = parts.graph, Hypothesis.EVENTS
    if graph.heirs and parts.world.network is not None:
        text = "an heir may take the lead whenever messages of the leader are lost for long"
        remedy = "remove `leadership` to see what is guaranteed without it"
        yield fails(name, Kind.PROOF, text, remedy=remedy, reason=text)
        return
    if not graph.events:
        return
    for event in graph.events:
        text = uncovered(graph, event)
        if text:
            shown = f"{event.at:g} s"
            yield fails(name, Kind.PROOF, text, event.at, shown, remedy=_REMEDY, reason=text)
            return
    text = "a cut link, and an agent that nobody hears any more, are those of a graph that switches"
    yield holds(name, Kind.PROOF, text, len(graph.events), f"{len(graph.events)} covered")


def uncovered(graph: Graph, event: Event) -> str:
    """Return why no guarantee covers an event; empty if one may."""
    if isinstance(event, Join):
        return f"{event} at {event.at:g} s, and nothing bounds how far from its goal it is then"
    if not isinstance(event, Cut) and _leads(graph, event):
        return f"{event} at {event.at:g} s while it leads, and until an heir takes over nobody does"
    return ""


def _leads(graph: Graph, event: Event) -> bool:
    """Tell whether an agent that is lost was followed until then."""
    schedule = graph.schedule
    assert schedule is not None and schedule.nearest is not None
    row = schedule.row(event.at)
    return bool((schedule.nearest[max(row - 1, 0)] == agents_of(event)[0]).any())


def events_in_words(parts: Parts, guarantee: Promise) -> list[JsonObject]:
    """Return each event of a run, by time, and what is guaranteed through it, ready for JSON."""
    prefix = guarantee.prefix
    return [
        {**as_mapping(event), "guarantee": _through(parts.graph, event, holding)}
        for event in parts.graph.events
        for holding in (prefix.promise if prefix and event.at < prefix.at else guarantee,)
    ]


def as_mapping(event: Event) -> JsonObject:
    """Return an event ready for JSON."""
    return {
        "at": event.at,
        "what": type(event).__name__.lower(),
        "agents": list(agents_of(event)),
        "until": event.end if isinstance(event, Cut) and event.duration is not None else None,
        "text": str(event),
    }


def _through(graph: Graph, event: Event, guarantee: Promise) -> JsonObject:
    """Return what is guaranteed through an event: of which kind, and in words."""
    why = uncovered(graph, event)
    if why or not guarantee.promised:
        text = f"Nothing is guaranteed through it: {why}." if why else "Nothing is guaranteed."
        if not why and guarantee.conditions:
            conditions = " and ".join(guarantee.conditions)
            text = f"Not guaranteed: the claim covers it while {conditions}. {guarantee.ignored()}"
            text = text.rstrip()
        return {"promised": False, "kind": None, "sentence": text}
    verb, what = _SEVERED if isinstance(event, Cut) else _BEREFT
    if guarantee.without:
        # It is of another flight, and covers nothing of this one.
        text = f"The guarantee would {verb} {what}. {guarantee.ignored()}"
        return {"promised": False, "kind": None, "sentence": text}
    text = f"The guarantee {verb}s {what}."
    return {"promised": True, "kind": str(guarantee.kind), "sentence": text}
