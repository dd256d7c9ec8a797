"""How far a stable linear loop is from losing what it promises.

The law u = -c R^-1 B'P z splits over the eigenvectors of the grounded Laplacian into the modes
A - c lambda B K, K = R^-1 B'P, one for each of its eigenvalues lambda. All that is said here is of
these matrices (kind: linearization), with the same delay or scale for every agent.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

from echelon._errors import GainError
from echelon._types import Matrix

_FAR = 1e6  # factors on the coupling beyond this count as infinite
_HIDDEN = 1e-9  # relative size below which a singular value or a damping counts as zero


class GainMargin(NamedTuple):
    """Every mode decays for the factors on the coupling low < factor < high."""

    low: float
    high: float


class DelayMargin(NamedTuple):
    """The least delay (s) that costs stability, or infinity, and where: w (rad/s) and lambda."""

    delay: float
    frequency: float
    eigenvalue: float


class InputScaling(NamedTuple):
    """The worst abscissa (1/s) over scaled inputs, the scales (m,) and the lambda that give it."""

    abscissa: float
    scales: tuple[float, ...]
    eigenvalue: float


class StringGain(NamedTuple):
    """||T||_inf of one link of a chain, and the frequency (rad/s) where it is reached."""

    gain: float
    frequency: float


class HiddenMode(NamedTuple):
    """A mode that does not decay and never shows: its eigenvalue, 1/s, and its direction (n,)."""

    eigenvalue: complex
    direction: Matrix


def modes(
    A: Matrix, B: Matrix, P: Matrix, R: Matrix, coupling: float, eigenvalues: Matrix
) -> Matrix:
    """Return the matrices A - c lambda B R^-1 B'P, (K, n, n), for lambda in `eigenvalues` (K,).

    Raises:
        GainError: one of them does not decay, so that there is no margin to speak of.
    """
    strengths = coupling * np.atleast_1d(np.asarray(eigenvalues, dtype=np.float64))
    closed = A - strengths[:, None, None] * (B @ np.linalg.solve(R, B.T @ P))
    abscissas = np.linalg.eigvals(closed).real.max(1)
    worst = int(abscissas.argmax())
    if not abscissas[worst] < 0.0:
        raise GainError(
            f"margins need a loop that decays, and the mode of eigenvalue "
            f"{strengths[worst] / coupling:.6g} has abscissa {abscissas[worst]:.3g} 1/s."
        )
    return closed


def gain_margin(
    A: Matrix, B: Matrix, P: Matrix, R: Matrix, coupling: float, eigenvalues: Matrix
) -> GainMargin:
    """Return the interval of factors on the coupling, around 1, for which every mode decays.

    At an edge two eigenvalues of A - k B K add to zero, k = factor c lambda, so that the pencil of
    X -> A X + X A' and X -> B K X + X (B K)' is singular: its real eigenvalues are candidates.
    Between two of them one sample decides, and bisection sharpens the edge. `high` is infinite
    where no edge lies below a factor of 1e6.

    Raises:
        GainError: a mode does not decay at factor 1.
    """
    modes(A, B, P, R, coupling, eigenvalues)
    G = B @ np.linalg.solve(R, B.T @ P)
    strengths = coupling * np.unique(eigenvalues)
    edges = _crossings(A, G, _FAR * strengths[-1])

    def decays(k: float) -> bool:
        return bool(np.linalg.eigvals(A - k * G).real.max() < 0.0)

    low = max(float(_edge(decays, k, edges[edges < k][::-1], 0.0) / k) for k in strengths)
    high = min(float(_edge(decays, k, edges[edges > k], _FAR * k) / k) for k in strengths)
    return GainMargin(low, high if high < _FAR else np.inf)


def delay_margin(
    A: Matrix, B: Matrix, P: Matrix, R: Matrix, coupling: float, eigenvalues: Matrix
) -> DelayMargin:
    """Return the largest delay tau of all z, u = -c R^-1 B'P z(t - tau), that every mode survives.

    A root of det(s I - A + c lambda B K e^{-s tau}) reaches the axis at s = i w only where an
    eigenvalue mu of K (i w I - A)^-1 B has size 1 / (c lambda), and first at the delay that turns
    c lambda mu into -1. The sizes are swept over frequency once and crossed for each lambda.

    Raises:
        GainError: a mode does not decay without delay.
    """
    closed = modes(A, B, P, R, coupling, eigenvalues)
    K, strengths = np.linalg.solve(R, B.T @ P), coupling * np.unique(eigenvalues)

    def loci(w: Matrix) -> Matrix:
        mu = np.linalg.eigvals(K @ _resolvent(A, w, B))
        return np.take_along_axis(mu, np.abs(mu).argsort(-1), -1)

    def size(w: float, i: int, at: float = 0.0) -> float:
        return float(np.abs(loci(np.array([w]))[0, i])) - at

    grid = _frequencies([A, *closed])
    columns = enumerate(np.abs(loci(grid)).T)
    peaks = [_peaks(lambda w, i=i: size(w, i), grid, column) for i, column in columns]
    grid = np.union1d(grid, np.concatenate(peaks))
    sizes, best = np.abs(loci(grid)), DelayMargin(np.inf, 0.0, float(strengths[0] / coupling))
    for k in strengths:
        for at, i in np.argwhere(np.diff(sizes > 1.0 / k, axis=0)):
            ends, sharp = (grid[at], grid[at + 1]), 1e-13 * grid[at]
            w = scipy.optimize.root_scalar(size, (i, 1.0 / k), "brentq", ends, xtol=sharp).root
            mu = loci(np.array([w]))[0]
            # Loci that cross together share the size and differ in phase: the first one counts.
            phases = np.angle(-mu[np.abs(np.abs(mu) * k - 1.0) < 1e-6]) % (2.0 * np.pi)
            best = min(best, DelayMargin(float(phases.min() / w), float(w), float(k / coupling)))
    return best


def input_scaling(
    A: Matrix,
    B: Matrix,
    P: Matrix,
    R: Matrix,
    coupling: float,
    eigenvalues: Matrix,
    spread: float = 0.3,
    slopes: Matrix | None = None,
) -> InputScaling:
    """Return the worst mode when every input acts 1 +- spread as strongly as the law believes.

    The plant's B becomes B diag(s) for all agents alike, as by a wrong mass or inertia, while the
    law keeps its own. Where the trim input u* is part of A through a state-dependent g, `slopes`
    (m, n, n) holds u*_k dg_k/dx, and A becomes A + sum_k (s_k - 1) slopes_k. The 2^m corners are
    looked at, not what lies between them, nor where the trim moves.

    Raises:
        GainError: `spread` is not in [0, 1), or there are more than 12 inputs.
    """
    m = B.shape[1]
    if not 0.0 <= spread < 1.0 or m > 12:
        raise GainError(f"`spread` is {spread} on {m} inputs; allowed are [0, 1) and 12 inputs.")
    K, values = np.linalg.solve(R, B.T @ P), np.unique(eigenvalues)
    slopes = np.zeros((m, *A.shape)) if slopes is None else slopes
    worst = InputScaling(-np.inf, (), 0.0)
    for scales in itertools.product((1.0 - spread, 1.0 + spread), repeat=m):
        plant = A + np.tensordot(np.array(scales) - 1.0, slopes, 1)
        closed = plant - coupling * values[:, None, None] * (B * np.array(scales) @ K)
        abscissas = np.linalg.eigvals(closed).real.max(1)
        at = int(abscissas.argmax())
        worst = max(worst, InputScaling(float(abscissas[at]), scales, float(values[at])))
    return worst


def disturbance_ellipsoid(
    A: Matrix,
    B: Matrix,
    P: Matrix,
    R: Matrix,
    coupling: float,
    eigenvalues: Matrix,
    E: Matrix,
    bound: float = 1.0,
) -> Matrix:
    """Return for each state (n,) a bound that no disturbance of norm up to `bound` makes it leave.

    From rest, delta obeys a mode plus E w, E (n, q). For each alpha the ellipsoid X with
    (A + alpha/2 I) X + X (.)' + E E'/alpha = 0 cannot be left, so |delta_j| <= bound sqrt(X_jj);
    each state takes its best alpha (X_jj is log-convex in alpha), and the worst mode at that alpha.
    So it holds for each follower if the disturbances of all together have norm up to `bound`.

    Raises:
        GainError: a mode does not decay.
    """
    closed, n = modes(A, B, P, R, coupling, eigenvalues), len(A)
    forms = [scipy.linalg.schur(mode)[:2] for mode in closed]
    (solve,) = scipy.linalg.get_lapack_funcs(("trsyl",), (A,))
    limit = -2.0 * float(np.linalg.eigvals(closed).real.max())

    def squares(alpha: float) -> Matrix:
        found = np.zeros(n)
        for T, Q in forms:
            S, F = T + 0.5 * alpha * np.eye(n), Q.T @ E
            Y, scale, _ = solve(S, S, -(F @ F.T) / alpha, tranb="T")
            found = np.maximum(found, np.einsum("ij,jk,ik->i", Q, Y / scale, Q))
        return found

    ends = (1e-9 * limit, (1.0 - 1e-9) * limit)
    return bound * np.sqrt([_lowest(lambda a, j=j: squares(a)[j], *ends).fun for j in range(n)])


def disturbance_l1(
    A: Matrix,
    B: Matrix,
    P: Matrix,
    R: Matrix,
    coupling: float,
    eigenvalues: Matrix,
    E: Matrix,
    bound: float = 1.0,
) -> Matrix:
    """Return for each state (n,) the largest value that a disturbance of norm `bound` gives it.

    In one mode, from rest, this is exactly bound times the integral of |e_j' exp(A t) E|, to a
    relative 1e-6; the worst mode is taken, so that it is what a disturbance shaped like one
    eigenvector of the grounded Laplacian can do.

    Raises:
        GainError: a mode does not decay.
    """
    closed = modes(A, B, P, R, coupling, eigenvalues)
    return bound * np.max([_impulse_norms(mode, E) for mode in closed], axis=0)


def string_gain(A: Matrix, B: Matrix, P: Matrix, R: Matrix, coupling: float) -> StringGain:
    """Return ||T||_inf, T(s) = c K (s I - A + c B K)^-1 B, K = R^-1 B'P.

    By so much can one link of a chain amplify its parent's input when that is fed forward (theory
    page, T4), and d links by the d-th power. The norm is Euclidean in normalized inputs.

    Raises:
        GainError: A - c B K does not decay.
    """
    closed = modes(A, B, P, R, coupling, np.ones(1))[0]
    K = coupling * np.linalg.solve(R, B.T @ P)

    def sizes(w: Matrix) -> Matrix:
        return np.linalg.norm(K @ _resolvent(closed, w, B), ord=2, axis=(-2, -1))

    grid = np.append(0.0, _frequencies([A, closed]))
    grid = np.union1d(grid, _peaks(lambda w: float(sizes(np.array([w]))[0]), grid, sizes(grid)))
    at = int(sizes(grid).argmax())
    return StringGain(float(sizes(grid)[at]), float(grid[at]))


def detectability(A: Matrix, C: Matrix) -> list[HiddenMode]:
    """Return the modes with Re s >= 0 and a right eigenvector v with C v = 0 (the PBH test).

    The largest invariant subspace where C vanishes is found first, by singular values; then the
    eigenvalues there. A mode of several directions is listed once for each, in a sparse basis.
    """
    hidden, size = _unobservable(A, C), float(np.linalg.norm(A, 2)) or 1.0
    inner, tiny = hidden.T @ A @ hidden, _HIDDEN * size
    values, found = np.linalg.eigvals(inner), list[HiddenMode]()
    for value in values:
        # Rounding scatters the eigenvalues of a Jordan block around their mean, which stays put.
        centre = values[np.abs(values - value) <= 1e-3 * size].mean()
        nulls = [(s, _null_space(inner - s * np.eye(len(inner)), tiny)) for s in (centre, value)]
        s, null = nulls[0] if nulls[0][1].size else nulls[1]
        if s.real >= -tiny and all(abs(s - m.eigenvalue) > 1e-6 * size for m in found):
            found += [HiddenMode(complex(s), v) for v in _sparse(hidden @ null).T]
    return found


def _edge(decays: Callable[[float], bool], k: float, edges: Matrix, end: float) -> float:
    """Return where stability ends on the way from k over the candidates `edges` to `end`."""
    inside = k
    for here, beyond in itertools.pairwise([*edges, end]):
        probe = 0.5 * (here + beyond)
        if not decays(probe):
            outside = probe
            for _ in range(60):
                middle = 0.5 * (inside + outside)
                inside, outside = (middle, outside) if decays(middle) else (inside, middle)
            return inside
        inside = probe
    return end


def _crossings(A: Matrix, G: Matrix, top: float) -> Matrix:
    """Return the k in (0, top) at which two eigenvalues of A - k G may add to zero, ascending."""
    i, j = np.triu_indices(len(A))
    basis = np.zeros((len(i), *A.shape))
    basis[range(len(i)), i, j] = basis[range(len(i)), j, i] = 1.0
    fixed, moved = (((M @ basis) + (M @ basis).swapaxes(1, 2))[:, i, j].T for M in (A, G))
    over, under = np.asarray(scipy.linalg.eigvals(fixed, moved, homogeneous_eigvals=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        k = over / under
    real = np.isfinite(k) & (np.abs(k.imag) <= 1e-3 * np.abs(k)) & (k.real > 0.0)
    return np.unique(k.real[real & (k.real < top)])


def _resolvent(A: Matrix, w: Matrix, B: Matrix) -> Matrix:
    """Return (i w I - A)^-1 B for each frequency, (N, n, m)."""
    return np.linalg.solve(1j * w[:, None, None] * np.eye(len(A)) - A, B[None].astype(complex))


def _frequencies(matrices: list[Matrix]) -> Matrix:
    """Return frequencies up to the largest norm of the matrices, denser about their resonances."""
    # |w| <= |A - k B K z| for |z| = 1, which is at most twice the norm of A and that of A - k B K.
    top = 3.0 * max(float(np.linalg.norm(M, 2)) for M in matrices) or 1.0
    poles = np.concatenate([np.linalg.eigvals(M) for M in matrices])
    width = np.maximum(np.abs(poles.real), 1e-6 * np.abs(poles))
    steps = np.geomspace(0.05, 20.0, 12)
    near = np.abs(poles.imag)[:, None] + width[:, None] * np.concatenate([-steps, steps])
    sweep = np.geomspace(1e-9 * top, top, 3600)
    return np.union1d(sweep, near[near > sweep[0]])


def _peaks(f: Callable[[float], float], grid: Matrix, values: Matrix) -> Matrix:
    """Return the local maxima of f between the points of a grid where it has these values."""
    middle, left, right = values[1:-1], values[:-2], values[2:]
    # A flat stretch has maxima by rounding, which are no peaks.
    tops = (middle >= left) & (middle >= right) & (middle > (1.0 + 1e-9) * np.minimum(left, right))
    around = [(grid[k - 1], grid[k + 1]) for k in np.flatnonzero(tops) + 1]
    return np.array([_lowest(lambda w: -f(w), *ends).x for ends in around])


def _lowest(f: Callable[[float], float], low: float, high: float) -> Any:
    sharp = {"xatol": 1e-7 * (high - low)}
    return scipy.optimize.minimize_scalar(f, None, (low, high), (), "bounded", options=sharp)


def _impulse_norms(A: Matrix, E: Matrix) -> Matrix:
    """Return the integrals over t >= 0 of the norms of the rows of exp(A t) E, (n,).

    Gauss's rule of 8 nodes on panels that are halved until the halves agree with the whole, all
    open panels of one length at a time; the first is halved until it resolves the fastest mode.
    """
    A, (d, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    h, fast = -1.0 / float(np.linalg.eigvals(A).real.max()), 0.1 / float(np.linalg.norm(A, 2))
    while np.linalg.norm(scipy.linalg.expm(A * h), 1) > 1e-12:
        h *= 2.0
    nodes, weights = np.polynomial.legendre.leggauss(8)
    starts, wholes = (E / d[:, None])[None], np.full((1, len(A)), np.inf)
    closed, first = np.zeros(len(A)), True
    for _ in range(40):
        h *= 0.5
        starts = np.concatenate([starts, scipy.linalg.expm(A * h) @ starts])
        steps = scipy.linalg.expm(A * (0.5 * h * (nodes + 1.0))[:, None, None])
        few = np.array_split(starts[:, None], 1 + len(starts) // 4096)
        rows = np.concatenate([np.linalg.norm(steps @ some, axis=-1) for some in few])
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


def _unobservable(A: Matrix, C: Matrix) -> Matrix:
    """Return an orthonormal basis, (n, r), of the largest invariant subspace where C vanishes."""
    rows = np.linalg.norm(C, axis=1, keepdims=True)
    basis = _null_space(C / np.where(rows > 0.0, rows, 1.0), _HIDDEN)
    while basis.shape[1]:
        leak = A @ basis - basis @ (basis.T @ A @ basis)
        kept = _null_space(leak, _HIDDEN * float(np.linalg.norm(A, 2)))
        if kept.shape[1] == basis.shape[1]:
            break
        basis = basis @ kept
    return basis


def _null_space(M: Matrix, tolerance: float) -> Matrix:
    """Return an orthonormal basis of the vectors that M sends to less than the tolerance."""
    _, singular, right = np.linalg.svd(M)
    return right[int((singular > tolerance).sum()) :].conj().T


def _sparse(vectors: Matrix) -> Matrix:
    """Return unit vectors of the same span, (n, r), each alone at one state where it is large."""
    pivots = np.asarray(scipy.linalg.qr(vectors.conj().T, pivoting=True)[-1])[: vectors.shape[1]]
    sparse = vectors @ np.linalg.inv(vectors[pivots])
    sparse = np.where(np.abs(sparse) > _HIDDEN, sparse, 0.0)
    sparse = sparse / np.linalg.norm(sparse, axis=0)
    return sparse if np.abs(sparse.imag).any() else sparse.real
