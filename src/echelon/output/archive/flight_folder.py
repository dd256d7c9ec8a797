"""What flies: the folder of one agent's law, as Python and C, and that of a whole flight."""

import functools
import hashlib
import json
import math
import operator
import py_compile
from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from echelon import __version__
from echelon.agents.models.heading_symmetry import heading_index
from echelon.agents.models.linearization import own_damping
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.channel import NO_DEVIATIONS, Network
from echelon.core.errors import FlightError, OutputError
from echelon.core.files import write_atomic
from echelon.core.numerics import precision
from echelon.core.trace import shared_traces
from echelon.core.types import Array, JsonObject
from echelon.core.words import Verdict
from echelon.guarantees.promises.coverage import watched_by
from echelon.guarantees.promises.promise import guarantee_data
from echelon.laws.law import Travels
from echelon.output.archive.folder import write_errors
from echelon.simulation.engine.agent import Agent, OwnLaw
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.onboard.agent_functions import (
    agent_functions,
    message_sizes,
    motions_of,
    move_function,
    senders_of,
)
from echelon.simulation.onboard.message_words import (
    message_meaning,
    message_words,
    normalized_equation,
)
from echelon.simulation.onboard.source_code import LawFunction, c_text, header_text, python_text
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.networks import LateNetwork
from echelon.simulation.step.settings import Settings
from echelon_flight.parameters import DEFAULTS

_EXCLUDES = (
    "state estimation, message formats and time-outs, the vehicle's own control loops, and a "
    "supervisor that stops it",
    "other steps than `dt`",
)
_STATED = ("verdict", "claim", "theorem", "kind", "start", "graphs", "premises", "numbers")
_STATED += ("ignores", "covers_start", "until", "watched")
"""What law.json repeats of the guarantee of the formation."""
_CURRENT = "late or lost messages: the guarantee assumes that `z` is of the current step"
_LATE = "other networks than `network`"


@shared_traces()
def law_files(parts: Parts, settings: Settings, agent: int, formation: str) -> dict[str, str]:
    """Return the files of one agent's law by name.

    `formation` is a text that is equal for all agents of the formation alone.

    Raises:
        OutputError: the law has no scalar operations; with the file and line of a user's code.
        EchelonError: there is no such agent, or the parts do not fit each other.
    """
    own, double = _traced(parts, settings, agent)
    single, functions = agent_functions(own, 32), double.values()
    about, constants = _head(settings, agent, formation)
    files = {
        "law.py": python_text(functions, about, constants),
        "law.c": c_text(functions, single.values(), about),
        "law.h": header_text(functions, about, constants | _sizes(double)),
    }
    stated = guarantee_data(parts, settings) | _watched(parts, settings, agent)
    return {**files, "law.json": _facts(own, double, constants, stated, files)}


def python_law(
    parts: Parts, settings: Settings, agent: int, formation: str, stated: JsonObject
) -> dict[str, str]:
    """Return law.py and law.json of one agent, as `law_files`, with its guarantee."""
    own, functions = _traced(parts, settings, agent)
    about, constants = _head(settings, agent, formation)
    files = {"law.py": python_text(functions.values(), about, constants)}
    stated = stated | _watched(parts, settings, agent)
    return {**files, "law.json": _facts(own, functions, constants, stated, files)}


def _watched(parts: Parts, settings: Settings, agent: int) -> JsonObject:
    return {"watched": watched_by(parts, settings, agent)}


def _traced(parts: Parts, settings: Settings, agent: int) -> tuple[OwnLaw, dict[str, LawFunction]]:
    own = Agent(parts, agent, settings.dt, settings.limits).own_law
    try:
        return own, agent_functions(own)
    except Unsupported as error:
        raise OutputError(
            f"the law of agent {agent} cannot be exported: there is no code for {error}."
        ) from None


def _head(settings: Settings, agent: int, formation: str) -> tuple[str, dict[str, float | str]]:
    mark = hashlib.sha256(f"{__version__}\n{settings.dt!r}\n{formation}".encode()).hexdigest()
    about = f"The law of agent {agent}, by echelon {__version__}; see law.json."
    return about, {"AGENT": agent, "DT": settings.dt, "FORMATION": mark}


def _facts(
    own: OwnLaw,
    functions: Mapping[str, LawFunction],
    constants: Mapping[str, float | str],
    stated: JsonObject,
    files: Mapping[str, str],
) -> str:
    dt = float(constants["DT"])
    described = {
        "agent": constants["AGENT"],
        "formation": constants["FORMATION"],
        **_description(own, functions),
        "dt": dt,
        "network": _network_facts(own, dt),
        "guarantee": {key: stated[key] for key in _STATED} | _failed(stated),
        "excluded": [*_EXCLUDES, _LATE if isinstance(own.loop.network, LateNetwork) else _CURRENT],
        "echelon": __version__,
        "sha256": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()},
    }
    return json.dumps(described, indent=2) + "\n"


