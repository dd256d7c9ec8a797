"""Checks all that a run's folder states: its gain, its guarantee, and the run, computed again."""

import dataclasses
import json
import re
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import Outcome, OutputError
from echelon.core.types import PathLike
from echelon.experiments.results.dataset import SUM, labelled_parts, run_file, with_sums
from echelon.experiments.results.labelled import Labelled
from echelon.experiments.results.recording import read_recording
from echelon.experiments.results.summary import COVERED, OBSERVED, summary
from echelon.experiments.scenario.build import Experiment, build, origin_of
from echelon.experiments.scenario.scenario import (
    SCENARIO_FILE,
    Scenario,
    ScenarioLike,
    as_scenario,
    load_scenario,
)
from echelon.experiments.scenario.self_contained import files_of, names_code, without_folders
from echelon.experiments.studies.causes import moved_starts
from echelon.experiments.studies.recomputation import compare_structure, experiment_of, recompute
from echelon.guarantees.promises.promise import guarantee
from echelon.guarantees.verifier import verify as verifier
from echelon.guarantees.verifier.findings import ClaimCheck, unchecked
from echelon.guarantees.verifier.saved_gain import read_json
from echelon.guarantees.verifier.stored_values import Digits, compare_arrays, compare_values
from echelon.guarantees.verifier.verify import CLAIMED, STATED, Verification, judge, states_gain
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import DATA, GAIN, REPORT, SUMMARY, check_exists
from echelon.output.archive.run_folder import load, save_run
from echelon.output.reports.run_report import report, sizes
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import RunSoFar, simulate
from echelon.simulation.step.meter import SETTLED

OBSERVATIONS = "what the run observed"
"""The claim that stands for all of them where they are not computed again."""
_COMPUTED = ("engine", "wall_time_s", "versions")
"""Entries of a summary that say how a run was computed, which differs between computers."""
_ATTRIBUTES = ("computed_by", "solver", "provenance", "guarantee", "scenario_text", "_NCProperties")
"""Attributes that say the same, or are compared by themselves."""
_PRECISIONS = {"float64": Digits(1e-6, 1e-9), "float32": Digits(1e-3, 1e-4)}
"""To what two processors agree on a run."""
_SOLVED = Digits(1e-3, 1e-4)
"""To what two solvers agree on its plans."""
_STOPPED = (Outcome.INTERRUPTED.name.lower(), Outcome.STOPPED.name.lower())
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_ROUNDING, _LAST = Decimal("1e-8"), Decimal("0.12")
"""Printed numbers below it are mostly rounding of the run, which differs between processors; and
how much of a number its last digit may be."""
_GROWN = "the run computed again differs, perhaps by rounding, which may grow where errors do"
_MOVED, _TIMES, _UNLIKE = 1e-12, 30.0, 0.1
"""How far starts are moved to see how rounding grows, by what factor two processors may differ
more, and from which relative difference on runs are not compared."""
_SETTLED = {"graph spectrum": "graph.spectrum", "method": "method"}
"""What independent code leaves open of large and switching graphs and own methods, and what the
scenario settles it by."""


# ---- the files -----------------------------------------------------------------------------------


class ClaimFiles(NamedTuple):
    """Files with claims about a run's gain or law, and what belongs to them; None if absent."""

    gain: Path | None = None
    claims: Path | None = None
    data: Path | None = None
    scenario: Path | None = None


def claim_files(place: PathLike) -> ClaimFiles:
    """Return the files of a run that `verify` reads.

    Raises:
        GainError: a file cannot be read, or is no JSON.
        OutputError: there is nothing, or nothing that makes claims; or a gain file is missing.
    """
    path = _place(Path(place))
    if not path.is_dir():
        return ClaimFiles(path) if states_gain(read_json(path)) else ClaimFiles(claims=path)
    names = GAIN, SUMMARY, DATA, SCENARIO_FILE
    files = ClaimFiles(*(path / name if (path / name).is_file() else None for name in names))
    if files.claims is None and files.gain is None:
        state = "an unfinished run" if Chunks(path).exist else "no run"
        raise OutputError(f"`{path}` holds {state}: it has neither `{SUMMARY}` nor `{GAIN}`.")
    stated = {STATED: None} if files.claims is None else read_json(files.claims)
    if files.gain is None and stated.get("gain") is not None:
        raise OutputError(
            f"`{path}` has lost its `{GAIN}`; `echelon run {path} --out OTHER` creates it."
        )
    if STATED not in stated and "promise" in stated:
        raise OutputError(
            f"`{files.claims}` was written by an earlier version of echelon; "
            f"`echelon run {path} --out OTHER` computes it again."
        )
    if STATED not in stated:
        raise OutputError(f"`{files.claims}` is damaged: it has no `{STATED}`.")
    return files


