"""The report of an internal error: a file with versions and traceback, and a sentence about it."""

import sys
import tempfile
import traceback
from pathlib import Path
from typing import Final

CRASHED: Final = 70
"""Exit code of an error in the program itself, as in BSD's `sysexits.h`."""


def note_crash(error: Exception) -> str:
    """Write the details of an internal error to a file, and return the sentence that names it."""
    kind = type(error).__name__
    reason = (str(error).splitlines() or ["no message"])[0].rstrip(".")
    sentence = f"internal error of echelon (your input may be correct): {kind}: {reason}"
    details = "".join(traceback.format_exception(error))
    try:
        from echelon.core.provenance import versions

        head = f"{' '.join(sys.argv)}\n{versions()}\n\n"
        with tempfile.NamedTemporaryFile(
            "w", prefix="echelon-crash-", suffix=".txt", delete=False, encoding="utf-8"
        ) as file:
            file.write(head + details)
        return f"{sentence}. Please report it with `{Path(file.name)}`."
    except OSError:
        # No file can be written, so the details go to the terminal.
        print(details, file=sys.stderr)
        return f"{sentence}. Please report it with the details above."
