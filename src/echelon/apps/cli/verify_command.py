"""`echelon verify`: whether a gain and the guarantee of a run are as their files state."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli.options import JsonOption
from echelon.apps.cli.status import STATUS

if TYPE_CHECKING:
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.guarantees.verifier.findings import Finding
    from echelon.guarantees.verifier.verify import Verification
    from echelon.output.archive.open_folder import ClaimFiles

_SETTLED = {"graph spectrum": "graph.spectrum", "method": "method"}
"""What independent code leaves open of large and switching graphs and own methods, and what the
scenario settles it by."""
_EXIT_CODES = {"verified": 0, "refused": 1, "incomplete": 5}


def verify(
    file: Annotated[
        Path,
        typer.Argument(help="The folder of a run, a gain file, or the output of `check --json`."),
    ],
    scenario: Annotated[
        str | None,
        typer.Option(help="The scenario or run with classes of your own; their code is executed."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check a gain by independent code, and compute a run's guarantee again from its scenario.

    Exit code 0 if all claims hold, 1 if one does not, 5 if one could not be checked.
    """
    STATUS.begin(f"verifying {file}", not as_json)
    from echelon.output.archive.open_folder import claim_files

    files = claim_files(file)
    trusted = None if scenario is None else _load(scenario)
    source, obstacle = _source(files, trusted)
    findings, note = _independent(files, trusted)
    computed = [] if source is None else _recomputed(source, files)
    from echelon.apps.cli.verify_report import as_mapping, print_verification
    from echelon.guarantees.verifier.verify import judge

    verification = judge([*_still_open(findings, computed, obstacle), *computed], note)
    if as_json:
        print(json.dumps(as_mapping(verification), indent=2))
    else:
        print_verification(verification, file if files.data is not None else None)
        for text in _advice(file, files, verification, obstacle, scenario):
            print(text)
    raise typer.Exit(_EXIT_CODES[verification.verdict])


def _load(scenario: str | Path) -> "Scenario":
    from echelon.experiments.scenario.scenario import load_scenario

    return load_scenario(scenario)


def _source(files: "ClaimFiles", trusted: "Scenario | None") -> "tuple[Scenario | None, str]":
    """Return the scenario from which claims are computed again; or None, and what is against it."""
    from echelon.experiments.scenario.self_contained import files_of, names_code, without_folders

    if files.scenario is None:
        return trusted, "" if trusted is not None else "no scenario is beside the file"
    own = _load(files.scenario)
    if trusted is not None:
        same = without_folders(own.data) == without_folders(trusted.data)
        return (trusted, "") if same else (None, "the scenario is not that of the run")
    if names_code(own):
        return None, "the scenario names code, which is not executed unless you name it"
    folder = files.scenario.parent.resolve()
    if not all(each.resolve().is_relative_to(folder) for each in files_of(own)):
        return None, "the scenario names a file outside of its folder"
    return own, ""


def _independent(files: "ClaimFiles", trusted: "Scenario | None") -> "tuple[list[Finding], str]":
    """Return what independent code finds in each file, and its notes."""
    from echelon.guarantees.verifier.verify import verify as check

    model = None
    if trusted is not None:
        from echelon.experiments.scenario.build import build

        model = build(trusted).parts.model
    results = [check(each, model) for each in (files.gain, files.claims) if each is not None]
    return [x for each in results for x in each.findings], "".join(x.note for x in results)


def _recomputed(scenario: "Scenario", files: "ClaimFiles") -> "list[Finding]":
    """Return what the scenario gives; nothing for a gain file by itself."""
    if files.claims is None and files.data is None:
        return []
    STATUS.begin("computing the guarantee again, which takes up to a minute", log=False)
    from echelon.experiments.studies.recomputation import recompute

    return list(recompute(scenario, files.claims, files.gain, files.data))


def _still_open(
    findings: "list[Finding]", computed: "list[Finding]", obstacle: str
) -> "Iterator[Finding]":
    """Yield what independent code found, without what it left open and the scenario has settled."""
    from echelon.guarantees.verifier.verify import PROMISE

    agree = {each.claim.partition(": ")[2] for each in computed if each.verdict == "recomputed"}
    for each in findings:
        if each.claim.startswith(PROMISE):
            if not computed:
                yield each._replace(text=obstacle or each.text)
        elif not (each.open and _SETTLED.get(each.claim) in agree):
            yield each


def _advice(
    file: Path,
    files: "ClaimFiles",
    verification: "Verification",
    obstacle: str,
    scenario: str | None,
) -> "Iterator[str]":
    """Yield how what is open can be checked, and what a refusal may come from."""
    from echelon.guarantees.verifier.verify import MODEL, PROMISE

    if verification.verdict == "refused":
        yield from _other_version(files)
    elif any(x.open and x.claim.startswith((PROMISE, MODEL)) for x in verification.findings):
        if scenario is not None:
            yield f"`--scenario {scenario}`: {obstacle}."
        own = file if files.scenario is not None else "SCENARIO"
        command = f"echelon verify {file} --scenario {own}"
        yield f"To check the rest, with code that you trust: {command}"


def _other_version(files: "ClaimFiles") -> "Iterator[str]":
    """Yield that a run was made by another version, if its summary says so."""
    if files.claims is None:
        return
    from echelon.core.provenance import versions
    from echelon.guarantees.verifier.strict_json import read_json

    made, ours = read_json(files.claims).get("versions"), versions()
    names = [f"{made.get('echelon')} ({made.get('git')})"] if isinstance(made, dict) else []
    current = f"{ours['echelon']} ({ours.get('git')})"
    if names and names[0] != current:
        yield f"It was made by echelon {ascii(names[0])[1:-1]}, and this is {current}."
        yield "Another version may compute or word the same guarantee in another way."
