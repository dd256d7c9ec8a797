"""Tables of reports as LaTeX, for papers: `tabular` without packages, sentences as comments."""

from typing import Any, final

from rich.console import Console
from rich.table import Table
from rich.text import Text

_LETTERS = {
    **{letter: rf"\{letter}" for letter in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"<": "$<$", ">": "$>$", "±": r"$\pm$", "×": r"$\times$", "→": r"$\to$", "λ": r"$\lambda$"},
    "−": "$-$",
}


def latex(table: Table) -> str:
    """Return a table as a `tabular`, with its title as a comment."""
    sides = "".join("r" if column.justify == "right" else "l" for column in table.columns)
    lines = [" & ".join(map(_escaped, row)) + r" \\" for row in cells_of(table)]
    title = [f"% {plain(table.title)}"] if table.title else []
    body = [r"\hline", lines[0], r"\hline", *lines[1:], r"\hline"]
    return "\n".join([*title, rf"\begin{{tabular}}{{{sides}}}", *body, r"\end{tabular}"])


def cells_of(table: Table) -> list[list[str]]:
    """Return the heads and the rows of a table as plain text."""
    rows = zip(*(column.cells for column in table.columns))
    heads = [plain(column.header) for column in table.columns]
    return [heads, *([plain(cell) for cell in row] for row in rows)]


def plain(cell: object) -> str:
    """Return a cell without markup, on one line."""
    text = cell if isinstance(cell, Text) else Text.from_markup(str(cell))
    return " ".join(text.plain.split())


def _escaped(text: str) -> str:
    return "".join(_LETTERS.get(letter, letter) for letter in text)


@final
class LatexConsole(Console):
    """A console that prints tables as LaTeX, and everything else as comments."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print each object."""
        for one in objects:
            text = latex(one) if isinstance(one, Table) else _comment(str(one))
            super().print(text, markup=False, highlight=False, soft_wrap=True)


def _comment(text: str) -> str:
    return "\n".join(f"% {line}".rstrip() for line in text.strip("\n").split("\n"))
