"""The folder of compiled code, so that a later run of the command line need not compile again.

Only the command line sets it; the library leaves the process of its user alone.
"""

import os
import sys
import warnings
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

_SETTINGS: Final = {
    # By default JAX stores only code that took a second to compile: 1 of 24 pieces of `run paper`.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
_LIMIT: Final = 256 * 2**20
"""Bytes: 500 scenarios of the paper's size. JAX's own limit would need `filelock`."""


def keep_compiled_code(environment: MutableMapping[str, str]) -> Path | None:
    """Let JAX store compiled code in the folder of `cache_folder`, and return that folder.

    JAX reads the environment when it is imported, so this needs no JAX. Nothing is changed, and
    None returned, if the folder cannot be written, if others may write to it, or if the user has
    set JAX's own variable.
    """
    folder = cache_folder(environment)
    if folder is None or "JAX_COMPILATION_CACHE_DIR" in environment or not _prepare(folder):
        return None
    environment["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    for name, value in _SETTINGS.items():
        environment.setdefault(name, value)
    # A full disk or a truncated entry: JAX compiles again, and the run is the same.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    return folder


def cache_folder(environment: MutableMapping[str, str]) -> Path | None:
    """Return the folder of compiled code: in `ECHELON_CACHE`, else among the user's caches.

    None if `ECHELON_CACHE` is empty or `off`, or if the user has no home.
    """
    setting = environment.get("ECHELON_CACHE")
    if setting in ("", "off"):
        return None
    try:
        home = Path(setting).expanduser() if setting else _user_caches(environment) / "echelon"
    except RuntimeError:  # pathlib's error for a user without a home, as in some containers
        return None
    return home.absolute() / "compiled"


def _user_caches(environment: MutableMapping[str, str]) -> Path:
    """Return the folder that the system reserves for caches."""
    if sys.platform == "win32":
        return Path(environment.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _prepare(folder: Path) -> bool:
    """Create the folder and limit its size; return whether only the user can write to it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder) or not os.access(folder, os.W_OK):
            return False
        _remove_oldest(folder)
    except OSError:
        return False
    return True


def _is_private(folder: Path) -> bool:
    """Return whether nobody else may write code there, which would then be run."""
    if sys.platform == "win32":  # there a folder inside a user's folder is the user's
        return True
    status = folder.stat()
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022


def _remove_oldest(folder: Path) -> None:
    """Remove the oldest entries until the rest is within the limit."""
    entries = [(entry, entry.stat()) for entry in folder.glob("*-cache")]
    remaining = _LIMIT
    for entry, status in sorted(entries, key=lambda pair: pair[1].st_mtime, reverse=True):
        remaining -= status.st_size
        if remaining < 0:
            entry.unlink(missing_ok=True)
