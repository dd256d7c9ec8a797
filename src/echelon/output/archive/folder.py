"""The folders that commands write: new or empty, and claimed before a run.

So no file is lost, and the files of two runs do not mix.
"""

import contextlib
import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from string import Template

from echelon.core.errors import OutputError
from echelon.core.files import INPUTS, write_atomic

CHUNKS, RUNS, BATCHES = "chunks", "runs", "batches"
DATA, GAIN, SUMMARY, FRAMES = "run.nc", "gain.json", "summary.json", "states.nc"
REPORT = "report.txt"
_RUN = (SUMMARY, DATA, GAIN, "scenario.yaml", REPORT, "figures", INPUTS, CHUNKS)
_COMPARISON = ("comparison.json", "comparison.txt", RUNS, "figures")
_SWEEP = ("sweep.nc", FRAMES, "scenario.yaml", "sweep.txt", "figures", INPUTS, BATCHES)
_MARKS = {SUMMARY: _RUN, CHUNKS: _RUN, "comparison.json": _COMPARISON}
_MARKS |= {"sweep.nc": _SWEEP, BATCHES: _SWEEP}
"""The name that shows which command wrote a folder, and the files that `--force` then removes."""
FORCE, IN_PYTHON = "`--force`", "`force=True`"
"""What replaces files that exist, for the command line and in Python."""
_FILES = {CHUNKS: _RUN, RUNS: _COMPARISON, BATCHES: _SWEEP}


def claim_folder(
    name: str, out: Path | None, force: bool, by: str = CHUNKS, how: str = FORCE
) -> Path:
    """Return the folder for a run, created and empty of earlier runs.

    Without `out` it is `runs/<name>-<time>`, numbered where two runs start in the same second. It
    is claimed by creating the folder `by` in it, which only one of two runs can. `how` is what
    replaces an earlier run, in words.

    Raises:
        OutputError: `out` holds something and `force` was not given, or it cannot be written.
    """
    with write_errors(Path(RUNS) if out is None else out):
        folder = (
            _new_folder(Path(RUNS), name) if out is None else _named_folder(out, force, by, how)
        )
        try:
            (folder / by).mkdir()
        except FileExistsError:
            raise OutputError(f"another run has just started in the folder `{out}`.") from None
        return folder


def check_empty(folder: Path) -> None:
    """Check that a folder is new or empty.

    Raises:
        OutputError: it holds something, or is a file.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"`{folder}` exists and is not empty; choose another name.")


def claim_folders(names: Sequence[str], out: Path | None, force: bool) -> list[Path]:
    """Return a folder for the comparison of each named scenario: `out` itself where there is one.

    Raises:
        OutputError: two scenarios have one name, or as in `claim_folder`.
    """
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise OutputError(f"two scenarios have the name `{twice}`; rename one of them.")
    if out is None:
        return [claim_folder(f"compare-{name}", None, force, RUNS) for name in names]
    if len(names) == 1:
        # A single comparison goes into `out` itself.
        return [claim_folder(names[0], out, force, RUNS)]
    return [claim_folder(name, out / name, force, RUNS) for name in names]


def claim_design(
    out: Path | None, figures: Path | None, force: bool, inputs: Sequence[Path]
) -> None:
    """Check that a design can write its gain and its figures without the loss of a file.

    Raises:
        OutputError: as in `claim_file`; or the folder of the figures holds something, and `force`
            was not given.
    """
    if figures is not None and figures.exists():
        _check_folder(figures)
        if any(figures.iterdir()) and not force:
            raise OutputError(
                f"the folder `{figures}` is not empty; choose another, or `--force` to replace "
                "earlier figures."
            )
    if out is not None:
        claim_file(out, force, inputs)


def check_exists(run: Path) -> Path:
    """Return the path of a run, after checking that there is something.

    Raises:
        OutputError: there is nothing, or a scenario.
    """
    if not run.exists():
        raise OutputError(f"`{run}` does not exist; give the folder of a run, or its `{DATA}`.")
    if run.is_file() and run.suffix in (".yaml", ".yml"):
        raise OutputError(
            f"`{run}` is a scenario; run it first (`echelon run {run} --out FOLDER`), and give the "
            "folder."
        )
    return run


def newest_run() -> Path:
    """Return the folder in runs/ that was written last, of a finished or an unfinished run.

    Raises:
        OutputError: there is none.
    """
    folders = [path for path in Path(RUNS).glob("*") if path.is_dir()]
    ages = {path: when_written(path) for path in folders}
    if not any(ages.values()):
        raise OutputError(f"there is no run in `{RUNS}/`; give the folder of a run.")
    return max(ages, key=lambda path: ages[path])


def when_written(folder: Path) -> float:
    """Return when the dataset or the parts of a run were last written; 0 of another folder."""
    marks = [path for path in (folder / DATA, folder / CHUNKS) if path.exists()]
    return max((path.stat().st_mtime for path in marks), default=0.0)


def claim_file(
    file: Path,
    force: bool,
    inputs: Sequence[Path] = (),
    endings: Sequence[str] = (),
    how: str = FORCE,
) -> None:
    """Check that a file can be written without the loss of another.

    Raises:
        OutputError: it has none of the `endings`, if there are any; it is a folder, is among the
            `inputs` of the command, or exists and `force` was not given; or its folder does not
            exist.
    """
    if endings and file.suffix.lower() not in endings:
        raise OutputError(
            f"`{file.name}` ends in `{file.suffix}`, and must end in {' or '.join(endings)}."
        )
    if file.is_dir():
        raise OutputError(f"`{file}` is a folder; give a file.")
    if any(path.exists() and file.exists() and file.samefile(path) for path in inputs):
        raise OutputError(f"`{file}` is an input of this command; choose another file.")
    # A pipe or a device holds nothing that could be lost.
    if file.is_file() and not force:
        raise OutputError(f"the file `{file}` exists; choose another, or {how} to replace it.")
    if not file.resolve().parent.is_dir():
        raise OutputError(f"`{file.parent}` is not a folder; create it first to write `{file}`.")


def claim_files(folder: Path, names: Sequence[str], force: bool) -> None:
    """Check that files can be written into a folder without the loss of others.

    Raises:
        OutputError: the folder is a file, or one of the files exists and `force` was not given.
    """
    if folder.exists():
        _check_folder(folder)
    existing = [name for name in names if (folder / name).exists()]
    if existing and not force:
        raise OutputError(
            f"the file `{folder / existing[0]}` exists; choose another folder, or `--force` to "
            "replace it."
        )


def _check_folder(path: Path) -> None:
    if not path.is_dir():
        raise OutputError(f"`{path}` is a file; give a folder.")


@contextlib.contextmanager
def writing(folder: Path, by: str = CHUNKS) -> Iterator[None]:
    """Lock the folder of a run as long as this process writes into it.

    `by` is the folder in it by which it was claimed.

    Raises:
        OutputError: another process writes into it, or it holds no run to continue.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no such lock; two writers do the chunks no harm
        yield
        return
    with write_errors(folder):
        descriptor = os.open(folder / by, os.O_RDONLY)
    try:
        # Released by the system however the process ends, as no file in the folder would be.
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise OutputError(f"another run is writing into the folder `{folder}`.") from None
    except OSError:
        pass  # a file system without locks
    try:
        yield
    finally:
        os.close(descriptor)


