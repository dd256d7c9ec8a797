"""Formulas of the documentation: plain text becomes the TeX that it means, and code stays code."""

import importlib.util
import re
from pathlib import Path

import markdown
import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"


spec = importlib.util.spec_from_file_location("formulas", DOCS / "formulas.py")
formulas = importlib.util.module_from_spec(spec)
spec.loader.exec_module(formulas)


MEANS = {
    "xdot = f(x) + g(x) u": r"\dot{x} = f(x) + g(x) u",
    "δ' (L_g ⊗ P) δ": r"\delta^{\prime} (L_{g} \otimes P) \delta",
    "c >= 1/(2 λ_min)": r"c \ge 1/(2 \lambda_{\mathrm{min}})",
    "1/2 z'z": r"\tfrac{1}{2} z^{\prime} z",
    "|exp(A t) x|_P": r"| \operatorname{exp}(A t) x |_{P}",
    "ζ~_i' = -σ(c z_i)": r"\tilde{\zeta}_{i}^{\prime} = -\sigma(c z_{i})",
    "δ^ = D'δ": r"\hat{\delta} = D^{\prime} \delta",
    "y^(r) = e^(-ρt)": r"y^{(r)} = e^{-\rho t}",
    "x / sqrt(1 + (x/s)²)": r"x / \sqrt{1 + (x/s)^{2}}",
    "f(x*) + g(x*) u* = 0": r"f(x^{*}) + g(x^{*}) u^{*} = 0",
    "c_(k+1)' - c_k": r"c_{k+1}^{\prime} - c_{k}",
    "R^-1/2 1e-9": r"R^{-\tfrac{1}{2}} 10^{-9}",
}
CODE = ["stopping-point", "Graph.spectrum", "max", "T2", "python x.py", "x = 'a'", "sqrt(x"]


def test_plain_text_becomes_what_it_means_and_code_stays_code():
    found = {text: re.sub(r"\s+", "", formulas.tex(text)) for text in MEANS}
    assert found == {text: re.sub(r"\s+", "", means) for text, means in MEANS.items()}
    for text in CODE:
        with pytest.raises(formulas.NotMath):
            formulas.tex(text)


PAGE = """# Page

<!-- formulas -->

### T1: a statement

Let `c >= 0` for d_max and `relay`, so that

    P A <= 0   for all A.

Then `V' <= 0`. *Proof.* Clear.

*Tests:* `test_a.py::test_b`.
"""


def rendered(text):
    page = markdown.Markdown(extensions=[formulas.Formulas(), "tables"])
    return page.convert(text)


def test_a_marked_page_has_formulas_frames_and_folded_tests():
    html = rendered(PAGE)
    assert r'<div class="statement">' in html and html.count('class="formula"') == 4
    assert "<code>relay</code>" in html and r"\(d_{\mathrm{max}}" in html
    assert html.index("</div>\n<p><em>Proof.") < html.index("<details>")
    assert "<summary>Tests</summary>" in html and "<code>test_a.py::test_b</code>" in html
    # A page without the mark is as it was.
    plain = PAGE.replace("<!-- formulas -->", "")
    assert rendered(plain) == markdown.markdown(plain, extensions=["tables"])


def test_braces_of_all_formulas_of_the_theory_pages_match():
    pages = (DOCS / "theory").glob("*.md")
    html = "".join(rendered(path.read_text("utf-8")) for path in pages)
    parts = re.findall(r'class="formula">\\[(\[](.*?)\\[)\]]</', html, re.DOTALL)
    assert len(parts) > 500
    for part in parts:
        assert part.count("{") == part.count("}") and "class=" not in part, part
