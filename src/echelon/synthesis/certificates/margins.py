"""Robustness margins of a stable linear loop: gain, input scaling, string stability.

The law u = -c R^-1 B'P z splits over the eigenvectors of the grounded Laplacian into the modes
A - c lambda B K, K = R^-1 B'P, one for each of its eigenvalues lambda; those of a directed graph
may be complex, and one of a pair stands for both, whose modes mirror each other. All that is said
here is of these matrices (kind: linearization), with the same scale for every agent.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg

from echelon.core.errors import GainError
from echelon.core.linear import symmetric_basis
from echelon.core.rational import bisect
from echelon.core.types import Array
from echelon.synthesis.certificates.frequency import frequencies, peaks, resolvent

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


class GainMargin(NamedTuple):
    """Every mode decays for the factors on the coupling low < factor < high."""

    low: float
    high: float


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


def gain_margin(loop: ClosedLoop) -> GainMargin:
    """Return the interval of factors on the coupling, around 1, for which every mode decays.

    At an edge two eigenvalues of A - k B K add to zero, k = factor c lambda, so that the pencil of
    X -> A X + X A' and X -> B K X + X (B K)' is singular: its real eigenvalues are candidates.
    Between two of them one sample decides, and bisection sharpens the edge. `high` is infinite
    where no edge lies below a factor of 1e6, `low` is 0 where none lies above 1e-6.

    Raises:
        GainError: a mode does not decay at factor 1.
    """
    modes(loop)
    G, strengths = loop.B @ loop.K, loop.strengths
    ranges = _real_ends(loop.A, G, np.real(strengths[np.imag(strengths) == 0.0]))
    for k in strengths[np.imag(strengths) != 0.0]:
        ranges.append(_ends(loop.A, k * G, np.ones(1), _crossings(loop.A, k * G, _FAR)))
    low, high = max(ends[0] for ends in ranges), min(ends[1] for ends in ranges)
    return GainMargin(low if low > 1.0 / _FAR else 0.0, high if high < 0.999 * _FAR else np.inf)


def _real_ends(A: Array, G: Array, strengths: Array) -> list[tuple[float, float]]:
    """Return the factors about 1 for which A - factor k G decays, for runs of k without an edge."""
    if not len(strengths):
        return []
    edges = _crossings(A, G, _FAR * strengths[-1])
    probes = 0.5 * (edges[:-1] + edges[1:])
    growing = np.linalg.eigvals(A - probes[:, None, None] * G).real.max(axis=1, initial=-1) >= 0.0
    # All strengths of a run share both edges, so its least and largest speak for it.
    runs = np.split(strengths, np.unique(np.searchsorted(strengths, probes[growing])))
    return [_ends(A, G, run, edges) for run in runs if len(run)]


def _ends(A: Array, G: Array, run: Array, edges: Array) -> tuple[float, float]:
    """Return the factors about 1 between which A - factor k G decays for all k of a run."""

    def decays(k: float) -> bool:
        return bool(np.linalg.eigvals(A - k * G).real.max() < 0.0)

    low = _edge(decays, run[0], edges[edges < run[0]][::-1], 0.0)
    high = _edge(decays, run[-1], edges[edges > run[-1]], _FAR * run[-1])
    return float(low / run[0]), float(high / run[-1])


def decays_between(loop: ClosedLoop) -> bool:
    """Tell whether a mode decays for every lambda from the least eigenvalue to the largest."""
    return slowest_between(loop) < 0.0


def slowest_between(loop: ClosedLoop) -> float:
    """Return the largest real part of a mode (1/s) over the real eigenvalues and all between them.

    Between the candidates of `gain_margin` no real part changes its sign, and one sample decides.
    So does it for modes that are shifted by a rate, which is bisected.
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


def _edge(decays: Callable[[float], bool], k: float, edges: Array, end: float) -> float:
    """Return where stability ends on the way from k over the candidates `edges` to `end`."""
    inside = k
    for here, beyond in itertools.pairwise([*edges, end]):
        # Stability cannot change between neighbouring candidates, so their middle speaks for both
        # ends.
        probe = 0.5 * (here + beyond)
        if not decays(probe):
            return bisect(decays, inside, probe, 60)
        inside = probe
    return end


def _crossings(A: Array, G: Array, top: float) -> Array:
    """Return the k in (0, top) at which two eigenvalues of A - k G may add to zero, ascending.

    Of a complex G, at which one of them and the conjugate of another do.
    """
    if np.iscomplexobj(G):
        one = np.eye(len(A))
        fixed, moved = (np.kron(M, one) + np.kron(one, M.conj()) for M in (A, G))
        return _positive(fixed.astype(complex), moved, top)
    basis, (i, j) = symmetric_basis(len(A)), np.triu_indices(len(A))
    fixed, moved = (((M @ basis) + (M @ basis).swapaxes(1, 2))[:, i, j].T for M in (A, G))
    return _positive(fixed, moved, top)


def _positive(fixed: Array, moved: Array, top: float) -> Array:
    """Return the k in (0, top) at which fixed - k moved is singular, ascending."""
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
    """Return an orthonormal basis of the vectors that M sends to less than the tolerance."""
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
