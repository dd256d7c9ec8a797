"""Matrices of a linear system in a MATLAB file."""

from collections.abc import Mapping

import numpy as np

from echelon.core.errors import ModelError, listing
from echelon.core.types import Array, PathLike

_NAMES = ("A", "B", "C", "D", "Ts")


def read_matrices(file: PathLike) -> dict[str, Array]:
    """Return the matrices A and B of a `.mat` file, and C, D and Ts where it has them.

    Raises:
        ModelError: the file cannot be read, or lacks A or B.
    """
    content = _content(file)
    names = [name for name in content if not name.startswith("__")]
    missing = [name for name in ("A", "B") if name not in names]
    if missing:
        held = f"holds {listing(names)}" if names else "is empty"
        raise ModelError(
            f"`{file}` lacks {listing(missing)} and {held}; save the matrices by themselves, as in "
            "`save('plant.mat', 'A', 'B', 'C', 'D')`."
        )
    return {name: _dense(content[name]) for name in _NAMES if name in names}


def _content(file: PathLike) -> Mapping[str, object]:
    """Return all that a MATLAB file holds, by name."""
    # Imported here: few models are in files, and SciPy's readers load slowly.
    from scipy.io import loadmat

    try:
        return loadmat(str(file), appendmat=False)
    except NotImplementedError:
        raise ModelError(
            f"`{file}` is a MATLAB file of version 7.3; save it with `save(..., '-v7')`."
        ) from None
    except OSError as error:
        raise ModelError(f"`{file}` cannot be read: {error.strerror or error}.") from None
    except Exception as error:  # SciPy raises whatever a damaged file causes
        raise ModelError(f"`{file}` is not a MATLAB file that can be read: {error}.") from None


def _dense(value: object) -> Array:
    """Return a matrix that MATLAB may have stored as a sparse one."""
    to_array = getattr(value, "toarray", None)
    return np.asarray(value if to_array is None else to_array())
