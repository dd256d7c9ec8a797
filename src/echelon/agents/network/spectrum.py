"""The spectrum of a network: the eigenvalues that gains and proofs need, with a proved bound."""

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from echelon.core.errors import GraphError
from echelon.core.files import notebook_page
from echelon.core.types import Array


class Spectrum(NamedTuple):
    """Eigenvalues lambda of the matrix L that weighs errors into disagreements.

    Attributes:
        eigenvalues: (K,), of positive real part, ascending by it and read-only: all of them, or of
            a large graph the extreme two. Complex where a directed graph makes them so.
        total: the number of all eigenvalues, K or more.
        proved: a number with W L + L'W >= 2 proved W, W = diag(sums), rounding included; 0 where
            none is known. For a symmetric L it is a lower bound of the smallest eigenvalue.
        sums: (n,) positive, the weights w of followers in sum_i w_i delta_i'P delta_i (theory page,
            T7); None where all are 1.
        weakest: replaces lambda_min where several graphs take turns: for each of them
            L + L' >= 2 weakest; None for one graph.
    """

    eigenvalues: Array
    total: int
    proved: float
    sums: Array | None = None
    weakest: float | None = None

    def _repr_html_(self) -> str:
        return notebook_page("report", self)

    @property
    def low(self) -> float:
        """The smallest real part, lambda_min: the slowest disagreement, which sets the coupling.

        It is itself an eigenvalue, also of a directed graph (Perron and Frobenius).
        """
        return float(self.eigenvalues[0].real) if self.weakest is None else self.weakest

    @property
    def high(self) -> float:
        """The largest modulus, lambda_max: the fastest disagreement, which limits the time step."""
        if np.iscomplexobj(self.eigenvalues):
            return float(np.abs(self.eigenvalues).max())
        return float(self.eigenvalues[-1])

    @property
    def symmetric(self) -> bool:
        """Whether L is one symmetric matrix, so that V = delta'(L kron P) delta can decrease."""
        return self.weakest is None and self.sums is None and self.proved > 0.0

    @property
    def skew(self) -> float:
        """Ratio of the largest and the smallest weight in `sums`, 1 or more."""
        return 1.0 if self.sums is None else float(self.sums.max() / self.sums.min())


# ---- a rigorous lower bound of the smallest eigenvalue -------------------------------------------
# The matrix has no positive entry off its diagonal, so for any positive vector x its smallest
# eigenvalue is at least min_i (L x)_i / x_i (Collatz and Wielandt). That quotient is computed in
# floats less a bound of their rounding. An eigenvalue computed in floats is wrong by as much as the
# rounding of the largest weight, which a proof may not ignore.

_FEW = 400
"""Largest number of followers for an elimination, which takes a tenth of a second."""
_EFFORT = 12_000
"""Rounds of inverse iteration times followers."""
_UNIT, _LEAST = 2.0**-53, 2.0**-1073
_DECADES = 1e40
"""Largest ratio of weights for an elimination."""
_SHARP = 1.0 - 1e-9


class Grounded(NamedTuple):
    """The weights of a grounded Laplacian.

    Attributes:
        pairs: (E, 2), the followers at the ends of each edge between followers.
        weights: (E,), of these edges.
        leader_edges: (K, 2), follower and weight of each edge to a leader.
        size: number of followers.
    """

    pairs: Array
    weights: Array
    leader_edges: Array
    size: int


def least_eigenvalue_bound(matrix: Grounded, vector: Array, near: float) -> float:
    """Return a lower bound of the smallest eigenvalue; 0 where no better one is found.

    Args:
        matrix: the grounded Laplacian.
        vector: (n,), near its eigenvector.
        near: the eigenvalue where floats resolve it, else infinite; a bound within 1e-9 of it is
            sharp enough.
    """
    positive = np.maximum(np.abs(vector), 1e-300)
    best = rounded_bound(matrix, positive)
    if matrix.size > _FEW or best >= _SHARP * near:
        return best
    weights = np.concatenate([matrix.weights, matrix.leader_edges[:, 1]])
    if weights.max() > _DECADES * weights.min():
        return 0.0
    try:
        return max(best, _elimination_bound(matrix, positive, float(weights.max())))
    except FloatingPointError:
        return best


