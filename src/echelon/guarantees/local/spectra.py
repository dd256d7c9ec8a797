"""Spectra of the deviations from rest: which of them end, and how fast."""

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from echelon.core.linear import radius_between
from echelon.core.types import Array

_EPS = float(np.finfo(float).eps)
_CONDITIONED = 600
"""Size up to which the condition of each eigenvalue is computed."""
_ROUGH = 1e-9
"""How far eigenvalues of larger matrices may be off, relative to the matrix."""


class Split(NamedTuple):
    """The map I kron F + C kron K of deviations, by each eigenvalue of C that counts.

    One map W of everything is F = W, K = 0 and one eigenvalue.

    Attributes:
        F: (s, s) of an agent whose neighbours are where it is.
        K: (s, s) of what it makes of a disagreement.
        eigenvalues: (L,) of C, what agents hear of each other.
        between: whether all between the least and the largest count.
    """

    F: Array
    K: Array
    eigenvalues: Array
    between: bool = False

    @classmethod
    def whole(cls, W: Array) -> "Split":
        """Return the map of everything."""
        return cls(W, np.zeros_like(W), np.zeros(1))

    def of(self, places: Array) -> Array:
        """Return the maps (L, k, k) of some entries of the body."""
        at = np.ix_(places, places)
        return self.F[at] + self.eigenvalues[:, None, None] * self.K[at]


class Modes(NamedTuple):
    """The eigenvalues of a map that count, and how far each may be off by rounding.

    Attributes:
        values: (K,).
        unsure: (K,).
        lasting: places of numbers that nothing changes, and others read.
        loose: places of numbers that nothing changes, and no other reads at rest.
    """

    values: Array
    unsure: Array
    lasting: tuple[int, ...] = ()
    loose: tuple[int, ...] = ()

    @property
    def radius(self) -> float:
        """The largest modulus; 0 without any."""
        return float(np.abs(self.values).max(initial=0.0))

    @property
    def worst(self) -> float:
        """The largest modulus that rounding leaves possible."""
        return float((np.abs(self.values) + self.unsure).max(initial=0.0))


def modes_of(split: Split) -> Modes:
    """Return the modes of a map, block by block.

    What acts on no state counts too: a memory may multiply what is zero at rest, and its slope
    says nothing of that.
    """
    pattern = (split.F != 0.0) | (split.K != 0.0)
    values, unsure, lasting, loose = [np.zeros(0)], [np.zeros(0)], list[int](), list[int]()
    for places in blocks_of(split):
        first = int(places[0])
        if len(places) == 1 and split.F[first, first] == 1.0 and split.K[first, first] == 0.0:
            read = np.count_nonzero(pattern[:, first]) > 1
            (lasting if read else loose).append(first)
            continue
        found, rounding = _eigenvalues(split.of(places))
        if split.between:
            ends = np.real(split.eigenvalues[[0, -1]])
            F, K = (part[np.ix_(places, places)] for part in (split.F, split.K))
            # At least 1 unless all between are shown to decay.
            found = np.append(found, radius_between(F, -K, *ends))
        values.append(found.reshape(-1))
        unsure.append(np.full(found.size, rounding))
    return Modes(np.concatenate(values), np.concatenate(unsure), (*lasting,), (*loose,))


def blocks_of(split: Split) -> list[Array]:
    """Return the places of the strongly connected parts of a map, by who acts on whom."""
    pattern = (split.F != 0.0) | (split.K != 0.0)
    count, block = csgraph.connected_components(sp.csr_array(pattern), connection="strong")
    order = np.argsort(block, kind="stable")
    return np.split(order, np.searchsorted(block[order], np.arange(1, count)))


def _eigenvalues(maps: Array) -> tuple[Array, float]:
    """Return the eigenvalues (L, k) of maps (L, k, k), and how far the largest may be off."""
    if maps.shape[1] == 1:
        values = maps[:, 0]
        return values, 2.0 * _EPS * float(np.abs(values).max())
    pattern = np.abs(maps).sum(axis=0)
    balance: Any = scipy.linalg.matrix_balance
    scale = balance(pattern, permute=False, separate=True)[1][0]
    maps = maps * (scale / scale[:, None])
    values = np.linalg.eigvals(maps)
    worst = maps[np.abs(values).max(axis=1).argmax()]
    size = float(np.linalg.norm(worst))
    if len(worst) > _CONDITIONED:
        return values, _ROUGH * size
    eig: Any = scipy.linalg.eig
    found, left, right = eig(worst, left=True, right=True)
    k = np.abs(found).argmax()
    along = float(np.abs(left[:, k].conj() @ right[:, k]))
    # A multiple eigenvalue without its vectors moves by a root of what is rounded.
    rounding = _EPS * len(worst) * size
    return values, min(rounding / max(along, _EPS), rounding ** (1.0 / len(worst)))


# ---- how much errors may grow before they end ----------------------------------------------------

_TRANSIENT = 400
"""Size up to which powers of a map are taken."""
_DOUBLINGS, _ENDED = 24, 1e-3


def amplification(split: Split, is_state: Array) -> float | None:
    """Return how often the states' errors are multiplied at most, at powers of 2 of steps.

    None where the map is too large to say.
    """
    if len(split.F) > _TRANSIENT or len(split.eigenvalues) > _TRANSIENT:
        return None
    with np.errstate(all="ignore"):
        return _largest_power(split.of(np.arange(len(split.F))), is_state)


def _largest_power(power: Array, is_state: Array) -> float:
    most = 1.0
    for _ in range(_DOUBLINGS):
        if not np.isfinite(power).all():
            return np.inf
        norms = np.linalg.norm(power[:, is_state][:, :, is_state], 2, (1, 2))
        most = max(most, float(norms.max()))
        if norms.max() < _ENDED:
            return most
        power = power @ power
    return most