def _place(path: Path) -> Path:
    if not path.exists():
        raise OutputError(f"`{path}` does not exist; give the folder of a run, or a gain file.")
    check_exists(path)
    if path.name == DATA:
        raise OutputError(
            f"`{path}` is data alone; give the folder in which it is, `{path.parent}`."
        )
    within = path.name == SUMMARY and (path.parent / SCENARIO_FILE).is_file()
    return path.parent if within else path


# ---- the run, computed again ---------------------------------------------------------------------


def compare_run(
    files: ClaimFiles, scenario: Scenario, experiment: Experiment
) -> Iterator[ClaimCheck]:
    """Yield a finding for each array, number and text that only the run itself gives.

    Raises:
        EchelonError: the run cannot be computed, or a file cannot be read.
    """
    assert files.data is not None
    _, data = read_recording(files.data)
    steps = data.arrays().get(SUM + "steps")
    if steps is None or not int(steps[0]):
        yield unchecked(OBSERVATIONS, "", "the file has no sums over the steps of the run")
        return
    result = _repeated(experiment, data, int(steps[0]))
    if result is None:
        yield unchecked(OBSERVATIONS, "", "the run was stopped at a step that is not repeated")
        return
    result = dataclasses.replace(result, **origin_of(scenario))
    yield from compare_structure(files.data, run_file(result))
    findings = [*_compare(files, data, result, _digits_of(result))]
    refused = {finding.claim for finding in findings if _differs(finding)}
    if refused and not (guarantee(*experiment).promised and _converged(result)):
        refused = _beyond_rounding(files, data, experiment, result)
    for finding in findings:
        open_ = _differs(finding) and finding.claim not in refused
        yield unchecked(finding.claim, finding.stored, _GROWN) if open_ else finding


def _digits_of(result: Result) -> Digits:
    laws = isinstance(result.parts.drive, Laws)
    return _PRECISIONS[result.settings.precision] if laws else _SOLVED


def _beyond_rounding(
    files: ClaimFiles, data: Labelled, experiment: Experiment, result: Result
) -> set[str]:
    """Return the claims that differ by more than rounding may have grown to."""
    wider = _digits_left(experiment, result, _digits_of(result))
    if wider is None or files.data is None:
        return set()
    stored = load(files.data.parent, experiment.parts)
    again = _compare(files, data, result, wider, stored)
    return {finding.claim for finding in again if _differs(finding)}


def _differs(finding: ClaimCheck) -> bool:
    return finding.verdict == "refused" and bool(finding.stored and finding.value)


def _digits_left(experiment: Experiment, result: Result, digits: Digits) -> Digits | None:
    """Return to what two processors agree on a run, by one whose starts are moved by 1e-12.

    None where rounding grows so far that nothing can be compared.
    """
    parts, settings = experiment
    moved = moved_starts(parts, settings.seed, 0, settings.precision == "float32", _MOVED)
    again = simulate(moved, settings)
    if again.outcome is not result.outcome or again.states.shape != result.states.shape:
        return None
    with np.errstate(all="ignore"):
        apart = float(np.nanmax(np.abs(again.states - result.states), initial=0.0))
        spread = _TIMES * apart / float(np.nanmax(np.abs(result.states), initial=1.0))
    if not spread < _UNLIKE:
        return None
    return Digits(max(digits.same, spread), max(digits.noise, spread))


def _converged(result: Result) -> bool:
    """Where errors grow, so may another processor's rounding: a difference proves nothing."""
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


def _compare(
    files: ClaimFiles, data: Labelled, result: Result, digits: Digits, told: Result | None = None
) -> Iterator[ClaimCheck]:
    """Compare files with a run computed again, and the report with that of a run `told`."""
    assert files.data is not None
    yield from _compare_dataset(files.data.name, data, result, digits)
    stopped = {"outcome", "warnings"} if result.outcome.name.lower() in _STOPPED else set[str]()
    if files.claims is not None:
        names = [name for name in OBSERVED if name not in {*_COMPUTED, *stopped}]
        stored, value = read_json(files.claims), json.loads(json.dumps(summary(result)))
        theirs, ours = [{k: x[k] for k in names if k in x} for x in (stored, value)]
        yield from compare_values("", theirs, ours, digits)
        guarantees = [x[STATED] if isinstance(x.get(STATED), dict) else {} for x in (stored, value)]
        covered = [{COVERED: x.get(COVERED)} for x in guarantees]
        yield from compare_values(STATED, covered[0], covered[1])
        # What both files say of the program: nothing else says it.
        versions = {k[8:]: x for k, x in data.attributes.items() if k.startswith("version_")}
        value = {"engine": data.attributes.get("computed_by"), "versions": versions}
        yield from compare_values("", {key: stored.get(key) for key in value}, value)
    written = files.data.parent / REPORT
    if written.is_file() and not stopped:
        yield _compare_report(written, report(told or result) + "\n")


def _compare_dataset(
    name: str, data: Labelled, result: Result, digits: Digits
) -> Iterator[ClaimCheck]:
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


