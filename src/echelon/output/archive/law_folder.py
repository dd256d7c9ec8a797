"""The folder of one agent's law: as Python, as C, and what it is for."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from echelon import __version__
from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.core.trace import shared_traces
from echelon.core.types import JsonObject
from echelon.guarantees.promises.promise import guaranteed
from echelon.laws.law import Law
from echelon.output.archive.folder import write_errors
from echelon.simulation.engine.agent import Agent, OwnLaw
from echelon.simulation.engine.parts import Parts
from echelon.simulation.onboard.law_functions import (
    LawFunction,
    law_functions,
    message_meaning,
    message_words,
    normalized_equation,
)
from echelon.simulation.onboard.source_code import c_text, header_text, python_text
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.knowledge import HOP_LIFE
from echelon.simulation.step.settings import Settings

_EXCLUDES = (
    "state estimation, message formats and time-outs, the vehicle's own control loops, and a "
    "supervisor that stops it",
    "other steps than `dt`",
)
_CURRENT = "late or lost messages: the guarantee assumes that `z` is of the current step"
_LATE = "other networks than `network`"


@shared_traces()
def law_files(parts: Parts, settings: Settings, agent: int, formation: str) -> dict[str, str]:
    """Return the files of one agent's law by name.

    Args:
        parts: of the whole formation.
        settings: the step `dt` and whether the actuators' limits act.
        agent: its number.
        formation: a text that is equal for all agents of the formation alone.

    Raises:
        OutputError: the law has no scalar operations; with the file and line of a user's code.
        EchelonError: there is no such agent, or the parts do not fit each other.
    """
    own, double = _traced(parts, settings, agent)
    single, functions = law_functions(own, 32), double.values()
    about, constants = _head(settings, agent, formation)
    files = {
        "law.py": python_text(functions, about, constants),
        "law.c": c_text(functions, single.values(), about),
        "law.h": header_text(functions, about, constants | _sizes(double)),
    }
    sentence = guaranteed(parts, settings)
    return {**files, "law.json": _facts(own, double, constants, sentence, files)}


def python_law(
    parts: Parts, settings: Settings, agent: int, formation: str, sentence: str
) -> dict[str, str]:
    """Return law.py and law.json of one agent, as `law_files`, with the sentence of `promise`."""
    own, functions = _traced(parts, settings, agent)
    about, constants = _head(settings, agent, formation)
    files = {"law.py": python_text(functions.values(), about, constants)}
    return {**files, "law.json": _facts(own, functions, constants, sentence, files)}


def _traced(parts: Parts, settings: Settings, agent: int) -> tuple[OwnLaw, dict[str, LawFunction]]:
    own = Agent(parts, agent, settings.dt, settings.limits).own_law
    try:
        return own, law_functions(own)
    except Unsupported as error:
        raise OutputError(
            f"the law of agent {agent} cannot be exported: there is no code for {error}."
        ) from None


def _head(settings: Settings, agent: int, formation: str) -> tuple[str, dict[str, float | str]]:
    """Return the comment at the head of each file, and the constants."""
    mark = hashlib.sha256(f"{__version__}\n{settings.dt!r}\n{formation}".encode()).hexdigest()
    about = f"The law of agent {agent}, by echelon {__version__}; see law.json."
    return about, {"AGENT": agent, "DT": settings.dt, "FORMATION": mark}


def _facts(
    own: OwnLaw,
    functions: Mapping[str, LawFunction],
    constants: Mapping[str, float | str],
    sentence: str,
    files: Mapping[str, str],
) -> str:
    """Return law.json."""
    dt = float(constants["DT"])
    described = {
        "agent": constants["AGENT"],
        "formation": constants["FORMATION"],
        **_description(own, functions),
        "dt": dt,
        "network": network_facts(own, dt, functions),
        "guaranteed": sentence,
        "excluded": [*_EXCLUDES, _CURRENT if own.loop.channel is None else _LATE],
        "echelon": __version__,
        "sha256": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()},
    }
    return json.dumps(described, indent=2) + "\n"


def _sizes(functions: Mapping[str, LawFunction]) -> dict[str, int]:
    """Return how many numbers each array of the functions has."""
    sizes = {name: size for f in functions.values() for name, size in f.inputs.items() if size}
    sizes |= {name: len(x) for f in functions.values() for name, x in f.outputs.items()}
    return {name.upper(): size for name, size in sizes.items()}


def _description(own: OwnLaw, functions: Mapping[str, LawFunction]) -> JsonObject:
    """Return whom an agent hears, and the names and units of its numbers."""
    model = own.loop.model
    return {
        "leads": own.leads,
        "hears": list(own.neighbours),
        "weights": own.weights[0].tolist(),
        "switching": _switching(own),
        "feed_forward_from": own.source,
        "states": dict(zip(model.state_names, model.state_units, strict=True)),
        "inputs": dict(zip(model.input_names, model.input_units, strict=True)),
        "trim": dict(zip(model.input_names, model.trim[1], strict=True)),
        "scale": np.asarray(model.input_scale, float).tolist(),
        "normalized": normalized_equation(model),
        "signal": list(own.signal_names),
        "message": message_words(own),
        "message_meaning": message_meaning(own),
        "memory": len(functions["begin"].outputs["memory"]),
        "operations": {name: f.operations for name, f in functions.items()},
    }


def _switching(own: OwnLaw) -> JsonObject | None:
    """Return when which weights hold, of a graph that switches; a period repeats."""
    if own.schedule is None:
        return None
    starts, weights = own.schedule.starts.tolist(), own.weights.tolist()
    return {"starts": starts, "weights": weights, "period": own.schedule.period}


def network_facts(
    own: OwnLaw, dt: float, functions: Mapping[str, LawFunction]
) -> JsonObject | None:
    """Return what an agent needs for messages that are late; None in the ideal network."""
    channel, loop = own.loop.channel, own.loop
    if channel is None:
        return None
    expected, forget = functions.get("expected"), float(channel.forget) * dt
    size = len(own.forward_names) if expected is None else expected.inputs["content"]
    return {
        "period": int(channel.every) * dt,
        "messages": str(channel.messages),
        "prediction": str(channel.prediction),
        "uses": str(channel.hears),
        "forget": forget,
        "forget_hops": HOP_LIFE * forget,
        "agents": len(loop.order),
        "leaders": loop.leaders.tolist(),
        "content": size,
        "moves": loop.moving is not None and type(own.law).goal_offset is not Law.goal_offset,
    }


def save_law(files: Mapping[str, str], folder: Path) -> None:
    """Write the files into a folder that is new or empty.

    Raises:
        OutputError: they cannot be written.
    """
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            write_atomic(folder / name, text)