def rounded_bound(matrix: Grounded, x: Array) -> float:
    """Return a lower bound, 0 or more, of min_i (L x)_i / x_i for a positive x (n,)."""
    (i, j), near_leader = matrix.pairs.T, matrix.leader_edges[:, 0].astype(int)
    flow, inflow = matrix.weights * (x[i] - x[j]), matrix.leader_edges[:, 1] * x[near_leader]
    ends = np.concatenate([i, j, near_leader])
    terms = np.concatenate([flow, -flow, inflow])
    total, size, count = (
        np.bincount(ends, weights, matrix.size) for weights in (terms, np.abs(terms), None)
    )
    # A term has two roundings, and a sum of k terms k - 1 more of all their sizes (Higham, section
    # 3.1), or the smallest float; the remaining factors cover the rounding of this bound itself.
    lost = (count + 4.0) * (_UNIT * (1.0 + 1e-9) * size + _LEAST)
    least = (total - lost) / x * (1.0 - 8.0 * _UNIT)
    return max(0.0, float(least.min()))


def _elimination_bound(matrix: Grounded, x: Array, heaviest: float) -> float:
    """Return min_i x_i / (L^-1 x)_i, rounded down, for an x > 0 improved by inverse iteration.

    For weights far apart, whose x has nearly equal entries with differences that floats do not
    have. Eliminating a node links its neighbours to each other and to its leaders. Nothing is
    subtracted (Grassmann, Taksar and Heyman, 1985), so that the network of k nodes that remains has
    relative errors of (k + 3) u. Determinant and cofactors of its matrix are polynomials of degree
    k at most in the weights, with positive coefficients (matrix tree theorem), so that these errors
    change no entry of L^-1 x by more than 2 k (k + 3) u, and the sum that returns to node k adds
    (2 k + 4) u. Over all k, with the sums of m edges to leaders, that is below (n + m + 4)^3 u.

    Raises:
        FloatingPointError: the weight of a link is too small for a float.
    """
    (i, j), n = matrix.pairs.T, matrix.size
    w, sums, best = np.zeros((n, n)), np.zeros(n), 0.0
    w[i, j] = w[j, i] = matrix.weights / heaviest
    led = matrix.leader_edges[:, 0].astype(int)
    ground = np.bincount(led, matrix.leader_edges[:, 1] / heaviest, n)
    with np.errstate(under="raise"):
        for k in reversed(range(n)):
            sums[k] = w[k, :k].sum() + ground[k]
            # Above the diagonal, the share of a link to node k in all links of that.
            w[:k, k] /= sums[k]
            w[:k, :k] += np.outer(w[:k, k], w[k, :k])
            ground[:k] += w[:k, k] * ground[k]
            # A link of a node to itself is none.
            w[range(k), range(k)] = 0.0
    for _ in range(_EFFORT // n):
        # Beside such entries, what is too small for a float is nothing.
        x = np.maximum(x / x.max(), 1e-100)
        y = x.copy()
        for k in reversed(range(n)):
            y[:k] += w[:k, k] * y[k]
        for k in range(n):
            y[k] = (y[k] + (w[k, :k] * y[:k]).sum()) / sums[k]
        quotients, x = x / y, y
        best = max(best, float(quotients.min()))
        if best >= _SHARP * quotients.max():
            break
    return best * heaviest * (1.0 - (n + int(np.bincount(led).max()) + 4.0) ** 3 * _UNIT)


def contraction_bound(L: sp.csr_array, x: Array, w: Array) -> float:
    """Return a float s >= 0 with W L + L'W >= 2 s W, W = diag(w), rounding included.

    The symmetric matrix on the left has no positive entry off its diagonal, so it has no negative
    eigenvalue if it takes a positive x (n,) to a vector without negative entries. L (n, n) is the
    grounded Laplacian of a directed graph, w (n,) is positive.
    """
    # Diagonals of L are sums of weights, rounded once an edge; the relative margin below covers it.
    direct, transposed = L @ x, L.T @ (w * x)
    size = abs(L) @ x
    sizes = w * size + abs(L.T) @ (w * x)
    degree = float(max(np.diff(L.indptr).max(), np.diff(L.tocsc().indptr).max(), 1))
    lost = 4.0 * (degree + 4.0) * _UNIT * sizes + _LEAST
    least = (w * direct + transposed - lost) / (2.0 * w * x) * (1.0 - 16.0 * _UNIT)
    return max(0.0, float(least.min()))


# ---- spectra of undirected, directed and switching graphs ----------------------------------------

# Below this many followers the dense eigenvalue routine is both faster and exact to rounding.
_DENSE = 400
_LARGEST = 1000
"""Largest strongly connected component whose eigenvalues are computed: a second."""
_RESOLVED = 1e-6
_LEFT_OUT = 1e-6
_ITERATIONS = 30
_ROUNDED = 1.0 - 1e-9
"""A bound this near to an eigenvalue does not reduce it."""
_SHARE = 0.9
"""Share of lambda_min at which the weighted sum of a directed graph decays. Nearer to 1 the ratio
of its weights grows, without limit where followers are not strongly connected."""
_FAR_APART = 1e12
"""Largest ratio of the weights of such a sum that floats resolve."""
_ROUNDING = 1e-12


def symmetric_spectrum(L: sp.csr_array, grounded: Grounded) -> Spectrum:
    """Return the spectrum of an undirected graph.

    All eigenvalues up to 400 followers, beyond that the smallest and the largest.

    Raises:
        GraphError: the weights are too far apart for the smallest to be known.
    """
    if grounded.size <= _DENSE:
        dense = L.toarray()
        eigenvalues, vector = np.linalg.eigvalsh(dense), np.linalg.eigh(dense)[1][:, 0]
    else:
        eigenvalues, vector = _extremes(L)
    low, high = float(eigenvalues[0]), float(eigenvalues[-1])
    # Floats resolve it up to the rounding of the largest.
    near = low if low > _RESOLVED * high else np.inf
    proved = least_eigenvalue_bound(grounded, _spread(L, vector), near)
    if not proved > 0.0:
        raise _weights_too_far_apart(np.append(grounded.weights, grounded.leader_edges[:, 1]))
    # Rounding may have raised the eigenvalue, so its bound limits it, or made it negative.
    eigenvalues[0] = min(low, proved / _ROUNDED) if low > 0.0 else proved
    eigenvalues.setflags(write=False)
    return Spectrum(eigenvalues, grounded.size, proved)


def directed_spectrum(L: sp.csr_array, weights: Array) -> Spectrum:
    """Return the spectrum of a directed graph, all eigenvalues.

    In the order of its strongly connected components L is block triangular, so its eigenvalues are
    those of its blocks; computed block by block they lose no digits in long chains.

    Raises:
        GraphError: the weights are too far apart, or a component is too large.
    """
    count, block = csgraph.connected_components(L, directed=True, connection="strong")
    order = np.argsort(block, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(block, minlength=count))[:-1])
    alone = np.concatenate([part for part in parts if len(part) == 1] or [np.zeros(0, int)])
    eigenvalues = [L.diagonal()[alone].astype(complex)]
    eigenvalues += [_of_block(L, part, weights) for part in parts if len(part) > 1]
    values = in_order(np.concatenate(eigenvalues))
    return Spectrum(values, len(values), *_contraction(L, float(np.real(values[0]))))


