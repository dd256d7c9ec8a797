"""The lines in which `check` says what it found."""

from typing import NamedTuple

from echelon.core.words import Kind, Verdict


class Line(NamedTuple):
    """One statement: its verdict, the kind of argument, the number behind it, what to change."""

    statement: str
    verdict: Verdict
    kind: Kind
    number: str
    text: str


class Checked(NamedTuple):
    """All lines, whether the closed loop is promised anything, and the promise in a sentence."""

    lines: tuple[Line, ...]
    promised: bool
    promise: str
