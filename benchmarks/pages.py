"""Pages that several benchmarks write, each its own part."""

from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def write_part(name: str, script: str, text: str) -> None:
    """Replace a script's part of a page, from its mark to the next mark, or append it."""
    page = DOCS / name
    mark = f"<!-- made by benchmarks/{script} -->\n"
    before, found, after = page.read_text("utf-8").partition(mark)
    _, next_mark, rest = after.partition("<!-- made by ")
    kept = f"{next_mark}{rest}" if next_mark else ""
    before = before if found else before.rstrip("\n") + "\n\n"
    page.write_text(f"{before}{mark}\n{text.strip()}\n" + (f"\n{kept}" if kept else ""), "utf-8")
