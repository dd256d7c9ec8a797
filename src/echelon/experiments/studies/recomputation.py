"""The guarantee of a run, computed again from its scenario and compared with the run's files."""

import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from echelon.core.errors import GainError
from echelon.core.types import JsonObject
from echelon.core.words import amount
from echelon.experiments.results.dataset import labelled_parts
from echelon.experiments.results.labelled import Labelled, groups_of
from echelon.experiments.results.recording import Recording, read_recording
from echelon.experiments.results.summary import COVERED, OBSERVED, leader_gain_of, statement
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.self_contained import without_folders
from echelon.experiments.scenario.yaml import read_yaml
from echelon.experiments.studies.check import check
from echelon.experiments.studies.design import with_gain
from echelon.guarantees.promises.promise import guarantee
from echelon.guarantees.verifier.findings import ClaimCheck, decide, unchecked
from echelon.guarantees.verifier.saved_gain import parse_json, read_json
from echelon.guarantees.verifier.stored_values import Digits, compare_values
from echelon.laws.consensus import Consensus
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts, initial_states
from echelon.simulation.engine.prepare import prepare
from echelon.synthesis.gains.gain import Gain
from echelon.synthesis.gains.gain_file import gain_as_mapping, load_gain

if TYPE_CHECKING:
    import h5netcdf

# ---- the structure of a run's dataset ------------------------------------------------------------
# Readers such as xarray change numbers by attributes (`scale_factor`), mask them (`_FillValue`) and
# show groups and names beside them, so a file states more than its arrays.

_WRITTEN = {"units": ("s", "m"), "_FillValue": ("nan",)}
"""Attributes of variables and their values in every format, beside the names of coordinates."""


def compare_attributes(file: Path) -> Iterator[ClaimCheck]:
    """Yield a refused finding for each attribute of a group or variable that echelon never writes.

    Those of the root are compared with the run, one by one.
    """
    for place, part in _structure(file).items():
        for name, value in part["attributes"].items():
            known = name == "coordinates" or ("type" in part and value in _WRITTEN.get(name, ()))
            if not known:
                claim, text = f"{file.name}: {place}.{name}", "echelon does not write it"
                yield decide(ascii(claim)[1:-1], False, value, text=text)._replace(by_scenario=True)


def compare_structure(file: Path, again: bytes) -> Iterator[ClaimCheck]:
    """Compare groups, dimensions, variables, types and attributes with those of a file in memory.

    Sizes and numbers are compared with the arrays.
    """
    claim, stored, value = f"{file.name}: structure", _structure(file), _structure(again)
    findings = [*compare_values(claim, stored, value)]
    refused = [each for each in findings if each.verdict == "refused"]
    same = ClaimCheck(claim, f"{len(stored)} parts", f"{len(value)} parts", "recomputed", "", True)
    yield from refused or [same]


def _structure(file: Path | bytes) -> dict[str, JsonObject]:
    # Here, since it is slow to load.
    import h5netcdf

    parts = dict[str, JsonObject]()
    with h5netcdf.File(io.BytesIO(file) if isinstance(file, bytes) else file, "r") as stored:
        for group in groups_of(stored):
            root = group.name == "/"
            parts[group.name] = {
                "dimensions": " ".join(sorted(group.dimensions)),
                "attributes": {} if root else _attributes(group),
            }
            for name, variable in group.variables.items():
                parts[f"{group.name.rstrip('/')}/{name}"] = {
                    "dimensions": " ".join(variable.dimensions),
                    "type": str(variable.dtype),
                    "attributes": _attributes(variable),
                }
    return parts


def _attributes(place: "h5netcdf.Group | h5netcdf.Variable") -> dict[str, str]:
    return {str(name): str(value) for name, value in place.attrs.items()}


# ---- guarantees ----------------------------------------------------------------------------------
# This is not an independent check: the code is that which made the files. It shows that a file
# states what its scenario gives, word for word; the verifier checks by code of its own what it can.

