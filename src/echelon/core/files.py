"""Files that are whole or not there: written beside their name, and renamed when complete."""

import os
from collections.abc import Callable
from pathlib import Path

PART = ".part"
"""What the names of unfinished files end in."""


def write_atomic(path: Path, content: bytes | str) -> None:
    """Write a file that has all of the content or, where that fails, what it had before.

    Raises:
        OSError: it cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    make_atomic(path, lambda part: _write(part, data))


def make_atomic(path: Path, make: Callable[[Path], object]) -> None:
    """Let `make` write a file under another name, and give it its own when it is complete.

    Raises:
        OSError: it cannot be written.
    """
    if path.exists() and not path.is_file():
        # A pipe or a device, which nothing can take the place of.
        make(path)
        return
    # What a link leads to is written, and the link stays.
    path = path.resolve()
    # By the process too: two that write the same file must not write into each other's.
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
        # Without it a power cut may leave the name with nothing in it.
        os.fsync(file.fileno())
