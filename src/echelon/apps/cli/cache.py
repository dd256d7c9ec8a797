"""Where compiled code is kept between runs of the command line, so that each need not compile anew.

The library sets nothing of this: who imports echelon decides for their own process.
"""

import os
import sys
import warnings
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

_SETTINGS: Final = {
    # JAX keeps what took it a second or more: of the 24 pieces that `run paper` compiles, one.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
_LIMIT: Final = 256 * 2**20
"""Bytes that may lie there: 500 scenarios of the paper's size. JAX's own limit needs `filelock`."""


def keep_compiled_code(environment: MutableMapping[str, str]) -> Path | None:
    """Let JAX keep what it compiles, and return the folder of `cache_folder`.

    JAX reads the environment when it is imported, so this needs no JAX. A folder that cannot be
    made or written, or that others may write, changes nothing; nor is anything changed where the
    user gave JAX a folder. None is returned then.
    """
    folder = cache_folder(environment)
    if folder is None or "JAX_COMPILATION_CACHE_DIR" in environment or not _prepare(folder):
        return None
    environment["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    for name, value in _SETTINGS.items():
        environment.setdefault(name, value)
    # A full disk, or an entry cut short by Ctrl-C: JAX compiles anew, and the run is the same.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    return folder


def cache_folder(environment: MutableMapping[str, str]) -> Path | None:
    """Return the folder for what is kept: in `ECHELON_CACHE`, else among the user's caches.

    None where `ECHELON_CACHE` is empty or `off`, or where the user has no home.
    """
    named = environment.get("ECHELON_CACHE")
    if named in ("", "off"):
        return None
    try:
        home = Path(named).expanduser() if named else _user_caches(environment) / "echelon"
    except RuntimeError:  # what pathlib raises for a user without a home, as in some containers
        return None
    return home.absolute() / "compiled"


def _user_caches(environment: MutableMapping[str, str]) -> Path:
    """Return the folder that the system keeps for what a program can compute again."""
    if sys.platform == "win32":
        return Path(environment.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _prepare(folder: Path) -> bool:
    """Make the folder and its room, and tell whether the user can write it, and no other."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_own(folder) or not os.access(folder, os.W_OK):
            return False
        _remove_oldest(folder)
    except OSError:
        return False
    return True


def _is_own(folder: Path) -> bool:
    """Tell whether nobody else may put there what is then run."""
    if sys.platform == "win32":  # where a folder among a user's is the user's
        return True
    status = folder.stat()
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022


def _remove_oldest(folder: Path) -> None:
    """Remove the entries that were written first, until the rest is within the limit."""
    entries = [(entry, entry.stat()) for entry in folder.glob("*-cache")]
    room = _LIMIT
    for entry, status in sorted(entries, key=lambda pair: pair[1].st_mtime, reverse=True):
        room -= status.st_size
        if room < 0:
            entry.unlink(missing_ok=True)
