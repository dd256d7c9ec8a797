"""Bounds on the states of a stable linear loop under a disturbance, mode by mode.

Kept apart from the other margins for its own numerics: an ellipsoid that cannot be left, and the
exact peak gain by quadrature of the impulse response.
"""

import numpy as np
import scipy.linalg

from echelon.core.linear import matrix_exponential
from echelon.core.types import Array
from echelon.synthesis.certificates.frequency import lowest
from echelon.synthesis.certificates.margins import ClosedLoop, modes


def invariant_ellipsoid(loop: ClosedLoop, E: Array, bound: float = 1.0) -> Array:
    """Return for each state (n,) a bound that no disturbance of norm up to `bound` makes it leave.

    From rest, delta obeys a mode plus E w, E (n, q). For each alpha the ellipsoid X with
    (A + alpha/2 I) X + X (.)' + E E'/alpha = 0 cannot be left, so |delta_j| <= bound sqrt(X_jj);
    each state takes its best alpha (X_jj is log-convex in alpha), and the worst mode at that alpha.
    So it holds for each follower if the disturbances of all together have norm up to `bound`.

    Raises:
        GainError: a mode does not decay.
    """
    closed, n = modes(loop), len(loop.A)
    # A + alpha/2 I has the Schur vectors of A, so each alpha costs a back substitution alone.
    forms = [scipy.linalg.schur(mode)[:2] for mode in closed]
    (solve,) = scipy.linalg.get_lapack_funcs(("trsyl",), (loop.A,))
    # From there on A + alpha/2 I does not decay, and no ellipsoid exists.
    limit = -2.0 * float(np.linalg.eigvals(closed).real.max())

    def squares(alpha: float) -> Array:
        largest = np.zeros(n)
        for T, Q in forms:
            S, F = T + 0.5 * alpha * np.eye(n), Q.T @ E
            Y, scale, _ = solve(S, S, -(F @ F.T) / alpha, tranb="T")
            largest = np.maximum(largest, np.einsum("ij,jk,ik->i", Q, Y / scale, Q))
        return largest

    ends = (1e-9 * limit, (1.0 - 1e-9) * limit)
    return bound * np.sqrt([lowest(lambda a, j=j: squares(a)[j], *ends).fun for j in range(n)])


def peak_gain(loop: ClosedLoop, E: Array, bound: float = 1.0) -> Array:
    """Return for each state (n,) the largest value that a disturbance of norm `bound` gives it.

    In one mode, from rest, this is exactly bound times the integral of |e_j' exp(A t) E|, to a
    relative 1e-6; the worst mode is taken, so that it is what a disturbance shaped like one
    eigenvector of the grounded Laplacian can do.

    Raises:
        GainError: a mode does not decay.
    """
    return bound * np.max([_impulse_norms(mode, E) for mode in modes(loop)], axis=0)


def _impulse_norms(A: Array, E: Array) -> Array:
    """Return the integrals over t >= 0 of the norms of the rows of exp(A t) E, (n,).

    Gauss's rule of 8 nodes on panels that are halved until the halves agree with the whole, all
    open panels of one length at a time; the first is halved until it resolves the fastest mode.
    """
    A, (d, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    h, fast = -1.0 / float(np.linalg.eigvals(A).real.max()), 0.1 / float(np.linalg.norm(A, 2))
    flow = matrix_exponential(A * h)
    # The tail beyond h is as small as exp(A h), so h grows by squaring until that is nothing.
    while np.linalg.norm(flow, 1) > 1e-12:
        flow, h = flow @ flow, 2.0 * h
    nodes, weights = np.polynomial.legendre.leggauss(8)
    times = np.append(0.5 * (nodes + 1.0), 1.0)[:, None, None]
    starts, wholes = (E / d[:, None])[None], np.full((1, len(A)), np.inf)
    closed, first = np.zeros(len(A)), True
    for _ in range(40):
        h *= 0.5
        *steps, flow = matrix_exponential(A * (h * times))
        starts = np.concatenate([starts, flow @ starts])
        # In parts, since matrices of all panels and nodes at once need not fit into memory.
        few = np.array_split(starts[:, None], 1 + len(starts) // 4096)
        rows = np.concatenate([np.linalg.norm(np.array(steps) @ some, axis=-1) for some in few])
        parts = 0.5 * h * np.einsum("pij,i->pj", rows, weights)
        total, halves = closed + parts.sum(0), parts.reshape(2, -1, len(A)).sum(0)
        still = (np.abs(halves - wholes) > 1e-8 * total + 1e-13 * total.max()).any(1)
        if first:
            still[0] |= h > fast
            first = bool(still[0])
        closed += halves[~still].sum(0)
        both = np.tile(still, 2)
        starts, wholes = starts[both], parts[both]
        if not still.any():
            break
    return d * (closed + wholes.sum(0))
