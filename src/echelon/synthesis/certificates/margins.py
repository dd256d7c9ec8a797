"""Robustness margins of a stable linear loop: gain, scaling, strings, delays and disturbances."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from echelon.core.errors import GainError
from echelon.core.linear import matrix_exponential, symmetric_basis
from echelon.core.rational import bisect
from echelon.core.types import Array

# ---- sweeps over frequencies ---------------------------------------------------------------------


def resolvent(A: Array, w: Array, B: Array) -> Array:
    """Return (i w I - A)^-1 B for each frequency, (N, n, m)."""
    return np.linalg.solve(1j * w[:, None, None] * np.eye(len(A)) - A, B[None].astype(complex))


def frequencies(matrices: list[Array]) -> Array:
    """Return frequencies up to the largest norm of the matrices, denser about their resonances."""
    # |w| <= |A - k B K z| for |z| = 1, which is at most twice the norm of A and that of A - k B K.
    top = 3.0 * max(float(np.linalg.norm(M, 2)) for M in matrices) or 1.0
    poles = np.concatenate([np.linalg.eigvals(M) for M in matrices])
    width = np.maximum(np.abs(poles.real), 1e-6 * np.abs(poles))
    steps = np.geomspace(0.05, 20.0, 12)
    near = np.abs(poles.imag)[:, None] + width[:, None] * np.concatenate([-steps, steps])
    # 400 frequencies a decade.
    sweep = np.geomspace(1e-9 * top, top, 3600)
    grid = np.union1d(sweep, near[near > sweep[0]])
    # Between two points that differ by rounding, so does all that is computed there.
    return grid[np.append(True, np.diff(grid) > 1e-9 * grid[1:])]


def peaks(f: Callable[[float], float], grid: Array, values: Array) -> Array:
    """Return the local maxima of f between the points of a grid where it has these values."""
    middle, left, right = values[1:-1], values[:-2], values[2:]
    # A flat stretch has maxima by rounding, which are no peaks, nor is what hardly exceeds them.
    tops = (middle >= left) & (middle >= right) & (middle > (1.0 + 1e-7) * np.minimum(left, right))
    around = [(grid[k - 1], grid[k + 1]) for k in np.flatnonzero(tops) + 1]
    return np.array([lowest(lambda w: -f(w), *ends).x for ends in around])


def lowest(f: Callable[[float], float], low: float, high: float) -> Any:
    """Return SciPy's account of the least f between two points, where it has one minimum."""
    from scipy.optimize import minimize_scalar

    sharp = {"xatol": 1e-7 * (high - low)}
    return minimize_scalar(f, None, (low, high), (), "bounded", options=sharp)


# ---- gain, input scaling and strings -------------------------------------------------------------
# The law u = -c R^-1 B'P z splits over the eigenvectors of the grounded Laplacian into the modes A
# - c lambda B K, K = R^-1 B'P, one for each of its eigenvalues lambda; those of a directed graph
# may be complex, and one of a pair stands for both, whose modes mirror each other. All that is said
# here is of these matrices (kind: linearization), with the same scale for every agent.

_FAR = 1e6  # factors on the coupling beyond this count as infinite
_HALVINGS = 30  # of a rate
_HIDDEN = 1e-9  # relative size below which a singular value or a damping counts as zero


class ClosedLoop(NamedTuple):
    """What every margin is of: the modes A - c lambda B R^-1 B'P for lambda in `eigenvalues`.

    With `between` every real number from the least to the largest of them is an eigenvalue too, as
    where only the extremes of a large graph are known.
    """

    A: Array
    B: Array
    P: Array
    R: Array
    coupling: float
    eigenvalues: Array
    between: bool = False

    @property
    def K(self) -> Array:
        """R^-1 B'P, (m, n)."""
        return np.linalg.solve(self.R, self.B.T @ self.P)

    @property
    def strengths(self) -> Array:
        """The distinct c lambda, ascending by their real parts."""
        return self.coupling * np.unique(np.asarray(self.eigenvalues))


class InputScaling(NamedTuple):
    """The worst abscissa (1/s) over scaled inputs, the scales (m,) and the lambda that give it."""

    abscissa: float
    scales: tuple[float, ...]
    eigenvalue: complex


class StringGain(NamedTuple):
    """||T||_inf of one link of a chain, and the frequency (rad/s) where it is reached."""

    gain: float
    frequency: float


class HiddenMode(NamedTuple):
    """A mode that does not decay and never shows: its eigenvalue, 1/s, and its direction (n,)."""

    eigenvalue: complex
    direction: Array


