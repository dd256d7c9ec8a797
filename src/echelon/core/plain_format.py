"""Trees of numbers, texts, arrays and echelon's own records as bytes, and back.

Unlike a pickle, reading one calls nothing: it only creates records of echelon's classes.
"""

import dataclasses
import enum
import importlib
import json
from fractions import Fraction
from typing import Any, Final

import numpy as np

_HEAD: Final = 8
"""Bytes of the length of the text before the buffers."""


def encode(value: object) -> bytes:
    """Return a tree as bytes.

    Raises:
        TypeError: a part is of another kind, such as a function.
    """
    buffers = list[bytes]()
    text = json.dumps(_plain(value, buffers), separators=(",", ":"))
    head = json.dumps([[len(each) for each in buffers], text]).encode()
    return b"".join([len(head).to_bytes(_HEAD, "little"), head, *buffers])


def decode(content: bytes) -> Any:
    """Return the tree of some bytes; its arrays are read-only.

    Raises:
        ValueError, TypeError, LookupError, AttributeError, ImportError: it is damaged.
    """
    start = _HEAD + int.from_bytes(content[:_HEAD], "little")
    lengths, text = json.loads(content[_HEAD:start])
    buffers = list[bytes]()
    for length in lengths:
        buffers.append(content[start : start + length])
        start += length
    return _tree(json.loads(text), buffers)


def _plain(value: Any, buffers: list[bytes]) -> object:
    """Return a tree for JSON, in which every list begins with the letter of its kind."""
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if isinstance(value, enum.Enum):
        return ["e", _name(kind), value.name]
    if isinstance(value, Fraction):
        return ["q", value.numerator, value.denominator]
    if kind is bytes:
        return ["b", _stored(buffers, value)]
    if isinstance(value, np.ndarray | np.generic):
        if value.dtype.hasobject:
            raise TypeError("an array of objects is no plain value")
        scalar = isinstance(value, np.generic)
        array = np.ascontiguousarray(value)
        number = _stored(buffers, array.tobytes())
        return ["s" if scalar else "a", array.dtype.str, list(np.shape(value)), number]
    if kind is dict:
        return ["d", *([_plain(k, buffers), _plain(v, buffers)] for k, v in value.items())]
    if kind in (list, tuple):
        return ["l" if kind is list else "t", *(_plain(part, buffers) for part in value)]
    if isinstance(value, tuple) and hasattr(kind, "_fields"):
        return ["n", _name(kind), *(_plain(part, buffers) for part in value)]
    if dataclasses.is_dataclass(kind):
        return ["r", _name(kind), _plain(dict(vars(value)), buffers)]
    raise TypeError(f"a `{kind.__name__}` is no plain value")


def _stored(buffers: list[bytes], content: Any) -> int:
    buffers.append(content)
    return len(buffers) - 1


def _name(kind: type) -> str:
    """Return the name of one of echelon's classes."""
    name = f"{kind.__module__}:{kind.__qualname__}"
    if _class(name) is not kind:
        raise TypeError(f"`{name}` is no class of echelon")
    return name


def _class(name: str) -> Any:
    module, _, path = name.partition(":")
    if module.partition(".")[0] != "echelon":
        raise TypeError(f"`{name}` is no class of echelon")
    place: Any = importlib.import_module(module)
    for part in path.split("."):
        place = getattr(place, part)
    # Not what its module imports: nothing but echelon's own classes.
    if not isinstance(place, type) or place.__module__ != module:
        raise TypeError(f"`{name}` is no class of echelon")
    return place


def _tree(plain: Any, buffers: list[bytes]) -> Any:
    if not isinstance(plain, list):
        return plain
    letter, *parts = plain
    if letter in ("a", "s"):
        array = np.frombuffer(buffers[parts[2]], np.dtype(parts[0])).reshape(parts[1])
        return array if letter == "a" else array[()]
    if letter == "b":
        return buffers[parts[0]]
    if letter == "q":
        return Fraction(*parts)
    if letter == "e":
        return _class(parts[0])[parts[1]]
    if letter == "d":
        return {_tree(key, buffers): _tree(item, buffers) for key, item in parts}
    if letter == "n":
        return tuple.__new__(_class(parts[0]), (_tree(part, buffers) for part in parts[1:]))
    if letter == "r":
        record = object.__new__(_class(parts[0]))
        vars(record).update(_tree(parts[1], buffers))
        return record
    if letter not in ("l", "t"):
        raise ValueError(f"`{letter}` is no kind of value")
    items = (_tree(part, buffers) for part in parts)
    return [*items] if letter == "l" else tuple(items)
