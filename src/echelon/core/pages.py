"""How a value shows itself in a notebook, by code of a room above that is loaded when asked."""

import importlib
from typing import Any, Final

PAGES: Final[dict[str, str]] = {}
"""What makes the HTML of each kind of value, as `module:function`."""


def page_of(kind: str, value: Any) -> str:
    """Return a value as HTML."""
    module, _, name = PAGES[kind].partition(":")
    return getattr(importlib.import_module(module), name)(value)