def _compare_report(file: Path, text: str) -> ClaimCheck:
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
    # Of a number with one digit the last one is all of it.
    digit = min(digit, _LAST * max(one, other))
    return abs(one - other) <= digit or max(one, other) < _ROUNDING


# ---- all of it -----------------------------------------------------------------------------------


def verify(
    run: "Result | PathLike",
    model: ControlAffine | None = None,
    scenario: ScenarioLike | None = None,
    repeat: bool = True,
) -> Verification:
    """Check a gain by independent code, and compute a run and its guarantee again.

    Args:
        run: a gain file, the output of `check --json`, the folder of a run, or a result, whose
            guarantee is that of its file if it is from disk.
        model: the agents' model of a gain file, if it is not bundled. Without it, claims about its
            equations are not checked and the verdict is `incomplete`.
        scenario: of a folder whose scenario names classes of your own, which are executed; a
            result's own is executed.
        repeat: whether to simulate the scenario again. Without it, what the run observed is not
            checked and the verdict is `incomplete`.

    Raises:
        GainError: a file is neither, or a part is missing or unknown.
        OutputError: a folder has no claims.
        ScenarioError: the scenario has faults, or a part of it cannot be built.
    """
    if isinstance(run, Result):
        with TemporaryDirectory() as place:
            folder = save_run(run, Path(place) / "run", figures=False)
            own = folder if "scenario_text" in run.provenance else None
            return verify(folder, model, own, repeat)
    if Path(run).is_file() and scenario is None:
        return verifier.verify(run, model)
    trusted = None if scenario is None else as_scenario(scenario)
    return check_files(claim_files(run), trusted, repeat)[0]


def check_files(
    files: ClaimFiles,
    trusted: Scenario | None,
    repeat: bool,
    begin: Callable[[str], None] = lambda what: None,
) -> tuple[Verification, str]:
    """Return what holds of files with claims, and what is against their scenario, if anything.

    `begin` is called with a text before each part that may take a minute or longer.
    """
    source, obstacle = _source(files, trusted)
    findings, note = _independent(files, trusted)
    computed = list[ClaimCheck]()
    # A gain file by itself is no run.
    if source is not None and (files.claims is not None or files.data is not None):
        computed = [*_computed(files, source, repeat, begin)]
    still_open = [*_still_open(findings, computed, obstacle)]
    if files.claims is not None and files.claims.name == SUMMARY and files.data is None:
        still_open.append(unchecked(DATA, "", "it is missing"))
    return judge([*still_open, *computed], note), obstacle


def _computed(
    files: ClaimFiles, source: Scenario, repeat: bool, begin: Callable[[str], None]
) -> Iterator[ClaimCheck]:
    begin("computing the guarantee again, which takes up to a minute")
    experiment, findings = experiment_of(source, files.claims, files.gain)
    yield from findings
    for finding in recompute(experiment, source, files.claims, files.data):
        findings.append(finding)
        yield finding
    if files.data is None:
        return
    if not repeat:
        yield unchecked(OBSERVATIONS, "", "the run was not computed again")
    elif any(each.verdict == "refused" for each in findings):
        yield unchecked(OBSERVATIONS, "", "other values of the run are refused")
    else:
        begin("computing the run again")
        yield from compare_run(files, source, experiment)


def _source(files: ClaimFiles, trusted: Scenario | None) -> tuple[Scenario | None, str]:
    if files.scenario is None:
        return trusted, "" if trusted is not None else "no scenario is beside the file"
    own = load_scenario(files.scenario)
    if trusted is not None:
        same = without_folders(own.data) == without_folders(trusted.data)
        return (trusted, "") if same else (None, "the scenario is not that of the run")
    if names_code(own):
        return None, "the scenario names code, which is not executed unless you name it"
    folder = files.scenario.parent.resolve()
    if not all(each.resolve().is_relative_to(folder) for each in files_of(own)):
        return None, "the scenario names a file outside of its folder"
    return own, ""


def _independent(files: ClaimFiles, trusted: Scenario | None) -> tuple[list[ClaimCheck], str]:
    model = None if trusted is None else build(trusted).parts.model
    checked = [each for each in (files.gain, files.claims) if each is not None]
    results = [verifier.verify(each, model) for each in checked]
    return [x for each in results for x in each.findings], "".join(x.note for x in results)


def _still_open(
    findings: list[ClaimCheck], computed: list[ClaimCheck], obstacle: str
) -> Iterator[ClaimCheck]:
    """Yield what independent code found, without what it left open and the scenario has settled."""
    agree = {each.claim.partition(": ")[2] for each in computed if each.verdict == "recomputed"}
    for each in findings:
        if each.claim.startswith(CLAIMED):
            if not computed:
                yield each._replace(text=obstacle or each.text)
        elif not (each.open and _SETTLED.get(each.claim) in agree):
            yield each