def switching_spectrum(Ls: Sequence[sp.csr_array]) -> Spectrum:
    """Return the spectrum of graphs that take turns: all eigenvalues, and their common decay.

    The sum of squared errors does not depend on the graph, so it can decrease through switches. Its
    decay under a graph is the smallest eigenvalue of (L + L')/2; where that is not positive, the
    sum may grow.
    """
    eigenvalues, weakest, lost = list[Array](), np.inf, 0.0
    for L in Ls:
        dense = L.toarray()
        eigenvalues.append(np.linalg.eigvals(dense).astype(complex))
        weakest = min(weakest, float(np.linalg.eigvalsh(0.5 * (dense + dense.T))[0]))
        lost = max(lost, _ROUNDING * len(dense) * float(np.abs(dense).sum(axis=1).max()))
    values, weakest = in_order(np.concatenate(eigenvalues), lost), max(0.0, weakest - lost)
    return Spectrum(values, len(values), weakest, None, weakest)


def in_order(values: Array, lost: float = 0.0) -> Array:
    """Return eigenvalues (K,) by their real parts, read-only; real where no part exceeds `lost`."""
    values = values[np.lexsort((np.imag(values), np.real(values)))]
    if np.abs(np.imag(values)).max(initial=0.0) <= lost:
        values = np.real(values).copy()
    values.setflags(write=False)
    return values


def _of_block(L: sp.csr_array, part: Array, weights: Array) -> Array:
    """Return the eigenvalues of a strongly connected component of followers."""
    if len(part) > _LARGEST:
        raise GraphError(
            f"a strongly connected component of the directed graph has {len(part)} followers, and "
            f"may have {_LARGEST}; remove arrows that close circles."
        )
    dense = L[part][:, part].toarray()
    if np.array_equal(dense, dense.T):
        values = np.linalg.eigvalsh(dense).astype(complex)
    else:
        values = np.linalg.eigvals(dense).astype(complex)
    least = int(np.real(values).argmin())
    low = _least(dense)
    if not low > 0.0:
        raise _weights_too_far_apart(weights)
    # It is real, and no eigenvalue has a smaller real part (Perron and Frobenius).
    values[least] = low
    return values


