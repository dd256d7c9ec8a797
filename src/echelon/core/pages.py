"""HTML pages of values in notebooks, made by an output module that is imported on demand."""

import importlib
from typing import Final

# By name, since the output layer is above this one and must not be imported from here.
_PAGES: Final = {"result": "echelon.output.archive.notebook:result_page"}


def notebook_page(kind: str, value: object) -> str:
    """Return a value as HTML."""
    module, _, name = _PAGES[kind].partition(":")
    return getattr(importlib.import_module(module), name)(value)
