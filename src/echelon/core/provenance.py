"""Provenance of results: package versions and the commit of the source."""

import platform
import subprocess
from importlib import metadata
from pathlib import Path

from echelon import __version__

_PACKAGES = ("jax", "jaxlib", "equinox", "numpy", "scipy", "llvmlite")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that compute.

    In a checkout, `git` is the commit.
    """
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
