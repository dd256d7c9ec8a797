"""What the command line sets: where its paths lead, and what of the file gives way to it."""

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from echelon.experiments.scenario.checks import SOURCES, surplus_keys
from echelon.experiments.scenario.yaml import Document, KeyPath


def settle_overrides(document: Document) -> Document:
    """Return a document whose overrides stand beside nothing that excludes them.

    A path that the command line sets is relative to the working folder, and becomes absolute.
    """
    # The document that was read stays what the file says.
    data = copy.deepcopy(document.data)
    set_ = [path for path, _ in document.overrides]
    for path in set_:
        _make_absolute(data, path)
        part = _at(data, path[:-1])
        for rival in _rivals(path, part):
            beside = (*path[:-1], rival)
            # What the command line sets too is for the checks to refuse.
            if not any(each[: len(beside)] == beside for each in set_):
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


def _make_absolute(data: Any, path: KeyPath) -> None:
    found = _at(data, path)
    for place, name, rest in named_files(found, path):
        _at(data, place[:-1])[place[-1]] = f"{Path(name).resolve()}{rest}"


def named_files(value: Any, path: KeyPath) -> Iterator[tuple[KeyPath, str, str]]:
    """Yield the place of every file that plain data name, its name, and what stands after that."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from named_files(item, (*path, key))
    elif isinstance(value, str) and path and path[-1] == "file":
        yield path, value, ""
    elif isinstance(value, str) and path and path[-1] == "python":
        file, colon, name = value.rpartition(":")
        yield path, file, colon + name


def _at(data: Any, path: KeyPath) -> Any:
    for key in path:
        try:
            data = data[key]
        except (LookupError, TypeError):
            # A path through a number or a text leads nowhere; the checks of the file say so.
            return None
    return data
