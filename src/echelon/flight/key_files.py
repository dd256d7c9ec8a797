"""The files that outlast a flight: the key, and beside it the highest flight number used."""

import stat
from pathlib import Path
from typing import Final, final

from echelon.core.errors import FlightError
from echelon.core.files import write_atomic

_LARGEST_NUMBER: Final = 2**63


def require_key(file: Path | None) -> Path:
    """Return the key file.

    Raises:
        FlightError: none is named.
    """
    if file is None:
        raise FlightError("give `--key` with the key file, which all agents and the ground share.")
    return file


def read_key(file: Path) -> bytes:
    """Return the key of a formation, which its owner alone may read.

    Raises:
        FlightError: there is none, others may read it, or it is too short.
    """
    try:
        mode, key = file.stat().st_mode, file.read_bytes()
    except OSError as error:
        raise FlightError(
            f"the key file `{file}` cannot be read ({(error.strerror or '').lower()}); make one "
            f"with `(umask 077; head -c 32 /dev/urandom > {file})`, and copy it to every vehicle."
        ) from None
    if stat.S_IMODE(mode) & 0o077:
        raise FlightError(
            f"the key file `{file}` has mode {stat.S_IMODE(mode):04o}, and others may read it; "
            f"use `chmod 600 {file}`."
        )
    if len(key) < 16:
        raise FlightError(f"the key file `{file}` has {len(key)} bytes, and must have at least 16.")
    return key


@final
class NumberFile:
    """The highest flight number that a process has used, which survives its restart.

    Args:
        key: the key file, beside which it is.
        name: of the process, such as `agent-2`.
    """

    def __init__(self, key: Path, name: str) -> None:
        """Write nothing yet."""
        self._file = key.with_name(f"{key.name}.{name}.flight")

    def read(self) -> int:
        """Return the number, and make sure that the next one can be written; 0 before any.

        Raises:
            FlightError: the file is damaged, or cannot be read or written.
        """
        number = 0
        try:
            if self._file.exists():
                text = self._file.read_bytes()[:40].decode("ascii", "replace").strip()
                if not (text.isdigit() and (number := int(text)) < _LARGEST_NUMBER):
                    raise FlightError(
                        f"the flight number in `{self._file}` is `{text}`, and must be a whole "
                        "number below 2^63; delete the file to begin anew."
                    )
        except OSError as error:
            why = (error.strerror or "").lower()
            raise FlightError(f"`{self._file}` cannot be read ({why}).") from None
        self.write(number)
        return number

    def write(self, number: int) -> None:
        """Store a number.

        Raises:
            FlightError: it cannot be written.
        """
        try:
            write_atomic(self._file, f"{number}\n")
        except OSError as error:
            why = (error.strerror or "").lower()
            raise FlightError(
                f"the flight number cannot be stored in `{self._file}` ({why}); make its folder "
                "writable."
            ) from None
