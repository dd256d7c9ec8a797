"""The folder of a run: written, and read whatever the state of the run."""

import dataclasses
import json
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import overload

from echelon.core.errors import Outcome, OutputError
from echelon.core.files import INPUTS, write_atomic
from echelon.core.types import Array, JsonObject, PathLike
from echelon.experiments.results.dataset import STORED, SUM, digest_of, labelled, run_file
from echelon.experiments.results.labelled import Labelled
from echelon.experiments.results.recording import read_recording, recording
from echelon.experiments.results.summary import summary
from echelon.experiments.scenario.build import build, origin_of
from echelon.experiments.scenario.scenario import (
    SCENARIO_FILE,
    Scenario,
    load_scenario,
    scenario_from_text,
)
from echelon.experiments.scenario.self_contained import names_files
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.flown import PLAN, flight_data, root_of
from echelon.output.archive.folder import (
    DATA,
    GAIN,
    IN_PYTHON,
    REPORT,
    SUMMARY,
    check_exists,
    claim_folder,
    write_errors,
)
from echelon.output.archive.recorded import Recorded, recorded
from echelon.output.reports.run_report import report
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.record import Segment
from echelon.simulation.engine.result import Later, Result
from echelon.simulation.engine.simulate import reassemble
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats
from echelon.synthesis.gains.gain_file import save_gain


def save_run(
    result: Result, folder: PathLike | None = None, figures: bool = True, force: bool = False
) -> Path:
    """Write all that `echelon run` writes, and return the folder.

    Args:
        result: the run.
        folder: new or empty; `runs/<name>-<time>` when left out.
        figures: whether to draw the figures, each as PNG and PDF.
        force: whether to replace an earlier run in the folder.

    Raises:
        OutputError: the folder holds something, or cannot be written.
    """
    name = result.provenance.get("scenario") or type(result.model).__name__
    place = claim_folder(name, None if folder is None else Path(folder), force, how=IN_PYTHON)
    # A run from Python has no scenario file.
    if "scenario_text" in result.provenance:
        with write_errors(place):
            write_atomic(place / SCENARIO_FILE, result.provenance["scenario_text"])
            for each, content in result.files.items():
                (place / each).parent.mkdir(parents=True, exist_ok=True)
                write_atomic(place / each, content)
    write_findings(result, place, figures)
    Chunks(place).remove()
    return place


def report_beside(place: Path) -> str:
    """Return the report in the folder of a run, or beside its `run.nc`; empty without one."""
    folder = place.parent if place.name == DATA else place
    file = folder / REPORT
    return file.read_text("utf-8", "replace") if file.is_file() else ""


def write_findings(result: Result, folder: Path, figures: bool = True) -> None:
    """Write the dataset of a run, then summary, report and figures.

    Raises:
        OutputError: a file cannot be written.
    """
    with write_errors(folder):
        # The data first, so that a figure that fails loses nothing.
        data = labelled(result)
        write_atomic(folder / DATA, run_file(result, data))
        # NaN is not JSON, and other parsers refuse it.
        content = json.dumps(summary(result), indent=2, allow_nan=False)
        write_atomic(folder / SUMMARY, content + "\n")
        write_atomic(folder / REPORT, report(result) + "\n")
        if result.drive.gain is not None:
            save_gain(result.drive.gain, result.model, result.graph, folder / GAIN)
        if figures and len(result.times):
            # Here, since matplotlib takes long to load and only figures need it.
            from echelon.output.plots.run_figures import save_figures

            save_figures(recording(data.arrays(), data.attributes), folder)


@overload
def load(place: PathLike, parts: Parts | None = None, agents: None = None) -> Result: ...
@overload
def load(place: PathLike, parts: None = None, *, agents: Mapping[int, str]) -> Recorded: ...


