"""A run computed again from its scenario, and compared with what its files state of it."""

import dataclasses
import json
import re
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.types import JsonObject
from echelon.experiments.results.dataset import OBSERVED, run_file, summary, with_sums
from echelon.experiments.results.labelled import Labelled
from echelon.experiments.results.labelled_parts import labelled_parts
from echelon.experiments.results.recording import FORMAT, recording_with_data
from echelon.experiments.results.run_groups import SUM
from echelon.experiments.scenario.build import Experiment, origin_of
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.studies.recomputation import compare_structure
from echelon.guarantees.promises.promise import promise
from echelon.guarantees.verifier.findings import Finding, unchecked
from echelon.guarantees.verifier.saved_gain import read_json
from echelon.guarantees.verifier.stored_values import Digits, compare_arrays, compare_values
from echelon.output.archive.open_folder import ClaimFiles
from echelon.output.reports.causes import sizes
from echelon.output.reports.run_report import report
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import RunSoFar, simulate
from echelon.simulation.step.meter import SETTLED

OBSERVATIONS = "what the run observed"
"""The claim that stands for all of them where they are not computed again."""
_COMPUTED = ("engine", "wall_time_s", "versions")
"""Entries of a summary that say how a run was computed, which differs between computers."""
_ATTRIBUTES = ("computed_by", "solver", "provenance", "promise", "scenario_text", "_NCProperties")
"""Attributes that say the same, or are compared by themselves."""
_PRECISIONS = {"float64": Digits(1e-6, 1e-9), "float32": Digits(1e-3, 1e-4)}
"""To what two processors agree on a run."""
_SOLVED = Digits(1e-3, 1e-4)
"""To what two solvers agree on its plans."""
_STOPPED = (Outcome.INTERRUPTED.name.lower(), Outcome.STOPPED.name.lower())
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_ROUNDING = Decimal("1e-8")
"""Printed numbers below it are mostly rounding of the run, which differs between processors."""
_REPORT = "report.txt"


def compare_run(files: ClaimFiles, scenario: Scenario, experiment: Experiment) -> Iterator[Finding]:
    """Yield a finding for each array, number and text that only the run itself gives.

    Args:
        files: of the run.
        scenario: of the run, which is simulated once more.
        experiment: of it, with the gains that the files state.

    Raises:
        EchelonError: the run cannot be computed, or a file cannot be read.
    """
    assert files.data is not None
    _, data = recording_with_data(files.data)
    steps = data.arrays().get(SUM + "steps")
    if data.attributes["format"] != FORMAT or steps is None or not int(steps[0]):
        yield unchecked(OBSERVATIONS, "", "the file has no sums over the steps of the run")
        return
    result = _repeated(experiment, data, int(steps[0]))
    if result is None:
        yield unchecked(OBSERVATIONS, "", "the run was stopped at a step that is not repeated")
        return
    result = dataclasses.replace(result, **origin_of(scenario))
    yield from compare_structure(files.data, run_file(result))
    decided = bool(promise(*experiment).promised) and _converged(result)
    for finding in _compare(files, data, result):
        differs = finding.verdict == "refused" and finding.stored and finding.value
        open_ = differs and not decided
        yield unchecked(finding.claim, finding.stored, _GROWN) if open_ else finding


_GROWN = "the run computed again differs, perhaps by rounding, which may grow where errors do"


def _converged(result: Result) -> bool:
    """Tell whether errors shrank or remained small: a local guarantee does not cover every start.

    Where errors grow, so may the rounding of another processor, and a difference proves nothing.
    """
    if result.outcome in (Outcome.DIVERGED, Outcome.LEFT_CHART):
        return False
    first, last = sizes(result)
    return last <= max(first, SETTLED)


