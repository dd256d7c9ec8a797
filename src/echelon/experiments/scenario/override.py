"""Overrides from the command line: they remove the keys of the file that they exclude."""

import copy
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from echelon.experiments.scenario.checks import SOURCES, surplus_keys
from echelon.experiments.scenario.yaml import Document, KeyPath


def settle_overrides(document: Document) -> Document:
    """Return a document without the keys that its overrides exclude.

    A path on the command line is relative to the working folder, and becomes absolute.
    """
    # The document that was read is not changed.
    data = copy.deepcopy(document.data)
    set_ = [path for path, _ in document.overrides]
    for path in set_:
        rename_files(data, lambda name: str(Path(name).resolve()), path)
        part = _at(data, path[:-1])
        for rival in _rivals(path, part):
            other = (*path[:-1], rival)
            # Two overrides that exclude each other are refused by the checks.
            if not any(path[: len(other)] == other for path in set_):
                del part[rival]
    return document._replace(data=data)


def _rivals(path: KeyPath, part: Any) -> list[Any]:
    """Return the keys of the same section that the one at `path` excludes."""
    if not isinstance(part, dict) or part.get(path[-1]) is None:
        return []
    if path[1:] == ("law",):
        return [key for key in surplus_keys(str(path[0]), part["law"]) if key in part]
    sources, _ = SOURCES.get(path[:-1], ((), False))
    if path[-1] not in sources:
        return []
    # A gain file contains what the other keys would say.
    excluded = part if path[-1] == "file" else sources
    return [key for key in excluded if key in part and key != path[-1]]


def rename_files(data: object, rename: Callable[[str], str], path: KeyPath = ()) -> None:
    """Replace the name of every file in a part of plain data."""
    for place, name, rest in list(named_files(_at(data, path), path)):
        _at(data, place[:-1])[place[-1]] = rename(name) + rest


def named_files(value: object, path: KeyPath) -> Iterator[tuple[KeyPath, str, str]]:
    """Yield the path of every file name in plain data, the name, and the text after it."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from named_files(item, (*path, key))
    elif isinstance(value, str) and path and path[-1] == "file":
        yield path, value, ""
    elif isinstance(value, str) and path and path[-1] == "python" and ":" in value:
        file, colon, name = value.rpartition(":")
        yield path, file, colon + name


def _at(data: Any, path: KeyPath) -> Any:
    for key in path:
        try:
            data = data[key]
        except (LookupError, TypeError):
            # A path through a number or a text leads nowhere; the checks report it.
            return None
    return data
