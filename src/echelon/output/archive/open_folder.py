"""A run's folder, read again: the recording of its `run.nc`, or of what was computed of it."""

import json
from pathlib import Path
from typing import Any

from echelon.core.errors import OutputError
from echelon.core.types import PathLike
from echelon.experiments.results.recording import Recording, read_recording
from echelon.guarantees.verifier.tube_claims import read_tube
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import DATA, GAIN, SUMMARY


def open_run(place: PathLike) -> Recording:
    """Return the run in a folder, or in a netCDF file such as its `run.nc`.

    Of a run that was ended from outside it is what was computed.

    Raises:
        OutputError: there is none, it is damaged, or of another version.
        ScenarioError: the scenario of a run that was ended cannot be read.
    """
    path = Path(place)
    if path.is_file():
        return read_recording(path)
    if (path / DATA).is_file():
        return read_recording(path / DATA)
    if path.is_dir() and Chunks(path).exist:
        # Here, since it builds the scenario's parts, which loads JAX.
        from echelon.experiments.results.dataset import dataset
        from echelon.experiments.results.recording import recording
        from echelon.output.archive.run_folder import load_run

        return recording(dataset(load_run(path)))
    if not path.exists():
        raise OutputError(f"`{path}` does not exist; give the folder of a run, or its `{DATA}`.")
    if (path / "comparison.json").is_file():
        raise OutputError(f"`{path}` is a comparison; give one of its runs, `{path}/runs/NAME.nc`.")
    raise OutputError(f"the folder `{path}` holds no `{DATA}`, and so no run.")


def promise_file(place: PathLike) -> Path:
    """Return the file that holds what a run's gain, or its law, promises: what `verify` takes.

    Args:
        place: the folder of a run; or such a file itself, which is returned as it is.

    Raises:
        OutputError: nothing that its law promises is kept there.
    """
    path = Path(place)
    if not path.is_dir():
        return path
    # A law without a gain leaves its tube, where it has one, in the summary.
    if (path / GAIN).is_file() or not (path / SUMMARY).is_file():
        return path / GAIN
    if read_tube(path / SUMMARY) is None:
        if _summary(path / SUMMARY).get("gain") is not None:
            raise OutputError(
                f"`{path}` has lost its `{GAIN}`; `echelon run {path} --out OTHER` makes it again."
            )
        raise OutputError(f"the law of `{path}` left neither a gain nor a tube to verify.")
    return path / SUMMARY


def _summary(file: Path) -> dict[str, Any]:
    """Return the summary in a file.

    Raises:
        OutputError: the file is damaged.
    """
    try:
        told = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"`{file}` cannot be read, or is damaged: {error}.") from error
    if not isinstance(told, dict):
        raise OutputError(f"`{file}` is damaged: it holds no mapping.")
    return told
