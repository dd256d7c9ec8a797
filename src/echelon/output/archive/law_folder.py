"""The folder of one agent's law: as Python, as C, and what it is for."""

import hashlib
import json
from pathlib import Path

from echelon import __version__
from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.core.types import JsonObject
from echelon.guarantees.promises.promise import promise
from echelon.output.archive.folder import write_errors
from echelon.simulation.engine.agent import Agent
from echelon.simulation.engine.own_step import OwnLaw
from echelon.simulation.engine.parts import Parts
from echelon.simulation.onboard.c_text import c_text, header_text
from echelon.simulation.onboard.law_functions import LawFunction, law_functions
from echelon.simulation.onboard.python_text import python_text
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.settings import Settings

_EXCLUDES = (
    "state estimation, message formats and time-outs, the vehicle's own control loops, and a "
    "supervisor that stops it",
    "late or lost messages: the guarantee assumes that `z` is of the current step",
    "other steps than `dt`",
)


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
    own = Agent(parts, agent, settings.dt, settings.limits).own_law
    try:
        functions = law_functions(own)
    except Unsupported as error:
        raise OutputError(
            f"the law of agent {agent} cannot be exported: there is no code for {error}."
        ) from None
    mark = hashlib.sha256(f"{__version__}\n{settings.dt!r}\n{formation}".encode()).hexdigest()
    about = f"The law of agent {agent}, by echelon {__version__}; see law.json."
    constants = {"AGENT": agent, "DT": settings.dt, "FORMATION": mark}
    sizes = {name.upper(): size for f in functions for name, size in f.inputs.items() if size}
    sizes |= {name.upper(): len(part) for name, part in functions[-1].outputs.items()}
    texts = {
        "law.py": python_text(functions, about, constants),
        "law.c": c_text(functions, about),
        "law.h": header_text(functions, about, constants | sizes),
    }
    described = {
        "agent": agent,
        "formation": mark,
        **_description(own, functions),
        "dt": settings.dt,
        "guaranteed": promise(parts, settings).sentence(),
        "excluded": _EXCLUDES,
        "echelon": __version__,
        "sha256": {k: hashlib.sha256(v.encode()).hexdigest() for k, v in texts.items()},
    }
    return {**texts, "law.json": json.dumps(described, indent=2) + "\n"}


def _description(own: OwnLaw, functions: tuple[LawFunction, ...]) -> JsonObject:
    """Return whom an agent hears, and the names and units of its numbers."""
    model = own.loop.model
    return {
        "leads": own.leads,
        "hears": list(own.neighbours),
        "weights": own.weights[0].tolist(),
        "feed_forward_from": own.source,
        "states": dict(zip(model.state_names, model.state_units, strict=True)),
        "inputs": dict(zip(model.input_names, model.input_units, strict=True)),
        "signal": list(own.signal_names),
        "message": list(own.forward_names),
        "memory": len(functions[0].outputs["memory"]),
        "operations": {f.name: f.operations for f in functions},
    }


def save_law(files: dict[str, str], folder: Path) -> None:
    """Write the files into a folder that is new or empty.

    Raises:
        OutputError: they cannot be written.
    """
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            write_atomic(folder / name, text)
