"""What a run leaves in its folder while it lasts: a file a stretch, and what going on rests on."""

import contextlib
import hashlib
import io
import json
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, final

import numpy as np

from echelon.core.errors import OutputError
from echelon.core.files import write_atomic
from echelon.core.provenance import versions
from echelon.experiments.scenario.scenario import KEPT, Scenario
from echelon.experiments.scenario.self_contained import self_contained
from echelon.output.archive.folder import CHUNKS, INPUTS, unwritable
from echelon.simulation.engine.record import Stretch
from echelon.simulation.step.meter import Sums

_BEGUN = "begun.json"
_DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
"""What reading a file that is cut short or was changed may raise."""


@final
class Chunks:
    """The stretches of one run in its folder, each named by the step at which it begins.

    So those of two processes that computed the same run fit together, wherever each was cut.

    Args:
        folder: of the run.
        by: the folder in it where they are.
    """

    def __init__(self, folder: Path, by: str = CHUNKS) -> None:
        """Take the folder."""
        self.folder, self.place = folder, folder / by

    @property
    def exist(self) -> bool:
        """Whether the run may go on."""
        return self.place.is_dir()

    @property
    def hold_any(self) -> bool:
        """Whether a stretch was written."""
        return any(self.place.glob("*.npz"))

    def begin(self, scenario: Scenario, more: Mapping[str, str] = MappingProxyType({})) -> None:
        """Write the scenario with all files that it names, before anything is computed.

        `more` are texts that the numbers rest on too, by their names among these files.

        Raises:
            OutputError: a file cannot be written.
        """
        text, files = self_contained(scenario, INPUTS)
        try:
            for name, source in files.items():
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                write_atomic(self.folder / name, source.read_bytes())
            for name, told in more.items():
                (self.folder / INPUTS).mkdir(exist_ok=True)
                write_atomic(self.folder / INPUTS / name, told)
            write_atomic(self.folder / KEPT, text)
            begun = {"inputs": self._digest(), "versions": versions()}
            write_atomic(self.place / _BEGUN, json.dumps(begun) + "\n")
        except OSError as error:
            raise unwritable(self.folder, error) from error

    def check(self) -> None:
        """Check that what the run is computed from is what it was begun with.

        Raises:
            OutputError: it is not, or is computed by other versions, which round otherwise.
        """
        try:
            begun = json.loads((self.place / _BEGUN).read_text("utf-8"))
        except _DAMAGED as error:
            raise OutputError(
                f"`{self.folder}` holds no run that can go on; give the folder of one that ended."
            ) from error
        if begun["inputs"] != self._digest():
            raise OutputError(
                f"the scenario in `{self.folder}` was changed since the run began, so it cannot go "
                f"on; `echelon run {self.folder}` runs what is there now from the start."
            )
        for name, version in versions().items():
            before = begun["versions"].get(name)
            # Unknown where the checkout could not be asked.
            if before not in (None, version):
                raise OutputError(
                    f"the run in `{self.folder}` was begun under {name} `{before}`, and this is "
                    f"`{version}`, which may round otherwise; `echelon run {self.folder}` runs it "
                    "from the start."
                )

    def _digest(self) -> str:
        """Return a number that changes with the scenario and with every file that it names."""
        files = [self.folder / KEPT, *sorted((self.folder / INPUTS).rglob("*"))]
        digest = hashlib.sha256()
        for file in (file for file in files if file.is_file()):
            # Names too, each ended by a byte that no name has: the same bytes under other names are
            # other inputs.
            digest.update(file.relative_to(self.folder).as_posix().encode() + b"\0")
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()

    def write(self, stretch: Stretch) -> None:
        """Write a stretch, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        self.store(stretch.first, _arrays(stretch))

    def store(self, first: int, arrays: Mapping[str, Any]) -> None:
        """Write arrays under a number, whole or not at all.

        Raises:
            OSError: they cannot be written.
        """
        # In memory first, since a file is written whole or not at all.
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        write_atomic(self.place / f"{first}.npz", content.getvalue())

    def stored(self, first: int) -> dict[str, Any] | None:
        """Return the arrays under a number; None where they are missing or damaged."""
        try:
            # A pickle would run what it holds, and a folder may come from others.
            with np.load(self.place / f"{first}.npz", allow_pickle=False) as stored:
                return dict(stored)
        except _DAMAGED:
            return None

    def read(self) -> list[Stretch]:
        """Return the stretches in their order, up to the first that is missing or damaged."""
        return list(self._read())

    def _read(self) -> Iterator[Stretch]:
        first, done = -1, 0
        while first != done:
            first = done
            stored = self.stored(first)
            try:
                stretch = _stretch(first, stored or {})
            except _DAMAGED:
                return
            yield stretch
            done = stretch.done

    def remove(self) -> None:
        """Remove them all."""
        shutil.rmtree(self.place, ignore_errors=True)

    def forget(self) -> None:
        """Remove all that `begin` wrote, where nothing was computed since."""
        if not self.exist or self.hold_any:
            return
        self.remove()
        shutil.rmtree(self.folder / INPUTS, ignore_errors=True)
        # A folder in which a person has put something meanwhile is not empty, and stays.
        with contextlib.suppress(OSError):
            (self.folder / KEPT).unlink(missing_ok=True)
            self.folder.rmdir()


def _arrays(stretch: Stretch) -> dict[str, Any]:
    """Return a stretch as named arrays."""
    plain = {name: getattr(stretch, name) for name in _PLAIN}
    sums = {f"sums_{name}": value for name, value in stretch.sums._asdict().items()}
    moment = {f"moment_{k}": value for k, value in enumerate(stretch.moment)}
    told = {"reference": stretch.reference, "stopped": stretch.stopped}
    return {**plain, **sums, **moment, **{k: v for k, v in told.items() if v is not None}}


_PLAIN = ("done", "times", "states", "inputs", "seconds")


def _stretch(first: int, stored: dict[str, Any]) -> Stretch:
    """Return the stretch of named arrays."""
    count = sum(name.startswith("moment_") for name in stored)
    stopped = stored.get("stopped")
    return Stretch(
        first=first,
        done=int(stored["done"]),
        times=stored["times"],
        states=stored["states"],
        inputs=stored["inputs"],
        reference=stored.get("reference"),
        sums=Sums(*(stored[f"sums_{name}"] for name in Sums._fields)),
        moment=tuple(stored[f"moment_{k}"] for k in range(count)),
        stopped=None if stopped is None else str(stopped),
        seconds=float(stored["seconds"]),
    )
