"""A `Result` from the file of a run, whose parts are built when they are first read."""

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from echelon.core.errors import Outcome, OutputError
from echelon.core.lazy_field import Later
from echelon.core.types import Array, JsonObject
from echelon.experiments.results.dataset import STORED
from echelon.experiments.results.labelled import Labelled
from echelon.experiments.results.recording import recording_with_data
from echelon.experiments.results.run_groups import SUM
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats


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
    solver, seconds = attributes.get("solver"), summary.get("wall_time_s")
    settings = Settings(**json.loads(attributes["settings"]))
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
        sums=Later(partial(_sums, file, arrays)),
        parts=Later(partial(parts, attributes, settings)),
        work=None if solver is None else SolverStats(**json.loads(solver)),
        engine=attributes["computed_by"],
        provenance={name: attributes[name] for name in attributes["provenance"].split()},
        files=files,
        late=arrays.get("late"),
    )


def _sums(file: Path, arrays: Mapping[str, Array]) -> Sums:
    if SUM + "steps" not in arrays:
        raise OutputError(
            f"`{file}` has no sums over all steps, which metrics and the report are computed from; "
            "`echelon run FOLDER --out OTHER` computes the run again."
        )
    return Sums(*(arrays[SUM + name] for name in Sums._fields))