SOLVED = Digits(1e-3)
"""Relative. On another machine a semidefinite program ends at another P, 1e-4 apart."""


def experiment_of(
    scenario: Scenario, claims: Path | None, gain: Path | None
) -> tuple[Experiment, list[ClaimCheck]]:
    """Return the parts of a run with the gains that its files state, and what is compared of them.

    Args:
        scenario: of the run. Code that it names is executed.
        claims: the run's `summary.json`, or the output of `check --json`.
        gain: the run's gain file; the guarantee is then that of the gain in it.

    Raises:
        EchelonError: the scenario cannot be built, or a file cannot be read.
    """
    # As for a run: what is too large to have been run is refused.
    experiment, findings = build(scenario, to_run=True), list[ClaimCheck]()
    if gain is not None:
        findings += compare_gain(gain, experiment)
        with contextlib.suppress(GainError):
            experiment = with_gain_of(experiment, gain)
    if claims is not None:
        stored = read_json(claims).get("leader_gain")
        experiment, more = with_leader_gain(experiment, stored)
        findings += more
    return experiment, findings


def recompute(
    experiment: Experiment, scenario: Scenario, claims: Path | None, data: Path | None = None
) -> Iterator[ClaimCheck]:
    """Yield a finding for each value that a run's files state and its scenario gives.

    `claims` are as in `experiment_of`; of `run.nc` parts, guarantee and starts are compared.

    Raises:
        EchelonError: a file cannot be read.
    """
    if claims is not None:
        yield from compare_claims(read_json(claims), experiment, scenario.name)
    if data is not None:
        yield from _compare_data(data, scenario, experiment)
        yield from compare_attributes(data)


def with_gain_of(experiment: Experiment, file: Path) -> Experiment:
    """Return the parts with the gain of a file.

    Raises:
        GainError: it is not a gain of them.
    """
    parts, drive = experiment.parts, experiment.parts.drive
    if drive.gain is None:
        raise GainError("the law of the scenario has no gain.")
    gain = load_gain(file, parts.model, parts.graph)
    # A law of the user's own is built with its gain, and not taken apart.
    if not (isinstance(drive, Laws) and isinstance(drive.follower, Consensus)):
        return experiment
    return experiment._replace(parts=with_gain(parts, gain))


def compare_gain(file: Path, experiment: Experiment) -> Iterator[ClaimCheck]:
    """Compare a gain file with the gain of a scenario; its certificate the verifier checks."""
    try:
        with_gain_of(experiment, file)
    except GainError as error:
        yield decide(file.name, False, text=str(error).rstrip("."))._replace(by_scenario=True)
        return
    parts, stored = experiment.parts, read_json(file)
    assert parts.drive.gain is not None
    value = _as_json(gain_as_mapping(parts.drive.gain, parts.model, parts.graph))
    for key in ("method", "coupling", "P", "R", "inner"):
        yield from compare_values(f"{file.name}: {key}", stored[key], value[key], SOLVED)
    yield from compare_values(f"{file.name}: graph", stored["graph"], value["graph"])
    # The name of a class may change with the version, and the verifier has evaluated it.
    stored, value = ({**each["model"], "class": ""} for each in (stored, value))
    yield from compare_values(f"{file.name}: model", stored, value)


def compare_claims(stored: JsonObject, experiment: Experiment, name: str) -> Iterator[ClaimCheck]:
    """Compare a summary, or the output of a check, with what a scenario of a name gives."""
    if "lines" in stored:
        value = check(*experiment).as_mapping()
        if "region" in stored:
            stored = {**stored}
            text = "it was observed; `echelon check --region` simulates it again"
            yield unchecked("region", amount(len(stored.pop("region")), "value"), text)
    else:
        value = statement(*experiment, name)
        stored = {key: stored[key] for key in stored if key not in OBSERVED}
        if isinstance(stored.get("guarantee"), dict):
            # Whether the run kept to it only the run gives.
            stored["guarantee"] = {k: x for k, x in stored["guarantee"].items() if k != COVERED}
    yield from compare_values("", stored, _as_json(value))


