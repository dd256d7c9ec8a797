"""A folder to begin with: a scenario, a model, a law and a notebook that all run."""

import re
from pathlib import Path
from string import Template

from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.output.archive.folder import unwritable

_START = Path(__file__).resolve().parent / "start"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def begin(folder: Path) -> list[Path]:
    """Write the folder, named by its last part, and return the files.

    Raises:
        OutputError: the folder holds something, its name is none for a scenario, or it cannot be
            written.
    """
    name = folder.resolve().name
    if not _NAME.fullmatch(name):
        raise OutputError(
            f"`{name}` is no name for a scenario, which has letters, digits, `.`, `-` and `_`."
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"`{folder}` exists and is not empty; choose another name.")
    files = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for source in sorted(_START.iterdir()):
            # Python's own files end in .txt here, so that nobody takes them for modules.
            file = folder / source.name.removesuffix(".txt")
            write_atomic(file, Template(source.read_text("utf-8")).safe_substitute(name=name))
            files.append(file)
    except OSError as error:
        raise unwritable(folder, error) from error
    return files
