"""How a value shows itself in a notebook, by code of a room above that is loaded when asked."""

import importlib
from typing import Final

# By name, since what a notebook shows is drawn high above where values are made.
_PAGES: Final = {"result": "echelon.output.archive.notebook:result_page"}


def notebook_page(kind: str, value: object) -> str:
    """Return a value as HTML."""
    module, _, name = _PAGES[kind].partition(":")
    return getattr(importlib.import_module(module), name)(value)