def _least(dense: Array) -> float:
    """Return the smallest eigenvalue of an irreducible L with L^-1 >= 0; 0 if it is not resolved.

    For every x > 0 it lies between the least and the largest (L x)_i / x_i (Collatz, Wielandt).
    """
    x, inverse, ends = np.ones(len(dense)), np.linalg.inv(dense), (0.0, 0.0)
    for _ in range(_ITERATIONS * 10):
        y = inverse @ x
        if not (y > 0.0).all():
            return 0.0
        ends = (x / y).min(), (x / y).max()
        x = y / y.max()
        if ends[1] - ends[0] <= 1e-13 * ends[1]:
            break
    # The error of the inverse shows in its product with the matrix.
    lost = float(np.abs(dense @ inverse - np.eye(len(dense))).max())
    return 0.0 if lost > _RESOLVED else float(0.5 * (ends[0] + ends[1]))


def _contraction(L: sp.csr_array, low: float) -> tuple[float, Array | None]:
    """Return the decay of a sum of squares with weights w, and w; 0 and None if there is none.

    With (L - s) x = 1 and (L' - s) y = 1, s below lambda_min, x and y are positive. With w = y / x
    the matrix W L + L'W - 2 s W has no positive entry off its diagonal and takes x > 0 to a
    positive vector, so it is positive definite.
    """
    ones = np.ones(len(L.diagonal()))
    shifted = sp.csc_array(L)
    shifted.setdiag(L.diagonal() - _SHARE * low)
    with np.errstate(all="ignore"):
        solved = spla.splu(shifted)
        x, y = solved.solve(ones), solved.solve(ones, trans="T")
        w = y / x
        positive = bool(np.isfinite(w).all() and (x > 0.0).all() and (y > 0.0).all())
    if not positive or w.max() > _FAR_APART * w.min():
        return 0.0, None
    w /= w.max()
    decay = contraction_bound(L, x, w)
    return (decay, w) if decay > 0.0 else (0.0, None)


def _weights_too_far_apart(weights: Array) -> GraphError:
    return GraphError(
        f"the weights of the graph range from {weights.min():.3g} to {weights.max():.3g}, too far "
        "apart to distinguish the smallest eigenvalue from 0; choose weights of similar size."
    )


def factor_inverse(L: sp.csr_array) -> spla.LinearOperator:
    """Return x -> L^-1 x for a sparse positive definite matrix, factored once."""
    # An ordering and a pivoting that keep L's symmetry give a factor many times sparser.
    symmetric = {"SymmetricMode": True}
    factor = spla.splu(sp.csc_array(L), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    return spla.LinearOperator(L.shape, factor.solve, dtype=np.float64)  # pyright: ignore


def _extremes(L: sp.csr_array) -> tuple[Array, Array]:
    """Return the ends of the spectrum of a sparse positive definite matrix, and the low vector."""
    # About 0 the smallest is well separated relative to its size; Lanczos on L finds it last.
    inverse = factor_inverse(L)
    smallest, vectors = spla.eigsh(L, k=1, sigma=0.0, OPinv=inverse)
    # The same about a bound of the largest, the sum of two neighbours' degrees (Anderson, Morley):
    # the largest of a line are so close that Lanczos on L hardly separates them.
    entries, degrees = sp.coo_array(L), L.diagonal()
    bound = 1.000001 * float((degrees[entries.row] + degrees[entries.col]).max())
    above = factor_inverse(sp.csr_array(bound * sp.eye_array(len(degrees)) - L))
    away = spla.LinearOperator(L.shape, lambda x: -above.matvec(x), dtype=np.float64)  # pyright: ignore
    largest = spla.eigsh(L, k=1, sigma=bound, OPinv=away, return_eigenvectors=False)
    return np.concatenate([smallest, largest]), vectors[:, 0]


def _spread(L: sp.csr_array, vector: Array) -> Array:
    """Inverse iteration gives entries to components on which the eigenvector vanishes."""
    _, piece = csgraph.connected_components(L, directed=False)
    size = np.zeros(piece.max() + 1)
    np.maximum.at(size, piece, np.abs(vector))
    if (size > _LEFT_OUT).all():
        return vector
    other = np.ones(len(vector))
    # Sums round the lightest of weights far apart away, and the matrix is nearly singular.
    with contextlib.suppress(RuntimeError), np.errstate(all="ignore"):
        inverse = factor_inverse(L)
        for _ in range(_ITERATIONS):
            other = inverse.matvec(other)
            largest = np.zeros_like(size)
            np.maximum.at(largest, piece, other)
            other = other / largest[piece]
    other = np.where(np.isfinite(other) & (other > 0.0), other, 1.0)
    return np.where(size[piece] > _LEFT_OUT, vector, other)
