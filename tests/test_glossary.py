"""Every term that a table prints is in the glossary, and every scenario key is on its page."""

import re
import runpy
from pathlib import Path

import numpy as np
from runs import made_up

import echelon as ech
from echelon.core.statement import Hypothesis, Topic
from echelon.core.words import Feedforward, Kind, Theorem, Verdict
from echelon.experiments.scenario.scenario import json_schema
from echelon.experiments.studies.compare import Comparison
from echelon.output.reports import comparison_report, design_report, run_report

DOCS = Path(__file__).resolve().parents[1] / "docs"
TEXT = (DOCS / "glossary.md").read_text("utf-8")
ENTRIES = re.findall(r"\*\*(.+?)\*\*", TEXT)
WORDS = [
    *(each.value for each in (*Hypothesis, *Topic)),
    *map(str, (*Verdict, *Kind, *Theorem, *Feedforward)),
]


def heads(table):
    names = (" ".join(str(column.header).split()) for column in table.columns)
    return [re.sub(r"( from)?,.*| \(.*\)| \d+ s$| last .*", "", name) for name in names]


def test_each_entry_stands_once_and_says_something():
    assert len(ENTRIES) == len(set(ENTRIES)), sorted(x for x in ENTRIES if ENTRIES.count(x) > 1)
    for item in re.split(r"^- ", TEXT, flags=re.MULTILINE)[1:]:
        assert len(item.split()) > 4, item


def test_every_word_of_a_check_is_explained():
    assert [word for word in WORDS if word not in ENTRIES] == []


def test_every_column_of_a_design_is_explained():
    names = {
        re.sub(r"(,.*| \(\d\))", "", " ".join(x.split()))
        for x, _ in design_report._DESIGN.values()
        if x
    }
    assert names <= set(ENTRIES), names - set(ENTRIES)


def test_every_column_of_a_report_is_explained():
    for model in (ech.models.DoubleIntegrator(2), ech.models.VanDerPol()):
        result = made_up(np.zeros((4, 3, len(model.state_names))), model, ech.Graph.path(3))
        names = heads(run_report._table(result, ech.metrics(result)))
        assert set(names) <= set(ENTRIES), set(names) - set(ENTRIES)
        assert len(names) == 6


def test_every_column_of_a_comparison_is_explained():
    compared = Comparison("x", (), 10.0, 2.0, ())
    names = {*heads(comparison_report._errors_table(compared))}
    names |= {*heads(comparison_report._costs_table(compared))}
    assert names <= set(ENTRIES), names - set(ENTRIES)


def test_the_page_of_keys_is_what_the_schema_makes():
    told = (DOCS / "scenario.md").read_text("utf-8")
    page = runpy.run_path(str(DOCS / "scenario_keys.py"))["keys_page"]()
    assert told == page, "run `python docs/scenario_keys.py`"


def numbers_of(what):
    """Whether a number that is no count may stand in a value of the schema."""
    if isinstance(what, dict):
        # A choice may be called `number`.
        parts = [part for name, part in what.items() if name not in ("default", "enum")]
        return any(map(numbers_of, parts))
    return any(map(numbers_of, what)) if isinstance(what, list) else what == "number"


def test_every_number_of_a_scenario_has_a_unit_and_every_key_a_sentence():
    schema = json_schema()
    for name, part in (*schema["$defs"].items(), ("file", schema)):
        for key, what in part["properties"].items():
            others = (
                ("GraphSpec", "edges"),
                *((x, "parameters") for x in ("MotionSpec", "EventSpec")),
            )
            if name not in ("file", "UserClass") and (name, key) not in others:
                assert "unit" in what or not numbers_of(what), (name, key)
            assert "description" in what or "$ref" in repr(what), (name, key)
