"""Strict JSON for the verifier: what readers take in different ways is refused."""

import json
import math
from pathlib import Path
from typing import NoReturn

from echelon.core.errors import GainError
from echelon.core.types import JsonObject, PathLike

_LARGEST_FILE = 2**28
"""Bytes. The largest gain files have some millions."""


def read_json(file: PathLike) -> JsonObject:
    """Return the mapping in a file, without repeated keys, NaN, or numbers that overflow.

    Raises:
        GainError: it cannot be read, is not such JSON, or holds no mapping.
    """
    try:
        with Path(file).open("rb") as opened:
            content = opened.read(_LARGEST_FILE + 1)
    except OSError as error:
        raise GainError(f"the file `{file}` cannot be read: {error.strerror}.") from error
    if len(content) > _LARGEST_FILE:
        raise GainError(f"the file `{file}` has more than {_LARGEST_FILE} bytes; no such is read.")
    return parse_json(content, file)


def parse_json(content: str | bytes, name: PathLike) -> JsonObject:
    """Return the mapping in a text, as `read_json` does of a file; `name` is for messages."""
    try:
        text = content if isinstance(content, str) else content.decode("utf-8")
        document = json.loads(
            text,
            object_pairs_hook=_mapping,
            parse_constant=_no_number,
            parse_float=_number,
            parse_int=_whole,
        )
    except (ValueError, RecursionError) as error:
        raise GainError(f"the file `{name}` is not valid JSON: {error}.") from error
    if not isinstance(document, dict):
        raise GainError(f"`{name}` must be a mapping.")
    return document


def _mapping(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Return a mapping; repeated keys are refused, since readers differ in which one they use."""
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        twice = next(key for k, (key, _) in enumerate(pairs) if key in dict(pairs[:k]))
        raise ValueError(f"`{twice}` occurs twice")
    return mapping


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"`{text}` is not a finite number")


def _number(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _no_number(text[:20])


def _whole(text: str) -> int:
    # A larger one has no float, so that it could not be compared.
    return int(text) if len(text) <= 300 else _no_number(f"{text[:20]}...")
