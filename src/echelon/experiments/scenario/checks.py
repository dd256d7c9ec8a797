"""Faults of a scenario that no single key shows: keys at odds with others, agents not there.

The checks read the plain data of the file and step around whatever is malformed (the schema reports
that), so one fault never hides another. Each check yields the path of a fault and its sentence.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from echelon.core.errors import did_you_mean, listing
from echelon.core.limits import horizon_fault
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.yaml import Document, KeyPath, are, shown

Finding = tuple[KeyPath, str]
Part = Mapping[object, object]

_STOPPING = "stopping-point"
_TRACKS = ("tracking", "lqr", "optimal-tracking", _STOPPING)
"""The leader laws that follow a reference; the last one does without, too."""

# Of these two keys a section has one at most; True where it must have one.
SOURCES: dict[str, tuple[str, str, bool]] = {
    "model": ("name", "python", True),
    "graph": ("edges", "name", True),
    "formation": ("offsets", "name", False),
    "reference": ("name", "python", True),
}

# What a choice needs beside itself and what it takes; keys that stand nowhere here are everybody's.
_Taken = dict[str, tuple[tuple[str, ...], tuple[str, ...]]]
_GRAPH_KEYS: _Taken = dict.fromkeys(registry.GRAPHS, (("agents",), ("directed",))) | {
    "edges": ((), ("agents", "weights", "directed", "schedule", "period")),
    "grid": (("rows", "columns"), ("agents", "directed")),
    "geometric": (("agents", "radius"), ("seed", "directed")),
}
_FORMATION_KEYS: _Taken = dict.fromkeys(registry.FORMATIONS, ((), ("spacing",))) | {
    "offsets": ((), ()),
    "grid": ((), ("spacing", "columns")),
}
_GAIN_KEYS: _Taken = {name: (entry.needs, entry.takes) for name, entry in registry.METHODS.items()}
_GAIN_KEYS["file"] = ((), ())
_LAW_KEYS: dict[str, _Taken] = {
    "leader": {
        # Where a leader starts is the run's, and who cannot react is told so by the builder.
        name: (entry.needs, ("reacts", "start_error", *entry.takes))
        for name, entry in registry.LEADER_LAWS.items()
    },
    "follower": {
        name: (entry.needs, entry.takes) for name, entry in registry.FOLLOWER_LAWS.items()
    },
}


def section(data: Part, *path: str) -> Part:
    """Return the mapping at `path`; an empty one where there is none."""
    for key in path:
        inner = data.get(key)
        data = inner if isinstance(inner, dict) else {}
    return data


def law_of(data: Part, role: str) -> object:
    """Return the law of a role, as the file names it or by default."""
    default = "consensus"
    if role == "leader":
        default = "passive" if data.get("reference") is None else "tracking"
        # Its followers are sent what no other law has.
        if law_of(data, "follower") == _STOPPING:
            default = _STOPPING
    return section(data, role).get("law", default)


def surplus_keys(role: str, law: object) -> list[str]:
    """Return the keys of a role that a law does not take; none of a law that no table has."""
    table = _LAW_KEYS.get(role, {})
    return [] if not isinstance(law, str) or law not in table else _foreign(law, table)


def number_of(value: object) -> float | None:
    """Return a real number as a float, anything else (a truth value too) as None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        # A whole number of 400 digits has no float.
        return math.inf


def _whole(value: object) -> int | None:
    # To `isinstance` a truth value is an int.
    return value if type(value) is int else None


def _infinite(value: object, path: KeyPath) -> Iterator[Finding]:
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _infinite(item, (*path, key))
        return
    number = number_of(value)
    if number is not None and not math.isfinite(number):
        yield path, f"got {shown(value)}, allowed is a finite number."


def _sources(data: Part) -> Iterator[Finding]:
    for name, (one, other, required) in SOURCES.items():
        part = data.get(name)
        if not isinstance(part, dict):
            continue
        given = [key for key in (one, other) if part.get(key) is not None]
        if len(given) == 2:
            yield (name,), f"got both `{one}` and `{other}`, allowed is one of them."
        elif required and not given:
            yield (name,), f"got neither `{one}` nor `{other}`, allowed is exactly one of them."


def _choice(part: Part, free: str) -> object:
    """Return what a section is made from, the key `free` or its name; None where both stand."""
    if part.get(free) is None:
        return part.get("name")
    return free if part.get("name") is None else None


