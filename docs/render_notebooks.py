"""Run the notebooks of docs/notebooks, and store what they show in them and in a page beside each.

Run it with `python docs/render_notebooks.py`. Cells run one after the other in this process, as a
kernel would: what is printed, the value of a last expression, and figures are shown. An output has
the same words in the notebook and in its page, and the picture of a figure is one file's.
"""

import ast
import base64
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
    """Write the outputs and the page of every notebook."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for book in sorted(BOOKS.glob("*.ipynb")):
        text, pictures, notebook = render(book)
        for name, figure in pictures.items():
            save(figure, PICTURES / name)
        put_pictures(notebook, PICTURES)
        book.with_suffix(".md").write_text(text, "utf-8")
        book.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")
        print(f"{book.name}: {len(pictures)} pictures")


def render(book: Path) -> tuple[str, dict[str, Figure], dict[str, Any]]:
    """Return the page of a notebook, its figures by the names of their files, and the notebook.

    Its outputs are those of today, with the name of a file in the place of a picture.
    """
    notebook = json.loads(book.read_text("utf-8"))
    count = 0
    # Classes of a notebook are looked up in their module.
    module = types.ModuleType(f"notebook_{book.stem}")
    sys.modules[module.__name__] = module
    parts, pictures = list[str](), dict[str, Figure]()
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        printed, value = run(source, module.__dict__)
        count += 1
        cell |= {"execution_count": count, "metadata": {}, "outputs": printed_output(printed)}
        parts.append(f"```python\n{source}\n```")
        if isinstance(value, Figure):
            name = f"{book.stem}_{len(pictures) + 1}.png"
            pictures[name] = value
            cell["outputs"].append(value_output(count, {"image/png": name}))
            parts.append(f"![What the cell above draws](../assets/notebooks/{name})")
        elif value is not None:
            printed += f"{value!r}\n"
            cell["outputs"].append(value_output(count, {"text/plain": lines(repr(value))}))
        if printed:
            parts.append(f"```text\n{printed.rstrip()}\n```")
    link = f"[The notebook]({book.name}), run as it stands:"
    return "\n\n".join([parts[0], link, *parts[1:]]) + "\n", pictures, notebook


def printed_output(text: str) -> list[dict[str, Any]]:
    """Return what a cell printed as a notebook stores it; nothing of a silent cell."""
    return [{"name": "stdout", "output_type": "stream", "text": lines(text)}] if text else []


def value_output(count: int, data: dict[str, Any]) -> dict[str, Any]:
    """Return the value of a cell's last line as a notebook stores it."""
    kind = {"output_type": "execute_result", "execution_count": count}
    return {"data": data, "metadata": {}} | kind


def lines(text: str) -> list[str]:
    """Return the lines of a text with their ends."""
    return text.splitlines(keepends=True)


def put_pictures(notebook: dict[str, Any], folder: Path) -> None:
    """Replace the names of pictures in the outputs by what is in their files."""
    for cell in notebook["cells"]:
        for output in cell.get("outputs", ()):
            name = output.get("data", {}).get("image/png")
            if name:
                content = (folder / name).read_bytes()
                output["data"]["image/png"] = base64.b64encode(content).decode("ascii")


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
