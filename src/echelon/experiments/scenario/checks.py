"""Checks of a scenario across its keys: keys that exclude each other, agents that do not exist.

They read the plain data of the file and skip whatever is malformed (the schema reports that), so
one fault never hides another. Each check yields the path of a fault and its sentence.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeGuard

from pydantic import BaseModel

from echelon.core.errors import did_you_mean, is_number, listing
from echelon.core.limits import LARGEST, horizon_fault
from echelon.core.words import amount
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.formation_sections import FormationSpec
from echelon.experiments.scenario.law_sections import FollowerSpec, GainSpec, LeaderSpec
from echelon.experiments.scenario.sections import GraphSpec
from echelon.experiments.scenario.values import foreign_keys, marked_keys
from echelon.experiments.scenario.yaml import Document, KeyPath, is_or_are, quoted

Finding = tuple[KeyPath, str]
Part = Mapping[object, object]

_GAIN_SOURCES = (("file", "method", "python"), False)
SOURCES: dict[KeyPath, tuple[tuple[str, ...], bool]] = {
    ("model",): (("name", "python"), True),
    ("graph",): (("edges", "name"), True),
    ("formation",): (("offsets", "name"), False),
    ("reference",): (("name", "python"), True),
    ("leader", "gain"): _GAIN_SOURCES,
    ("follower", "gain"): _GAIN_SOURCES,
}
"""The keys of each section of which at most one is allowed, and whether one is required."""
ROLES: dict[str, tuple[type[BaseModel], Mapping[str, registry.Entry]]] = {
    "leader": (LeaderSpec, registry.LEADER_LAWS),
    "follower": (FollowerSpec, registry.FOLLOWER_LAWS),
}


def section(data: Part, *path: str | int) -> Part:
    """Return the mapping at `path`; an empty one where there is none."""
    for key in path:
        inner = data.get(key)
        data = inner if isinstance(inner, dict) else {}
    return data


def law_of(data: Part, role: str) -> object:
    """Return the law of a role, as the file names it or by default."""
    default = registry.DEFAULT_FOLLOWER_LAW
    if role == "leader":
        reference = data.get("reference") is not None
        default = registry.default_leader_law(law_of(data, "follower"), reference)
    return section(data, role).get("law", default)


def surplus_keys(role: str, law: object) -> list[str]:
    """Return the keys of a role that a law does not take; none of a law that no table has."""
    kind, laws = ROLES.get(role, (BaseModel, {}))
    return foreign_keys(kind, law) if isinstance(law, str) and law in laws else []


def number_of(value: object) -> float | None:
    """Return a real number as a float, anything else (a truth value too) as None."""
    return float(value) if is_number(value) and abs(value) <= LARGEST else None


def _whole(value: object) -> int | None:
    # To `isinstance` a truth value is an int.
    return value if type(value) is int else None


def _too_large(value: object, path: KeyPath) -> Iterator[Finding]:
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _too_large(item, (*path, key))
    elif is_number(value) and not abs(value) <= LARGEST:
        yield path, f"got {quoted(value)}, allowed is a number from -{LARGEST:g} to {LARGEST:g}."


def _sources(data: Part) -> Iterator[Finding]:
    for path, (sources, required) in SOURCES.items():
        part = section(data, *path)
        present = [key for key in sources if part.get(key) is not None]
        if len(present) > 1:
            got = " and ".join(f"`{key}`" for key in present)
            yield path, f"got {got}, allowed is one of them."
        elif required and not present and isinstance(data.get(path[0]), dict):
            yield path, f"got neither {' nor '.join(map('`{}`'.format, sources))}, one is required."


def _taken(
    data: Part, path: KeyPath, kind: type[BaseModel], choice: object, choices: Iterable[str]
) -> Iterator[Finding]:
    """Yield the keys that `choice` lacks, and those that belong to other choices."""
    if not isinstance(choice, str) or choice not in choices:
        return
    part, foreign = section(data, *path), foreign_keys(kind, choice)
    for key, mark in marked_keys(kind).items():
        if choice in mark.needed_by and part.get(key) is None:
            yield (*path, key), f"got nothing, `{choice}` needs this key."
    # The keys that make the choice are no keys of what is chosen.
    other = {"law", *SOURCES.get(path, ((), False))[0], *foreign}
    allowed = [key for key in kind.model_fields if key not in other]
    for key in (key for key in part if key in foreign):
        message = f"allowed {is_or_are(allowed)}" if allowed else "it takes no keys"
        yield (*path, str(key)), f"got a key that `{choice}` does not take, {message}."


def _source(data: Part, path: KeyPath) -> str | None:
    """Return the only one of its sources that a section has, else None."""
    part = section(data, *path)
    present = [key for key in SOURCES[path][0] if part.get(key) is not None]
    return present[0] if len(present) == 1 else None


def _choices(data: Part) -> Iterator[Finding]:
    for name, kind, table in (
        ("graph", GraphSpec, registry.GRAPHS),
        ("formation", FormationSpec, registry.FORMATIONS),
    ):
        source = _source(data, (name,))
        choice = section(data, name).get("name") if source == "name" else source
        yield from _taken(data, (name,), kind, choice, (*table, "edges", "offsets"))
    for role, (kind, laws) in ROLES.items():
        yield from _taken(data, (role,), kind, law_of(data, role), laws)
        yield from _gain_choices(data, (role, "gain"))


def _gain_choices(data: Part, path: KeyPath) -> Iterator[Finding]:
    gain = section(data, *path)
    # The class of the user alone knows its keys.
    if gain.get("python") is not None:
        return
    made_by = gain.get("method", registry.DEFAULT_METHOD)
    made_by = made_by if gain.get("file") is None else "file"
    yield from _taken(data, path, GainSpec, made_by, (*registry.METHODS, "file"))
    # The schema accepts further keys, which a class of the user may have.
    keys = list(GainSpec.model_fields)
    for key in (key for key in gain if isinstance(key, str) and key not in keys):
        yield (
            (*path, key),
            f"got an unknown key, allowed {is_or_are(keys)}{did_you_mean(key, keys)}.",
        )


def _edge_lists(graph: Part) -> Iterator[tuple[KeyPath, list[Any]]]:
    """Yield the path and the items of every list of edges: the first one and the schedule's."""
    later = graph.get("schedule")
    stretches = [("schedule", k, part) for k, part in enumerate(later)] if _is_list(later) else []
    for *inside, part in ((graph,), *stretches):
        edges = part.get("edges") if isinstance(part, dict) else None
        if isinstance(edges, list):
            yield ("graph", *inside, "edges"), edges


