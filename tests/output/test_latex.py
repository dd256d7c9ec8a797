"""Tables as LaTeX, read back by rules of this test."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.table import Table
from rich.text import Text

from echelon.output.reports.latex import latex

BACK = {r"\textbackslash{}": "\\", r"\textasciitilde{}": "~", r"\textasciicircum{}": "^"}
BACK |= {"$<$": "<", "$>$": ">", r"$\pm$": "±", r"$\times$": "×"}
BACK |= {f"\\{letter}": letter for letter in "&%$#_{}"}
TOKEN = re.compile("|".join(map(re.escape, sorted(BACK, key=len, reverse=True))))


def cells_of(line):
    assert line.endswith(r" \\")
    parts = re.split(r"(?<!\\)&", line[: -len(r" \\")])
    return [TOKEN.sub(lambda found: BACK[found[0]], part).strip() for part in parts]


WORDS = st.text(st.sampled_from("ab 1.%&_#${}~^\\<>±×"), max_size=8).map(
    lambda x: " ".join(x.split())
)


@given(st.lists(st.lists(WORDS, min_size=3, max_size=3), min_size=1, max_size=4))
def test_all_cells_are_there_whatever_their_letters(rows):
    table = Table(title="one & two")
    for name, side in (("a_b", "left"), ("c", "right"), ("d %", "right")):
        table.add_column(name, justify=side)
    for row in rows:
        table.add_row(*map(Text, row))
    title, begin, _, head, _, *body, _, end = latex(table).split("\n")
    assert (title, begin, end) == ("% one & two", r"\begin{tabular}{lrr}", r"\end{tabular}")
    assert cells_of(head) == ["a_b", "c", "d %"]
    assert [cells_of(line) for line in body] == rows


@pytest.mark.parametrize(
    "command", ["report r --latex", "design integrators --method riccati --latex"]
)
def test_what_is_printed_is_tables_and_comments(echelon, command):
    changes = ("--set", "simulation.horizon=1", "--set", "report.steady_window=0.5", "--no-figures")
    assert echelon("run", "integrators", *changes, "--out", "r")[0] == 0
    code, out, _ = echelon(*command.split())
    lines = out.rstrip("\n").split("\n")
    kinds = {line[:1] for line in lines if not line.endswith(r" \\")}
    assert code < 2 and kinds <= {"%", "\\"} and r"\begin{tabular}" in out
    widths = {len(cells_of(line)) for line in lines if line.endswith(r" \\")}
    assert min(widths) > 2
