"""A run's folder, read again: the recording of its `run.nc`, or of what was computed of it."""

from pathlib import Path

from echelon.archive.chunks import Chunks
from echelon.archive.folder import DATA
from echelon.core.errors import OutputError
from echelon.core.types import PathLike
from echelon.results.recording import Recording, read_recording


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
        from echelon.archive.run import load_run
        from echelon.results.dataset import dataset
        from echelon.results.recording import recording

        return recording(dataset(load_run(path)))
    if not path.exists():
        raise OutputError(f"`{path}` does not exist; give the folder of a run, or its `{DATA}`.")
    if (path / "comparison.json").is_file():
        raise OutputError(f"`{path}` is a comparison; give one of its runs, `{path}/runs/NAME.nc`.")
    raise OutputError(f"the folder `{path}` holds no `{DATA}`, and so no run.")
