"""The pictures and notebooks of the pages: their scripts make them, and they stay small."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
GALLERY = DOCS / "assets" / "gallery"
BOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def script(name, monkeypatch):
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_gallery_s_script_draws_every_picture_of_the_page(tmp_path, monkeypatch):
    script("draw_gallery", monkeypatch).main(["--quick", "--out", str(tmp_path)])
    made = {path.name for path in tmp_path.iterdir()}
    page = (DOCS / "gallery.md").read_text("utf-8")
    assert made == set(re.findall(r"\(assets/gallery/(\S+)\)", page))
    assert made == {path.name for path in GALLERY.iterdir()}
    assert all(path.stat().st_size > 1000 for path in tmp_path.iterdir())


def test_pictures_are_many_and_small():
    sizes = {kind: [p.stat().st_size for p in GALLERY.glob(f"*.{kind}")] for kind in ("png", "gif")}
    assert len(sizes["png"]) >= 12 and max(sizes["png"]) <= 100_000
    assert len(sizes["gif"]) >= 3 and max(sizes["gif"]) <= 800_000


@pytest.mark.slow
@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_a_notebook_runs_and_shows_what_its_page_shows(book, monkeypatch):
    found, pictures = script("render_notebooks", monkeypatch).render(book)
    assert found == book.with_suffix(".md").read_text("utf-8")
    assert all((DOCS / "assets" / "notebooks" / name).is_file() for name in pictures)


def test_there_are_three_notebooks():
    assert len(BOOKS) >= 3
