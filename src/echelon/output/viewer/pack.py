"""Numbers as the page takes them: 16 bits between extremes, differences in time, deflated.

Each channel is rounded to a 65535th of its own range, so that a flock of 20 m is stored to 0.3 mm.
"""

import json
import struct
import zlib
from typing import Any, NamedTuple

import numpy as np

from echelon.core.types import Array

FINE, COARSE, BYTE = 65535, 1023, 255
GAP = 65535
"""What stands for a missing number in a series, which takes one level less."""


class Group(NamedTuple):
    """Channels that are packed alike.

    Attributes:
        values: (T, C).
        levels: between the extremes of a channel; 255 or less takes one byte.
        limits: the extremes, where they are not the channel's own.
        gaps: whether a number may be missing (NaN).
    """

    values: Array
    levels: int = FINE
    limits: tuple[float, float] | None = None
    gaps: bool = False


def pack(header: dict[str, Any], groups: dict[str, Group]) -> bytes:
    """Return header and groups as one deflated block: the header's length, its JSON, the numbers.

    The header gets `groups`: for each, by name, extremes, steps, frames and bytes a number.
    """
    blocks, told = [], {}
    for name, group in groups.items():
        block, told[name] = _pack_group(group)
        blocks.append(block)
    text = json.dumps({**header, "groups": told}, allow_nan=False, separators=(",", ":")).encode()
    return zlib.compress(b"".join([struct.pack("<I", len(text)), text, *blocks]), 9)


def _pack_group(group: Group) -> tuple[bytes, dict[str, Any]]:
    values = np.asarray(group.values, np.float64)
    low, high = _extremes(values, group.limits)
    levels = group.levels - 1 if group.gaps else group.levels
    # Rounded first, so that page and Python use the same numbers.
    low = np.array([float(f"{value:.9g}") for value in low])
    step = np.array([float(f"{value:.9g}") for value in np.maximum((high - low) / levels, 0.0)])
    safe = np.where(step > 0.0, step, 1.0)
    scaled = np.round((values - low) / safe)
    q = np.where(np.isnan(scaled), GAP, np.clip(np.nan_to_num(scaled), 0, levels)).astype(np.int64)
    differences = np.diff(q.T, axis=1, prepend=0)
    wide = group.levels > BYTE
    # Modulo 2^16 or 2^8: the page adds them up in as many bits.
    d = (differences & (0xFFFF if wide else 0xFF)).astype(np.uint16)
    block = (d & 255).astype(np.uint8).tobytes()
    if wide:
        block += (d >> 8).astype(np.uint8).tobytes()
    told = {"low": low.tolist(), "step": step.tolist()}
    return block, {**told, "frames": len(values), "bytes": 2 if wide else 1}


def _extremes(values: Array, limits: tuple[float, float] | None) -> tuple[Array, Array]:
    channels = values.shape[1]
    if limits is not None:
        return np.full(channels, limits[0]), np.full(channels, limits[1])
    known = np.isfinite(values)
    low = np.where(known, values, np.inf).min(axis=0, initial=np.inf)
    high = np.where(known, values, -np.inf).max(axis=0, initial=-np.inf)
    some = known.any(axis=0)
    return np.where(some, low, 0.0), np.where(some, high, 0.0)