def _failed(stated: JsonObject) -> JsonObject:
    """Return what a claim is left conditional on, and what stands against any."""
    lines = [line for line in stated["conditions"] if line["verdict"] == str(Verdict.FAILS)]
    names = {"while": "while", "against": "reason"}
    return {name: [x[key] for x in lines if x[key]] for name, key in names.items()}


def _sizes(functions: Mapping[str, LawFunction]) -> dict[str, int]:
    """Return how many numbers each array of the functions has."""
    sizes = {name: size for f in functions.values() for name, size in f.inputs.items() if size}
    sizes |= {name: len(x) for f in functions.values() for name, x in f.outputs.items()}
    return {name.upper(): size for name, size in sizes.items()}


def _description(own: OwnLaw, functions: Mapping[str, LawFunction]) -> JsonObject:
    model = own.loop.model
    return {
        "leads": own.leads,
        "hears": senders_of(own),
        "message": message_sizes(own),
        "signal": list(own.signal_names),
        "feed_forward": message_words(own),
        "feed_forward_from": own.source,
        "feed_forward_meaning": message_meaning(own),
        "states": dict(zip(model.state_names, model.state_units, strict=True)),
        "inputs": dict(zip(model.input_names, model.input_units, strict=True)),
        "trim": dict(zip(model.input_names, model.trim[1], strict=True)),
        "scale": np.asarray(model.input_scale, float).tolist(),
        "normalized": normalized_equation(model),
        "memory": len(functions["begin"].outputs["memory"]),
        "operations": {name: f.operations for name, f in functions.items()},
    }


def _network_facts(own: OwnLaw, dt: float) -> JsonObject | None:
    """Return what an agent needs to send messages that are late; None in the ideal network."""
    network = own.loop.network
    if not isinstance(network, LateNetwork):
        return None
    period, messages = int(network.medium.every) * dt, str(network.medium.messages)
    return {"period": period, "messages": messages, "leaders": own.loop.laws.leaders.tolist()}


def save_law(files: Mapping[str, str], folder: Path) -> None:
    """Write the files into a folder that is new or empty.

    Raises:
        OutputError: they cannot be written.
    """
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            write_atomic(folder / name, text)


_SUBSTEPS = 2
"""Of a simulated vehicle in a period of the law; an input acts from the next one on."""
_MARGIN, _FASTER = 1.5, 4.0
"""m and m/s, by which a fence is beyond the starts and the plan."""
_EVERY = 0.02  # s between offsets of a formation that moves
_SINKING = -0.5  # m/s


def flight_files(parts: Parts, settings: Settings, formation: str) -> dict[str, str]:
    """Return the files of a flight by name.

    What `parts` say of plants, wind and sensors is of simulated vehicles.

    Raises:
        FlightError: messages are not those that fly.
        OutputError: a law or a vehicle has no scalar operations.
        EchelonError: the parts do not fit each other.
    """
    network = _network(parts)
    agents, rule = parts.graph.agents, parts.leadership
    files, stated = dict[str, str](), guarantee_data(parts, settings)
    for k in range(agents):
        law = python_law(parts, settings, k, formation, stated)
        files |= {f"law-{k}/{name}": text for name, text in law.items()}
    facts = json.loads(files["law-0/law.json"])
    vehicles = _vehicles(parts, settings)
    described = {
        "formation": facts["formation"],
        "agents": agents,
        "dt": settings.dt,
        "horizon": settings.horizon,
        "message": facts["message"],
        "leader": min(parts.graph.leaders),
        "leadership": rule and {"backups": list(rule.backups), "timeout": rule.timeout},
        "weather": {"delay": network.delay, "jitter": network.jitter, "loss": network.loss},
        **_places(parts.model),
        "fence": _fence(parts, settings),
        "parameters": dict(DEFAULTS),
        "plan": _plan(parts, settings),
        "offsets": _offsets(parts, settings),
        "vehicles": vehicles[0],
    }
    return {**files, **vehicles[1], "flight.json": json.dumps(described, indent=2) + "\n"}


def _network(parts: Parts) -> Network:
    network = parts.world.network
    if network is None:
        raise FlightError(f"{NO_DEVIATIONS.format('no `network`')}.")
    if not isinstance(parts.drive, Laws):
        raise FlightError("the agents of the scenario are under no laws, and only laws can fly.")
    if parts.events:
        raise FlightError(
            "`events` are of simulations; in a flight agents and links are lost by themselves. Use "
            "`--set events=null`."
        )
    if parts.graph.schedule is not None:
        raise FlightError("the graph of the scenario switches, which no flight does yet.")
    for text in filter(None, (part.unflown() for part in parts.world.all_parts)):
        raise FlightError(f"{text}.")
    return network


def _places(model: ControlAffine) -> JsonObject:
    """Return which states a supervisor looks at."""
    names = model.state_names
    velocity = model.state_groups.get("velocity", ())
    tilt = ("roll", "pitch") if {"roll", "pitch"} <= {*names} else ()
    return {
        "position": list(model.position_indices()),
        "velocity": [names.index(name) for name in velocity],
        "tilt": [names.index(name) for name in tilt],
    }


