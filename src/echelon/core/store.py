"""What took long to make, kept on disk between processes of the command line.

What is kept is found by all that it was made from: echelon's own source, the versions below it, the
machine, and the values that it was made for. Where one of them is of a class that is not echelon's,
nothing is kept, since nobody knows what such a class reads. So nothing is found that these sources
would not make.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import os
import platform
import sys
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType
from typing import Any, Final

FOLDER: Final = "ECHELON_KEPT"
"""Of the environment: where all is kept. The command line sets it; the library keeps nothing."""
_SETTINGS, _IDLE = ("xla_", "jax_"), ("cache", "log")
"""What the names of settings begin with that may change what JAX makes, and hold if they do not."""
_BEGAN = time.time()
_closed = threading.Event()


class _Foreign(Exception):
    """A value of a class that is not echelon's."""


def is_open() -> bool:
    """Tell whether anything is kept in this process."""
    return not _closed.is_set() and FOLDER in os.environ


def close() -> None:
    """Keep and find nothing from here on, since a user's file may have changed what runs."""
    _closed.set()


def place_of(what: str, *values: Any) -> Path | None:
    """Return the file for what is made of some values; None where nothing may be kept.

    Args:
        what: is made, by whom.
        values: trees of numbers, arrays, words and echelon's own classes.
    """
    ground = _ground() if is_open() else None
    if ground is None:
        return None
    made = hashlib.sha256(ground)
    try:
        for part in _told((what, values)):
            made.update(b"%d:" % len(part) + part)
    except _Foreign:
        return None
    return Path(os.environ[FOLDER]) / f"{made.hexdigest()}-made-cache"


def is_ours(value: Any) -> bool:
    """Tell whether a tree of values is of echelon's own classes, and of such as never change.

    What others define may be defined anew, or read what changes, as long as a process runs.
    """
    try:
        for _ in _told(value):
            pass
    except _Foreign:
        return False
    return True


def read(file: Path) -> bytes | None:
    """Return what a file keeps; None where it is not there, or not whole."""
    try:
        stored = file.read_bytes()
    except OSError:
        return None
    # What is half-written or damaged would end the process and not only the run.
    if hashlib.sha256(stored[32:]).digest() != stored[:32]:
        return None
    return zlib.decompress(stored[32:])


def keep(file: Path, made: bytes) -> None:
    """Write what was made to a file, beside it first; a folder without room keeps nothing."""
    # A file that is loaded late may have changed since the others were told.
    if _changed():
        return
    beside, packed = file.with_name(f"{file.name}.{os.getpid()}"), zlib.compress(made, 1)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(hashlib.sha256(packed).digest() + packed)
        beside.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            beside.unlink()


# ---- what it was made from -----------------------------------------------------------------------


@functools.cache
def _ground() -> bytes | None:
    """Return what all depends on: sources, versions, settings and the machine."""
    # Here, since the command line reads a name of this file before it needs any of them.
    import equinox
    import jax
    import jaxlib
    import numpy as np
    import scipy

    sources = _sources()
    if sources is None or jax.local_device_count() > 1 or jax.default_backend() != "cpu":
        return None
    below = (np, scipy, jax, jaxlib, equinox)
    told = [*(module.__version__ for module in below), sys.version, _processor()]
    settings = [*os.environ.items(), *jax.config.values.items()]
    told += sorted(f"{key}={value}" for key, value in settings if _sets(key.lower()))
    return hashlib.sha256(sources + "\0".join(told).encode()).digest()


def _sets(name: str) -> bool:
    return name.startswith(_SETTINGS) and not any(word in name for word in _IDLE)


def _sources() -> bytes | None:
    """Return what echelon's own files hold, in short; None where they are not what was loaded."""
    home, told = Path(__file__).parents[1], hashlib.sha256()
    if _changed():
        return None
    for file in sorted(home.rglob("*.py")):
        content = file.read_bytes()
        told.update(f"{file.relative_to(home)}\0{len(content)}\0".encode() + content)
    return told.digest()


def _changed() -> bool:
    """Tell whether a source changed while this process ran, which may have loaded it before."""
    files = Path(__file__).parents[1].rglob("*.py")
    return any(file.stat().st_mtime >= _BEGAN for file in files)


def _processor() -> str:
    """Return what tells processors apart for which machine code is made."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        named = ("model name", "flags", "CPU part", "Features")
        return "\n".join(line for line in lines if line.startswith(named))
    return " ".join((platform.machine(), platform.processor(), platform.platform()))


def _told(value: Any) -> Iterator[bytes]:
    """Yield what a tree of values is known by, each part with its class."""
    if isinstance(value, type | FunctionType):
        yield b"named " + _name_of(value).encode()
        return
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        yield from _bits(value)
        return
    yield _name_of(type(value)).encode()
    if isinstance(value, enum.Enum):
        yield value.name.encode()
    elif value is None or isinstance(value, bool | int | str | bytes | float | complex):
        # `repr` of a float has all its digits, and the sign of 0.
        yield repr(value).encode()
    else:
        for part in _parts(value):
            yield from _told(part)
        yield b"."


def _parts(value: Any) -> Iterator[Any]:
    """Yield what a value is made of."""
    if isinstance(value, tuple | list):
        yield from value
    elif isinstance(value, dict):
        yield from value.items()
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            # Equinox leaves out what is an attribute of the class.
            yield field.name, getattr(value, field.name)
    else:
        raise _Foreign


def _bits(array: Any) -> Iterator[bytes]:
    import numpy as np

    values = np.asarray(array)
    if values.dtype.hasobject:
        raise _Foreign
    yield f"{type(array).__name__} {values.dtype.str}{values.shape}".encode()
    yield values.tobytes()


_OURS: Final = {"echelon", "builtins", "numpy", "jax"}


def _name_of(named: Any) -> str:
    """Return the name of a class or function that stands in echelon or below it."""
    home, name = named.__module__, named.__qualname__
    found: Any = sys.modules.get(home)
    for part in name.split("."):
        found = getattr(found, part, None)
    # What cannot be found by its name, as a class that is made in a function, is nobody's.
    known = named is type(None) or found is named
    if home.partition(".")[0] not in _OURS or not known:
        raise _Foreign
    return f"{home}.{name}"
