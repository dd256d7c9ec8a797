"""A `Result` from the file of a run, whose parts are built when they are first read."""

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from echelon.core.errors import Outcome, OutputError
from echelon.core.lazy_field import Later
from echelon.core.types import JsonObject
from echelon.experiments.results.dataset import STORED
from echelon.experiments.results.labelled import Labelled
from echelon.experiments.results.recording import recording_with_data
from echelon.experiments.results.run_groups import SUM
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats

_SETTINGS = tuple(name for name in Settings._fields if name != "limits")


def read_result(
    file: Path,
    parts: Callable[[JsonObject, Settings], Parts],
    summary: JsonObject,
    files: Mapping[str, bytes],
) -> Result:
    """Return the run in a file.

    Args:
        file: the run's `run.nc`.
        parts: returns the parts of a run with these attributes and settings.
        summary: of the run, with its computing time; empty where there is none.
        files: that the scenario text names, by name.

    Raises:
        OutputError: the file cannot be read, is damaged, or has another format.
    """
    _, data = recording_with_data(file)
    try:
        result = _result(file, data, parts, summary, files)
    except (KeyError, ValueError, TypeError) as error:
        raise OutputError(f"`{file}` is damaged: its attributes are not those of a run.") from error
    rest = {name: part for name, part in data.variables.items() if not name.startswith(SUM)}
    STORED[result] = data._replace(variables=rest)
    return result


def _result(
    file: Path,
    data: Labelled,
    parts: Callable[[JsonObject, Settings], Parts],
    summary: JsonObject,
    files: Mapping[str, bytes],
) -> Result:
    attributes, arrays = data.attributes, data.arrays()
    sums = {name: arrays[SUM + name] for name in Sums._fields if SUM + name in arrays}
    solver, seconds = attributes.get("solver"), summary.get("wall_time_s")
    settings = _settings(attributes)
    return Result(
        times=arrays["time"],
        states=arrays["states"],
        inputs=arrays["inputs"],
        reference=arrays.get("reference"),
        outcome=Outcome[attributes["outcome"].upper()],
        message=attributes["message"],
        warnings=tuple(attributes["warnings"].splitlines()),
        settings=settings,
        wall_time=float("nan") if seconds is None else float(seconds),
        sums=Later(partial(_sums, file, sums)),
        parts=Later(partial(parts, attributes, settings)),
        work=None if solver is None else SolverStats(**json.loads(solver)),
        engine=attributes.get("computed_by") or summary.get("engine", "jax"),
        provenance={name: attributes[name] for name in _provenance(attributes)},
        files=files,
    )


def _sums(file: Path, sums: Mapping[str, object]) -> Sums:
    # Earlier versions found the closest two agents in stored frames only.
    sums = {"closest": np.zeros(0), "met": np.zeros((0, 3)), **sums}
    missing = [name for name in Sums._fields if name not in sums]
    if missing:
        raise OutputError(
            f"`{file}` was written by an earlier version and has no sums over all steps, which "
            "the metrics and the report are computed from; `echelon run FOLDER --out OTHER` "
            "computes the run again."
        )
    return Sums(**sums)


def _settings(attributes: JsonObject) -> Settings:
    if "settings" in attributes:
        return Settings(**json.loads(attributes["settings"]))
    # Format 3 has them one by one.
    rest = {name: attributes[name] for name in _SETTINGS if name in attributes}
    return Settings(**rest, limits=bool(attributes["limits"]))


def _provenance(attributes: JsonObject) -> list[str]:
    if "provenance" in attributes:
        return attributes["provenance"].split()
    own = ("scenario", "scenario_text")
    return [name for name in attributes if name in own or name.startswith("version_")]
