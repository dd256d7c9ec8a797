"""Spectra of grounded Laplacians of undirected, directed and switching graphs."""

from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from echelon.agents.network.bound import Grounded, contraction_bound, least_eigenvalue_bound
from echelon.agents.network.spectrum import Spectrum
from echelon.core.errors import GraphError
from echelon.core.types import Array

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
    # Rounding may have raised the eigenvalue, so its bound limits it.
    eigenvalues[0] = min(eigenvalues[0], proved / _ROUNDED)
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
    """Return an eigenvector with entries on all components into which leaders cut a network.

    Inverse iteration supplies the entries of a component on which the eigenvector vanishes.
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
