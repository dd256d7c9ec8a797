"""Results in notebooks are tables, read here by the parser of the standard library."""

from html.parser import HTMLParser

import numpy as np
import pytest

import echelon as ech
from echelon.experiments.studies.compare import Comparison, ComparisonRow
from echelon.experiments.studies.observed_region import ObservedRegion, ScaleTrial
from echelon.experiments.studies.seed_comparison import NUMBERS, MethodSeeds, SeedComparison

TAGS = ("<b onclick='f()'>&amp;", "[bold]x[/bold] </table>")
"""Names that are neither HTML nor markup of a terminal."""


class Page(HTMLParser):
    """The tables (rows of cells), the paragraphs and the tags of a page; each must be closed."""

    def __init__(self, text):
        super().__init__()
        self.tables, self.texts, self.tags, self._open, self._text = [], [], set(), [], ""
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        assert not attrs
        self._open.append(tag)
        self.tags.add(tag)
        self._text = ""
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])

    def handle_endtag(self, tag):
        assert self._open.pop() == tag
        if tag in ("td", "th"):
            self.tables[-1][-1].append(self._text)
        elif tag in ("p", "caption"):
            self.texts.append(self._text)

    def handle_data(self, data):
        self._text += data


def page_of(value):
    """The page of a result, whose tables are rectangular and have distinct heads."""
    page = Page(value._repr_html_())
    assert page.tags <= {"table", "tr", "th", "td", "p", "caption"}
    for rows in page.tables:
        assert len({len(row) for row in rows}) == 1 and len({*rows[0]}) == len(rows[0])
    return page


@pytest.fixture(scope="module")
def integrators():
    return ech.build(ech.load_scenario("integrators"))


def test_a_check_is_its_sentences_and_a_table_of_all_lines(integrators):
    found = ech.check(*integrators)
    page = page_of(found)
    cells = {row[0]: row[1:] for table in page.tables for row in table[1:]}
    assert {*cells} == {line.name for line in found.lines}
    for line in found.lines:
        assert cells[line.name][0] == line.shown_verdict
        assert cells[line.name][2].split() == line.number_text.split()
    assert ech.guarantee_text(found.promise).split()[0] in " ".join(page.texts)


def test_a_design_is_tables_of_all_methods_with_the_recommendation(integrators):
    found = ech.design(integrators)
    page = page_of(found)
    for table in page.tables:
        assert [row[0] for row in table[1:]] == [one.method for one in found.designs]
    [column] = [k for k, head in enumerate(page.tables[0][0]) if head == "coupling"]
    for one, row in zip(found.designs, page.tables[0][1:], strict=True):
        if one.gain is not None:
            assert float(row[column]) == pytest.approx(one.gain.coupling, rel=5e-3)
    assert page.texts[-1] == found.because


def rows_of(spectrum):
    [table] = page_of(spectrum).tables
    return dict(table)


def test_a_spectrum_is_a_table_of_its_eigenvalues():
    spectrum = ech.Graph.path(3).spectrum()
    # Of the grounded path of two followers: [[2, -1], [-1, 1]].
    found = np.linalg.eigvalsh([[2.0, -1.0], [-1.0, 1.0]])
    rows = rows_of(spectrum)
    assert [float(x) for x in rows["eigenvalues"].split(", ")] == pytest.approx(found, rel=1e-3)
    assert float(rows["proved bound"]) <= found[0]
    many = ech.Graph.path(60).spectrum()
    assert rows_of(many)["eigenvalues"].endswith(" and 39 more")


def test_names_are_neither_markup_nor_html():
    rows = tuple(ComparisonRow(tag, None, f"no gain of {tag}") for tag in TAGS)
    page = page_of(Comparison("a <i> b", rows, 10.0, 2.0, ()))
    for tag in TAGS:
        assert any(f"no gain of {tag}" in text for text in page.texts)
    numbers = {name: np.arange(1.0, 7.0) for name in NUMBERS}
    methods = [MethodSeeds(tag, ["completed"] * 6, numbers, unit="m") for tag in ("<u>", "other")]
    page = page_of(SeedComparison("<i>", range(6), methods, 5.0, ()))
    assert [row[0] for row in page.tables[0][1:]] == ["<u>", "other"]
    assert any("<i>, 6 seeds" in text for text in page.texts)


def test_an_observed_region_is_a_table_of_its_trials():
    trials = (ScaleTrial(0.5, 20, {}), ScaleTrial(1.0, 20, {"diverged": 3}))
    region = ObservedRegion({"x": 1.0}, {"x": "m"}, True, 8.0, "m", True, trials)
    [table] = page_of(region).tables
    assert [row[:2] for row in table[1:]] == [["0.5", "0 of 20"], ["1", "3 of 20"]]


def test_a_terminal_has_plain_text(integrators, echelon):
    found = ech.check(*integrators)
    assert "<table" not in f"{found!r}{found}"
    for command in ("check", "design"):
        assert "<t" not in echelon(command, "integrators")[1]
