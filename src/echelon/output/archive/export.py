"""A run's numbers for other programs: as a table, and as files of their formats."""

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.errors import MissingExtraError, OutputError, check_kind, check_name
from echelon.core.files import write_atomic
from echelon.core.gone import VALUES, gone
from echelon.core.limits import excess_rows

if TYPE_CHECKING:
    import pandas as pd

    from echelon.core.types import JsonObject, PathLike
    from echelon.experiments.results.recording import Recording
    from echelon.simulation.engine.result import Result


def table(run: "Result | Recording", every: int = 1) -> "pd.DataFrame":
    """Return one row per time and agent that is there, with a column for each state and input.

    The columns are `time` (s), `agent`, `leader` (whether it leads then), the states and inputs by
    name (an input that has the name of a state as `input_NAME`), and `formation_error`, the
    distance from the goal. `attrs["units"]` has the unit of each column that has one.

    Args:
        run: a result.
        every: takes every so-manieth stored frame.

    Raises:
        OutputError: the table would not fit in memory, with its size; or `every` is no whole
            number from 1 on.
    """
    import pandas as pd

    from echelon.experiments.results.recording import Recording, recording_of
    from echelon.simulation.engine.result import Result

    if not isinstance(run, Recording):
        check_kind("result", run, Result)
    if not isinstance(every, int | np.integer) or every < 1:
        raise OutputError(f"`every` is {every}, and must be a whole number from 1 on.")
    # Before errors are computed, which take as much memory as the states.
    frames, (_, agents, n) = len(run.times[::every]), run.states.shape
    excess = excess_rows(frames * agents, 4 + n + run.inputs.shape[2])
    if excess is not None:
        raise OutputError(f"the table is too large: {excess}; take fewer frames with `every`.")
    run = recording_of(run)
    states, inputs = run.states[::every], run.inputs[::every]
    columns: JsonObject = {
        "time": np.repeat(run.times[::every], agents),
        "agent": np.tile(np.arange(agents), frames),
        "leader": (run.nearest_then[::every] == np.arange(agents)).ravel(),
        **{name: states[:, :, k].ravel() for k, name in enumerate(run.state_names)},
    }
    units = {"time": "s", **dict(zip(run.state_names, run.state_units, strict=True))}
    for k, (name, unit) in enumerate(zip(run.input_names, run.input_units, strict=True)):
        # A state and an input may share a name, such as a thrust that is both.
        name = f"input_{name}" if name in columns else name
        columns[name], units[name] = inputs[:, :, k].ravel(), unit
    columns["formation_error"] = run.goal_distances(slice(None, None, every)).ravel()
    units["formation_error"] = run.length_unit
    frame = pd.DataFrame(columns)
    # What is stored of an agent that is absent is where it was lost, and no motion.
    if run.presence is not None:
        frame = frame.loc[run.presence[::every].ravel(), :].reset_index(drop=True)
    frame.attrs["units"] = {name: unit for name, unit in units.items() if unit}
    return frame


def export(run: "Result", path: "PathLike", force: bool = False) -> Path:
    """Write a run as a file for other programs, and return its path.

    The ending chooses the format: `.csv` and `.parquet` have the columns of `table`, `.npz` and
    `.mat` (MATLAB) arrays (times, agents, states), `.nc` is the `run.nc` of a folder, `.html` the
    page that `echelon view` shows, and `.mcap` a bag of ROS 2. Videos are written by `save_video`.

    Args:
        run: a result.
        path: of the file.
        force: whether to replace a file.

    Raises:
        OutputError: there is no such format, the run has no stored frame, the file exists, or it
            cannot be written.
        MissingExtraError: pyarrow, of Parquet, rosbags, or the page's three.js is not installed.
    """
    from echelon.output.archive.folder import IN_PYTHON, claim_file, write_errors

    file = Path(path)
    if not file.suffix:
        raise OutputError(f"`{file.name}` has no ending, such as `.csv`, to choose the format.")
    content = content_of(file.suffix.lower().removeprefix("."), f"`{file.name}` ends in")
    claim_file(file, force, how=IN_PYTHON)
    with write_errors(file):
        write_atomic(file, content(run))
    return file


