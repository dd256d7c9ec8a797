"""One self-contained HTML page, with its code and its data inside.

Numbers take 16 bits each, as differences in time: each channel is rounded to a 65535th of its
range, which is .3 mm of 20 m.
"""

import base64
import json
import struct
import zlib
from html import escape
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from echelon.core.errors import MissingExtraError

if TYPE_CHECKING:
    # It loads JAX, and the command line looks for the page before that.
    from echelon.core.types import Array, JsonObject

_HERE: Final = Path(__file__).resolve().parent / "page"
_BUNDLE = "three.min.js"
_SCRIPTS = (
    *("run", "shaders", "shapes", "surroundings", "scene", "chart", "controls", "keys", "live"),
    *("growing", "replay"),
)


def page(title: str, *data: bytes) -> str:
    """Return the page of one run or more in compressed data, as `pack` returns them.

    Raises:
        MissingExtraError: three.js is not built, as in a fresh clone.
    """
    check_page()
    code = f"{_read(_BUNDLE)}\n/* three.js:\n{_read('three.LICENSE.txt')}*/"
    for name in _SCRIPTS:
        # Without indentation and comments, which every page would carry.
        lines = (line.strip() for line in _read(f"{name}.js").splitlines())
        code += "".join(f"\n{line}" for line in lines if line and not line.startswith("//"))
    return Template(_read("page.html")).substitute(
        title=escape(f"{title} \u00b7 echelon"),
        style=_read("page.css"),
        code=_text(zlib.compress(code.encode(), 9)),
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


def _read(name: str) -> str:
    return (_HERE / name).read_text("utf-8")


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


# ---- numbers ----------------------------------------------------------------------------------

FINE, COARSE, BYTE = 65535, 1023, 255
_GAP, _BELOW = 65535, 65534
"""Codes in groups with gaps, which have two levels less: no finite number, and -inf."""


class Group(NamedTuple):
    """Channels with a common format.

    Attributes:
        values: (T, C).
        levels: between the extremes of a channel; 255 or less takes one byte.
        limits: the extremes; None for each channel's own.
        gaps: whether numbers may be missing: NaN, or -inf for what is below the axis.
    """

    values: "Array"
    levels: int = FINE
    limits: tuple[float, float] | None = None
    gaps: bool = False


def pack(header: "JsonObject", groups: dict[str, Group]) -> bytes:
    """Return a compressed block: the header's length, its JSON, and the numbers.

    The header gets the key `groups`: by name, extremes, steps, frames and bytes per number.
    """
    blocks, formats = [], {}
    for name, group in groups.items():
        block, formats[name] = _pack_group(group)
        blocks.append(block)
    text = json.dumps(
        {**header, "groups": formats}, allow_nan=False, separators=(",", ":")
    ).encode()
    return zlib.compress(b"".join([struct.pack("<I", len(text)), text, *blocks]), 9)


def _pack_group(group: Group) -> "tuple[bytes, JsonObject]":
    values = np.asarray(group.values, np.float64)
    low, high = _extremes(values, group.limits)
    levels = group.levels - 2 if group.gaps else group.levels
    # Rounded before use, so that page and Python compute with the same numbers.
    low = np.array([float(f"{value:.9g}") for value in low])
    step = np.array([float(f"{value:.9g}") for value in np.maximum((high - low) / levels, 0.0)])
    safe = np.where(step > 0.0, step, 1.0)
    scaled = np.nan_to_num(np.round((values - low) / safe))
    q = np.clip(scaled, 0, levels).astype(np.int64)
    if group.gaps:
        q = np.where(np.isfinite(values), q, np.where(values == -np.inf, _BELOW, _GAP))
    differences = np.diff(q.T, axis=1, prepend=0)
    wide = group.levels > BYTE
    # Modulo 2^16 or 2^8, as the page adds them up.
    d = (differences & (0xFFFF if wide else 0xFF)).astype(np.uint16)
    block = (d & 255).astype(np.uint8).tobytes()
    if wide:
        block += (d >> 8).astype(np.uint8).tobytes()
    ranges = {"low": low.tolist(), "step": step.tolist()}
    numbers = {"frames": len(values), "bytes": 2 if wide else 1, "gaps": group.gaps}
    return block, ranges | numbers


def _extremes(values: "Array", limits: tuple[float, float] | None) -> "tuple[Array, Array]":
    channels = values.shape[1]
    if limits is not None:
        return np.full(channels, limits[0]), np.full(channels, limits[1])
    finite = np.isfinite(values)
    low = np.where(finite, values, np.inf).min(axis=0, initial=np.inf)
    high = np.where(finite, values, -np.inf).max(axis=0, initial=-np.inf)
    some = finite.any(axis=0)
    return np.where(some, low, 0.0), np.where(some, high, 0.0)