def _is_list(value: object) -> TypeGuard[list[Any]]:
    return isinstance(value, list)


def _pairs(edges: list[Any], directed: bool = True) -> Iterator[tuple[int, tuple[int, int]]]:
    """Yield the place in the list, and the two agents, of every well-formed edge.

    The smaller agent comes first, unless the graph is directed.
    """
    for index, edge in enumerate(edges):
        if not isinstance(edge, list) or len(edge) < 2:
            continue
        i, j = _whole(edge[0]), _whole(edge[1])
        if i is not None and j is not None and i != j and min(i, j) >= 0:
            yield index, ((i, j) if directed else (min(i, j), max(i, j)))


def _edges(document: Document) -> Iterator[Finding]:
    graph = section(document.data, "graph")
    agents, directed = _whole(graph.get("agents")), graph.get("directed") is True
    for path, edges in _edge_lists(graph):
        first: dict[tuple[int, int], int] = {}
        for index, pair in _pairs(edges, directed):
            if pair in first:
                at = document.place((*path, first[pair]))
                per = "direction" if directed else "pair"
                message = f"got a second edge of agents `{pair[0]}` and `{pair[1]}`"
                yield (
                    (*path, index),
                    f"{message}, allowed is one for each {per}; the first is at {at}.",
                )
            first.setdefault(pair, index)
            if agents is not None and max(pair) >= agents > 0:
                yield (*path, index), f"got agent `{max(pair)}`, {_range(agents)}."


