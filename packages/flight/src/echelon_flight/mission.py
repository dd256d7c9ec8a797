"""What a process of a flight is given: the prepared folder, and the key beside its own number.

The folder has flight.json, a folder `law-K` for agent K, and the files of simulated vehicles.
"""

import hashlib
import importlib.util
import json
import os
import secrets
import stat
import time
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Final, final

from echelon_flight import FlightError, __version__
from echelon_flight.flight_log import FOLDER, FlightLog
from echelon_flight.links import check_scheme
from echelon_flight.parameters import check_fence, values_of
from echelon_flight.wire import GROUND, Wire

_LARGEST_NUMBER: Final = 2**63


def check_options(link: str, key: Path | None, signs: bool) -> None:
    """Check options of a process, before its folder is written.

    Args:
        link: as `--link` has it.
        key: as `--key` has it.
        signs: whether the process needs the key, as an agent's and the ground station's do.

    Raises:
        FlightError: there is no such link, or the key cannot be used.
    """
    check_scheme(link)
    if signs:
        read_key(key)


@final
class Mission:
    """A prepared flight.

    Args:
        folder: of the flight.

    Attributes:
        folder: likewise.
        facts: the content of flight.json.
        parameters: the value of each, by name.

    Raises:
        FlightError: it is no such folder, of an earlier version, or has a number that is refused.
    """

    def __init__(self, folder: Path) -> None:
        """Read flight.json."""
        self.folder, self.facts = folder, _read(folder / "flight.json")
        if "message" not in self.facts:
            raise FlightError(
                f"`{folder}` was prepared by an earlier version; prepare it again with "
                "`echelon fly`."
            )
        self.parameters = values_of(self.facts)
        check_fence(self.facts)

    @property
    def agents(self) -> int:
        """How many there are."""
        return self.facts["agents"]

    def law(self, number: int) -> tuple[ModuleType, dict[str, Any]]:
        """Return the law of an agent, and the content of its law.json.

        Raises:
            FlightError: there is none, it was changed, or it is of another formation.
        """
        if not 0 <= number < self.agents:
            raise FlightError(
                f"`--agent` is {number}, and the agents of this flight are 0 to {self.agents - 1}."
            )
        file = self.folder / f"law-{number}" / "law.py"
        facts = _read(file.with_name("law.json"))
        if not file.is_file():
            raise FlightError(f"`{file}` does not exist.")
        if hashlib.sha256(file.read_bytes()).hexdigest() != facts["sha256"]["law.py"]:
            raise FlightError(f"`{file}` is not the file that its law.json describes.")
        if facts["formation"] != self.facts["formation"]:
            raise FlightError(
                f"the law in `{file.parent}` is of another formation than `{self.folder}`; write "
                "both again from one scenario."
            )
        return load_module(file), facts

    def log(self, law: Mapping[str, Any], vehicle: str) -> FlightLog:
        """Return the log of an agent, in the folder `logs`.

        Args:
            law: the content of its law.json.
            vehicle: as `--link` has it.
        """
        same = "agent", "formation", "dt", "states", "inputs", "message", "hears", "limits"
        facts = {name: law.get(name) for name in same}
        facts |= {"law": law["sha256"]["law.py"], "vehicle": vehicle, "by": __version__}
        facts |= {"parameters": self.parameters, "network": law["network"]}
        sizes = len(law["states"]), len(law["inputs"]), sum(law["message"].values())
        return FlightLog(self.folder / FOLDER, facts, *sizes)

    def wire(self, number: int, key: Path | None) -> Wire:
        """Return what signs for an agent, or for the ground, by a key file.

        Raises:
            FlightError: the key cannot be used, or the flight number beside it.
        """
        secret, size = read_key(key), sum(self.facts["message"].values())
        assert key is not None
        file = NumberFile(key, "ground" if number == GROUND else f"agent-{number}")
        common = secret, self.facts["formation"], number, self.agents, size
        boot, apart = time.time_ns() // 1_000_000, self.parameters["stamp_difference"]
        return Wire(*common, boot, file.read(), file.write, apart)


def load_module(file: Path) -> ModuleType:
    """Return a file of Python as a module."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _read(file: Path) -> dict[str, Any]:
    try:
        return json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        raise FlightError(
            f"`{file}` cannot be read; `echelon fly SCENARIO --out {file.parent}` writes it."
        ) from None


# ---- files that outlast a flight -----------------------------------------------------------------


def read_key(file: Path | None) -> bytes:
    """Return the key of a formation, which its owner alone may read.

    Raises:
        FlightError: none is named, there is none, others may read it, or it is too short.
    """
    if file is None:
        raise FlightError("give `--key` with the key file, which all agents and the ground share.")
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


def make_key(file: Path) -> None:
    """Write a new key that its owner alone may read."""
    file.unlink(missing_ok=True)
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
        out.write(secrets.token_bytes(32))


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
        """Store a number; where that fails, the previous one remains.

        Raises:
            FlightError: it cannot be written.
        """
        file = self._file.resolve()
        part = file.with_name(f".{file.name}.{os.getpid()}.part")
        try:
            try:
                with part.open("w", encoding="ascii") as out:
                    out.write(f"{number}\n")
                    out.flush()
                    # Without it, a power failure may leave an empty file under the final name.
                    os.fsync(out.fileno())
                part.replace(file)
            finally:
                part.unlink(missing_ok=True)
        except OSError as error:
            why = (error.strerror or "").lower()
            raise FlightError(
                f"the flight number cannot be stored in `{self._file}` ({why}); make its folder "
                "writable."
            ) from None
