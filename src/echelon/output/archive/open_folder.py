"""Read a run's folder: its dataset, its partial results, or its gain."""

from pathlib import Path
from typing import NamedTuple

from echelon.core.errors import OutputError
from echelon.core.types import PathLike
from echelon.experiments.results.recording import Recording, read_recording
from echelon.experiments.scenario.scenario import SCENARIO_FILE
from echelon.guarantees.verifier.strict_json import read_json
from echelon.guarantees.verifier.verify import states_gain
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


class ClaimFiles(NamedTuple):
    """Files with claims about a run's gain or law, and what belongs to them; None for each absent.

    Attributes:
        gain: a gain file.
        claims: the summary of a run, or the output of a check.
        data: the dataset of the run.
        scenario: the scenario of the run.
    """

    gain: Path | None = None
    claims: Path | None = None
    data: Path | None = None
    scenario: Path | None = None


def claim_files(place: PathLike) -> ClaimFiles:
    """Return the files of a run that `verify` reads.

    Args:
        place: the folder of a run, its summary, a gain file, or the output of a check.

    Raises:
        GainError: a file cannot be read, or is no JSON.
        OutputError: the folder holds no claims, or its gain file is missing.
    """
    path = Path(place)
    if path.name == SUMMARY and (path.parent / SCENARIO_FILE).is_file():
        path = path.parent
    if not path.is_dir():
        return ClaimFiles(path) if states_gain(read_json(path)) else ClaimFiles(claims=path)
    names = GAIN, SUMMARY, DATA, SCENARIO_FILE
    files = ClaimFiles(*(path / name if (path / name).is_file() else None for name in names))
    if files.claims is None and files.gain is None:
        state = "an unfinished run" if Chunks(path).exist else "no run"
        raise OutputError(f"`{path}` holds {state}: it has neither `{SUMMARY}` nor `{GAIN}`.")
    summary = {"promise": None} if files.claims is None else read_json(files.claims)
    if files.gain is None and summary.get("gain") is not None:
        raise OutputError(
            f"`{path}` has lost its `{GAIN}`; `echelon run {path} --out OTHER` creates it."
        )
    if "promise" not in summary:
        raise OutputError(f"`{files.claims}` is damaged: it has no `promise`.")
    return files
