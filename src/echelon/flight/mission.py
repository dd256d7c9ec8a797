"""The folder of a flight: flight.json, and the exported law of each agent."""

import hashlib
import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any, final

from echelon.core.errors import FlightError

FACTS = "flight.json"


@final
class Mission:
    """A prepared flight.

    Args:
        folder: with flight.json, and a folder `law-K` for agent K.

    Attributes:
        folder: likewise.
        facts: the content of flight.json.

    Raises:
        FlightError: it is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        """Read flight.json."""
        self.folder, self.facts = folder, _read(folder / FACTS)

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
        facts, file = _read(self.folder / f"law-{number}" / "law.json"), self._file(number)
        if hashlib.sha256(file.read_bytes()).hexdigest() != facts["sha256"]["law.py"]:
            raise FlightError(f"`{file}` is not the file that its law.json describes.")
        if facts["formation"] != self.facts["formation"]:
            raise FlightError(
                f"the law in `{file.parent}` is of another formation than `{self.folder}`; write "
                "both again from one scenario."
            )
        return load_module(file), facts

    def _file(self, number: int) -> Path:
        file = self.folder / f"law-{number}" / "law.py"
        if not file.is_file():
            raise FlightError(f"`{file}` does not exist.")
        return file


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
