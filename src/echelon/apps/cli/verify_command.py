"""`echelon verify`: whether a gain and the guarantee of a run are as their files state."""

import json
import textwrap
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import JsonOption
from echelon.apps.cli.terminal import STATUS

if TYPE_CHECKING:
    from echelon.core.types import JsonObject
    from echelon.guarantees.verifier.findings import ClaimCheck
    from echelon.guarantees.verifier.verify import Verification
    from echelon.output.archive.verify_folder import ClaimFiles

_EXIT_CODES = {"verified": 0, "refused": 1, "incomplete": 5}
_WIDTH = 80
_TITLES = ("claim", "stored", "recomputed", "verdict")
_DEPTHS = {"guarantee.anywhere.": 3, "guarantee.": 2}
"""Entries of a guarantee that are rows by themselves; of others, the first key is."""


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
    from echelon.output.archive.verify_folder import claim_files

    # Before what takes long to load.
    files = claim_files(file)
    from echelon.experiments.scenario.scenario import load_scenario
    from echelon.output.archive.verify_folder import check_files

    def begin(what: str) -> None:
        STATUS.begin(what, log=False)

    trusted = None if scenario is None else load_scenario(scenario)
    verification, obstacle = check_files(files, trusted, repeat, begin)
    if as_json:
        print(json.dumps(_as_mapping(verification), indent=2))
    else:
        _print_verification(verification, file if files.data is not None else None)
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
    from echelon.guarantees.verifier.agent_claims import MODEL
    from echelon.guarantees.verifier.verify import CLAIMED

    if verification.verdict == "refused":
        yield from _other_version(file, files)
    elif any(x.open and x.claim.startswith((CLAIMED, MODEL)) for x in verification.findings):
        if scenario is not None:
            yield f"`--scenario {scenario}`: {obstacle}."
        own = file if files.scenario is not None else "SCENARIO"
        command = f"echelon verify {file} --scenario {own}"
        yield f"To check the rest, with code that you trust: {command}"


def _other_version(file: Path, files: "ClaimFiles") -> "Iterator[str]":
    if files.claims is None:
        return
    from echelon.core.files import versions
    from echelon.guarantees.verifier.saved_gain import read_json

    made, ours = read_json(files.claims).get("versions"), versions()
    names = [f"{made.get('echelon')} ({made.get('git')})"] if isinstance(made, dict) else []
    current = f"{ours['echelon']} ({ours.get('git')})"
    if names and names[0] != current:
        wrote = f"echelon {ascii(names[0])[1:-1]} wrote it, and this is {current}, which may "
        yield from textwrap.wrap(f"{wrote}state more, or the same in other words.", _WIDTH)
        yield f"To compute it again by this one: echelon run {file} --out OTHER"


def _as_mapping(verification: "Verification") -> "JsonObject":
    return {
        "verdict": verification.verdict,
        "holds": verification.holds,
        "sentence": verification.sentence,
        "findings": [finding.as_mapping() for finding in verification.findings],
    }


def _print_verification(verification: "Verification", run: Path | None) -> None:
    """`run` is the folder if the claims are of a whole run."""
    by = {"recomputed": list["ClaimCheck"](), "independent": list["ClaimCheck"]()}
    for finding in verification.findings:
        by["recomputed" if finding.by_scenario else "independent"].append(finding)
    _print_rows("By independent code", [x[:4] for x in by["independent"] if not x.open])
    _print_rows("Computed again from the scenario", _summed(by["recomputed"]))
    for text in _reasons(verification.findings):
        _print(f"- {text}")
    if run is not None:
        text = "Not covered: the figures, the computing time, and the stated versions and engine. "
        _print(f"{text}`echelon plot {run} --out OTHER` draws the figures again.")
    _print(verification.sentence)


def _print(text: str) -> None:
    # Words are not broken, so that a path can be copied.
    lines = textwrap.wrap(text, _WIDTH, break_long_words=False, break_on_hyphens=False)
    print("\n".join(lines))


def _print_rows(title: str, rows: Iterable[Iterable[str]]) -> None:
    rows = list(rows)
    if rows:
        from echelon.output.reports.check_report import plain_table

        table = plain_table(_TITLES, rows)
        table.title, table.title_justify = title, "left"
        tables.console(_WIDTH).print(table)


def _reasons(findings: Iterable["ClaimCheck"]) -> Iterator[str]:
    """Yield why claims are refused, each by itself, and then why others are open."""
    findings = list(findings)
    for each in findings:
        if each.verdict == "refused":
            yield f"{each.claim}: {each.text or 'stored and recomputed differ'}."
    for reason, some in groupby((x for x in findings if x.open), lambda x: x.text):
        yield f"not checked: {', '.join(x.claim for x in some)}; {reason}."


def _summed(findings: Iterable["ClaimCheck"]) -> Iterator[tuple[str, ...]]:
    """Yield rows, one for all values below a key that agree."""
    for key, some in groupby(findings, lambda x: _key(x.claim)):
        some = list(some)
        equal = [each for each in some if each.verdict == "recomputed"]
        if len(equal) == 1:
            yield (key, *equal[0][1:4])
        elif equal:
            yield key, f"{len(equal)} values", "equal", "recomputed"
        yield from (each[:4] for each in some if each.verdict != "recomputed")


def _key(claim: str) -> str:
    file, colon, path = claim.rpartition(": ")
    depth = next((n for start, n in _DEPTHS.items() if path.startswith(start) and not file), 1)
    return file + colon + ".".join(path.split(".")[:depth])