def modes(loop: ClosedLoop) -> Array:
    """Return the matrices A - c lambda B R^-1 B'P, (K, n, n), for the distinct eigenvalues.

    Raises:
        GainError: one of them does not decay, so that there is no margin to speak of.
    """
    strengths = loop.strengths
    closed = loop.A - strengths[:, None, None] * (loop.B @ loop.K)
    abscissas = np.linalg.eigvals(closed).real.max(1)
    worst = int(abscissas.argmax())
    if not abscissas[worst] < 0.0:
        raise GainError(
            f"margins need a loop that decays, and the mode of eigenvalue "
            f"{strengths[worst] / loop.coupling:.6g} has abscissa {abscissas[worst]:.3g} 1/s."
        )
    return closed


def stiffness(loop: ClosedLoop) -> float:
    """Return how many times as fast as the slowest mode decays the fastest moves; inf if none."""
    eigenvalues = np.linalg.eigvals(loop.A - loop.strengths[:, None, None] * (loop.B @ loop.K))
    slowest = -float(eigenvalues.real.max())
    return float(np.abs(eigenvalues).max()) / slowest if slowest > 0.0 else np.inf


def slowest_between(loop: ClosedLoop) -> float:
    """Return the largest real part of a mode (1/s) over the real eigenvalues and all between them.

    A real part changes its sign only where two eigenvalues of A - k B K add to zero, so that the
    pencil of X -> A X + X A' and X -> B K X + X (B K)' is singular; between two of those k one
    sample decides. So does it for modes that are shifted by a rate, which is bisected.
    """
    return _slowest_between(loop.A, loop.B @ loop.K, loop.strengths)


def _slowest_between(A: Array, G: Array, strengths: Array) -> float:
    """Return the same of A - k G, over k in `strengths` and between the real ones."""
    slowest = _at_probes(A, G, strengths)
    if not slowest < 0.0:
        return slowest

    def decays(rate: float) -> bool:
        return _at_probes(A + rate * np.eye(len(A)), G, strengths) < 0.0

    near = -(1.0 - 1e-6) * slowest
    return -near if decays(near) else -float(bisect(decays, 0.0, near, _HALVINGS))


def _at_probes(A: Array, G: Array, strengths: Array) -> float:
    """Return the largest real part of a mode where, among real strengths, a sign may change."""
    real = np.real(strengths[np.imag(strengths) == 0.0])
    edges = _crossings(A, G, real[-1])
    ends = np.union1d(real, edges[edges > real[0]])
    probes = np.union1d(np.union1d(ends, 0.5 * (ends[:-1] + ends[1:])), strengths)
    return float(np.linalg.eigvals(A - probes[:, None, None] * G).real.max())


def input_scaling(
    loop: ClosedLoop, spread: float = 0.3, slopes: Array | None = None
) -> InputScaling:
    """Return the worst mode when every input acts 1 +- spread as strongly as the law believes.

    The plant's B becomes B diag(s) for all agents alike, as by a wrong mass or inertia, while the
    law keeps its own. Where the trim input u* is part of A through a state-dependent g, `slopes`
    (m, n, n) holds u*_k dg_k/dx, and A becomes A + sum_k (s_k - 1) slopes_k. The 2^m corners are
    looked at, not what lies between them, nor where the trim moves.

    Raises:
        GainError: `spread` is not in [0, 1), or there are more than 12 inputs.
    """
    A, B, m = loop.A, loop.B, loop.B.shape[1]
    if not 0.0 <= spread < 1.0 or m > 12:
        raise GainError(f"`spread` is {spread} on {m} inputs; allowed are [0, 1) and 12 inputs.")
    K, strengths = loop.K, loop.strengths
    slopes = np.zeros((m, *A.shape)) if slopes is None else slopes
    worst = InputScaling(-np.inf, (), 0.0)
    for scales in itertools.product((1.0 - spread, 1.0 + spread), repeat=m):
        plant = A + np.tensordot(np.array(scales) - 1.0, slopes, 1)
        G = B * np.array(scales) @ K
        abscissas = np.linalg.eigvals(plant - strengths[:, None, None] * G).real.max(1)
        at, slowest = int(abscissas.argmax()), float(abscissas.max())
        if loop.between:
            slowest = _slowest_between(plant, G, strengths)
        margin = InputScaling(slowest, scales, strengths[at] / loop.coupling)
        worst = max(worst, margin, key=lambda m: m.abscissa)
    return worst


