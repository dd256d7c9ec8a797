"""A run's numbers for other programs: CSV, Parquet, NumPy, MATLAB."""

import io
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.errors import MissingExtraError, OutputError, check_name

if TYPE_CHECKING:
    import pandas as pd

    from echelon.core.types import JsonObject
    from echelon.experiments.results.recording import Recording


def content_of(kind: str) -> "Callable[[Recording], bytes]":
    """Return the writer of a format.

    `csv` and `parquet` have one row per agent and time, `npz` and `mat` arrays.

    Raises:
        OutputError: there is no such format.
    """
    check_name("`--to` is", kind, _WRITERS, OutputError)
    return _WRITERS[kind]


def table(run: "Recording") -> "pd.DataFrame":
    """Return one row per agent and time: states and inputs by name, and the formation error."""
    import pandas as pd

    frames, agents = run.states.shape[:2]
    leads = np.isin(np.arange(agents), run.leaders)
    columns: JsonObject = {
        "time": np.repeat(run.times, agents),
        "agent": np.tile(np.arange(agents), frames),
        "leader": np.tile(leads, frames),
    }
    for k, name in enumerate(run.state_names):
        columns[name] = run.states[:, :, k].ravel()
    for k, name in enumerate(run.input_names):
        # A state and an input may share a name, such as a thrust that is both.
        columns[name if name not in columns else f"input_{name}"] = run.inputs[:, :, k].ravel()
    columns["formation_error"] = run.formation_errors.ravel()
    return pd.DataFrame(columns)


def _csv(run: "Recording") -> bytes:
    return table(run).to_csv(index=False).encode()


def _parquet(run: "Recording") -> bytes:
    content = io.BytesIO()
    try:
        table(run).to_parquet(content, index=False)
    except ImportError as error:
        raise MissingExtraError(
            "Parquet needs pyarrow, which is not installed; "
            "`pip install 'echelon-formation[parquet]'`, or use `--to csv`."
        ) from error
    return content.getvalue()


def _arrays(run: "Recording") -> "JsonObject":
    """Return the arrays of a run by name."""
    arrays: JsonObject = {
        "time": run.times,
        "states": run.states,
        "inputs": run.inputs,
        "error": run.errors,
        "formation_error": run.formation_errors,
        "offsets": run.offsets,
        "edges": run.edges,
        "weights": run.weights,
        "leaders": np.array(run.leaders),
        "state_names": np.array(run.state_names),
        "state_units": np.array(run.state_units),
        "input_names": np.array(run.input_names),
        "input_units": np.array(run.input_units),
    }
    more = {"reference": run.reference, "lyapunov": run.lyapunov, "P": run.metric}
    return arrays | {name: value for name, value in more.items() if value is not None}


def _npz(run: "Recording") -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **_arrays(run))
    return content.getvalue()


def _mat(run: "Recording") -> bytes:
    from scipy.io import savemat

    content = io.BytesIO()
    # Texts as cell arrays, MATLAB's type for names; agents are numbered from 0 here too.
    arrays = {
        name: value.astype(object) if value.dtype.kind == "U" else value
        for name, value in _arrays(run).items()
    }
    savemat(content, arrays, do_compression=True, oned_as="column")
    return content.getvalue()


_WRITERS: "dict[str, Callable[[Recording], bytes]]" = {
    "csv": _csv,
    "parquet": _parquet,
    "npz": _npz,
    "mat": _mat,
}
