"""The folder of compiled code, so that a later run of the command line need not compile again.

Only the command line sets it; the library leaves the process of its user alone.
"""

import os
import sys
import warnings
from collections.abc import MutableMapping
from pathlib import Path
from typing import Final

from echelon.core.private_folder import PrivateFolder

_SETTINGS: Final = {
    # By default JAX stores only code that took a second to compile: 1 of 24 pieces of `run paper`.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}
_LIMIT: Final = 256 * 2**20
"""Bytes: 500 scenarios of the paper's size. JAX's own limit would need `filelock`."""


def keep_compiled_code(environment: MutableMapping[str, str]) -> PrivateFolder | None:
    """Let JAX store compiled code in the folder of `cache_folder`, and return that folder.

    JAX reads the environment when it is imported, so this needs no JAX. Nothing is changed, and
    None returned, if the folder cannot be written, if others can change it, or if the user has set
    JAX's own variable.
    """
    folder = cache_folder(environment)
    if folder is None or "JAX_COMPILATION_CACHE_DIR" in environment:
        return None
    opened = _prepare(folder)
    if opened is None:
        return None
    environment["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    for name, value in _SETTINGS.items():
        environment.setdefault(name, value)
    # A full disk or a truncated entry: JAX compiles again, and the run is the same.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    return opened


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


def _prepare(folder: Path) -> PrivateFolder | None:
    """Open the folder and limit its size; return None unless only the user can change it."""
    try:
        opened = PrivateFolder(folder)
        if not os.access(folder, os.W_OK):
            return None
        opened.remove_oldest("-cache", _LIMIT)
    except OSError:
        return None
    return opened
