"""The text of a check fits a terminal, and puts the verdict on this scenario first."""

from types import SimpleNamespace

import pytest
from in_words import in_words
from recordings import GUARANTEE

import echelon as ech
from echelon.core.statement import Hypothesis, Topic, fails, holds, unneeded
from echelon.core.words import Kind
from echelon.output.reports.check_report import HEIGHT, check_report, grouped
from echelon.output.reports.guarantee_text import WIDTH

# Those with the most lines and the longest.
LONG = ("paper-everything", "crossing", "paper-far")


@pytest.mark.parametrize(
    "name", ["paper", "integrators", *(pytest.param(x, marks=pytest.mark.slow) for x in LONG)]
)
def test_a_check_of_a_bundled_scenario_fits_a_terminal(name):
    found = ech.check(*ech.build(ech.load_scenario(name)))
    text = check_report(found)
    lines = text.splitlines()
    assert len(lines) <= HEIGHT == 40 and max(map(len, lines)) <= WIDTH == 80
    assert " ".join(text.split()).startswith(in_words(found.promise).partition(" if ")[0][:60])
    # Whatever fails has its line, those of the paper's text after all that this loop rests on.
    # What fails and is no condition of a guarantee is a note.
    rows = [k for k, line in enumerate(lines) if "  fails  " in line or "  note   " in line]
    assert len(rows) == sum(line.fails for line in found.lines)
    printed = next(k for k, line in enumerate(lines) if line.startswith("the paper's printed"))
    for line in found.lines:
        row = next((k for k in rows if lines[k].startswith(f" {line.name} ")), None)
        assert (row is not None) == line.fails
    papers = grouped(found.lines)[lines[printed][:-1]]
    assert sum(k > printed for k in rows) == sum(line.fails for line in papers)


def found_of(make):
    """A check with a long guarantee and all lines that there are, each made by a function."""
    promise = GUARANTEE | {"start": ["word " * 15] * 3, "notes": ["word " * 15]}
    lines = tuple(map(make, (*Hypothesis, *Topic)))
    return SimpleNamespace(promise=promise, lines=lines, warnings=(), region=None)


@pytest.mark.parametrize(
    "make",
    [
        lambda line: holds(line, Kind.PROOF, "text " * 30, 1.0, "x 1.23456, y 2.34567"),
        lambda line: holds(line, Kind.PROOF, "text " * 30, 1.0, "a long number, " * 5),
        lambda line: unneeded(line, Kind.PROOF, "text"),
    ],
)
def test_what_holds_makes_room(make):
    lines = check_report(found_of(make)).splitlines()
    assert len(lines) <= HEIGHT and max(map(len, lines)) <= WIDTH


def test_what_fails_is_never_left_out_and_every_line_is_in_one_group():
    found = found_of(lambda line: fails(line, Kind.PROOF, "x", remedy=f"change {line.name}"))
    text = check_report(found)
    for line in found.lines:
        assert f" {line.name} " in text
        papers = line in grouped(found.lines)[list(grouped(found.lines))[-1]]
        assert (f"-> {line.remedy}" in text) != papers
    assert max(map(len, text.splitlines())) <= WIDTH
    lines = found_of(lambda line: unneeded(line, Kind.PROOF, "text")).lines
    groups = grouped(lines)
    assert sorted(x.name for part in groups.values() for x in part) == sorted(x.name for x in lines)
