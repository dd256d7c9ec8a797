"""What took long to make, kept on disk between processes of the command line.

What is kept is found by all that it was made from: echelon's own source, the versions below it, the
machine, what is set, and the values that it was made for. Where one of them is of a class that is
not echelon's, nothing is kept, since nobody knows what such a class reads. So nothing is found that
these sources would not make.
"""

import contextlib
import functools
import hashlib
import os
import platform
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

from echelon.core.identity import digest

_SETTINGS, _IDLE = ("xla_", "jax_"), ("cache", "log")
"""What the names of settings begin with that may change what JAX makes, and hold if they do not."""
_BEGAN = time.time() - 1.0
"""When this process began, s, or before: a file's clock is coarser, and some were loaded first."""
_folder: Path | None = None
_closed = threading.Event()


@contextlib.contextmanager
def use_folder(folder: Path | None) -> Iterator[None]:
    """Keep all in a folder, or nothing, while the context lasts and in this process alone.

    The command line opens one: who imports the library may change what its classes do.
    """
    global _folder
    before, _folder = _folder, folder
    try:
        yield
    finally:
        _folder = before


def is_open() -> bool:
    """Tell whether anything is kept in this process."""
    return not _closed.is_set() and _folder is not None


def close() -> None:
    """Keep and find nothing from here on, since a user's file may have changed what runs."""
    _closed.set()


def file_for(what: str, *values: object) -> Path | None:
    """Return the file for what is made of some values; None where nothing may be kept.

    Args:
        what: is made, by whom.
        values: trees of numbers, arrays, words and echelon's own classes.
    """
    folder, ground = _folder, _ground() if is_open() else None
    if folder is None or ground is None:
        return None
    identity = digest((what, jax_settings(), values))
    if identity is None:
        return None
    return folder / f"{hashlib.sha256(ground + identity).hexdigest()}-made-cache"


def jax_settings() -> tuple[str, ...]:
    """Return what is set, in this thread, that may change what JAX makes."""
    # Here, since the command line opens the store before it needs JAX.
    import jax

    # Of some, JAX knows but the value that all threads have.
    of_all = jax.config.values
    return tuple(f"{name}={getattr(jax.config, name, of_all[name])}" for name in _switches())


def read(file: Path) -> bytes | None:
    """Return what a file keeps; None where it is not there, or not whole."""
    try:
        stored = file.read_bytes()
    except OSError:
        return None
    # What is half-written or damaged would end the process and not only the run.
    if hashlib.sha256(stored[32:]).digest() == stored[:32]:
        with contextlib.suppress(zlib.error):
            return zlib.decompress(stored[32:])
    return None


def write_if_unchanged(file: Path, made: bytes) -> None:
    """Write what was made by echelon's sources to a file of `file_for`."""
    # A source that is loaded late may have changed since all were told.
    if _sources() == _loaded():
        write(file, made)


def write(file: Path, made: bytes) -> None:
    """Write a file that `read` reads, beside it first; a folder without room keeps nothing."""
    packed = zlib.compress(made, 1)
    with contextlib.suppress(OSError):
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        # By a name that goes with the oldest, should this process be killed before it has another.
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix="-cache", delete=False) as beside:
            try:
                beside.write(hashlib.sha256(packed).digest() + packed)
                beside.close()
                os.replace(beside.name, file)
            except BaseException:
                Path(beside.name).unlink(missing_ok=True)
                raise


# ---- what it was made from -----------------------------------------------------------------------


@functools.cache
def _ground() -> bytes | None:
    """Return what all depends on for as long as a process lasts: sources, versions, machine."""
    # Here, since the command line opens the store before it needs any of them.
    import equinox
    import jax
    import jaxlib
    import numpy as np
    import scipy

    sources = _loaded()
    if sources is None or jax.local_device_count() > 1 or jax.default_backend() != "cpu":
        return None
    below = (np, scipy, jax, jaxlib, equinox)
    parts = [*(module.__version__ for module in below), sys.version, _processor()]
    # JAX reads them once.
    parts += sorted(f"{key}={value}" for key, value in os.environ.items() if _sets(key.lower()))
    return hashlib.sha256(sources + "\0".join(parts).encode()).digest()


def _sets(name: str) -> bool:
    return name.startswith(_SETTINGS) and not any(word in name for word in _IDLE)


@functools.cache
def _switches() -> tuple[str, ...]:
    import jax

    return tuple(filter(_sets, sorted(jax.config.values)))


@functools.cache
def _loaded() -> bytes | None:
    """Return the sources as they were at the first look."""
    return _sources()


def _sources() -> bytes | None:
    """Return what echelon's own files hold, in short; None where they may not be what was loaded.

    So it is where one changed while this process ran, and where Python runs what was made of them.
    """
    home, hasher = Path(__file__).parents[1], hashlib.sha256()
    try:
        files = [(file, file.stat(), file.read_bytes()) for file in sorted(home.rglob("*.py"))]
    except OSError:
        return None
    # A file that was put there with an old date changed when it was put there.
    late = any(max(status.st_mtime, status.st_ctime) >= _BEGAN for _, status, _ in files)
    if late or Path(__file__) not in (file for file, *_ in files):
        return None
    for file, _, content in files:
        hasher.update(f"{file.relative_to(home)}\0{len(content)}\0".encode() + content)
    return hasher.digest()


def _processor() -> str:
    """Return what tells processors apart for which machine code is made."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        named = ("model name", "flags", "CPU part", "Features")
        return "\n".join(line for line in lines if line.startswith(named))
    return " ".join((platform.machine(), platform.processor(), platform.platform()))
