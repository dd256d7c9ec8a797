"""Read a run's folder: its dataset, its partial results, or its gain."""

import json
from pathlib import Path

from echelon.core.errors import OutputError
from echelon.core.types import JsonObject, PathLike
from echelon.experiments.results.recording import Recording, read_recording
from echelon.guarantees.verifier.tube_claims import read_tube
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import DATA, GAIN, SUMMARY, check_exists


def open_run(place: PathLike) -> Recording:
    """Return the run in a folder, or in a netCDF file such as its `run.nc`.

    Of an unfinished run it is the part that was computed.

    Raises:
        OutputError: there is none, it is damaged, or of another version.
        ScenarioError: the scenario of an unfinished run cannot be read.
    """
    path = check_exists(Path(place))
    if path.is_file():
        return read_recording(path)
    if (path / DATA).is_file():
        return read_recording(path / DATA)
    if path.is_dir() and Chunks(path).exist:
        # Here, since building the scenario's parts loads JAX.
        from echelon.experiments.results.dataset import recording_of
        from echelon.output.archive.run_folder import load_run

        return recording_of(load_run(path))
    if (path / "comparison.json").is_file():
        raise OutputError(f"`{path}` is a comparison; give one of its runs, `{path}/runs/NAME.nc`.")
    raise OutputError(f"the folder `{path}` holds no run: it has no `{DATA}`.")


def promise_file(place: PathLike) -> Path:
    """Return the file with the claims about a run's gain or law, which `verify` reads.

    Args:
        place: the folder of a run; or such a file, which is returned as it is.

    Raises:
        OutputError: the folder holds no such file.
    """
    path = Path(place)
    if not path.is_dir():
        return path
    # A law without a gain has its tube, if any, in the summary.
    if (path / GAIN).is_file() or not (path / SUMMARY).is_file():
        return path / GAIN
    if read_tube(path / SUMMARY) is None:
        if _summary(path / SUMMARY).get("gain") is not None:
            raise OutputError(
                f"`{path}` has lost its `{GAIN}`; `echelon run {path} --out OTHER` creates it."
            )
        raise OutputError(f"the law in `{path}` has neither a gain nor a tube to verify.")
    return path / SUMMARY


def _summary(file: Path) -> JsonObject:
    """Return the summary in a file.

    Raises:
        OutputError: the file is damaged.
    """
    try:
        summary = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"`{file}` cannot be read, or is damaged: {error}.") from error
    if not isinstance(summary, dict):
        raise OutputError(f"`{file}` is damaged: it must hold a mapping.")
    return summary
