"""One P for graphs that take turns, in continuous time and in held steps (theory page, T8).

With M_g = I kron F - L_g kron c G K the step of all followers on graph g, the sum of all
delta_i'P delta_i falls in any order of the graphs where M_g'(I kron P) M_g < I kron P for each.
"""

from typing import NamedTuple

import numpy as np

from echelon.agents.network.graph import Graph
from echelon.core.types import Array
from echelon.synthesis.certificates.lmi import rate_of
from echelon.synthesis.gains.gain import Gain

_DENSE = 1500
"""States of all followers up to which the norm of a step on a directed graph is computed."""
_ROUNDING = 16 * float(np.finfo(float).eps)  # of a norm, times a condition number
_SHARE = 1e-3  # of what the feedback takes from the sum in a step


class CommonMetric(NamedTuple):
    """The sum of all delta_i'P delta_i on graphs that take turns.

    Attributes:
        gain: of which P is.
        laplacians: (F, F) of each graph, grounded; of one that is symmetric its extreme
            eigenvalues alone, (2,).
        weakest: s > 0 with L + L' >= 2 s for each of them; 0 where there is none.
        rate: at which the sum's root falls in continuous time, 1/s, below 0 where it may rise;
            minus infinity where `weakest` is 0.
    """

    gain: Gain
    laplacians: tuple[Array, ...]
    weakest: float
    rate: float

    @classmethod
    def of(cls, graph: Graph, gain: Gain, A: Array, B: Array) -> "CommonMetric":
        """Return that of a graph that switches; A (n, n) and B (n, m) are of agents at the trim."""
        weakest = graph.spectrum().proved
        felt = 2.0 * gain.coupling * weakest
        rate = rate_of(gain.P, A[None], B, gain.R, felt) if weakest > 0.0 else -np.inf
        dense = (L.toarray() for L in graph.stretches())
        # (F - k G K)'P (F - k G K) is convex in k, so that the extremes speak for all.
        ends = (np.linalg.eigvalsh(L)[[0, -1]] if np.array_equal(L, L.T) else L for L in dense)
        return cls(gain, tuple(ends), weakest, rate)

    def growth(self, F: Array, G: Array, K: Array, dt: float) -> float:
        """Return by what the sum's root is multiplied at most in a step x+ = F x + G u of dt (s).

        Less than 1 also where the sum may stay, if it falls for as long as any z = K delta (m, n)
        is felt: z then ends, and with it what decays by itself or shows in z.
        """
        root, c = np.linalg.cholesky(self.gain.P).T, self.gain.coupling
        back = np.linalg.inv(root)
        step, fed = root @ F @ back, c * root @ G @ K @ back
        most = max(_norm(L, step, fed, np.zeros((0, len(F)))) for L in self.laplacians)
        rounding = _ROUNDING * len(F) * float(np.linalg.cond(root))
        if abs(most - 1.0) > rounding:
            return most
        felt = np.linalg.cholesky(2.0 * _SHARE * c * self.weakest * dt * self.gain.R).T @ K @ back
        ends = max(_norm(L, step, fed, felt) for L in self.laplacians) <= 1.0 + rounding
        return 1.0 - rounding if ends else 1.0 + rounding


def _norm(L: Array, step: Array, fed: Array, felt: Array) -> float:
    """Return the norm of I kron step - L kron fed above I kron felt; infinite of too large ones."""
    if L.ndim == 1:
        parts = np.stack([np.concatenate([step - k * fed, felt]) for k in L])
        return float(np.linalg.norm(parts, 2, (1, 2)).max())
    if len(L) * len(step) > _DENSE:
        return np.inf
    one = np.eye(len(L))
    whole = np.concatenate([np.kron(one, step) - np.kron(L, fed), np.kron(one, felt)])
    return float(np.sqrt(np.linalg.eigvalsh(whole.T @ whole)[-1]))
