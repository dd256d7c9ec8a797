"""Where a run's files go: a folder that is new or empty.

It is checked before the run, so that nothing is lost.
"""

import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from echelon.core.errors import OutputError

_OURS = (
    *("summary.json", "run.nc", "scenario.yaml", "report.txt", "figures"),
    *("comparison.json", "comparison.txt", "runs"),
)
"""What a run or a comparison writes, and all that `--force` may remove."""


def claim_folder(name: str, out: Path | None, force: bool) -> Path:
    """Return the folder for a run, made and empty of earlier runs.

    Without `out` it is `runs/<name>-<time>`, numbered where two runs start in the same second.

    Raises:
        OutputError: `out` holds something and `force` was not given, or it cannot be written.
    """
    try:
        return _named_folder(out, force) if out is not None else _new_folder(Path("runs"), name)
    except OSError as error:
        raise unwritable(out if out is not None else Path("runs"), error) from error


def claim_folders(names: Sequence[str], out: Path | None, force: bool) -> list[Path]:
    """Return a folder for the comparison of each named scenario: `out` itself where there is one.

    Raises:
        OutputError: two scenarios have one name, or as in `claim_folder`.
    """
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise OutputError(f"two scenarios have the name `{twice}`, and each needs its own folder.")
    if out is None:
        return [claim_folder(f"compare-{name}", None, force) for name in names]
    if len(names) == 1:
        # One comparison alone is the folder that was given, and not a folder within it.
        return [claim_folder(names[0], out, force)]
    return [claim_folder(name, out / name, force) for name in names]


def _new_folder(parent: Path, name: str) -> Path:
    parent.mkdir(parents=True, exist_ok=True)
    # Local time, since a person looks for a run by the clock.
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for attempt in range(1, 1000):
        folder = parent / (stem if attempt == 1 else f"{stem}-{attempt}")
        # Made and not looked for: of two runs that start together only one can make it.
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise OutputError(f"a thousand runs of `{name}` started in the same second; wait a second.")


def _named_folder(out: Path, force: bool) -> Path:
    if out.exists() and not out.is_dir():
        raise OutputError(f"`{out}` is a file, and the output must be a folder.")
    out.mkdir(parents=True, exist_ok=True)
    present = sorted(path.name for path in out.iterdir())
    if present and not force:
        raise OutputError(
            f"the folder `{out}` is not empty (it holds `{present[0]}`); choose another, "
            "or `--force` to replace an earlier run."
        )
    # Only writing shows that a folder can be written: permission bits know nothing of a full disk.
    probe = out / ".writable"
    probe.touch()
    probe.unlink()
    # By name, so that `--force` on a wrong folder takes nothing that echelon did not write.
    for name in _OURS:
        path = out / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return out


def unwritable(folder: Path, error: OSError) -> OutputError:
    """Return the error of a folder that cannot be written, with the reason."""
    return OutputError(f"the folder `{folder}` cannot be written: {error.strerror or error}.")
