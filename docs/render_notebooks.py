"""Run the notebooks of docs/notebooks and write each, with what it shows, as a page beside it.

Run it with `python docs/render_notebooks.py`. Cells run one after the other in this process, as a
kernel would: what is printed, the value of a last expression, and figures are shown.
"""

import ast
import contextlib
import io
import json
import sys
import types
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image

HERE = Path(__file__).resolve().parent
BOOKS = HERE / "notebooks"
PICTURES = HERE / "assets" / "notebooks"


def main() -> None:
    """Write the page of every notebook."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for book in sorted(BOOKS.glob("*.ipynb")):
        text, pictures = render(book)
        for name, figure in pictures.items():
            save(figure, PICTURES / name)
        book.with_suffix(".md").write_text(text, "utf-8")
        print(f"{book.name}: {len(pictures)} pictures")


def render(book: Path) -> tuple[str, dict[str, Figure]]:
    """Return the page of a notebook, and its figures by the names of their files."""
    cells = json.loads(book.read_text("utf-8"))["cells"]
    # Classes of a notebook are looked up in their module.
    module = types.ModuleType(f"notebook_{book.stem}")
    sys.modules[module.__name__] = module
    parts, pictures = list[str](), dict[str, Figure]()
    for cell in cells:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        printed, value = run(source, module.__dict__)
        parts.append(f"```python\n{source}\n```")
        if isinstance(value, Figure):
            name = f"{book.stem}_{len(pictures) + 1}.png"
            pictures[name] = value
            parts.append(f"![What the cell above draws](../assets/notebooks/{name})")
        elif value is not None:
            printed += f"{value!r}\n"
        if printed:
            parts.append(f"```text\n{printed.rstrip()}\n```")
    link = f"[The notebook]({book.name}), run as it stands:"
    return "\n\n".join([parts[0], link, *parts[1:]]) + "\n", pictures


def run(source: str, names: dict[str, Any]) -> tuple[str, Any]:
    """Run a cell; return what it prints, and the value of its last line where that has one."""
    tree, value = ast.parse(source), None
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile(tree, "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    return out.getvalue(), value


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG of few colours."""
    figure.savefig(path, dpi=120)
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(128, dither=Image.Dither.NONE)
    small.save(path, optimize=True)


if __name__ == "__main__":
    main()
