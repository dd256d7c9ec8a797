"""`echelon verify`: whether a gain and the guarantee of a run are as their files state."""

import json
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli.options import JsonOption
from echelon.apps.cli.status import STATUS

if TYPE_CHECKING:
    from echelon.guarantees.verifier.verify import Verification
    from echelon.output.archive.open_folder import ClaimFiles

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
    repeat: Annotated[
        bool,
        typer.Option(
            "--repeat/--no-repeat",
            help="Compute the run again too; without it, what the run observed is not checked.",
        ),
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Check a gain by independent code, and compute a run and its guarantee again.

    Exit code 0 if all claims hold, 1 if one does not, 5 if one could not be checked.
    """
    STATUS.begin(f"verifying {file}", not as_json)
    from echelon.output.archive.open_folder import claim_files

    # Before what takes long to load.
    files = claim_files(file)
    from echelon.experiments.scenario.scenario import load_scenario
    from echelon.output.archive.verify_folder import check_files

    def begin(what: str) -> None:
        STATUS.begin(what, log=False)

    trusted = None if scenario is None else load_scenario(scenario)
    verification, obstacle = check_files(files, trusted, repeat, begin)
    from echelon.apps.cli.verify_report import as_mapping, print_verification

    if as_json:
        print(json.dumps(as_mapping(verification), indent=2))
    else:
        print_verification(verification, file if files.data is not None else None)
        for text in _advice(file, files, verification, obstacle, scenario):
            print(text)
    raise typer.Exit(_EXIT_CODES[verification.verdict])


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
        yield from _other_version(file, files)
    elif any(x.open and x.claim.startswith((PROMISE, MODEL)) for x in verification.findings):
        if scenario is not None:
            yield f"`--scenario {scenario}`: {obstacle}."
        own = file if files.scenario is not None else "SCENARIO"
        command = f"echelon verify {file} --scenario {own}"
        yield f"To check the rest, with code that you trust: {command}"


def _other_version(file: Path, files: "ClaimFiles") -> "Iterator[str]":
    """Yield that a run was written by another version, if its summary says so, and what to do."""
    if files.claims is None:
        return
    from echelon.apps.cli.verify_report import WIDTH
    from echelon.core.provenance import versions
    from echelon.guarantees.verifier.saved_gain import read_json

    made, ours = read_json(files.claims).get("versions"), versions()
    names = [f"{made.get('echelon')} ({made.get('git')})"] if isinstance(made, dict) else []
    current = f"{ours['echelon']} ({ours.get('git')})"
    if names and names[0] != current:
        wrote = f"echelon {ascii(names[0])[1:-1]} wrote it, and this is {current}, which may "
        yield from textwrap.wrap(f"{wrote}state more, or the same in other words.", WIDTH)
        yield f"To compute it again by this one: echelon run {file} --out OTHER"