def with_leader_gain(experiment: Experiment, stored: object) -> tuple[Experiment, list[ClaimCheck]]:
    """Return the parts with the gain that a summary states of the leaders, and what is compared.

    It must be that of the scenario up to what differs between solvers.
    """
    drive = experiment.parts.drive
    gain = leader_gain_of(drive)
    if gain is None or not isinstance(stored, dict) or not {"P", "R"} <= stored.keys():
        return experiment, []
    numbers = {"P": gain.P.tolist(), "R": gain.R.tolist()}
    theirs = {name: stored[name] for name in numbers}
    findings = list(compare_values("leader_gain", theirs, numbers, SOLVED))
    with contextlib.suppress(GainError):
        if not any(each.verdict == "refused" for each in findings):
            P, R = (np.array(theirs[name], float) for name in numbers)
            own = Gain(P, R, gain.coupling, gain.method, gain.certificate, gain.inner)
            experiment = experiment._replace(parts=_led_by(experiment.parts, own))
    return experiment, findings


def _led_by(parts: Parts, gain: Gain) -> Parts:
    drive = parts.drive
    assert isinstance(drive, Laws)
    leader = drive.leader
    leader = eqx.tree_at(lambda law: law.gain, leader, gain, is_leaf=lambda part: part is None)
    return parts.replace(drive=Laws(leader, drive.follower).prepare(parts.model, parts.graph))


def _compare_data(file: Path, scenario: Scenario, experiment: Experiment) -> Iterator[ClaimCheck]:
    (run, data), (parts, settings), name = read_recording(file), experiment, file.name
    stored = parse_json(str(run.attributes["guarantee"]), f"{file}, guarantee")
    value = _as_json(guarantee(parts, settings).as_mapping())
    yield from compare_values(f"{name}: guarantee", stored, value)
    text = read_yaml(str(run.attributes.get("scenario_text", "")), str(file))
    # A key twice is a fault; readers differ in which one they use.
    theirs = None if text.faults else without_folders(text.data)
    ours = without_folders(scenario.data)
    yield from compare_values(f"{name}: scenario_text", theirs, ours)
    starts = initial_states(parts, settings.seed)[None][: len(run.states)]
    yield from compare_values(f"{name}: states", run.states[:1].tolist(), starts.tolist())
    fixed = labelled_parts(prepare(parts, settings).parts, settings)
    stated = {**run.attributes, **data.arrays()}
    yield from _compare_frames(run, data, experiment, name)
    yield from compare_values(f"{name}: scenario", run.attributes.get("scenario"), scenario.name)
    for key, part in {**fixed.attributes, **fixed.arrays()}.items():
        theirs, ours = (np.asarray(each).tolist() for each in (stated.get(key), part))
        yield from compare_values(f"{name}: parts.{key}", theirs, ours)


def _compare_frames(
    run: Recording, data: Labelled, experiment: Experiment, name: str
) -> Iterator[ClaimCheck]:
    (parts, settings), stored = experiment, data.arrays()
    steps = np.minimum(np.arange(len(run.states)) * settings.store_every, settings.steps)
    times, schedule = steps * settings.dt, parts.graph.schedule
    frames: dict[str, np.ndarray] = {"time": times}
    if schedule is not None and schedule.present is not None:
        frames["presence"] = schedule.present[schedule.rows(times)].astype(np.int8)
    if parts.formation.motion is not None:
        frames["moving_offset"] = parts.formation.offsets_at(times)
    for key, value in frames.items():
        theirs = np.asarray(stored.get(key)).tolist()
        yield from compare_values(f"{name}: {key}", theirs, value.tolist())


def _as_json(value: JsonObject) -> JsonObject:
    """Return a mapping as it is read from a file: lists for tuples, plain numbers."""
    return json.loads(json.dumps(value, allow_nan=False))
