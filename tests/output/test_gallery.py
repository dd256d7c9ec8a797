"""Pictures and notebooks of the documentation: their scripts produce them, and they stay small."""

import base64
import importlib.util
import json
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
GALLERY = DOCS / "assets" / "gallery"
BOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
ONE_BOOK = [BOOKS[0], *(pytest.param(book, marks=pytest.mark.study) for book in BOOKS[1:])]


def script(name, monkeypatch):
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.study
def test_the_gallery_s_script_draws_every_picture_of_the_page(tmp_path, monkeypatch):
    script("draw_gallery", monkeypatch).main(["--quick", "--out", str(tmp_path)])
    assert all(path.stat().st_size > 1000 for path in tmp_path.iterdir())
    assert {path.name for path in tmp_path.iterdir()} == committed()


def committed():
    return {path.name for path in GALLERY.iterdir()}


def test_pictures_and_notebooks_are_many_small_and_shown():
    page = (DOCS / "gallery.md").read_text("utf-8")
    assert set(re.findall(r"\(assets/gallery/(\S+)\)", page)) == committed()
    assert len(BOOKS) >= 3
    sizes = {kind: [p.stat().st_size for p in GALLERY.glob(f"*.{kind}")] for kind in ("png", "gif")}
    assert len(sizes["png"]) >= 12 and max(sizes["png"]) <= 100_000
    assert len(sizes["gif"]) >= 3 and max(sizes["gif"]) <= 800_000


@pytest.mark.slow
@pytest.mark.parametrize("book", ONE_BOOK, ids=lambda book: book.stem)
def test_a_notebook_runs_and_shows_what_its_page_shows(book, monkeypatch):
    text, pictures, notebook = script("render_notebooks", monkeypatch).render(book)
    assert text == book.with_suffix(".md").read_text("utf-8")
    assert all((DOCS / "assets" / "notebooks" / name).is_file() for name in pictures)
    # The stored outputs have today's words, and a picture where today has one.
    stored, today = json.loads(book.read_text("utf-8")), json.loads(json.dumps(notebook))
    assert without_pictures(stored) == without_pictures(today)


def without_pictures(notebook):
    """A notebook without the content of its pictures, whose bits differ between machines."""
    for cell in notebook["cells"]:
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                output["data"]["image/png"] = "a picture"
    return notebook


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_a_notebook_is_shipped_with_its_outputs_and_the_pictures_of_its_page(book):
    page, cells = book.with_suffix(".md").read_text("utf-8"), json.loads(book.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    shown = [output for cell in code for output in cell["outputs"]]
    words = [x.get("text") or x["data"].get("text/plain") for x in shown]
    assert words and all("".join(text).rstrip() in page for text in words if text)
    pictures = [x["data"]["image/png"] for x in shown if "image/png" in x.get("data", {})]
    names = re.findall(r"\(\.\./assets/notebooks/(\S+)\)", page)
    files = [DOCS / "assets" / "notebooks" / name for name in names]
    assert pictures == [base64.b64encode(file.read_bytes()).decode() for file in files]
