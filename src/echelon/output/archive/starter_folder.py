"""The starter folder of `echelon init`: a scenario, a model, a law and a notebook."""

import re
from pathlib import Path
from string import Template

from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.output.archive.folder import check_empty, write_errors

_START = Path(__file__).resolve().parent / "start"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def create_starter(folder: Path) -> list[Path]:
    """Write the folder, which gives the scenario its name, and return the files.

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
