"""The partial results of a run in its folder, from which it can be continued."""

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
from echelon.core.files import INPUTS, versions, write_atomic
from echelon.core.types import JsonObject
from echelon.experiments.scenario.scenario import SCENARIO_FILE, Scenario
from echelon.experiments.scenario.self_contained import self_contained
from echelon.output.archive.folder import CHUNKS, write_errors
from echelon.simulation.engine.record import Segment
from echelon.simulation.step.meter import Sums

_BEGUN = "begun.json"
_DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
"""Errors of reading a file that is truncated or was changed."""


@final
class Chunks:
    """The stretches of one run in its folder, each in a file named by its first step.

    So stretches that two processes computed of the same run fit together.
    """

    def __init__(self, folder: Path, by: str = CHUNKS) -> None:
        self.folder, self.place = folder, folder / by

    @property
    def exist(self) -> bool:
        """Whether there is an unfinished run."""
        return self.place.is_dir()

    @property
    def hold_any(self) -> bool:
        """Whether a stretch is stored."""
        return any(self.place.glob("*.npz"))

    def begin(
        self,
        scenario: Scenario,
        more: Mapping[str, str] = MappingProxyType({}),
        figures: bool = True,
    ) -> None:
        """Write the scenario and all files that it names, before anything is computed.

        `more` are further inputs, as texts by the name of their file; `figures` is whether figures
        are to be drawn.

        Raises:
            OutputError: a file cannot be written.
        """
        text, files = self_contained(scenario)
        with write_errors(self.folder):
            for name, source in files.items():
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                write_atomic(self.folder / name, source.read_bytes())
            for name, content in more.items():
                (self.folder / INPUTS).mkdir(exist_ok=True)
                write_atomic(self.folder / INPUTS / name, content)
            write_atomic(self.folder / SCENARIO_FILE, text)
            begun = {"inputs": self._digest(), "versions": versions(), "figures": figures}
            write_atomic(self.place / _BEGUN, json.dumps(begun) + "\n")

    def check(self) -> None:
        """Check that inputs and versions are those with which the run began.

        Raises:
            OutputError: they are not, so that its numbers could differ.
        """
        begun = self._begun()
        if begun["inputs"] != self._digest():
            raise OutputError(
                f"the scenario in `{self.folder}` was changed since the run began, so it cannot be "
                f"continued; `echelon run {self.folder}` starts a new run of it."
            )
        for name, version in versions().items():
            before = begun["versions"].get(name)
            # Unknown where the checkout could not be asked.
            if before not in (None, version):
                raise OutputError(
                    f"the run in `{self.folder}` began with {name} `{before}`, and `{version}` is "
                    f"installed, which may round differently; `echelon run {self.folder}` starts a "
                    "new run."
                )

    @property
    def figures(self) -> bool:
        """Whether figures are to be drawn, as was asked when the run began."""
        return bool(self._begun().get("figures", True))

    def _begun(self) -> JsonObject:
        try:
            return json.loads((self.place / _BEGUN).read_text("utf-8"))
        except _DAMAGED as error:
            raise OutputError(
                f"`{self.folder}` holds no unfinished run; give the folder of one."
            ) from error

    def _digest(self) -> str:
        files = [self.folder / SCENARIO_FILE, *sorted((self.folder / INPUTS).rglob("*"))]
        digest = hashlib.sha256()
        for file in (file for file in files if file.is_file()):
            # Names too, each followed by a byte that no name has: the same bytes under other names
            # are other inputs.
            digest.update(file.relative_to(self.folder).as_posix().encode() + b"\0")
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        return digest.hexdigest()

    def write(self, segment: Segment) -> None:
        """Write a stretch completely or not at all.

        Raises:
            OSError: it cannot be written.
        """
        self.store(segment.first, _arrays(segment))

    def store(self, first: int, arrays: Mapping[str, Any]) -> None:
        """Write arrays under a number, completely or not at all.

        Raises:
            OSError: they cannot be written.
        """
        # In memory first, since `write_atomic` takes all bytes of a file.
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        write_atomic(self.place / f"{first}.npz", content.getvalue())

    def stored(self, first: int) -> JsonObject | None:
        """Return the arrays under a number; None where they are missing or damaged."""
        try:
            # A pickle could run any code, and a folder may come from others.
            with np.load(self.place / f"{first}.npz", allow_pickle=False) as stored:
                return dict(stored)
        except _DAMAGED:
            return None

    def read(self) -> list[Segment]:
        """Return the stretches in order, up to the first that is missing or damaged."""
        return list(self._read())

    def _read(self) -> Iterator[Segment]:
        first, done = -1, 0
        while first != done:
            first = done
            stored = self.stored(first)
            try:
                segment = _segment(first, stored or {})
            except _DAMAGED:
                return
            yield segment
            done = segment.done

    def remove(self) -> None:
        """Remove them all."""
        shutil.rmtree(self.place, ignore_errors=True)

    def forget(self) -> None:
        """Remove all that `begin` wrote, if nothing was computed since."""
        if not self.exist or self.hold_any:
            return
        self.remove()
        shutil.rmtree(self.folder / INPUTS, ignore_errors=True)
        # A folder that a user has put a file into is not empty, and stays.
        with contextlib.suppress(OSError):
            (self.folder / SCENARIO_FILE).unlink(missing_ok=True)
            self.folder.rmdir()


def _arrays(segment: Segment) -> JsonObject:
    plain = {name: getattr(segment, name) for name in _PLAIN}
    sums = {f"sums_{name}": value for name, value in segment.sums._asdict().items()}
    moment = {f"moment_{k}": value for k, value in enumerate(segment.moment)}
    optional = {name: getattr(segment, name) for name in ("reference", "stopped")}
    return {**plain, **sums, **moment, **{k: v for k, v in optional.items() if v is not None}}


_PLAIN = ("done", "times", "states", "inputs", "seconds")


def _segment(first: int, stored: JsonObject) -> Segment:
    count = sum(name.startswith("moment_") for name in stored)
    stopped = stored.get("stopped")
    return Segment(
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
