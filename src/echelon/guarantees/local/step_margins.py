"""By how much the disagreement may be scaled, or be late, before a step that runs does not decay.

Both are of the map F + lambda K of a step, block by block, for each eigenvalue lambda of what
agents hear.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg

from echelon.core.linear import spectral_radii, symmetric_basis
from echelon.core.rational import bisect
from echelon.core.types import Array
from echelon.guarantees.local.spectra import Split, blocks_of
from echelon.guarantees.messages.own_delay import angles_beside, last_delay

# ---- factors -------------------------------------------------------------------------------------
# Of factors k a mode of M = F + k lambda K passes the unit circle only where the product of two of
# its eigenvalues (one conjugated) is 1, so that X -> M X M* - X is singular. Between two of those k
# one sample decides for all.

_FAR = 1e6
"""Factors beyond it count as infinite, below its inverse as 0."""


class GainMargin(NamedTuple):
    """Every step decays for the factors low < factor < high on the disagreement."""

    low: float
    high: float


def gain_margin(split: Split) -> GainMargin | None:
    """Return the interval of factors about 1 for which a step decays; None if it does not at 1."""
    ranges = [(0.0, _FAR)]
    values = np.unique(split.eigenvalues[np.imag(split.eigenvalues) >= 0.0])
    real = np.real(values[np.imag(values) == 0.0])
    for F, K in _driven(split):
        if not (spectral_radii(F + values[:, None, None] * K) < 1.0).all():
            return None
        if len(real):
            ranges += _real_ends(F, K, real)
        for k in values[np.imag(values) != 0.0]:
            ranges.append(_ends(F, k * K, np.ones(1), _crossings(F, k * K, _FAR)))
    low, high = max(ends[0] for ends in ranges), min(ends[1] for ends in ranges)
    return GainMargin(low if low > 1.0 / _FAR else 0.0, high if high < 0.999 * _FAR else np.inf)


def _driven(split: Split) -> list[tuple[Array, Array]]:
    """Return F and K of the blocks on which a disagreement acts, balanced."""
    parts = list[tuple[Array, Array]]()
    for places in blocks_of(split):
        F, K = (part[np.ix_(places, places)] for part in (split.F, split.K))
        if K.any():
            _, (scale, _) = scipy.linalg.matrix_balance(
                np.abs(F) + np.abs(K), permute=False, separate=True
            )
            parts.append((F * (scale / scale[:, None]), K * (scale / scale[:, None])))
    return parts


def _real_ends(F: Array, K: Array, strengths: Array) -> list[tuple[float, float]]:
    """Return the factors about 1 for which F + factor k K decays, for runs of k without an edge."""
    edges = _crossings(F, K, _FAR * strengths[-1])
    probes = 0.5 * (edges[:-1] + edges[1:])
    growing = spectral_radii(F + probes[:, None, None] * K) >= 1.0
    # All strengths of a run share both edges, so its least and largest speak for it.
    runs = np.split(strengths, np.unique(np.searchsorted(strengths, probes[growing])))
    return [_ends(F, K, run, edges) for run in runs if len(run)]


def _ends(F: Array, K: Array, run: Array, edges: Array) -> tuple[float, float]:
    """Return the factors about 1 between which F + factor k K decays for all k of a run."""

    def decays(k: float) -> bool:
        return float(spectral_radii(F + k * K)) < 1.0

    low = _edge(decays, run[0], edges[edges < run[0]][::-1], 0.0)
    high = _edge(decays, run[-1], edges[edges > run[-1]], _FAR * run[-1])
    return float(low / run[0]), float(high / run[-1])


def _edge(decays: Callable[[float], bool], k: float, edges: Array, end: float) -> float:
    """Return where stability ends on the way from k over the candidates `edges` to `end`."""
    inside, ways = k, [*edges, end]
    for here, beyond in zip(ways, ways[1:], strict=False):
        # Stability cannot change between neighbouring candidates, so their middle speaks for both
        # ends.
        probe = 0.5 * (here + beyond)
        if not decays(probe):
            return bisect(decays, inside, probe, 60)
        inside = probe
    return end


def _crossings(F: Array, K: Array, top: float) -> Array:
    """Return the k in (0, top) at which two modes of F + k K (one conjugated) multiply to 1."""
    # With E = F - I no digit of slow modes is lost: M X M* - X = D X + X D* + D X D*, D = E + k K.
    E, one = F - np.eye(len(F)), np.eye(len(F))
    real = not np.iscomplexobj(K)
    basis, (i, j) = symmetric_basis(len(F)), np.triu_indices(len(F))

    def sides(M: Array, N: Array) -> Array:
        # Symmetric X are half of all.
        return (M @ basis @ N.T)[:, i, j].T if real else np.kron(M, N.conj())

    zero = sides(E, one) + sides(one, E) + sides(E, E)
    first = sides(K, one) + sides(one, K) + sides(E, K) + sides(K, E)
    size, unit = len(zero), np.eye(len(zero))
    left, right = np.zeros((2, 2 * size, 2 * size), zero.dtype if real else complex)
    left[:size, size:], left[size:, :size], left[size:, size:] = unit, -zero, -first
    right[:size, :size], right[size:, size:] = unit, sides(K, K)
    # As pairs, since K has few inputs' rank and most of the quotients are infinite.
    over, under = np.asarray(scipy.linalg.eigvals(left, right, homogeneous_eigvals=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        k = over / under
    # Rounding splits double roots into complex pairs; a candidate too many costs one sample.
    near = np.isfinite(k) & (np.abs(k.imag) <= 1e-3 * np.abs(k)) & (k.real > 0.0)
    return np.unique(k.real[near & (k.real < top)])


# ---- delays --------------------------------------------------------------------------------------
# With z late by d steps, det(zeta I - F - lambda zeta^-d K) is det(zeta I - M) times
# det(I - (lambda zeta^-d - lambda_0) T(zeta)), M = F + lambda_0 K and T = V' (zeta I - M)^-1 U of
# K = U V'. M decays, so the modes that do not are counted by the turns of the second one along the
# unit circle (Nyquist). T is one for all delays and all lambda.

_RANK = 1e-12
"""Relative, of a singular value."""
_MOST, _EACH = 10_000, 20
"""Delays up to which are looked at, in steps: every one up to the second, then every tenth part."""
_TURN, _SMALL, _ROUNDS, _CHUNK = 1.0, 0.1, 8, 32
"""rad from a point to the next; where it is more, points are added, so many times, but for loci
that are smaller than the second number. Eigenvalues looked at together."""


class DelayMargin(NamedTuple):
    """By how many steps z may be late.

    Attributes:
        steps: all delays up to it that were tried decay; -1 where not even current z are shown to.
        each: whether every whole number of steps up to it was tried.
        last: whether no more were tried.
        eigenvalue: the largest of what agents hear whose mode grows one step later; None where
            none is shown to grow.
    """

    steps: int
    each: bool
    last: bool
    eigenvalue: complex | None


def delay_margin(split: Split) -> DelayMargin:
    """Return how many steps all disagreements may be late, in the steps that run."""
    loci = [_Locus(F, K, split) for F, K in _driven(split)]
    steps = last_delay(lambda d: all(locus.decays(d) for locus in loci), _MOST, _EACH)
    each = steps < _EACH
    if steps == _MOST or steps < 0:
        return DelayMargin(steps, each, steps == _MOST, None)
    growing = np.concatenate([locus.growing(steps + 1) for locus in loci])
    if not len(growing):
        return DelayMargin(steps, each, False, None)
    worst = complex(growing[int(np.argmax(np.abs(growing)))])
    return DelayMargin(steps, each, False, worst if worst.imag else worst.real)


class _Locus:
    """The eigenvalues of T along half of the unit circle, for one block."""

    def __init__(self, F: Array, K: Array, split: Split) -> None:
        left, sizes, right = np.linalg.svd(K)
        rank = int((sizes > _RANK * sizes[0]).sum())
        self._F, self._U, self._V = F, left[:, :rank] * sizes[:rank], right[:rank]
        values = split.eigenvalues[np.imag(split.eigenvalues) >= 0.0]
        self._values, self._between = np.unique(values), split.between
        # Any mode that decays will do; a real one keeps T real on the real axis.
        self._middle = float(np.real(self._values[len(self._values) // 2]))
        self._M = F + self._middle * K
        modes = np.linalg.eigvals(self._M)
        self._stable = bool((np.abs(modes) < 1.0).all())
        self._angles = angles_beside(modes)
        self._T = self._response(self._angles)

    def _response(self, angles: Array) -> Array:
        """Return the eigenvalues (T, r) of T at angles (T,), rad."""
        zeta = np.exp(1j * angles)[:, None, None]
        inner = np.linalg.solve(zeta * np.eye(len(self._M)) - self._M, self._U.astype(complex))
        values: Array = np.linalg.eigvals(self._V @ inner)
        return values

    def decays(self, delay: int) -> bool:
        """Tell whether a step decays for every eigenvalue, with z so many steps late."""
        if not self._stable:
            return False
        for _ in range(_ROUNDS):
            turns, most = self._turns(delay)
            # What turns by more than a circle between two points would seem to turn little.
            size = np.abs(self._T).max(axis=1) * np.abs(self._values).max()
            quick = delay * np.diff(self._angles) > _TURN
            quick &= np.maximum(size[1:], size[:-1]) > _SMALL
            rough = np.flatnonzero((most > _TURN) | quick)
            if not len(rough):
                return not turns.any() and (not self._between or self._joined(delay))
            gaps = np.diff(self._angles)[rough, None] * np.array([0.25, 0.5, 0.75])
            more = (self._angles[rough, None] + gaps).reshape(-1)
            angles = np.concatenate([self._angles, more])
            order = np.argsort(angles)
            self._T = np.concatenate([self._T, self._response(more)])[order]
            self._angles = angles[order]
        return False

    def _factors(self, values: Array, delay: int) -> Array:
        """Return 1 - (lambda zeta^-d - lambda_0) T, (K, T, r)."""
        late = np.exp(-1j * delay * self._angles)
        strength = values[:, None] * late - self._middle
        return 1.0 - strength[..., None] * self._T

    def growing(self, delay: int) -> Array:
        """Return the eigenvalues whose modes are counted outside of the circle at such a delay."""
        return self._values[self._turns(delay)[0] != 0.0] if self._stable else self._values[:0]

    def _turns(self, delay: int) -> tuple[Array, Array]:
        """Return the turns (K,) of the determinants, and the largest angle of each step (T,)."""
        turns, most = np.zeros(len(self._values)), np.zeros(len(self._angles) - 1)
        for k in range(0, len(self._values), _CHUNK):
            few = self._values[k : k + _CHUNK]
            # The other half is that of the conjugate eigenvalues.
            for values in (few, np.conj(few)) if np.iscomplexobj(few) else (few, few):
                # Of their product, since loci that cross change places from a point to the next.
                each = self._factors(values, delay).prod(axis=2)
                angle = np.angle(each[:, 1:] / each[:, :-1])
                turns[k : k + _CHUNK] += angle.sum(axis=1) / (2.0 * np.pi)
                most = np.maximum(most, np.abs(angle).max(axis=0))
        return np.round(turns), most

    def _joined(self, delay: int) -> bool:
        """Each factor is linear in lambda, so that it passes 0 between two only in half a turn."""
        each = self._factors(self._values, delay)
        return bool((np.abs(np.angle(each[1:] / each[:-1])) < 0.5 * np.pi).all())
