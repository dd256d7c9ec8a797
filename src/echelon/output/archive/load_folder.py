"""A run from disk: finished, stopped, killed, or still being computed."""

import dataclasses
import json
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from echelon.core.errors import Outcome, OutputError
from echelon.core.files import INPUTS
from echelon.core.types import Array, JsonObject, PathLike
from echelon.experiments.results.dataset import STORED, SUM, digest_of
from echelon.experiments.results.labelled import Labelled
from echelon.experiments.results.recording import read_recording
from echelon.experiments.scenario.build import build, origin_of
from echelon.experiments.scenario.scenario import (
    SCENARIO_FILE,
    Scenario,
    load_scenario,
    scenario_from_text,
)
from echelon.experiments.scenario.self_contained import names_files
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import DATA, SUMMARY, check_exists
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.record import Stretch
from echelon.simulation.engine.result import Later, Result
from echelon.simulation.engine.simulate import reassemble
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats


def load(place: PathLike, parts: Parts | None = None) -> Result:
    """Return the run in a folder, or in its `run.nc`, whatever its state.

    Of a run that was stopped or killed, or is still computed, it is what is stored. States and all
    else in `run.nc` are read without executing code; `parts` and what needs them (such as `report`,
    `metrics` and `lyapunov`) build the scenario of the folder, and so execute the classes that it
    names, as does a run that was killed before its `run.nc` was written.

    Args:
        place: the folder of a run, or a netCDF file such as its `run.nc`.
        parts: those of a run that was made in Python, which no file contains.

    Raises:
        OutputError: there is no run, it is damaged, or of a format that is not read. Also raised
            when `parts` are first read, if there is no scenario or it was changed since the run.
        ScenarioError: the scenario of a killed run cannot be read.
    """
    if not isinstance(place, str | os.PathLike):
        raise OutputError(
            f"`place` is {place!r}, and must be the folder of a run, or its `{DATA}`."
        )
    path = check_exists(Path(place))
    if path.is_file():
        return _stored(path, parts)
    stored = _stored(path / DATA, parts) if (path / DATA).is_file() else None
    chunks = Chunks(path)
    if chunks.exist:
        stretches = chunks.read()
        done = stretches[-1].done if stretches else 0
        # A run that was stopped, continued and killed is longer in its chunks.
        if stored is None or done > int(stored.sums.steps[0]):
            return _unfinished(path, stretches)
    if stored is not None:
        return stored
    if (path / "comparison.json").is_file():
        raise OutputError(f"`{path}` is a comparison; give one of its runs, `{path}/runs/NAME.nc`.")
    if (path / "sweep.nc").is_file():
        raise OutputError(
            f"`{path}` is a sweep, which holds numbers of many runs; open its `sweep.nc`."
        )
    raise OutputError(f"the folder `{path}` holds no run: it has no `{DATA}`.")


def _unfinished(folder: Path, stretches: list[Stretch]) -> Result:
    """Return a run from the chunks in its folder."""
    if not (folder / SCENARIO_FILE).is_file():
        raise OutputError(f"the run in `{folder}` ended before any of it was stored.")
    scenario = load_scenario(folder / SCENARIO_FILE)
    result = reassemble(*build(scenario), stretches)
    return dataclasses.replace(result, **origin_of(scenario))


def _stored(file: Path, parts: Parts | None) -> Result:
    """Return a run from its file, beside which its summary and its inputs may be."""
    _, data = read_recording(file)
    within = file.name == DATA
    names = sorted((file.parent / INPUTS).rglob("*")) if within else []
    files = {x.relative_to(file.parent).as_posix(): x.read_bytes() for x in names if x.is_file()}
    seconds = _seconds(file.with_name(SUMMARY)) if within else float("nan")
    try:
        result = _result(file, data, parts, files, seconds)
    except (KeyError, ValueError, TypeError) as error:
        raise OutputError(f"`{file}` is damaged: its attributes are not those of a run.") from error
    rest = {name: part for name, part in data.variables.items() if not name.startswith(SUM)}
    STORED[result] = data._replace(variables=rest)
    return result


def _seconds(summary: Path) -> float:
    """Return how long a run took to compute, s; NaN where its summary does not say it."""
    try:
        return float(json.loads(summary.read_text("utf-8"))["wall_time_s"])
    except (OSError, ValueError, KeyError, TypeError):
        return float("nan")


def _result(
    file: Path, data: Labelled, parts: Parts | None, files: Mapping[str, bytes], seconds: float
) -> Result:
    attributes, arrays = data.attributes, data.arrays()
    solver, settings = attributes.get("solver"), Settings(**json.loads(attributes["settings"]))
    # No closures, so that a result can be pickled.
    built = partial(_built, file, parts, digest_of(files), attributes, settings)
    return Result(
        times=arrays["time"],
        states=arrays["states"],
        inputs=arrays["inputs"],
        reference=arrays.get("reference"),
        outcome=Outcome[attributes["outcome"].upper()],
        message=attributes["message"],
        warnings=tuple(attributes["warnings"].splitlines()),
        settings=settings,
        wall_time=seconds,
        sums=Later(partial(_sums, file, arrays)),
        parts=Later(built),
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


def _built(
    file: Path, parts: Parts | None, digest: str, attributes: JsonObject, settings: Settings
) -> Parts:
    """Return the parts of a run, built from its scenario unless they are given."""
    own = build(_scenario(file, digest, attributes)).parts if parts is None else parts
    return prepare(own, settings).parts


def _scenario(file: Path, digest: str, attributes: JsonObject) -> Scenario:
    """Return the scenario of a run in a file; `digest` is that of the inputs beside it."""
    text = attributes.get("scenario_text")
    if text is None:
        raise OutputError(
            f"the run in `{file}` was made from parts in Python, which no file contains; give "
            "them: `ech.load(place, parts)`."
        )
    scenario = scenario_from_text(text, file.with_name(SCENARIO_FILE))
    if not names_files(scenario):
        return scenario
    if attributes.get("inputs") != digest:
        raise OutputError(
            f"the files that the run in `{file}` was computed from are not in its folder, or were "
            f"changed; `echelon run` computes it again from its `{SCENARIO_FILE}`."
        )
    return scenario