def load(
    place: PathLike, parts: Parts | None = None, agents: Mapping[int, str] | None = None
) -> Result | Recorded:
    """Return a run, whatever its state; or a flight, or what others recorded.

    Of a run that was stopped or killed, or is still computed, it is what is stored. States and all
    else in `run.nc` are read without executing code; `parts` and what needs them (such as `report`,
    `metrics` and `lyapunov`) build the scenario of the folder, and so execute the classes that it
    names, as does a run that was killed before its `run.nc` was written.

    Args:
        place: the folder of a run, or a netCDF file such as its `run.nc`; the folder of a flight,
            or that of one of its flights in `logs`, whose agents' logs are joined; with `agents` a
            bag of ROS 2 (folder, `.mcap`, `.db3`), a ULog (`.ulg`) or a Crazyflie's log (`.csv`).
        parts: those of a run that was made in Python, which no file contains.
        agents: the topic of each agent in a recording of others: PoseStamped or Odometry in a bag,
            `vehicle_odometry` or `vehicle_local_position` in a ULog, `stateEstimate` in a log. The
            result then has `times` (T,), `states` (T, N, n), `state_names`, and `tracks`.

    Raises:
        OutputError: there is no run, it is damaged, or of a format that is not read. Also raised
            when `parts` are first read, if there is no scenario or it was changed since the run.
            A recording lacks a topic.
        MissingExtraError: a recording needs a library that is not installed.
        ScenarioError: the scenario of a killed run cannot be read.
    """
    if not isinstance(place, str | os.PathLike):
        raise OutputError(
            f"`place` is {place!r}, and must be the folder of a run, or its `{DATA}`."
        )
    path = check_exists(Path(place))
    if agents is not None:
        return recorded(path, agents)
    if path.is_file():
        return _stored(path, read_recording(path)[1], parts)
    if root_of(path) is not None:
        return _stored(*flight_data(path), parts)
    file = path / DATA
    stored = _stored(file, read_recording(file)[1], parts) if file.is_file() else None
    chunks = Chunks(path)
    if chunks.exist:
        segments = chunks.read()
        done = segments[-1].done if segments else 0
        # A run that was stopped, continued and killed is longer in its chunks.
        if stored is None or done > int(stored.sums.steps[0]):
            return _unfinished(path, segments)
    if stored is not None:
        return stored
    if (path / "comparison.json").is_file():
        raise OutputError(f"`{path}` is a comparison; give one of its runs, `{path}/runs/NAME.nc`.")
    if (path / "sweep.nc").is_file():
        raise OutputError(
            f"`{path}` is a sweep, which holds numbers of many runs; open its `sweep.nc`."
        )
    raise OutputError(f"the folder `{path}` holds no run: it has no `{DATA}`.")


def _unfinished(folder: Path, segments: list[Segment]) -> Result:
    if not (folder / SCENARIO_FILE).is_file():
        raise OutputError(f"the run in `{folder}` ended before any of it was stored.")
    scenario = load_scenario(folder / SCENARIO_FILE)
    result = reassemble(*build(scenario), segments)
    return dataclasses.replace(result, **origin_of(scenario))


def _stored(file: Path, data: Labelled, parts: Parts | None) -> Result:
    within = file.name in (DATA, PLAN)
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
        sums=Later(partial(_sums, file, arrays, "flight" in attributes)),
        parts=Later(built),
        work=None if solver is None else SolverStats(**json.loads(solver)),
        engine=attributes["computed_by"],
        provenance={name: attributes[name] for name in attributes["provenance"].split()},
        files=files,
    )


def _sums(file: Path, arrays: Mapping[str, Array], flown: bool) -> Sums:
    if flown:
        raise OutputError(
            "a flight has no sums over steps, which metrics are computed from; `echelon report "
            "FLIGHT` prints its numbers."
        )
    if any(SUM + name not in arrays for name in Sums._fields):
        raise OutputError(
            f"`{file}` has no sums over all steps, which metrics and the report are computed from; "
            "`echelon run FOLDER --out OTHER` computes the run again."
        )
    return Sums(*(arrays[SUM + name] for name in Sums._fields))


def _built(
    file: Path, parts: Parts | None, digest: str, attributes: JsonObject, settings: Settings
) -> Parts:
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
