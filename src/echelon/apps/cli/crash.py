"""What is told of a fault of echelon's own."""

import sys
import tempfile
import traceback
from pathlib import Path
from typing import Final

CRASHED: Final = 70
"""Exit code of a fault in the program itself, as BSD's `sysexits.h` has it."""


def note_crash(error: Exception) -> str:
    """Write down what a report of a fault needs, and return the sentence that says where."""
    kind, what = type(error).__name__, (str(error).splitlines() or ["no message"])[0].rstrip(".")
    told = f"this is a fault of echelon's own, and what you gave need not be wrong: {kind}: {what}"
    details = "".join(traceback.format_exception(error))
    try:
        from echelon.core.provenance import versions

        head = f"{' '.join(sys.argv)}\n{versions()}\n\n"
        with tempfile.NamedTemporaryFile(
            "w", prefix="echelon-crash-", suffix=".txt", delete=False, encoding="utf-8"
        ) as file:
            file.write(head + details)
        return f"{told}; the details are in `{Path(file.name)}`."
    except OSError:
        # No disk takes them; better on the screen than lost.
        print(details, file=sys.stderr)
        return f"{told}; the details stand above."
