"""Checks all that a run states of its gain and its guarantee."""

from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from echelon.agents.models.model import ControlAffine
from echelon.core.types import PathLike
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.scenario import (
    Scenario,
    ScenarioLike,
    as_scenario,
    load_scenario,
)
from echelon.experiments.scenario.self_contained import files_of, names_code, without_folders
from echelon.experiments.studies.recomputation import experiment_of, recompute
from echelon.guarantees.verifier import verify as verifier
from echelon.guarantees.verifier.findings import Finding, unchecked
from echelon.guarantees.verifier.verify import PROMISE, Verification, judge
from echelon.output.archive.folder import DATA, SUMMARY
from echelon.output.archive.open_folder import ClaimFiles, claim_files
from echelon.output.archive.repetition import OBSERVATIONS, compare_run
from echelon.output.archive.run_folder import save_run
from echelon.simulation.engine.result import Result

_SETTLED = {"graph spectrum": "graph.spectrum", "method": "method"}
"""What independent code leaves open of large and switching graphs and own methods, and what the
scenario settles it by."""


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

    Args:
        files: of a run, or a gain file.
        trusted: the scenario whose code may be executed.
        repeat: whether to simulate the scenario again.
        begin: called with a text before each part that may take a minute or longer.
    """
    source, obstacle = _source(files, trusted)
    findings, note = _independent(files, trusted)
    computed = list[Finding]()
    # A gain file by itself is no run.
    if source is not None and (files.claims is not None or files.data is not None):
        computed = [*_computed(files, source, repeat, begin)]
    still_open = [*_still_open(findings, computed, obstacle)]
    if files.claims is not None and files.claims.name == SUMMARY and files.data is None:
        still_open.append(unchecked(DATA, "", "it is missing"))
    return judge([*still_open, *computed], note), obstacle


def _computed(
    files: ClaimFiles, source: Scenario, repeat: bool, begin: Callable[[str], None]
) -> Iterator[Finding]:
    """Yield what is computed again from a scenario: the guarantee, and then the run."""
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
    """Return the scenario from which claims are computed again; or None, and what is against it."""
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


def _independent(files: ClaimFiles, trusted: Scenario | None) -> tuple[list[Finding], str]:
    """Return what independent code finds in each file, and its notes."""
    model = None if trusted is None else build(trusted).parts.model
    checked = [each for each in (files.gain, files.claims) if each is not None]
    results = [verifier.verify(each, model) for each in checked]
    return [x for each in results for x in each.findings], "".join(x.note for x in results)


def _still_open(
    findings: list[Finding], computed: list[Finding], obstacle: str
) -> Iterator[Finding]:
    """Yield what independent code found, without what it left open and the scenario has settled."""
    agree = {each.claim.partition(": ")[2] for each in computed if each.verdict == "recomputed"}
    for each in findings:
        if each.claim.startswith(PROMISE):
            if not computed:
                yield each._replace(text=obstacle or each.text)
        elif not (each.open and _SETTLED.get(each.claim) in agree):
            yield each
