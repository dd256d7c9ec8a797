"""The files of a run's folder that make claims."""

from pathlib import Path
from typing import NamedTuple

from echelon.core.errors import OutputError
from echelon.core.types import PathLike
from echelon.experiments.scenario.scenario import SCENARIO_FILE
from echelon.guarantees.verifier.saved_gain import read_json
from echelon.guarantees.verifier.verify import states_gain
from echelon.output.archive.chunks import Chunks
from echelon.output.archive.folder import DATA, GAIN, SUMMARY, check_exists


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
        OutputError: there is nothing, or nothing that makes claims; or a gain file is missing.
    """
    path = _place(Path(place))
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


def _place(path: Path) -> Path:
    """Return the folder or file that a path means, after checking that it may make claims."""
    if not path.exists():
        raise OutputError(f"`{path}` does not exist; give the folder of a run, or a gain file.")
    check_exists(path)
    if path.name == DATA:
        raise OutputError(
            f"`{path}` is data alone; give the folder in which it is, `{path.parent}`."
        )
    within = path.name == SUMMARY and (path.parent / SCENARIO_FILE).is_file()
    return path.parent if within else path
