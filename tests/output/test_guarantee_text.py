"""A guarantee in words: short lines that fit a terminal, made of its data alone."""

import io
import json

import pytest
from in_words import in_words
from recordings import GUARANTEE
from rich.console import Console

import echelon as ech
from echelon.core.statement import Hypothesis, holds
from echelon.core.words import Kind
from echelon.experiments.results.metrics import metrics
from echelon.experiments.scenario.scenario import bundled_scenarios
from echelon.output.reports.guarantee_text import (
    guarantee_lines,
    guarantee_rows,
    guarantee_text,
    through_event,
)
from echelon.output.reports.run_report import print_screen

WORDS, COLUMNS, LINES = 25, 80, 24
QUICK = ("paper", "integrators", "unicycle", "van-der-pol")
LATER = sorted({*bundled_scenarios()} - {*QUICK})


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(x, marks=pytest.mark.slow) for x in LATER)]
)
def test_a_guarantee_of_a_bundled_scenario_is_data_whose_phrases_are_short(name):
    found = ech.guarantee(*ech.build(ech.load_scenario(name)))
    data = json.loads(json.dumps(found.as_mapping(), allow_nan=False))
    # What is stored says the same as what is in memory.
    assert guarantee_text(data) == guarantee_text(found)
    rows = list(guarantee_rows(data))
    assert max(len(text.split()) for _, text in rows) <= WORDS
    for brief in (False, True):
        assert max(map(len, guarantee_lines(data, brief=brief))) <= COLUMNS
    heads = {"guaranteed": "Guaranteed (", "conditional": "Conditional (", "none": "Not guaranteed"}
    assert guarantee_text(data).startswith(heads[data["verdict"]])
    assert {"name", "verdict", "value", "limit", "unit"} <= data["conditions"][0].keys()
    assert all({"value", "unit", "rounding"} == x.keys() for x in data["numbers"].values())


def test_a_run_of_the_paper_s_experiment_fits_a_screen():
    result = ech.run(ech.load_scenario("paper", ["simulation.horizon=11"]))
    text = io.StringIO()
    console = Console(file=text, width=COLUMNS, color_system=None, force_terminal=False)
    print_screen(console, result, metrics(result))
    lines = text.getvalue().splitlines()
    # One more names the files.
    assert len(lines) < LINES and "Guaranteed (linearization)" in lines
    assert max(len(line.split()) for line in lines) <= WORDS


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "Guaranteed (linearization) converges from starts close to the goals rate 0.5 1/s"),
        ({"ignores": ["the wind blows"]}, "(linearization), but for what it ignores"),
        ({"verdict": "none", "claim": None}, "Not guaranteed"),
        ({"start": ["a", "b"]}, "converges from a b rate"),
        ({"until": {"at": 3.0, "guarantee": GUARANTEE}}, "until 3 s: guaranteed (linearization)"),
    ],
)
def test_each_entry_has_its_row(changes, said):
    assert said in in_words(GUARANTEE | changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"against": "agent 0 leads"}, "Nothing is guaranteed through it: agent 0 leads."),
        ({"verdict": "guaranteed"}, "The guarantee covers it."),
        (
            {"verdict": "guaranteed", "of": "others"},
            "The guarantee covers all others through it.",
        ),
        ({"conditions": ["a", "b"]}, "Not guaranteed: the claim covers it while a and b."),
        ({"ignores": ["a"]}, "The guarantee would cover it, but ignores that a."),
        ({}, "Nothing is guaranteed."),
    ],
)
def test_an_event_has_one_sentence_on_its_guarantee(changes, said):
    nothing = {"verdict": "none", "of": "all", "against": "", "conditions": [], "ignores": []}
    assert through_event(nothing | changes) == said


@pytest.mark.parametrize(
    ("number", "shown", "unit"),
    [
        (0.0086433, "8.64 ms", "s"),
        (-26.09, "-26.1 .. 26.28 N, 78.1 deg", "N"),
        (-1.269, "-1.26 1/s at 1 rad/s", "1/s"),
        # The number is another than the first one of the table.
        (0.0424, "2.29 m/s, 3.22 m/s^2, 4.25 % of the input range", ""),
        (0.994, "dt 0.005 s", ""),
        (12, "rank 12 of 12", ""),
    ],
)
def test_a_condition_has_the_unit_of_its_own_number(number, shown, unit):
    line = holds(Hypothesis.LIMITS, Kind.PROOF, "", number, shown)
    assert line.as_mapping()["unit"] == unit
