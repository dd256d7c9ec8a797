"""The report of `echelon verify`, in 80 columns."""

import textwrap
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.apps.cli import tables

if TYPE_CHECKING:
    from echelon.core.types import JsonObject
    from echelon.guarantees.verifier.findings import Finding
    from echelon.guarantees.verifier.verify import Verification

WIDTH = 80
_TITLES = ("claim", "stored", "recomputed", "verdict")
_DEPTHS = {"promise.anywhere.": 3, "promise.": 2}
"""Entries of a guarantee that are rows by themselves; of others, the first key is."""


def as_mapping(verification: "Verification") -> "JsonObject":
    """Return a verification ready for JSON."""
    return {
        "verdict": verification.verdict,
        "holds": verification.holds,
        "sentence": verification.sentence,
        "findings": [finding.as_mapping() for finding in verification.findings],
    }


def print_verification(verification: "Verification", run: Path | None) -> None:
    """Print what was checked by which means, the reasons of what is not verified, and the verdict.

    `run` is the folder if the claims are of a whole run.
    """
    by = {"recomputed": list["Finding"](), "independent": list["Finding"]()}
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
    lines = textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False)
    print("\n".join(lines))


def _print_rows(title: str, rows: Iterable[Iterable[str]]) -> None:
    rows = list(rows)
    if rows:
        table = tables.plain_table(_TITLES, rows)
        table.title, table.title_justify = title, "left"
        tables.console(WIDTH).print(table)


def _reasons(findings: Iterable["Finding"]) -> Iterator[str]:
    """Yield why claims are refused, each by itself, and then why others are open."""
    findings = list(findings)
    for each in findings:
        if each.verdict == "refused":
            yield f"{each.claim}: {each.text or 'stored and recomputed differ'}."
    for reason, some in groupby((x for x in findings if x.open), lambda x: x.text):
        yield f"not checked: {', '.join(x.claim for x in some)}; {reason}."


def _summed(findings: Iterable["Finding"]) -> Iterator[tuple[str, ...]]:
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