def _gaps(data: Part) -> Iterator[Finding]:
    """Yield an edge whose agents have numbers that leave others, which are in no edge."""
    graph = section(data, "graph")
    if graph.get("agents") is not None or _numbered(graph) is None:
        return
    leaders = graph.get("leaders")
    numbers = [
        (agent, (*path, index))
        for path, edges in _edge_lists(graph)
        for index, pair in _pairs(edges)
        for agent in pair
    ]
    named = {agent for agent, _ in numbers}
    # A leader needs no edge.
    named |= {_whole(agent) for agent in (leaders if _is_list(leaders) else [0])} - {None}
    last, place = max(numbers)
    if last >= len(named):
        lost = next(agent for agent in range(last) if agent not in named)
        yield (
            place,
            f"got agent `{last}`, but agent `{lost}` is in no edge; number agents without gaps.",
        )


def _weights(data: Part) -> Iterator[Finding]:
    """Yield a wrong number of weights, edges that already have a weight, and wrong weights."""
    graph = section(data, "graph")
    edges, weights = graph.get("edges"), graph.get("weights")
    listed: list[tuple[KeyPath, object]] = []
    if isinstance(edges, list) and isinstance(weights, list):
        if len(edges) != len(weights):
            message = (
                f"got {amount(len(weights), 'weight')} for {amount(len(edges), 'edge')}, allowed "
                "is one for each edge"
            )
            yield ("graph", "weights"), f"{message}."
        for index, edge in enumerate(edges):
            if isinstance(edge, list) and len(edge) == 3:
                message = "got an edge with a weight, allowed with `weights` is `[i, j]`"
                yield ("graph", "edges", index), f"{message}."
        listed += [(("graph", "weights", index), weight) for index, weight in enumerate(weights)]
    for path, items in _edge_lists(graph):
        triples = ((k, edge) for k, edge in enumerate(items) if _is_list(edge) and len(edge) == 3)
        listed += [((*path, k, 2), edge[2]) for k, edge in triples]
    for place, weight in listed:
        number = number_of(weight)
        if number is not None and not number > 0.0:
            yield place, f"got the weight {quoted(weight)}, allowed is a number above 0."


def _schedule(data: Part) -> Iterator[Finding]:
    """Yield a period without a schedule, and times that do not ascend."""
    graph = section(data, "graph")
    stretches, period = graph.get("schedule"), number_of(graph.get("period"))
    if not isinstance(stretches, list) or not stretches:
        if graph.get("period") is not None:
            yield ("graph", "period"), "got a period without a `schedule`, which it needs."
        return
    last = 0.0
    for index, stretch in enumerate(stretches):
        at = number_of(stretch.get("at")) if isinstance(stretch, dict) else None
        if at is not None and 0.0 < at <= last:
            message = f"got `{stretch['at']}`, allowed are ascending times, here above {last:g} s"
            yield ("graph", "schedule", index, "at"), f"{message}."
        last = max(last, at or 0.0)
    if period is not None and 0.0 < period <= last:
        message = f"got `{graph['period']}`, allowed is a time after the last of the schedule"
        yield ("graph", "period"), f"{message}, {last:g} s."


def _range(agents: int) -> str:
    return f"allowed are agents `0` to `{agents - 1}`" if agents > 1 else "allowed is agent `0`"


def _numbered(graph: Part) -> int | None:
    """Return the largest number in the edges, plus one; None where an edge cannot be read."""
    later, lists = graph.get("schedule"), [edges for _, edges in _edge_lists(graph)]
    if len(lists) != 1 + (len(later) if _is_list(later) else 0):
        return None
    pairs = [pair for edges in lists for _, pair in _pairs(edges)]
    if len(pairs) != sum(map(len, lists)):
        return None
    return max((max(pair) + 1 for pair in pairs), default=None)


def _agents(graph: Part) -> int | None:
    """Return how many agents the graph has; None where the file does not say."""
    agents = _whole(graph.get("agents"))
    rows, columns = _whole(graph.get("rows")), _whole(graph.get("columns"))
    if graph.get("name") == "grid":
        agents = None if rows is None or columns is None else rows * columns
    elif agents is None and graph.get("name") is None:
        agents = _numbered(graph)
    return agents if agents is not None and agents > 0 else None


def _grid(data: Part) -> Iterator[Finding]:
    graph = section(data, "graph")
    agents, size = _whole(graph.get("agents")), _agents(graph)
    if graph.get("name") == "grid" and agents is not None and size is not None and agents != size:
        message = f"got `{agents}`, allowed is rows times columns, `{size}`"
        yield ("graph", "agents"), f"{message}; the key may be left out."


