"""Delay margin: how old the disagreement z may be in the loop of `margins`, for all agents alike.

A root of det(s I - A + k B K e^{-s tau}), k = c lambda, is on the axis at s = i w only where an
eigenvalue mu of K (i w I - A)^-1 B has size 1 / |k|, and first at the delay that turns k mu to -1.
The loci mu(w) are those of every lambda, so they are swept once and crossed at each size.
"""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.synthesis.certificates.frequency import frequencies, lowest, peaks, resolvent
from echelon.synthesis.certificates.margins import ClosedLoop, modes

_FEW = 32  # modes about whose resonances the sweep is denser
_SHARP = 1e-13  # relative, of a frequency
_APART = 1e-6  # relative; loci that cross together differ by less
_BEYOND = 1e3  # times all sizes that are sought; what lies farther out is not resolved


class DelayMargin(NamedTuple):
    """The least delay (s) that costs stability, or infinity, and where: w (rad/s) and lambda."""

    delay: float
    frequency: float
    eigenvalue: complex


def delay_margin(loop: ClosedLoop) -> DelayMargin:
    """Return the largest delay tau of all z, u = -c R^-1 B'P z(t - tau), that every mode survives.

    Of a pair of complex eigenvalues both are looked at, so that w > 0 suffices.

    Raises:
        GainError: a mode does not decay without delay.
    """
    closed, strengths = modes(loop), loop.strengths
    few = np.unique(np.linspace(0, len(closed) - 1, _FEW).astype(int))
    loci = _Loci(loop, strengths[len(strengths) // 2])
    grid = loci.resolved(frequencies([loop.A, *closed[few]]))
    at = _crossings(loci, grid, strengths)
    if loop.between:
        # What lies between two eigenvalues may be worse than both.
        at = np.concatenate([at, _turning_points(loci, grid)])
    at = at[np.isfinite(np.real(at[:, 0]))]
    if not len(at):
        return DelayMargin(np.inf, 0.0, strengths[0] / loop.coupling)
    delay, w, k = at[np.real(at[:, 0]).argmin()]
    k = k if k.imag else k.real
    return DelayMargin(float(delay.real), float(w.real), k / loop.coupling)


class _Loci:
    """The eigenvalues mu (m,) of K (i w I - A)^-1 B at each frequency, by ascending size."""

    def __init__(self, loop: ClosedLoop, strength: complex) -> None:
        self._B, self._K, self._strength = loop.B, strength * loop.K, strength
        self._closed = loop.A - self._B @ self._K
        sizes = np.abs(loop.strengths)
        self.sought = 1.0 / sizes.max(), 1.0 / sizes.min()

    def __call__(self, w: Array) -> Array:
        # Of the closed loop, which has no pole near the axis: a chain of integrators would lose
        # its small eigenvalue in the rounding of the large one.
        M = self._K @ resolvent(self._closed, w, self._B)
        one = np.eye(M.shape[-1])
        # About their mean, since LAPACK's sweeps do not end on some multiples of the identity.
        mean = np.trace(M, axis1=1, axis2=2)[:, None] / len(one)
        nu = np.linalg.eigvals(M - mean[..., None] * one) + mean
        with np.errstate(divide="ignore", invalid="ignore"):
            mu = nu / (self._strength * (1.0 - nu))
        return np.take_along_axis(mu, np.abs(mu).argsort(-1), -1)

    def sizes(self, w: Array) -> Array:
        """Return |mu| (K, m), cut off far from what is sought."""
        low, high = self.sought
        # Beyond all numbers where 1 - nu is nothing.
        sizes = np.nan_to_num(np.abs(self(w)), nan=np.inf)
        return np.clip(sizes, low / _BEYOND, high * _BEYOND)

    def resolved(self, grid: Array) -> Array:
        """Return frequencies with those added at which a locus is largest or least between them."""
        more, columns = list[Array](), self.sizes(grid).T
        for i, column in enumerate(columns):
            more.append(peaks(lambda w, i=i: self._size(w, i), grid, column))
            more.append(peaks(lambda w, i=i: 1.0 / self._size(w, i), grid, 1.0 / column))
        return np.union1d(grid, np.concatenate(more))

    def _size(self, w: float, i: int) -> float:
        return float(self.sizes(np.array([w]))[0, i])


def _crossings(loci: _Loci, grid: Array, strengths: Array) -> Array:
    """Return delay, frequency and strength (K, 3) wherever a locus has the size of a strength."""
    from scipy.optimize.elementwise import find_root  # which takes long to load

    columns, places = loci.sizes(grid).T, list[Array]()
    for i, column in enumerate(columns):
        k, at = np.nonzero(np.diff(column > 1.0 / np.abs(strengths)[:, None], axis=1))
        places.append(np.stack([k, at, np.full(len(k), i)]))
    k, at, which = np.concatenate(places, axis=1)
    if not len(k):
        return np.zeros((0, 3), complex)

    def excess(w: Array, level: Array, i: Array) -> Array:
        sizes = np.take_along_axis(loci.sizes(w), i.astype(int)[:, None], 1)[:, 0]
        return np.log(sizes * level)

    levels, sharp = np.abs(strengths)[k], {"xrtol": _SHARP}
    root = find_root(excess, (grid[at], grid[at + 1]), args=(levels, which), tolerances=sharp)
    w, mu = root.x, loci(root.x)
    away = np.abs(np.abs(mu) * levels[:, None] - 1.0)
    # Loci that cross together share the size and differ in phase: the first one counts.
    together = away <= np.maximum(_APART, away.min(axis=1, keepdims=True))
    delays = np.minimum(*(_delays(s[:, None] * mu, w) for s in (strengths[k], strengths[k].conj())))
    return np.stack([np.where(together, delays, np.inf).min(axis=1), w, strengths[k]], axis=1)


def _turning_points(loci: _Loci, grid: Array) -> Array:
    """Return the same where delays are least over all strengths from the least to the largest."""
    low, high = loci.sought
    mu = loci(grid)
    inside = (np.abs(mu) >= low) & (np.abs(mu) <= high)
    found = [np.zeros((0, 3), complex)]
    for i, column in enumerate(np.where(inside, _delays(mu, grid), np.inf).T):
        for k in np.flatnonzero((column[1:-1] <= column[:-2]) & (column[1:-1] <= column[2:])) + 1:
            if not np.isfinite(column[k]):
                continue

            def delay(w: float, i: int = i) -> float:
                return float(_delays(loci(np.array([w])), np.array([w]))[0, i])

            w = float(lowest(delay, grid[k - 1], grid[k + 1]).x)
            size = float(np.abs(loci(np.array([w]))[0, i]))
            if low <= size <= high:
                found.append(np.array([[delay(w), w, 1.0 / size]], complex))
            found.append(np.array([[column[k], grid[k], 1.0 / np.abs(mu[k, i])]], complex))
    return np.concatenate(found)


def _delays(turned: Array, w: Array) -> Array:
    """Return the least delays (s) that turn numbers (K, m) at frequencies (K,) to -1."""
    return (np.angle(-turned) % (2.0 * np.pi)) / w[:, None]