def string_gain(loop: ClosedLoop) -> StringGain:
    """Return ||T||_inf, T(s) = c K (s I - A + c B K)^-1 B, whatever the eigenvalues are.

    By so much can one link of a chain amplify its parent's input when that is fed forward (theory
    page, T4), and d links by the d-th power. The norm is Euclidean in normalized inputs.

    Raises:
        GainError: A - c B K does not decay.
    """
    closed = modes(loop._replace(eigenvalues=np.ones(1)))[0]
    K = loop.coupling * loop.K

    def sizes(w: Array) -> Array:
        return np.linalg.norm(K @ resolvent(closed, w, loop.B), ord=2, axis=(-2, -1))

    # The sweep is logarithmic, so w = 0 is added by hand.
    grid = np.append(0.0, frequencies([loop.A, closed]))
    grid = np.union1d(grid, peaks(lambda w: float(sizes(np.array([w]))[0]), grid, sizes(grid)))
    at = int(sizes(grid).argmax())
    return StringGain(float(sizes(grid)[at]), float(grid[at]))


def detectability(A: Array, C: Array) -> list[HiddenMode]:
    """Return the modes with Re s >= 0 and a right eigenvector v with C v = 0 (the PBH test).

    The largest invariant subspace where C vanishes is found first, by singular values; then the
    eigenvalues there. A mode of several directions is listed once for each, in a sparse basis.
    """
    hidden, size = _unobservable(A, C), float(np.linalg.norm(A, 2)) or 1.0
    inner, tiny = hidden.T @ A @ hidden, _HIDDEN * size
    values, modes = np.linalg.eigvals(inner), list[HiddenMode]()
    for value in values:
        # Rounding scatters the eigenvalues of a Jordan block around their mean, which stays put.
        centre = values[np.abs(values - value) <= 1e-3 * size].mean()
        nulls = [(s, _null_space(inner - s * np.eye(len(inner)), tiny)) for s in (centre, value)]
        s, null = nulls[0] if nulls[0][1].size else nulls[1]
        if s.real >= -tiny and all(abs(s - m.eigenvalue) > 1e-6 * size for m in modes):
            modes += [HiddenMode(complex(s), v) for v in _sparse(hidden @ null).T]
    return modes


def _crossings(A: Array, G: Array, top: float) -> Array:
    """Return the k in (0, top) at which two modes of A - k G add to 0, ascending."""
    basis, (i, j) = symmetric_basis(len(A)), np.triu_indices(len(A))
    fixed, moved = (((M @ basis) + (M @ basis).swapaxes(1, 2))[:, i, j].T for M in (A, G))
    # As pairs, since G has few inputs' rank and most of the quotients are infinite.
    over, under = np.asarray(scipy.linalg.eigvals(fixed, moved, homogeneous_eigvals=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        k = over / under
    # Rounding splits double roots into complex pairs; a candidate too many costs one sample.
    real = np.isfinite(k) & (np.abs(k.imag) <= 1e-3 * np.abs(k)) & (k.real > 0.0)
    return np.unique(k.real[real & (k.real < top)])


def _unobservable(A: Array, C: Array) -> Array:
    """Return an orthonormal basis, (n, r), of the largest invariant subspace where C vanishes."""
    # Each row in units of its own, so that a small torque counts like a large thrust.
    rows = np.linalg.norm(C, axis=1, keepdims=True)
    basis = _null_space(C / np.where(rows > 0.0, rows, 1.0), _HIDDEN)
    while basis.shape[1]:
        # The part of A that leaves the subspace; directions without one remain, until all do.
        leak = A @ basis - basis @ (basis.T @ A @ basis)
        inside = _null_space(leak, _HIDDEN * float(np.linalg.norm(A, 2)))
        if inside.shape[1] == basis.shape[1]:
            break
        basis = basis @ inside
    return basis


def _null_space(M: Array, tolerance: float) -> Array:
    _, singular, right = np.linalg.svd(M)
    return right[int((singular > tolerance).sum()) :].conj().T


def _sparse(vectors: Array) -> Array:
    """Return unit vectors of the same span, (n, r), each alone at one state where it is large."""
    # Through the pivots each column is 1 at its own state and 0 at those of the others.
    pivots = np.asarray(scipy.linalg.qr(vectors.conj().T, pivoting=True)[-1])[: vectors.shape[1]]
    sparse = vectors @ np.linalg.inv(vectors[pivots])
    sparse = np.where(np.abs(sparse) > _HIDDEN, sparse, 0.0)
    sparse = sparse / np.linalg.norm(sparse, axis=0)
    return sparse if np.abs(sparse.imag).any() else sparse.real


# ---- bounds on states under a disturbance --------------------------------------------------------
# Kept apart from the other margins for its own numerics: an ellipsoid that cannot be left, and the
# exact peak gain by quadrature of the impulse response.


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
    """Return the integrals over t >= 0 of the norms of the rows of exp(A t) E, (n,)."""
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
