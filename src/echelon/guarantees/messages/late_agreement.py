"""How fast stopping points agree over messages of any age (T9.2, T9.3).

Let v > 0 and rho >= 0 with rho v_i <= c (d_i v_i - e^(rho tau) sum_j a_ij v_j) for all followers i,
d_i the sums of what they hear. While no message in use is older than tau, |zeta~_i| <= v_i m(t)
with m' = -rho m / sqrt(1 + (rho m max v / s)^2).
"""

from fractions import Fraction
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from echelon.core.enclosure.interval import ELEMENTARY, point
from echelon.core.types import Array

_NEAR, _HALVINGS = 1e-5, 60
"""Relative distance to the best rate at which the search ends, and after how many steps at most."""
_SHARES, _MANY = (0.999, 0.9, 0.6), 1000
"""Of the best rate: the nearer to it, the larger the weights of some agents against others. Of so
many followers one rate is enough."""


class LateRate(NamedTuple):
    """A rate rho, 1/s, and weights v (F,) of followers, of which the inequality is proved."""

    rate: float
    weights: Array


def late_rates(L: sp.csr_array, c: float, age: Fraction) -> tuple[LateRate, ...]:
    """Return rates at which stopping points agree, the fastest first; none where none is proved.

    Args:
        L: grounded Laplacian of the followers.
        c: the coupling.
        age: tau, s.
    """
    L, ones = sp.csr_array(L), np.ones_like(L.diagonal())

    def weights(rate: float) -> Array | None:
        # Of a matrix without positive entries off its diagonal: v > 0 exactly if it is an M-matrix.
        grown = _grown(L, float(np.exp(min(rate * float(age), 300.0))))
        K = sp.csc_array(c * grown - rate * sp.diags_array(ones))
        try:
            v = spla.splu(K).solve(ones)
        except RuntimeError:
            return None
        fits = np.isfinite(v).all() and (v > 0.0).all() and (K @ v > 0.0).all()
        return v / v.max() if fits else None

    best, high = 0.0, c * float(L.diagonal().min())
    for _ in range(_HALVINGS):
        middle = 0.5 * (best + high)
        best, high = (best, middle) if weights(middle) is None else (middle, high)
        if high - best <= _NEAR * best:
            break
    shares = _SHARES if len(ones) <= _MANY else _SHARES[:1]
    pairs = ((best * share, weights(best * share)) for share in shares)
    drafts = (LateRate(rate, v) for rate, v in pairs if v is not None)
    return tuple(each for each in drafts if is_proved(each, L, c, age))


def _grown(L: sp.csr_array, factor: float) -> sp.csr_array:
    """Return a Laplacian with everything heard times a factor."""
    own = sp.diags_array(L.diagonal())
    return sp.csr_array(own + factor * (L - own))


def is_proved(late: LateRate, L: sp.csr_array, c: float, age: Fraction) -> bool:
    """Tell whether the inequality holds in rationals, with e^(rho tau) from above."""
    rate, coupling = Fraction(late.rate), Fraction(c)
    factor = ELEMENTARY["exp"].range(point(rate * age)).hi
    v = [Fraction(x) for x in late.weights.tolist()]
    rows = sp.coo_array(L)
    sums = [-rate * x / coupling for x in v]
    for i, j, a in zip(rows.row.tolist(), rows.col.tolist(), rows.data.tolist(), strict=True):
        sums[i] += Fraction(a) * v[j] * (1 if i == j else factor)
    return rate >= 0 and min(v) > 0 and min(sums) >= 0


def longest_ways(L: sp.csr_array) -> Array | None:
    """Return how many links the longest way to each follower has, (F,); None if some hear in rings.

    Followers that hear leaders alone have one.
    """
    heard = sp.coo_array(L - sp.diags_array(L.diagonal()))
    used = heard.data != 0.0
    i, j, count = heard.row[used], heard.col[used], len(L.diagonal())
    rings, _ = csgraph.connected_components(
        sp.coo_array((np.ones(len(i)), (i, j)), (count, count)), connection="strong"
    )
    if rings < count:
        return None
    ways = np.ones(count, int)
    while True:
        longer = ways.copy()
        np.maximum.at(longer, i, ways[j] + 1)
        if (longer == ways).all():
            return ways
        ways = longer