def _taken(path: KeyPath, part: Part, choice: object, table: _Taken) -> Iterator[Finding]:
    """Yield keys that `choice` lacks, and keys that belong to another choice."""
    if not isinstance(choice, str) or choice not in table:
        return
    needed, optional = table[choice]
    for key in needed:
        if part.get(key) is None:
            yield (*path, key), f"got nothing, `{choice}` needs this key."
    foreign = _foreign(choice, table)
    allowed = are(needed + optional) if needed + optional else "is no other key"
    for key in part:
        if key in foreign:
            yield (
                (*path, str(key)),
                f"got a key that `{choice}` does not take, allowed beside it {allowed}.",
            )


def _foreign(choice: str, table: _Taken) -> list[str]:
    """Return the keys that other choices take, and this one does not."""
    keys = dict.fromkeys(key for pair in table.values() for keys in pair for key in keys)
    return [key for key in keys if key not in (*table[choice][0], *table[choice][1])]


def _choices(data: Part) -> Iterator[Finding]:
    graph, formation = section(data, "graph"), section(data, "formation")
    yield from _taken(("graph",), graph, _choice(graph, "edges"), _GRAPH_KEYS)
    yield from _taken(("formation",), formation, _choice(formation, "offsets"), _FORMATION_KEYS)
    for role in ("leader", "follower"):
        yield from _taken((role,), section(data, role), law_of(data, role), _LAW_KEYS[role])
        gain = section(data, role, "gain")
        sources = [key for key in ("file", "method", "python") if gain.get(key) is not None]
        if len(sources) > 1:
            both = " and ".join(f"`{key}`" for key in sources)
            yield (role, "gain"), f"got {both}, allowed is one of them."
        if "python" in sources:  # whose keys its class alone knows
            continue
        method = gain.get("method", registry.DEFAULT_METHOD)
        made_by = "file" if "file" in sources else method
        yield from _taken((role, "gain"), gain, made_by, _GAIN_KEYS)
        # The schema leaves open which further keys a method has.
        for key in (key for key in gain if isinstance(key, str) and key not in registry.GAIN_KEYS):
            said = f"got an unknown key, allowed {are(registry.GAIN_KEYS)}"
            yield (role, "gain", key), f"{said}{did_you_mean(key, registry.GAIN_KEYS)}."


def _pairs(graph: Part) -> Iterator[tuple[int, tuple[int, int]]]:
    """Yield the place in the list, and the two agents, of every well-formed edge.

    The smaller agent comes first, unless the graph is directed.
    """
    directed = graph.get("directed") is True
    edges = graph.get("edges")
    for index, edge in enumerate(edges if isinstance(edges, list) else ()):
        if not isinstance(edge, list) or len(edge) < 2:
            continue
        i, j = _whole(edge[0]), _whole(edge[1])
        if i is not None and j is not None and i != j and min(i, j) >= 0:
            yield index, ((i, j) if directed else (min(i, j), max(i, j)))


def _edges(document: Document) -> Iterator[Finding]:
    graph = section(document.data, "graph")
    agents = _whole(graph.get("agents"))
    first: dict[tuple[int, int], int] = {}
    for index, pair in _pairs(graph):
        path = ("graph", "edges", index)
        if pair in first:
            at = document.place(("graph", "edges", first[pair]))
            said = f"got agents `{pair[0]}` and `{pair[1]}` again, allowed is one edge for "
            said += "each way" if graph.get("directed") is True else "each pair"
            yield path, f"{said}, and theirs stands at {at}."
        first.setdefault(pair, index)
        if agents is not None and max(pair) >= agents > 0:
            yield path, f"got agent `{max(pair)}`, {_range(agents)}."


def _weights(data: Part) -> Iterator[Finding]:
    """Yield weights that are not one for each edge, and edges that have one already."""
    graph = section(data, "graph")
    edges, weights = graph.get("edges"), graph.get("weights")
    if not isinstance(edges, list) or not isinstance(weights, list):
        return
    if len(edges) != len(weights):
        said = f"got {len(weights)} weights, allowed is one for each of the {len(edges)} edges"
        yield ("graph", "weights"), f"{said}."
    for index, edge in enumerate(edges):
        if isinstance(edge, list) and len(edge) == 3:
            said = "got an edge with a weight, allowed is `[i, j]` beside `weights`"
            yield ("graph", "edges", index), f"{said}."
    for index, weight in enumerate(weights):
        number = number_of(weight)
        if number is not None and not number > 0.0:
            yield ("graph", "weights", index), f"got `{weight}`, allowed is a number above 0."


