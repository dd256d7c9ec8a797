"""Modes that forbid every constant metric: unstable ones, and Jordan blocks on the axis."""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from echelon.core.errors import GainError
from echelon.core.types import Array

AXIS = 1e-9
"""Eigenvalues closer to the imaginary axis, in units of the norm, count as on it."""
_DEFECTIVE = 1e-6  # a spectral projector of norm 1e6 would need a P of condition 1e12


class Obstacle(NamedTuple):
    """A mode that no constant metric can keep from growing.

    Attributes:
        vertex: which matrix has it.
        eigenvalue: 1/s; on the imaginary axis where the mode is `defective`.
        defective: whether it is a Jordan block on the axis rather than an unstable mode.
        states: indices of the states that take part, those that feed a Jordan block included.
    """

    vertex: int
    eigenvalue: complex
    defective: bool
    states: tuple[int, ...]


def obstacle(As: Array) -> Obstacle | None:
    """Return the first mode that forbids every P > 0 with P A_k + A_k'P <= 0, or None.

    It is an eigenvalue in the open right half plane, or one on the imaginary axis with a Jordan
    block: where A - s I and its square differ in rank, that is where the left and the right null
    space of A - s I do not pair. Singular values decide, relative to the norm of the balanced A.
    """
    for vertex, A in enumerate(vertices_of(As)):
        # The units of the states must not decide what counts as zero.
        A = scipy.linalg.matrix_balance(A, permute=False)[0]
        for s, right, left in axis_modes(A):
            # Left and right null spaces pair off where there is no chain; a chain's two ends are
            # orthogonal.
            _, cosines, turn = np.linalg.svd(left.conj().T @ right)
            lost = right @ turn[cosines < _DEFECTIVE].conj().T
            if lost.size:
                # (A - s I) w = v: the vector w that feeds the end v of a chain, and so makes it
                # grow.
                feeding = np.linalg.lstsq(A - s * np.eye(len(A)), lost)[0]
                return Obstacle(vertex, s, True, _support(np.hstack([lost, feeding])))
        # After the axis, since rounding scatters a Jordan block to both sides of it.
        values, vectors = np.linalg.eig(A)
        worst = int(np.argmax(np.real(values)))
        if values[worst].real > AXIS * np.linalg.norm(A, 2):
            return Obstacle(vertex, complex(values[worst]), False, _support(vectors[:, [worst]]))
    return None


def vertices_of(As: Array) -> Array:
    """Return As as a float64 array (K, n, n), K >= 1, of finite numbers."""
    As = np.asarray(As, dtype=np.float64)
    if As.ndim != 3 or As.shape[1] != As.shape[2] or not As.size or not np.isfinite(As).all():
        raise GainError(f"`As` has shape {As.shape}, and must be (K, n, n) finite numbers, K >= 1.")
    return As


def axis_modes(A: Array) -> list[tuple[complex, Array, Array]]:
    """Return each s = i w, w >= 0, on the imaginary axis with right and left null space of A - s I.

    Rounding scatters the eigenvalues of a Jordan block and leaves their mean in place, so means of
    clusters are tried, the widest first.
    """
    size, values = float(np.linalg.norm(A, 2)) or 1.0, np.linalg.eigvals(A)
    points: dict[float, complex] = {}
    # A block of k scatters by eps^(1/k), which is 1e-3 for five: hence radii from a tenth of the
    # norm.
    for radius in size * 10.0 ** np.arange(-1.0, -11.0, -1.0):
        close = np.abs(values[:, None] - values) <= radius
        for mean in (close @ values) / close.sum(1):
            # A is real, so -w mirrors w.
            if abs(mean.real) <= AXIS * size and mean.imag >= -AXIS * size:
                points.setdefault(round(float(mean.imag / size), 10), 1j * mean.imag)
    cuts = [(s, *np.linalg.svd(A - s * np.eye(len(A)))) for s in points.values()]
    modes = [(s, v[w <= AXIS * size].conj().T, u[:, w <= AXIS * size]) for s, u, w, v in cuts]
    return [mode for mode in modes if mode[1].size]


def _support(vectors: Array) -> tuple[int, ...]:
    """Return the rows that hold a tenth or more of a column's largest entry."""
    sizes = np.abs(vectors)
    return tuple(np.flatnonzero((sizes >= 0.1 * sizes.max(0)).any(1)).tolist())
