"""Disk cache of expensive results, shared by processes of the command line.

A key covers everything that determines a result: echelon's source, the versions of its
dependencies, the machine, the settings of JAX and the arguments. Nothing is cached for a value
of a foreign class, since such a class may read anything. A cached result is therefore what the
current sources would compute.
"""

import contextlib
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
from typing import NamedTuple

from echelon.core.identity import digest
from echelon.core.private_folder import PrivateFolder

_SETTINGS, _IDLE = ("xla_", "jax_"), ("cache", "log")
"""Prefixes of settings that may change compiled code; words in names of settings that do not."""
_BEGAN = time.time() - 1.0
"""Start of this process, s, less a margin: file clocks are coarse, some modules load earlier."""
_folder: PrivateFolder | None = None
_closed = threading.Event()


class CacheFile(NamedTuple):
    """A file of the cache: its folder, and its name there."""

    folder: PrivateFolder
    name: str


@contextlib.contextmanager
def use_folder(folder: PrivateFolder | None) -> Iterator[None]:
    """Cache in a folder, or not at all, within the context and in this process only.

    Only the command line opens one: a program that imports echelon may modify its classes.
    """
    global _folder
    before, _folder = _folder, folder
    try:
        yield
    finally:
        _folder = before


def is_open() -> bool:
    """Return whether the cache is open in this process."""
    return not _closed.is_set() and _folder is not None


def close() -> None:
    """Stop reading and writing, since a user's file may have changed the code that runs."""
    _closed.set()


def file_for(what: str, *values: object) -> CacheFile | None:
    """Return the file for a result of some values; None if it may not be cached.

    Args:
        what: name of the function that computes it.
        values: trees of numbers, arrays, strings and echelon's own classes.
    """
    folder, ground = _folder, _ground() if is_open() else None
    if folder is None or ground is None:
        return None
    identity = digest((what, jax_settings(), values))
    if identity is None:
        return None
    return CacheFile(folder, f"{hashlib.sha256(ground + identity).hexdigest()}-made-cache")


def jax_folder() -> PrivateFolder | None:
    """Return the folder in which JAX keeps compiled code, if only the user can change it.

    Machine code that is read there is run.
    """
    import jax

    return _opened(getattr(jax.config, "jax_compilation_cache_dir", None) or "")


@functools.cache
def _opened(path: str) -> PrivateFolder | None:
    try:
        return PrivateFolder(Path(path).absolute()) if path else None
    except OSError:
        return None


def jax_settings() -> tuple[str, ...]:
    """Return the settings of this thread that may change what JAX compiles."""
    # Imported here, since the command line opens the cache before it needs JAX.
    import jax

    # Some settings have no value per thread.
    of_all = jax.config.values
    return tuple(f"{name}={getattr(jax.config, name, of_all[name])}" for name in _switches())


def read(file: CacheFile) -> bytes | None:
    """Return the content of a file; None if it is missing, damaged or not the user's own."""
    try:
        stored = file.folder.read(file.name)
    except OSError:
        return None
    # Damaged machine code would crash the process.
    if hashlib.sha256(stored[32:]).digest() == stored[:32]:
        with contextlib.suppress(zlib.error):
            return zlib.decompress(stored[32:])
    return None


def write_if_unchanged(file: CacheFile, made: bytes) -> None:
    """Write a result to a file of `file_for`, unless a source changed since the start."""
    # A module that is imported late may have changed since the digest was taken.
    if _sources() == _loaded():
        write(file, made)


def write(file: CacheFile, made: bytes) -> None:
    """Write a file for `read` atomically; a full disk is ignored."""
    packed = zlib.compress(made, 1)
    with contextlib.suppress(OSError):
        file.folder.write(file.name, hashlib.sha256(packed).digest() + packed)


# ---- what it was made from -----------------------------------------------------------------------


@functools.cache
def _ground() -> bytes | None:
    """Return a digest of what is constant in a process: sources, versions, machine."""
    # Imported here, since the command line opens the cache before it needs any of them.
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
    # JAX reads environment variables once, at import.
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
    """Return the digest of the sources at the first call."""
    return _sources()


def _sources() -> bytes | None:
    """Return a digest of echelon's source files; None if the loaded code may differ.

    That is so if a file changed while this process ran, or if Python runs compiled files only.
    """
    home, hasher = Path(__file__).parents[1], hashlib.sha256()
    try:
        files = [(file, file.stat(), file.read_bytes()) for file in sorted(home.rglob("*.py"))]
    except OSError:
        return None
    # A file copied with an old date counts by its change time.
    late = any(max(status.st_mtime, status.st_ctime) >= _BEGAN for _, status, _ in files)
    if late or Path(__file__) not in (file for file, *_ in files):
        return None
    for file, _, content in files:
        hasher.update(f"{file.relative_to(home)}\0{len(content)}\0".encode() + content)
    return hasher.digest()


def _processor() -> str:
    """Return the processor features that compiled code depends on."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        named = ("model name", "flags", "CPU part", "Features")
        return "\n".join(line for line in lines if line.startswith(named))
    return " ".join((platform.machine(), platform.processor(), platform.platform()))