def _schedule(data: Part) -> Iterator[Finding]:
    """Yield a period of nothing, and times that do not ascend."""
    graph = section(data, "graph")
    stretches, period = graph.get("schedule"), number_of(graph.get("period"))
    if not isinstance(stretches, list) or not stretches:
        if graph.get("period") is not None:
            yield ("graph", "period"), "got a period, allowed is one beside a `schedule`."
        return
    last = 0.0
    for index, stretch in enumerate(stretches):
        at = number_of(stretch.get("at")) if isinstance(stretch, dict) else None
        if at is not None and 0.0 < at <= last:
            said = f"got `{stretch['at']}`, allowed are times that ascend, above {last:g} s here"
            yield ("graph", "schedule", index, "at"), f"{said}."
        last = max(last, at or 0.0)
    if period is not None and 0.0 < period <= last:
        said = f"got `{graph['period']}`, allowed is more than the last time of the schedule"
        yield ("graph", "period"), f"{said}, {last:g} s."


def _range(agents: int) -> str:
    return f"allowed are agents `0` to `{agents - 1}`" if agents > 1 else "allowed is agent `0`"


def _numbered(graph: Part) -> int | None:
    """Return the largest number in the edges, plus one; None where an edge cannot be read."""
    later = graph.get("schedule")
    all_ = [graph, *(later if isinstance(later, list) else [])]
    if not all(isinstance(part, dict) and isinstance(part.get("edges"), list) for part in all_):
        return None
    pairs = [pair for part in all_ for _, pair in _pairs(part)]
    if len(pairs) != sum(len(part["edges"]) for part in all_):
        return None
    return max((max(pair) + 1 for pair in pairs), default=None)


def _agents(graph: Part) -> int | None:
    """Return how many agents the graph has, as far as the file tells; None where it does not."""
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
        said = f"got `{agents}`, allowed is rows times columns, `{size}`"
        yield ("graph", "agents"), f"{said}, or no such key."


def _unknown(
    path: KeyPath, what: str, numbers: Iterable[tuple[Any, object]], agents: int
) -> Iterator[Finding]:
    """Yield every one of `numbers` (the key it stands at, and its value) that is no agent."""
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
    """Yield a leader that tracks nothing, and a reference that nobody tracks."""
    law, given = law_of(data, "leader"), data.get("reference") is not None
    if law in _TRACKS and law != _STOPPING and not given:
        yield (
            ("leader", "law"),
            f"got `{law}` without a `reference`, a leader that tracks needs one.",
        )
    if given and isinstance(law, str) and law in registry.LEADER_LAWS and law not in _TRACKS:
        said = f"got a reference for a leader whose law is `{law}`"
        yield ("reference",), f"{said}, allowed is one only with a law of {listing(_TRACKS)}."


def _changed(data: Part) -> Iterator[Finding]:
    """Yield parameters of the plant that are both given and scaled."""
    given, scaled = (section(data, "plant", key) for key in ("parameters", "scale"))
    for name in (name for name in scaled if isinstance(name, str) and name in given):
        said = "got a factor on a parameter that `plant.parameters` gives"
        yield ("plant", "scale", name), f"{said}, allowed is one of them."


def _durations(data: Part) -> Iterator[Finding]:
    simulation = section(data, "simulation")
    horizon, dt = number_of(simulation.get("horizon")), number_of(simulation.get("dt"))
    if horizon is None or dt is None or not (0 < horizon < math.inf and 0 < dt < math.inf):
        return
    fault = horizon_fault(horizon, dt)
    if fault is not None:
        got = f"got {shown(simulation['horizon'])}, which {fault}"
        yield ("simulation", "horizon"), f"{got}."


def cross_faults(document: Document) -> Iterator[Finding]:
    """Yield the path and the sentence of every fault that takes more than one key to see.

    Numbers that are not finite come first: where the schema stumbles over the same number, the
    sentence found here counts.
    """
    data = document.data
    yield from _infinite(data, ())
    yield from _sources(data)
    yield from _choices(data)
    yield from _edges(document)
    yield from _weights(data)
    yield from _schedule(data)
    yield from _grid(data)
    yield from _members(data)
    yield from _following(data)
    yield from _changed(data)
    yield from _durations(data)
