"""Forged copies of what files state: every field in turn, each changed so that it states more."""

import copy
import re

NUMBER = re.compile(r"\d+(?:\.\d+)?")
SMALL = 1e-9
"""Residuals below it say of two machines only that they round."""


def forged(document, kept=()):
    """Yield the place of each field, and the document with that field alone changed.

    Fields whose path begins with a key among `kept` stay.
    """
    for path in places(document):
        if path and path[0] in kept:
            continue
        for k, value in enumerate(changes(at(document, path), () if path else kept)):
            yield f"{'.'.join(map(str, path))} ({k})", replaced(document, path, value)


def places(value, path=()):
    """The path to a value and to every value in it."""
    yield path
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(item, (*path, key))


def at(value, path):
    for key in path:
        value = value[key]
    return value


def replaced(document, path, value):
    if not path:
        return value
    result = copy.deepcopy(document)
    at(result, path[:-1])[path[-1]] = value
    return result


def changes(value, kept=()):
    """Other values that state something else."""
    if isinstance(value, dict):
        yield {**value, "proved": True}
        for key in [key for key in value if key not in kept]:
            rest = {name: item for name, item in value.items() if name != key}
            yield rest
            # A Cyrillic letter, or a key that differs in its case.
            yield {**rest, key.replace("o", "\u043e") if "o" in key else key.swapcase(): value[key]}
    elif isinstance(value, list):
        yield [*value, value[-1] if value else 1.0]
        yield from [value[:-1], value[::-1]] if value and value[::-1] != value else []
    elif isinstance(value, bool):
        yield from (not value, int(value), str(value))
    elif isinstance(value, int | float):
        yield from (f"{value}", None, True)
        yield from (value * 1.001, -value, 1e3 * value) if abs(value) > SMALL else (0.01, -1e-3)
    elif value is None:
        yield from (1.0, "", [], False)
    else:
        yield from (f"{value}.", f" {value.swapcase()}", None, 0)
        if (digit := NUMBER.search(value)) and "e-" not in value:
            number = digit.group()
            yield value.replace(number, number[:-1] + str((int(number[-1]) + 1) % 10), 1)