def _offsets(parts: Parts, settings: Settings) -> JsonObject:
    """Return where agents belong relative to each other, m, every so often (s)."""
    moves = parts.formation.motion is not None
    count = 1 + math.ceil(settings.horizon / _EVERY) if moves else 1
    places = parts.formation.offsets_at(_EVERY * np.arange(count))
    rows = places[:, :, list(parts.model.position_indices())]
    return {"every": _EVERY, "rows": np.round(rows, 7).tolist()}


def _plan(parts: Parts, settings: Settings) -> JsonObject | None:
    """Return where the plan has each agent, m, every so often (s); None without a path."""
    model, drive = parts.model, prepare(parts, settings).parts.drive
    assert isinstance(drive, Laws)
    times = _EVERY * np.arange(1 + math.ceil(settings.horizon / _EVERY))
    with precision("float64"):
        plan = Travels.of(drive.leader).reference_states(model, jnp.asarray(times))
    if plan is None:
        return None
    places = list(model.position_indices())
    goals = np.asarray(plan)[:, None, places] + parts.formation.offsets_at(times)[:, :, places]
    return {"every": _EVERY, "rows": np.round(goals, 4).tolist()}


def _fence(parts: Parts, settings: Settings) -> JsonObject:
    prepared = prepare(parts, settings)
    drive, model = prepared.parts.drive, parts.model
    assert isinstance(drive, Laws)
    places = list(model.position_indices())
    corners, fastest = [prepared.problem.states[:, places]], 0.0
    times = np.linspace(0.0, settings.horizon, 400)
    with precision("float64"):
        plan = Travels.of(drive.leader).reference_states(model, jnp.asarray(times))
    if plan is not None:
        path = np.asarray(plan)[:, places]
        goals = path[:, None] + parts.formation.offsets_at(times)[:, :, places]
        corners += list(goals)
        steps = np.diff(goals, axis=0) / np.diff(times)[:, None, None]
        fastest = float(np.linalg.norm(steps, axis=2).max(initial=0.0))
    points = np.vstack(corners)
    return {
        "low": _rounded(points.min(axis=0) - _MARGIN),
        "high": _rounded(points.max(axis=0) + _MARGIN),
        "speed": round(fastest + _FASTER, 2),
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(value), 3) for value in values]


def _vehicles(parts: Parts, settings: Settings) -> tuple[JsonObject, dict[str, str]]:
    prepared, model = prepare(parts, settings), parts.model
    motion, agents = prepared.problem.motion, parts.graph.agents
    about = "The motion of a simulated vehicle in a part of a control step."
    with precision("float64"):
        own = motions_of(motion, agents, _SUBSTEPS)
        hover = [[float(u) for u in each.plant.trim[1]] for each in own]
    try:
        texts = [python_text([move_function(each)], about, {}) for each in own]
    except Unsupported as error:
        raise OutputError(f"the vehicles have no code for {error}.") from None
    names = [f"vehicle-{texts.index(text)}.py" for text in texts]
    trim_x, trim_u = (list(map(float, part)) for part in motion.plant.trim)
    still = dict.fromkeys(("constant", "rms", "noise"), [0.0] * len(trim_x))
    simulated = [
        part.simulated(motion.plant, settings.dt / _SUBSTEPS) for part in parts.world.all_parts
    ]
    facts = {
        "starts": np.asarray(prepared.problem.states).tolist(),
        "files": names,
        "substeps": _SUBSTEPS,
        # As autopilots do, which find the thrust of hovering by themselves.
        "trim": hover,
        "rest": trim_x,
        **_autopilot(model, trim_x),
        "memory": trim_u if motion.motors.remembers else [],
        "fade": 0.0,
        "seed": settings.seed,
        **functools.reduce(operator.or_, simulated, still),
    }
    return facts, dict(zip(names, texts, strict=True))


def _autopilot(model: ControlAffine, rest: list[float]) -> JsonObject:
    """Return how a simulated autopilot levels and sinks, by the model's own damping."""
    names, places = model.state_names, list(model.position_indices())
    velocity = [names.index(name) for name in model.state_groups.get("velocity", ())]
    feedback = np.zeros((len(model.input_names), len(names)))
    height = names.index("z") if "z" in model.position else None
    sinking = list(rest)
    damping = own_damping(model)
    if damping is not None and height is not None and len(velocity) == len(places):
        feedback = np.asarray(model.input_scale) @ damping
        climbing = velocity[places.index(height)]
        # It knows neither its place nor its heading, and levels without them.
        feedback[:, [k for k in velocity if k != climbing]] = 0.0
        sinking[climbing] = _SINKING
    return {
        "levelling": feedback.tolist(),
        "sinking": sinking,
        "height": height,
        "place": [*places, *([] if model.heading is None else [heading_index(model)])],
    }


def save_flight(files: Mapping[str, str | bytes], folder: Path) -> None:
    """Write the files into a folder that is new or empty.

    Raises:
        OutputError: they cannot be written.
    """
    with write_errors(folder):
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_atomic(folder / name, content)
            if name.endswith(".py"):
                # An agent's process then needs half the time and memory to begin.
                py_compile.compile(str(folder / name))
