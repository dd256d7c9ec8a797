"""A run from disk: finished, stopped, killed, or still being computed."""

import dataclasses
import json
import os
import warnings
from functools import partial
from pathlib import Path

from echelon.core.errors import OutputError
from echelon.core.files import INPUTS
from echelon.core.types import JsonObject, PathLike
from echelon.experiments.results.dataset import digest_of
from echelon.experiments.results.stored_result import read_result
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
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import reassemble
from echelon.simulation.step.settings import Settings


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
    if stored is None:
        raise OutputError(_no_run(path))
    return stored


def _no_run(path: Path) -> str:
    if (path / "comparison.json").is_file():
        return f"`{path}` is a comparison; give one of its runs, `{path}/runs/NAME.nc`."
    if (path / "sweep.nc").is_file():
        return f"`{path}` is a sweep, which holds numbers of many runs; open its `sweep.nc`."
    return f"the folder `{path}` holds no run: it has no `{DATA}`."


def _unfinished(folder: Path, stretches: list[Stretch]) -> Result:
    """Return a run from the chunks in its folder."""
    if not (folder / SCENARIO_FILE).is_file():
        raise OutputError(f"the run in `{folder}` ended before any of it was stored.")
    scenario = load_scenario(folder / SCENARIO_FILE)
    result = reassemble(*build(scenario), stretches)
    return dataclasses.replace(result, **origin_of(scenario))


def _stored(file: Path, parts: Parts | None) -> Result:
    """Return a run from its file, beside which its summary and its inputs may be."""
    folder = file.parent if file.name == DATA else None
    names = [] if folder is None else sorted((folder / INPUTS).rglob("*"))
    files = {x.relative_to(file.parent).as_posix(): x.read_bytes() for x in names if x.is_file()}
    summary = {} if folder is None else _mapping(folder / SUMMARY)
    # No closures, so that a result can be pickled.
    return read_result(file, partial(_built, file, parts, digest_of(files)), summary, files)


def _built(
    file: Path, parts: Parts | None, digest: str, attributes: JsonObject, settings: Settings
) -> Parts:
    """Return the parts of a run, built from its scenario unless they are given."""
    own = build(_scenario(file, digest, attributes)).parts if parts is None else parts
    return prepare(own, settings).parts


def _mapping(file: Path) -> JsonObject:
    """Return the summary of a run; nothing where it is missing or damaged."""
    try:
        content = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


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


def load_run(folder: PathLike) -> Result:
    """Return `load(folder)`, under an earlier name."""
    return _renamed("load_run", folder)


def open_run(place: PathLike) -> Result:
    """Return `load(place)`, under an earlier name."""
    return _renamed("open_run", place)


def _renamed(name: str, place: PathLike) -> Result:
    text = f"`{name}` is now `load`, which returns the `Result` of a run in any state."
    warnings.warn(text, DeprecationWarning, stacklevel=3)
    return load(place)