def _unknown(
    path: KeyPath, what: str, numbers: Iterable[tuple[Any, object]], agents: int
) -> Iterator[Finding]:
    """Yield every one of `numbers` (its key and its value) that is no agent of the graph."""
    for key, value in numbers:
        agent = _whole(value)
        if agent is not None and not 0 <= agent < agents:
            yield (*path, key), f"got {what} `{agent}`, {_range(agents)}."


def _members(data: Part) -> Iterator[Finding]:
    """Yield leaders, offsets and starts of agents that the graph does not have."""
    graph = section(data, "graph")
    agents, leaders = _agents(graph), graph.get("leaders")
    leaders = leaders if isinstance(leaders, list) else [0]
    for index, leader in enumerate(leaders):
        if _whole(leader) is not None and leader in leaders[:index]:
            yield (
                ("graph", "leaders", index),
                f"got leader `{leader}` again, allowed is each agent once.",
            )
    if agents is None:
        return
    yield from _unknown(("graph", "leaders"), "leader", enumerate(leaders), agents)
    for place, key, what in (
        ("formation", "offsets", "an offset for agent"),
        ("initial", "states", "a state for agent"),
    ):
        numbered = ((number, number) for number in section(data, place, key))
        yield from _unknown((place, key), what, numbered, agents)


def _following(data: Part) -> Iterator[Finding]:
    """Yield a leader's law that lacks its reference, and a reference that the law does not take."""
    law, reference = law_of(data, "leader"), data.get("reference")
    entry = registry.LEADER_LAWS.get(law) if isinstance(law, str) else None
    if entry is not None and entry.reference == "needed" and reference is None:
        yield ("leader", "law"), f"got `{law}` without a `reference`, this law needs one."
    if entry is not None and entry.reference == "none" and reference is not None:
        message = f"got a reference, but the leader's law `{law}` takes none"
        yield ("reference",), f"{message}; {listing(registry.TRACKING_LAWS)} take one."


def _changed(data: Part) -> Iterator[Finding]:
    """Yield parameters of the plant that are both set and scaled."""
    values, factors = (section(data, "plant", key) for key in ("parameters", "scale"))
    for name in (name for name in factors if isinstance(name, str) and name in values):
        message = "got a factor for a parameter that `plant.parameters` sets"
        yield ("plant", "scale", name), f"{message}, allowed is one of them."


def _durations(data: Part) -> Iterator[Finding]:
    simulation = section(data, "simulation")
    horizon, dt = number_of(simulation.get("horizon")), number_of(simulation.get("dt"))
    if horizon is None or dt is None or not (horizon > 0.0 and dt > 0.0):
        return
    fault = horizon_fault(horizon, dt)
    if fault is not None:
        got = f"got {quoted(simulation['horizon'])}, which {fault}"
        yield ("simulation", "horizon"), f"{got}."


def _events(data: Part) -> Iterator[Finding]:
    """Yield events that are not one thing, and times for which nothing lasts."""
    events = data.get("events")
    listed = enumerate(events if isinstance(events, list) else ())
    for index, event in ((k, each) for k, each in listed if isinstance(each, dict)):
        got = [f"`{key}`" for key in ("lose", "cut", "join") if event.get(key) is not None]
        if len(got) != 1:
            text = f"got {' and '.join(got) or 'nothing that happens'}"
            yield ("events", index), f"{text}, allowed is one of `lose`, `cut` and `join`."
        elif event.get("for") is not None and got != ["`cut`"]:
            yield ("events", index, "for"), f"got a key that {got[0]} does not take."


def cross_faults(document: Document) -> Iterator[Finding]:
    """Yield the path and the sentence of every fault that concerns more than one key.

    Numbers that are too large come first: of the schema's sentence and this one it is reported.
    """
    data = document.data
    yield from _too_large(data, ())
    yield from _sources(data)
    yield from _choices(data)
    yield from _edges(document)
    yield from _gaps(data)
    yield from _weights(data)
    yield from _schedule(data)
    yield from _grid(data)
    yield from _members(data)
    yield from _following(data)
    yield from _changed(data)
    yield from _durations(data)
    yield from _events(data)