def content_of(kind: str, what: str = "`--to` is") -> "Callable[..., bytes]":
    """Return the writer of a format; `what` begins the message if there is none.

    The writer takes a run, which it refuses without a stored frame, and the report beside it.

    Raises:
        OutputError: there is no such format.
    """
    if ended := gone(VALUES, f"export --to {kind}"):
        raise OutputError(f"the format `{kind}`{ended}")
    check_name(what, kind, _WRITERS, OutputError)

    def content(run: "Result", numbers: str = "") -> bytes:
        if not len(run.times):
            raise OutputError("the run has no stored frame; an export needs at least one.")
        return _page(run, numbers) if kind == "html" else _WRITERS[kind](run)

    return content


def _parquet(run: "Result") -> bytes:
    content = io.BytesIO()
    try:
        table(run).to_parquet(content, index=False)
    except ImportError as error:
        raise MissingExtraError(
            "Parquet needs pyarrow, which is not installed; "
            "`pip install '.[parquet]'` in echelon's clone, or use `csv`."
        ) from error
    return content.getvalue()


def _arrays(run: "Result") -> "JsonObject":
    from echelon.experiments.results.recording import recording_of

    data = recording_of(run)
    arrays: JsonObject = {
        "time": data.times,
        "states": data.states,
        "inputs": data.inputs,
        "error": data.errors,
        "formation_error": data.formation_errors,
        "offsets": data.offsets,
        "edges": data.edges,
        "weights": data.weights,
        "leaders": np.array(data.leaders),
        "state_names": np.array(data.state_names),
        "state_units": np.array(data.state_units),
        "input_names": np.array(data.input_names),
        "input_units": np.array(data.input_units),
    }
    more = {"reference": data.reference, "lyapunov": data.lyapunov, "P": data.metric}
    return arrays | {name: value for name, value in more.items() if value is not None}


def _npz(run: "Result") -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **_arrays(run))
    return content.getvalue()


def _mat(run: "Result") -> bytes:
    from scipy.io import savemat

    content = io.BytesIO()
    # Texts as cell arrays, MATLAB's type for names; agents are numbered from 0 here too.
    arrays = {
        name: value.astype(object) if value.dtype.kind == "U" else value
        for name, value in _arrays(run).items()
    }
    savemat(content, arrays, do_compression=True, oned_as="column")
    return content.getvalue()


def _netcdf(run: "Result") -> bytes:
    from echelon.experiments.results.dataset import run_file

    return run_file(run)


def _page(run: "Result", numbers: str = "") -> bytes:
    from echelon.experiments.results.dataset import STORED
    from echelon.experiments.results.recording import recording_of
    from echelon.output.reports.run_report import report, whole_report
    from echelon.output.viewer.page import check_page
    from echelon.output.viewer.replay import replay_page

    check_page()
    data = recording_of(run)
    # The parts of a run from disk are not built, which executes code, only to show it.
    text = whole_report(data, numbers if run in STORED else report(run))
    return replay_page(data, reports=[text]).encode()


def _mcap(run: "Result") -> bytes:
    from echelon.output.archive.bags import mcap_content

    return mcap_content(run)


_WRITERS: "dict[str, Callable[[Result], bytes]]" = {
    "csv": lambda run: table(run).to_csv(index=False).encode(),
    "parquet": _parquet,
    "npz": _npz,
    "mat": _mat,
    "nc": _netcdf,
    "html": _page,
    "mcap": _mcap,
}

_HEAD = """# For Crazyswarm2, by echelon. Edit the addresses. Before the start each vehicle
# stands at its `initial_position`, below the first point of its CSV file.
robots:
"""
_TAIL = """robot_types:
  crazyflie:
    motion_capture:
      enabled: true
      tracking: librigidbodytracker
      marker: default_single_marker
      dynamics: default
    big_quad: false
    battery:
      voltage_warning: 3.8 # V
      voltage_critical: 3.7 # V
all:
  firmware_params:
    stabilizer:
      estimator: 2 # Kalman
      controller: 2 # Mellinger
"""


def swarm_text(begins: Sequence[Sequence[float]]) -> str:
    """Return the file for agents whose paths begin at points (x, y, z, ...), m."""
    robots = [
        f"  agent{k}:\n    enabled: true\n    uri: radio://0/80/2M/E7E7E7E7{k + 1:02X}\n"
        f"    initial_position: [{x:.4f}, {y:.4f}, 0.0]\n    type: crazyflie\n"
        for k, (x, y, *_) in enumerate(begins)
    ]
    return _HEAD + "".join(robots) + _TAIL
