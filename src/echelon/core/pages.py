"""HTML pages of values in notebooks, made by an output module that is imported on demand."""

import dataclasses
import html
import importlib
from typing import Final, final

# By name, since the output layer is above this one and must not be imported from here.
_PAGES: Final = {
    "result": "echelon.output.archive.notebook:result_page",
    "replay": "echelon.output.archive.notebook:result_replay",
}


@final
@dataclasses.dataclass(frozen=True, repr=False)
class CellPage:
    """A whole page, which a notebook shows in the output of a cell.

    Attributes:
        text: its HTML.
        height: pixels.
    """

    text: str
    height: int

    def __repr__(self) -> str:
        """Return what to do with it outside of a notebook."""
        return f"CellPage({len(self.text) / 1e6:.2g} MB of HTML in `text`; a notebook shows it)"

    def _repr_html_(self) -> str:
        """Return the page in a frame of its own."""
        style = f"width: 100%; height: {self.height}px; border: 1px solid #8888; border-radius: 6px"
        return f'<iframe style="{style}" srcdoc="{html.escape(self.text)}"></iframe>'


def notebook_page(kind: str, value: object) -> str:
    """Return a value as HTML."""
    module, _, name = _PAGES[kind].partition(":")
    return getattr(importlib.import_module(module), name)(value)