def _new_folder(parent: Path, name: str) -> Path:
    parent.mkdir(parents=True, exist_ok=True)
    # Local time, since a person looks for a run by the clock.
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for attempt in range(1, 1000):
        folder = parent / (stem if attempt == 1 else f"{stem}-{attempt}")
        # Not `exists`: of two runs that start together only one can create it.
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise OutputError(f"999 runs of `{name}` started in the same second; wait a second.")


def _named_folder(out: Path, force: bool, by: str, how: str) -> Path:
    if out.exists():
        _check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    # Files of the user come before the hidden ones that a run is just writing.
    present = sorted((path.name for path in out.iterdir()), key=lambda name: (name[0] == ".", name))
    if present and not force:
        raise OutputError(
            f"the folder `{out}` is not empty (it holds `{present[0]}`); choose another, "
            f"or {how} to replace an earlier run."
        )
    # Permission bits do not show a full disk, so a file is written.
    probe = out / ".writable"
    probe.touch()
    probe.unlink()
    _clear(out, present, _FILES[by])
    return out


def _clear(out: Path, present: Sequence[str], names: Sequence[str]) -> None:
    """Refuse where one is being written, or a file of such a name is not from echelon."""
    earlier = {name for mark, files in _MARKS.items() if mark in present for name in files}
    foreign = [name for name in present if name in {*names} - earlier]
    if foreign:
        raise OutputError(
            f"the folder `{out}` holds `{foreign[0]}`, which echelon did not write; choose another."
        )
    with contextlib.ExitStack() as stack:
        for by in {CHUNKS, BATCHES}.intersection(present):
            stack.enter_context(writing(out, by))
        # By name, so that only files of echelon are removed.
        for path in (out / name for name in earlier):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


@contextlib.contextmanager
def write_errors(place: Path) -> Iterator[None]:
    """Report a failure to write in one sentence.

    Raises:
        OutputError: the file or folder could not be written, with the reason.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"`{place}` cannot be written: {error.strerror or error}.") from error


# ---- the starter folder: a scenario, a model, a law and a notebook -------------------------------

_START = Path(__file__).resolve().parent / "start"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def create_starter(folder: Path) -> list[Path]:
    """Write the folder of `echelon init`, which gives the scenario its name; return the files.

    Raises:
        OutputError: the folder is not empty, its name cannot name a scenario, or it cannot be
            written.
    """
    name = folder.resolve().name
    if not _NAME.fullmatch(name):
        raise OutputError(
            f"`{name}` cannot name a scenario; use letters, digits, `.`, `-` and `_` only."
        )
    check_empty(folder)
    files = []
    with write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for source in sorted(_START.iterdir()):
            # Python files end in .txt here, so that nobody takes them for modules.
            file = folder / source.name.removesuffix(".txt")
            write_atomic(file, Template(source.read_text("utf-8")).safe_substitute(name=name))
            files.append(file)
    return files
