"""Reports as HTML, which notebooks show instead of the text of a result."""

import html
import io
from collections.abc import Iterable
from typing import Any, final

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from echelon.agents.network.spectrum import Spectrum
from echelon.core.digits import about, at_most
from echelon.experiments.studies.check import CheckResult
from echelon.experiments.studies.compare import Comparison
from echelon.experiments.studies.design import Designs
from echelon.experiments.studies.observed_region import ObservedRegion
from echelon.experiments.studies.seed_comparison import SeedComparison
from echelon.output.reports.check_report import print_statements
from echelon.output.reports.comparison_report import print_comparison
from echelon.output.reports.design_report import design_row, print_designs
from echelon.output.reports.latex import cells_of, plain
from echelon.output.reports.region_report import region_rows, region_sentences

_SHOWN = 20
"""Eigenvalues of a spectrum that are shown."""
Shown = CheckResult | Designs | Comparison | SeedComparison | ObservedRegion | Spectrum
"""What has a page."""


def html_table(rows: Iterable[Iterable[str]], title: str = "") -> str:
    """Return rows of plain text, the first of which are the heads, as an element of a page."""
    heads, *others = ([html.escape(cell) for cell in row] for row in rows)
    lines = ["".join(f"<th>{cell}</th>" for cell in heads)]
    lines += ["".join(f"<td>{cell}</td>" for cell in row) for row in others]
    caption = f"<caption>{html.escape(title)}</caption>" if title else ""
    return f"<table>{caption}{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


@final
class HtmlConsole(Console):
    """A console that keeps what it prints as elements of a page, in `elements`."""

    def __init__(self) -> None:
        super().__init__(file=io.StringIO())
        self.elements = list[str]()

    def print(self, *objects: Any, markup: bool = True, **options: Any) -> None:
        """Keep each object: tables as tables, everything else as paragraphs."""
        for one in objects:
            if isinstance(one, Table):
                title = plain(one.title) if one.title else ""
                self.elements.append(html_table(cells_of(one), title))
            else:
                text = plain(one if markup or not isinstance(one, str) else escape(one))
                self.elements.append(f"<p>{html.escape(text.removeprefix('- '))}</p>")


def html_report(shown: Shown) -> str:
    """Return what a report prints of a result, as HTML."""
    console = HtmlConsole()
    if isinstance(shown, CheckResult):
        print_statements(console, shown)
    elif isinstance(shown, Designs):
        print_designs(console, [design_row(one) for one in shown.designs], shown.because)
    elif isinstance(shown, Spectrum):
        return html_table(_spectrum_rows(shown))
    elif isinstance(shown, Comparison | SeedComparison):
        print_comparison(console, shown)
    region = getattr(shown, "region", shown)
    if isinstance(region, ObservedRegion):
        console.print(*region_sentences(region), markup=False)
        console.elements.append(html_table(region_rows(region), "observed region (no proof)"))
    return "".join(console.elements)


def _spectrum_rows(spectrum: Spectrum) -> list[tuple[str, str]]:
    values = ", ".join(f"{value:.4g}" for value in spectrum.eigenvalues[:_SHOWN])
    more = spectrum.total - len(spectrum.eigenvalues[:_SHOWN])
    numbers = [
        ("smallest real part", about(spectrum.low)),
        ("largest modulus", about(spectrum.high)),
        ("proved bound", at_most(spectrum.proved)),
    ]
    return [("eigenvalues", f"{values} and {more} more" if more else values), *numbers]
