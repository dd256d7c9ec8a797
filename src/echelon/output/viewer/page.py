"""One self-contained HTML page, with its code and data compressed inside."""

import base64
import zlib
from html import escape
from pathlib import Path
from string import Template
from typing import Final

from echelon.core.errors import MissingExtraError

_HERE: Final = Path(__file__).resolve().parent / "page"
_BUNDLE, _LICENSE = "three.min.js", "three.LICENSE.txt"
_SCRIPTS = (
    "run.js",
    "shaders.js",
    "shapes.js",
    "surroundings.js",
    "scene.js",
    "chart.js",
    "controls.js",
    "keys.js",
    "live.js",
    "growing.js",
    "replay.js",
)


def page(title: str, *data: bytes) -> str:
    """Return the page of one run or more in compressed data, as `pack` returns them.

    Raises:
        MissingExtraError: three.js is not built, as in a fresh clone.
    """
    html = Template(_read("page.html"))
    return html.substitute(
        title=escape(f"{title} \u00b7 echelon"),
        style=_read("page.css"),
        code=_text(zlib.compress(_code().encode(), 9)),
        data="\n".join(f'<script type="text/plain" class="data">{_text(x)}</script>' for x in data),
    )


def check_page() -> None:
    """Check that the page is complete.

    Raises:
        MissingExtraError: three.js is not built, as in a fresh clone.
    """
    if not (_HERE / _BUNDLE).is_file():
        raise MissingExtraError(
            "the page's three.js is not built in this copy of echelon; run `python3 dev.py setup` "
            "in its folder, or install a wheel, which contains it."
        )


def _code() -> str:
    check_page()
    parts = [_read(_BUNDLE), f"/* three.js:\n{_read(_LICENSE)}*/", *map(_script, _SCRIPTS)]
    return "\n".join(parts)


def _script(name: str) -> str:
    """Return a script without indentation and comments, which every page would carry."""
    lines = (line.strip() for line in _read(name).splitlines())
    return "\n".join(line for line in lines if line and not line.startswith("//"))


def _read(name: str) -> str:
    return (_HERE / name).read_text("utf-8")


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
