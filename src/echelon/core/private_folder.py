"""A folder that only its user can change, opened once: what is read from it is what he wrote.

Code is read from it and run, so a check by name is not enough: who may write a folder above it
could put another one in its place between the check and a read.
"""

import contextlib
import os
import secrets
import stat
import sys
import weakref
from pathlib import Path
from typing import Final, final

_BY_HANDLE: Final = sys.platform != "win32"
"""Whether files are opened relative to an open folder; Windows cannot, and there a folder inside a
user's folder is the user's."""
_OPEN: Final = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
_FOLDER: Final = _OPEN | getattr(os, "O_DIRECTORY", 0)
_LINKS: Final = 40
"""Links in a path at most."""


class NotPrivateError(OSError):
    """Somebody else can change a folder or a file."""


@final
class PrivateFolder:
    """An open folder, of which the user is the owner and that nobody else can write.

    Args:
        path: absolute; missing folders are created. Its last part may not be a link.

    Raises:
        OSError: it cannot be opened or created.
        NotPrivateError: somebody else owns it or may write it, or may write a folder above it.
    """

    def __init__(self, path: Path) -> None:
        """Open it."""
        self.path, self._handle = path, _open(path) if _BY_HANDLE else None
        if self._handle is None:
            path.mkdir(parents=True, exist_ok=True)
        else:
            weakref.finalize(self, os.close, self._handle)

    def read(self, name: str) -> bytes:
        """Return the content of a file.

        Raises:
            OSError: there is none, or it cannot be read.
            NotPrivateError: it is a link or a device, of somebody else, or others may write it.
        """
        # A pipe in its place would let the program wait.
        flags = _OPEN | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(self._name(name), flags, dir_fd=self._handle), "rb") as file:
            status = os.fstat(file.fileno())
            if _BY_HANDLE and not (stat.S_ISREG(status.st_mode) and _is_own(status)):
                raise NotPrivateError(f"`{name}` is not a file that only its user can write")
            return file.read()

    def write(self, name: str, content: bytes) -> None:
        """Write a file completely or not at all.

        Raises:
            OSError: it cannot be written.
        """
        # The ending lets the cleanup find the file if this process is killed before the rename.
        beside = f"{secrets.token_hex(8)}-cache"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _OPEN | getattr(os, "O_BINARY", 0)
        handle = os.open(self._name(beside), flags, 0o600, dir_fd=self._handle)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            ends = self._name(beside), self._name(name)
            os.replace(*ends, src_dir_fd=self._handle, dst_dir_fd=self._handle)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(self._name(beside), dir_fd=self._handle)
            raise

    def remove_oldest(self, ending: str, limit: int) -> None:
        """Remove the oldest files with an ending until the rest has at most `limit` bytes.

        Raises:
            OSError: the folder cannot be read, or a file not be removed.
        """
        with os.scandir(self.path if self._handle is None else self._handle) as entries:
            files = [(x.name, x.stat(follow_symlinks=False)) for x in entries]
        for name, status in sorted(files, key=lambda file: file[1].st_mtime, reverse=True):
            if name.endswith(ending) and stat.S_ISREG(status.st_mode):
                limit -= status.st_size
                if limit < 0:
                    os.unlink(self._name(name), dir_fd=self._handle)

    def _name(self, name: str) -> str:
        return str(self.path / name) if self._handle is None else name


def _open(path: Path) -> int:
    """Return an open folder after checking every folder and link on the way to it."""
    left, links, hidden = [*reversed(path.parts[1:])], 0, False
    at = os.open(path.anchor, _FOLDER)
    try:
        while left:
            status = os.fstat(at)
            hidden = _check_above(status, hidden)
            name = left.pop()
            target = _link(at, name) if left else None
            if target is None:
                inner = _enter(at, name)
                hidden = hidden and name != ".."
            else:
                links += 1
                if links > _LINKS:
                    raise NotPrivateError(f"`{path}` leads through too many links")
                left += reversed([part for part in target.parts if part != target.anchor])
                inner = os.open(target.anchor or ".", _FOLDER, dir_fd=at)
                hidden = hidden and not target.anchor
            os.close(at)
            at = inner
        if not _is_own(os.fstat(at)):
            raise NotPrivateError(f"`{path}` is not a folder that only its user can write")
    except BaseException:
        os.close(at)
        raise
    return at


def _check_above(status: os.stat_result, hidden: bool) -> bool:
    """Check a folder on the way; return whether others cannot enter it, nor what is below it."""
    mode = status.st_mode
    # In a folder such as /tmp nobody can rename what belongs to another user.
    closed = not mode & 0o022 or bool(mode & stat.S_ISVTX) or hidden
    if status.st_uid not in (0, os.geteuid()) or not closed:
        raise NotPrivateError("somebody else can write a folder above it")
    return hidden or not mode & 0o077


def _is_own(status: os.stat_result) -> bool:
    return status.st_uid == os.geteuid() and not status.st_mode & 0o022


def _link(at: int, name: str) -> Path | None:
    """Return where a link in a folder leads; None if it is none, or not there."""
    try:
        status = os.stat(name, dir_fd=at, follow_symlinks=False)
    except FileNotFoundError:
        return None
    if not stat.S_ISLNK(status.st_mode):
        return None
    if status.st_uid not in (0, os.geteuid()):
        raise NotPrivateError(f"the link `{name}` belongs to somebody else")
    return Path(os.readlink(name, dir_fd=at))


def _enter(at: int, name: str) -> int:
    """Return a folder in a folder, created if it is missing."""
    with contextlib.suppress(FileExistsError):
        try:
            return os.open(name, _FOLDER, dir_fd=at)
        except FileNotFoundError:
            os.mkdir(name, 0o700, dir_fd=at)
    return os.open(name, _FOLDER, dir_fd=at)
