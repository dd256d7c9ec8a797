"""Compressed numbers for the page: 16 bits per value, as differences in time.

Each channel is rounded to a 65535th of its range: 0.3 mm of 20 m.
"""

import json
import struct
import zlib
from typing import NamedTuple

import numpy as np

from echelon.core.types import Array, JsonObject

FINE, COARSE, BYTE = 65535, 1023, 255
GAP, BELOW = 65535, 65534
"""Codes in groups with gaps, which have two levels less: no finite number, and -inf."""


class Group(NamedTuple):
    """Channels with a common format.

    Attributes:
        values: (T, C).
        levels: between the extremes of a channel; 255 or less takes one byte.
        limits: the extremes; None for each channel's own.
        gaps: whether numbers may be missing: NaN, or -inf for what is below the axis.
    """

    values: Array
    levels: int = FINE
    limits: tuple[float, float] | None = None
    gaps: bool = False


def pack(header: JsonObject, groups: dict[str, Group]) -> bytes:
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


def _pack_group(group: Group) -> tuple[bytes, JsonObject]:
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
        q = np.where(np.isfinite(values), q, np.where(values == -np.inf, BELOW, GAP))
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


def _extremes(values: Array, limits: tuple[float, float] | None) -> tuple[Array, Array]:
    channels = values.shape[1]
    if limits is not None:
        return np.full(channels, limits[0]), np.full(channels, limits[1])
    finite = np.isfinite(values)
    low = np.where(finite, values, np.inf).min(axis=0, initial=np.inf)
    high = np.where(finite, values, -np.inf).max(axis=0, initial=-np.inf)
    some = finite.any(axis=0)
    return np.where(some, low, 0.0), np.where(some, high, 0.0)
