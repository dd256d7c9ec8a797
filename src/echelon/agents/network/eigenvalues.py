"""Spectra of grounded Laplacians: of symmetric ones, and of those of directed graphs."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from echelon.agents.network.bound import Grounded, held_sum, least_eigenvalue_bound
from echelon.agents.network.spectrum import Spectrum
from echelon.core.errors import GraphError
from echelon.core.types import Array

# Below this many followers the dense eigenvalue routine is both faster and exact to rounding.
_DENSE = 400
_LARGEST = 1000
"""Followers that hear each other in circles, of which all eigenvalues are computed: a second."""
_RESOLVED = 1e-6
_LEFT_OUT = 1e-6
_ITERATIONS = 30
_ROUNDED = 1.0 - 1e-9
"""A bound this near to an eigenvalue takes nothing from it."""
_SHARE = 0.9
"""Of lambda_min, which the sum of a directed graph is made for: nearer to 1 its weights lie farther
apart, without end where followers do not hear each other in circles."""
_FAR_APART = 1e12
"""Of the weights of such a sum: beyond it floats know nothing of what it holds."""
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
    # Floats know it to the rounding of the largest.
    known = low if low > _RESOLVED * high else np.inf
    proved = least_eigenvalue_bound(grounded, _spread(L, vector), known)
    if not proved > 0.0:
        raise _unknown(np.append(grounded.weights, grounded.held[:, 1]))
    # Where rounding may have raised it, the eigenvalue is no better known than its bound.
    eigenvalues[0] = min(eigenvalues[0], proved / _ROUNDED)
    eigenvalues.setflags(write=False)
    return Spectrum(eigenvalues, grounded.size, proved)


def directed_spectrum(L: sp.csr_array, weights: Array) -> Spectrum:
    """Return the spectrum of a directed graph whose arrows have some weights, all eigenvalues.

    Followers that hear each other in circles make a block; in the order in which blocks hear each
    other L is block triangular, so that its eigenvalues are those of its blocks, and no chain of
    blocks takes digits from them.

    Raises:
        GraphError: the weights are too far apart, or a block is too large.
    """
    count, block = csgraph.connected_components(L, directed=True, connection="strong")
    order = np.argsort(block, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(block, minlength=count))[:-1])
    alone = np.concatenate([part for part in parts if len(part) == 1] or [np.zeros(0, int)])
    found = [L.diagonal()[alone].astype(complex)]
    found += [_of_block(L, part, weights) for part in parts if len(part) > 1]
    values = in_order(np.concatenate(found))
    return Spectrum(values, len(values), *_held(L, float(np.real(values[0]))))


def switching_spectrum(Ls: Sequence[sp.csr_array]) -> Spectrum:
    """Return the spectrum of graphs that take turns: eigenvalues of all, and what holds for each.

    The sum of all errors' squares is one for all graphs, so that it may fall whenever they switch;
    a graph holds it by the least eigenvalue of (L + L')/2, 0 or less where it does not.
    """
    found, weakest, lost = list[Array](), np.inf, 0.0
    for L in Ls:
        dense = L.toarray()
        found.append(np.linalg.eigvals(dense).astype(complex))
        weakest = min(weakest, float(np.linalg.eigvalsh(0.5 * (dense + dense.T))[0]))
        lost = max(lost, _ROUNDING * len(dense) * float(np.abs(dense).sum(axis=1).max()))
    values, weakest = in_order(np.concatenate(found), lost), max(0.0, weakest - lost)
    return Spectrum(values, len(values), weakest, None, weakest)


def in_order(values: Array, lost: float = 0.0) -> Array:
    """Return eigenvalues (K,) by their real parts, read-only; real where no part exceeds `lost`."""
    values = values[np.lexsort((np.imag(values), np.real(values)))]
    if np.abs(np.imag(values)).max(initial=0.0) <= lost:
        values = np.real(values).copy()
    values.setflags(write=False)
    return values


def _of_block(L: sp.csr_array, part: Array, weights: Array) -> Array:
    """Return the eigenvalues of followers that hear each other in circles."""
    if len(part) > _LARGEST:
        raise GraphError(
            f"{len(part)} followers of the directed graph hear each other in circles, and "
            f"eigenvalues are computed of up to {_LARGEST}; let fewer of them, or hear one way."
        )
    dense = L[part][:, part].toarray()
    if np.array_equal(dense, dense.T):
        values = np.linalg.eigvalsh(dense).astype(complex)
    else:
        values = np.linalg.eigvals(dense).astype(complex)
    least = int(np.real(values).argmin())
    low = _least(dense)
    if not low > 0.0:
        raise _unknown(weights)
    # Real, and of no eigenvalue is the real part smaller (Perron and Frobenius).
    values[least] = low
    return values


def _least(dense: Array) -> float:
    """Return the smallest eigenvalue of an irreducible L with L^-1 >= 0; 0 where it is not known.

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
    # What the inverse has lost shows in what it leaves of the identity.
    lost = float(np.abs(dense @ inverse - np.eye(len(dense))).max())
    return 0.0 if lost > _RESOLVED else float(0.5 * (ends[0] + ends[1]))


def _held(L: sp.csr_array, low: float) -> tuple[float, Array | None]:
    """Return what a sum of squares with weights w is held by, and w; 0 and none where none is.

    With (L - s) x = 1 and (L' - s) y = 1, s below lambda_min, x and y are positive, and w = y / x
    makes W L + L'W - 2 s W a matrix without positive entries off its diagonal that takes x > 0 to
    something positive: a positive definite one.
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
    held = held_sum(L, x, w)
    return (held, w) if held > 0.0 else (0.0, None)


def _unknown(weights: Array) -> GraphError:
    return GraphError(
        f"the weights of the graph lie between {weights.min():.3g} and {weights.max():.3g}, too "
        "far apart to tell its smallest eigenvalue from 0; bring them nearer to each other."
    )


def factor_inverse(L: sp.csr_array) -> spla.LinearOperator:
    """Return x -> L^-1 x for a sparse positive definite matrix, which is factored here, once."""
    # An ordering and a pivoting that keep L's symmetry leave a factor many times sparser.
    symmetric = {"SymmetricMode": True}
    factor = spla.splu(sp.csc_array(L), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
    return spla.LinearOperator(L.shape, factor.solve, dtype=np.float64)  # pyright: ignore


def _extremes(L: sp.csr_array) -> tuple[Array, Array]:
    """Return the ends of the spectrum of a sparse positive definite matrix, and the low vector."""
    # About 0 the smallest is far from the others, relative to itself; Lanczos on L finds it last.
    inverse = factor_inverse(L)
    smallest, vectors = spla.eigsh(L, k=1, sigma=0.0, OPinv=inverse)
    # The same about a bound of the largest, the sum of two neighbours' degrees (Anderson, Morley):
    # of a line the largest lie so close together that Lanczos on L hardly parts them.
    entries, degrees = sp.coo_array(L), L.diagonal()
    bound = 1.000001 * float((degrees[entries.row] + degrees[entries.col]).max())
    above = factor_inverse(sp.csr_array(bound * sp.eye_array(len(degrees)) - L))
    away = spla.LinearOperator(L.shape, lambda x: -above.matvec(x), dtype=np.float64)  # pyright: ignore
    largest = spla.eigsh(L, k=1, sigma=bound, OPinv=away, return_eigenvectors=False)
    return np.concatenate([smallest, largest]), vectors[:, 0]


def _spread(L: sp.csr_array, vector: Array) -> Array:
    """Return an eigenvector with entries on all pieces of a network that its leaders cut apart.

    On a piece that it leaves out, inverse iteration finds the piece's own.
    """
    _, piece = csgraph.connected_components(L, directed=False)
    size = np.zeros(piece.max() + 1)
    np.maximum.at(size, piece, np.abs(vector))
    if (size > _LEFT_OUT).all():
        return vector
    inverse, other = factor_inverse(L), np.ones(len(vector))
    for _ in range(_ITERATIONS):
        other = inverse.matvec(other)
        largest = np.zeros_like(size)
        np.maximum.at(largest, piece, other)
        other = other / largest[piece]
    return np.where(size[piece] > _LEFT_OUT, vector, other)
