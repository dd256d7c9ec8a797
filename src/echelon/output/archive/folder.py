"""Where a run's files go: a folder that is new or empty.

It is taken before the run, so that nothing is lost and no two runs mix.
"""

import contextlib
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from echelon.core.errors import OutputError

CHUNKS, INPUTS, RUNS, BATCHES = "chunks", "inputs", "runs", "batches"
DATA, GAIN, SUMMARY = "run.nc", "gain.json", "summary.json"
_RUN = (SUMMARY, DATA, GAIN, "scenario.yaml", "report.txt", "figures", INPUTS, CHUNKS)
_COMPARISON = ("comparison.json", "comparison.txt", RUNS, "figures")
_SWEEP = ("sweep.nc", "scenario.yaml", "sweep.txt", "figures", INPUTS, BATCHES)
_OURS = {SUMMARY: _RUN, CHUNKS: _RUN, "comparison.json": _COMPARISON}
_OURS |= {"sweep.nc": _SWEEP, BATCHES: _SWEEP}
"""What shows that a command wrote a folder, and all that `--force` then removes."""
_WANTED = {CHUNKS: _RUN, RUNS: _COMPARISON, BATCHES: _SWEEP}


def claim_folder(name: str, out: Path | None, force: bool, by: str = CHUNKS) -> Path:
    """Return the folder for a run, made and empty of earlier runs.

    Without `out` it is `runs/<name>-<time>`, numbered where two runs start in the same second. It
    is taken by making the folder `by` in it, which of two runs only one can.

    Raises:
        OutputError: `out` holds something and `force` was not given, or it cannot be written.
    """
    try:
        folder = _new_folder(Path(RUNS), name) if out is None else _named_folder(out, force, by)
        (folder / by).mkdir()
        return folder
    except FileExistsError:
        raise OutputError(f"another run has just taken the folder `{out}`.") from None
    except OSError as error:
        raise unwritable(out if out is not None else Path(RUNS), error) from error


def claim_folders(names: Sequence[str], out: Path | None, force: bool) -> list[Path]:
    """Return a folder for the comparison of each named scenario: `out` itself where there is one.

    Raises:
        OutputError: two scenarios have one name, or as in `claim_folder`.
    """
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise OutputError(f"two scenarios have the name `{twice}`, and each needs its own folder.")
    if out is None:
        return [claim_folder(f"compare-{name}", None, force, RUNS) for name in names]
    if len(names) == 1:
        # One comparison alone is the folder that was given, and not a folder within it.
        return [claim_folder(names[0], out, force, RUNS)]
    return [claim_folder(name, out / name, force, RUNS) for name in names]


def claim_design(out: Path | None, figures: Path | None, force: bool, read: Sequence[Path]) -> None:
    """Check that a design can write its gain and its figures without the loss of a file.

    Raises:
        OutputError: the gain would replace a file that is `read` here, or another without `force`;
            or the folder of the figures holds something, without `force`.
    """
    if figures is not None and figures.exists() and not figures.is_dir():
        raise OutputError(f"`{figures}` is a file, and the figures need a folder.")
    if figures is not None and figures.is_dir() and any(figures.iterdir()) and not force:
        raise OutputError(
            f"the folder `{figures}` is not empty; choose another, or `--force` to replace "
            "earlier figures."
        )
    if out is None or not out.exists():
        return
    if out.is_dir():
        raise OutputError(f"`{out}` is a folder, and the output must be a file.")
    if any(file.exists() and out.samefile(file) for file in read):
        raise OutputError(f"`{out}` is what is read here, and would be lost; choose another file.")
    # A pipe or a device holds nothing that could be lost.
    if out.is_file() and not force:
        raise OutputError(f"the file `{out}` exists; choose another, or `--force` to replace it.")


@contextlib.contextmanager
def writing(folder: Path, by: str = CHUNKS) -> Iterator[None]:
    """Keep others from writing into the folder of a run, for as long as this process lives.

    `by` is the folder in it by which it was taken.

    Raises:
        OutputError: another process writes into it, or it is no folder of a run that goes on.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no such lock; the chunks themselves bear two writers
        yield
        return
    try:
        place = os.open(folder / by, os.O_RDONLY)
    except OSError as error:
        raise unwritable(folder, error) from error
    try:
        # Taken back by the system however the process ends, as no file in the folder would be.
        with contextlib.suppress(OSError):
            _lock(place, folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(place)


def _lock(place: int, folder: Path, how: int) -> None:
    import fcntl

    try:
        fcntl.flock(place, how)
    except BlockingIOError:
        raise OutputError(f"another run is writing into the folder `{folder}`.") from None


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


def _named_folder(out: Path, force: bool, by: str) -> Path:
    if out.exists() and not out.is_dir():
        raise OutputError(f"`{out}` is a file, and the output must be a folder.")
    out.mkdir(parents=True, exist_ok=True)
    # A person's files before those that a run is just writing under hidden names.
    present = sorted((path.name for path in out.iterdir()), key=lambda name: (name[0] == ".", name))
    if present and not force:
        raise OutputError(
            f"the folder `{out}` is not empty (it holds `{present[0]}`); choose another, "
            "or `--force` to replace an earlier run."
        )
    # Only writing shows that a folder can be written: permission bits know nothing of a full disk.
    probe = out / ".writable"
    probe.touch()
    probe.unlink()
    _clear(out, present, _WANTED[by])
    return out


def _clear(out: Path, present: Sequence[str], wanted: Sequence[str]) -> None:
    """Remove an earlier run or comparison, so that the names `wanted` are free.

    Raises:
        OutputError: one is being written, or what bears a name of ours was written by others.
    """
    earlier = {name for mark, names in _OURS.items() if mark in present for name in names}
    foreign = [name for name in present if name in {*wanted} - earlier]
    if foreign:
        raise OutputError(
            f"the folder `{out}` holds `{foreign[0]}`, which no run left there; choose another."
        )
    with contextlib.ExitStack() as stack:
        for by in {CHUNKS, BATCHES}.intersection(present):
            stack.enter_context(writing(out, by))
        # By name, so that nothing goes that echelon did not write.
        for path in (out / name for name in earlier):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def unwritable(folder: Path, error: OSError) -> OutputError:
    """Return the error of a folder that cannot be written, with the reason."""
    return OutputError(f"the folder `{folder}` cannot be written: {error.strerror or error}.")