def _repeated(experiment: Experiment, data: Labelled, steps: int) -> Result | None:
    """Return the run again, until the step at which it was stopped; None where it goes past it."""
    if data.attributes["outcome"] not in _STOPPED:
        return simulate(*experiment)

    def stop(run: RunSoFar) -> None:
        if run.done >= steps:
            raise KeyboardInterrupt

    result = simulate(*experiment, stop)
    same = result.outcome is Outcome.INTERRUPTED and int(result.sums.steps[0]) == steps
    stored = Outcome[data.attributes["outcome"].upper()]
    # How it was stopped is known to its files alone.
    return dataclasses.replace(result, outcome=stored) if same else None


def _compare(files: ClaimFiles, data: Labelled, result: Result) -> Iterator[Finding]:
    """Compare dataset, summary and report with those of the run computed again."""
    assert files.data is not None
    laws = isinstance(result.parts.drive, Laws)
    digits = _PRECISIONS[result.settings.precision] if laws else _SOLVED
    yield from _compare_dataset(files.data.name, data, result, digits)
    stopped = {"outcome", "warnings"} if result.outcome.name.lower() in _STOPPED else set[str]()
    if files.claims is not None:
        names = [name for name in OBSERVED if name not in {*_COMPUTED, *stopped}]
        stored, value = read_json(files.claims), json.loads(json.dumps(summary(result)))
        theirs, ours = [{k: x[k] for k in names if k in x} for x in (stored, value)]
        yield from compare_values("", theirs, ours, digits)
        yield from _compare_origin(stored, data)
    written = files.data.parent / _REPORT
    if written.is_file() and not stopped:
        yield _compare_report(written, report(result) + "\n")


def _compare_origin(stored: JsonObject, data: Labelled) -> Iterator[Finding]:
    """Compare what both files say of the program: nothing else says it."""
    attributes = data.attributes
    versions = {k[8:]: text for k, text in attributes.items() if k.startswith("version_")}
    value = {"engine": attributes.get("computed_by"), "versions": versions}
    yield from compare_values("", {key: stored.get(key) for key in value}, value)


def _compare_dataset(
    name: str, data: Labelled, result: Result, digits: Digits
) -> Iterator[Finding]:
    """Compare arrays and attributes of a dataset, but those of the parts of the run."""
    parts = labelled_parts(result.parts, result.settings)
    stored, again = data.arrays(), with_sums(result)
    for key, value in again.arrays().items():
        if key not in parts.arrays():
            theirs = stored.get(key)
            theirs = None if theirs is None else np.asarray(theirs)
            yield compare_arrays(f"{name}: observed.{key}", theirs, np.asarray(value), digits)
    values, attributes = again.attributes, data.attributes
    stopped = ("outcome", "message") if values["outcome"] in _STOPPED else ()
    skipped = {*_ATTRIBUTES, *stopped, *parts.attributes}
    for key in {**values, **attributes}:
        if key not in skipped and not key.startswith("version_"):
            theirs, ours = [{key: x[key]} if key in x else {} for x in (attributes, values)]
            yield from compare_values(f"{name}: observed", theirs, ours, digits)


def _compare_report(file: Path, text: str) -> Finding:
    """Compare a report; last digits may be rounded in another way, and are then left open."""
    try:
        stored = file.read_text("utf-8")
    except (OSError, ValueError):
        stored = ""
    [finding] = compare_values(f"{file.name}: text", stored, text)
    words = (_NUMBER.split(each) for each in (stored, text))
    pairs = zip(_NUMBER.findall(stored), _NUMBER.findall(text), strict=False)
    if finding.verdict == "refused" and len({*map(tuple, words)}) == 1 and all(map(_near, pairs)):
        return unchecked(finding.claim, "", "its last digits differ from those computed again")
    return finding


def _near(pair: tuple[str, str]) -> bool:
    """Tell whether two printed numbers differ by one in the last digit, or are rounding both."""
    one, other = map(Decimal, pair)
    digit = Decimal((0, (1,), max(int(x.as_tuple().exponent) for x in (one, other))))
    return abs(one - other) <= digit or max(one, other) < _ROUNDING
