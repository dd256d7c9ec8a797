"""What output needs: files written completely or not at all, versions, pages for notebooks."""

import dataclasses
import html
import importlib
import os
import platform
import subprocess
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Final, final

from echelon import __version__

INPUTS = "inputs"
"""The folder, beside a scenario, of the files that it names."""
PART = ".part"
"""Suffix of unfinished files."""


def write_atomic(path: Path, content: bytes | str) -> None:
    """Write a file completely, or raise `OSError` and leave its previous content."""
    data = content.encode() if isinstance(content, str) else content
    make_atomic(path, lambda part: _write(part, data))


def make_atomic(path: Path, make: Callable[[Path], object]) -> None:
    """Let `make` write a temporary file, and rename it when it is complete; `OSError` if not."""
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


_PACKAGES = ("jax", "jaxlib", "equinox", "numpy", "scipy", "llvmlite")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute, and a checkout's `git`."""
    result = {"python": platform.python_version(), "echelon": __version__}
    for package in _PACKAGES:
        try:
            result[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            result[package] = "unknown"
    commit = _commit()
    return {**result, "git": commit} if commit else result


def _commit() -> str | None:
    """Return the commit of echelon's own checkout, with `+` when changed; None elsewhere."""
    # core, echelon, src, and then the checkout.
    home = Path(__file__).resolve().parents[3]
    if not (home / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(home), "describe", "--always", "--dirty=+", "--abbrev=12"]
        # With a timeout: a slow disk must not delay a run for this detail.
        return subprocess.run(
            command, capture_output=True, text=True, timeout=5, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


# By name, since the output layer is above this one and must not be imported from here.
_PAGES: Final = {
    "result": "echelon.output.archive.notebook:result_page",
    "replay": "echelon.output.archive.notebook:result_replay",
    "report": "echelon.output.reports.html_report:html_report",
}


@final
@dataclasses.dataclass(frozen=True, repr=False)
class CellPage:
    """A whole page, which a notebook shows in the output of a cell.

    Attributes:
        text: its HTML.
        height: pixels.
    """

    text: str
    height: int

    def __repr__(self) -> str:
        return f"CellPage({len(self.text) / 1e6:.2g} MB of HTML in `text`; a notebook shows it)"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 1px solid #8888; border-radius: 6px"
        return f'<iframe style="{style}" srcdoc="{html.escape(self.text)}"></iframe>'


def notebook_page(kind: str, value: object) -> str:
    """Return a value as HTML."""
    module, _, name = _PAGES[kind].partition(":")
    return getattr(importlib.import_module(module), name)(value)
