"""A run or a sweep that is written to its folder while it is computed, and can be continued."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal, final

import typer

from echelon.core.errors import OutputError

if TYPE_CHECKING:
    from echelon.output.archive.chunks import Chunks


@final
class Job:
    """Work of a command whose results are stored part by part.

    Args:
        command: that computes it.
        chunks: the parts that are stored.
    """

    def __init__(self, command: Literal["run", "sweep"], chunks: "Chunks") -> None:
        """Store the parts in the folder of the chunks."""
        self.command, self.chunks = command, chunks

    @property
    def folder(self) -> Path:
        """The folder of the output."""
        return self.chunks.folder

    @property
    def remainder(self) -> str:
        """What is left of the work where it ended early, and how to continue it."""
        if not self.chunks.hold_any:
            return "no results could be saved"
        resume = f"echelon {self.command} --resume {self.folder}"
        return f"partial results are saved, and `{resume}` continues"

    def resume(self, dataset: str) -> None:
        """Check that the work can be continued; leave the program where its dataset is complete.

        Raises:
            OutputError: the folder holds no such work, or its inputs changed.
        """
        if not self.chunks.exist and (self.folder / dataset).is_file():
            print(f"echelon: the {self.command} in `{self.folder}` is complete; nothing to do.")
            raise typer.Exit()
        self.chunks.check()

    @contextlib.contextmanager
    def cleanup(self) -> Iterator[None]:
        """Remove the folder if the work ends before any part of it is stored."""
        try:
            yield
        except BaseException:
            self.chunks.forget()
            raise


def check_inputs(command: str, scenario: str | None, resume: Path | None, *others: object) -> None:
    """Check that a command is given either a scenario or a folder to continue.

    Raises:
        OutputError: it is given neither, or other inputs beside the folder.
    """
    if resume is None and scenario is None:
        raise OutputError(
            f"no scenario was given; give one, or `--resume` with the folder of a {command}."
        )
    if resume is not None and (scenario is not None or any(others)):
        raise OutputError("`--resume` takes its inputs from the folder; give no others.")
