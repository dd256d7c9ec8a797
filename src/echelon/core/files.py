"""Atomic writing of files: written under a temporary name, renamed when complete."""

import os
from collections.abc import Callable
from pathlib import Path

INPUTS = "inputs"
"""The folder, beside a scenario, of the files that it names."""
PART = ".part"
"""Suffix of unfinished files."""


def write_atomic(path: Path, content: bytes | str) -> None:
    """Write a file completely; if that fails, its previous content remains.

    Raises:
        OSError: it cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    make_atomic(path, lambda part: _write(part, data))


def make_atomic(path: Path, make: Callable[[Path], object]) -> None:
    """Let `make` write a temporary file, and rename it when it is complete.

    Raises:
        OSError: it cannot be written.
    """
    if path.exists() and not path.is_file():
        # A pipe or a device cannot be replaced by a rename.
        make(path)
        return
    # Resolved, so that a symbolic link stays and its target is written.
    path = path.resolve()
    # With the process id: two processes may write the same file.
    part = path.with_name(f".{path.name}.{os.getpid()}{PART}")
    try:
        make(part)
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        # Without it, a power failure may leave an empty file under the final name.
        os.fsync(file.fileno())
