"""One constant metric P for a polytope of Jacobians, by semidefinite programming."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from echelon.core.errors import GainError, MissingExtraError, listing
from echelon.core.linear import (
    eigenvalue_text,
    riccati,
    symmetric_basis,
    symmetric_part,
    with_unit_diagonal,
    without_warnings,
)
from echelon.core.types import Array

# ---- modes that forbid every constant metric -----------------------------------------------------

AXIS = 1e-9
"""Eigenvalues closer to the imaginary axis, in units of the norm, count as on it."""
_DEFECTIVE = 1e-6  # a spectral projector of norm 1e6 would need a P of condition 1e12


class Obstacle(NamedTuple):
    """A mode that no constant metric can keep from growing.

    Attributes:
        eigenvalue: 1/s; on the imaginary axis where the mode is `defective`.
        defective: whether it is a Jordan block on the axis rather than an unstable mode.
        states: indices of the states that take part, those that feed a Jordan block included.
    """

    vertex: int
    eigenvalue: complex
    defective: bool
    states: tuple[int, ...]


def obstacle(As: Array) -> Obstacle | None:
    """Return the first mode that forbids every P > 0 with P A_k + A_k'P <= 0, or None.

    It is an eigenvalue in the open right half plane, or one on the imaginary axis with a Jordan
    block: where A - s I and its square differ in rank, that is where the left and the right null
    space of A - s I do not pair. Singular values decide, relative to the norm of the balanced A.
    """
    for vertex, A in enumerate(vertices_of(As)):
        # The units of the states must not decide what counts as zero.
        A = scipy.linalg.matrix_balance(A, permute=False)[0]
        for s, right, left in axis_modes(A):
            # Left and right null spaces pair off where there is no chain; a chain's two ends are
            # orthogonal.
            _, cosines, turn = np.linalg.svd(left.conj().T @ right)
            lost = right @ turn[cosines < _DEFECTIVE].conj().T
            if lost.size:
                # (A - s I) w = v: the vector w that feeds the end v of a chain, and so makes it
                # grow.
                feeding = np.linalg.lstsq(A - s * np.eye(len(A)), lost)[0]
                return Obstacle(vertex, s, True, _support(np.hstack([lost, feeding])))
        # After the axis, since rounding scatters a Jordan block to both sides of it.
        values, vectors = np.linalg.eig(A)
        worst = int(np.argmax(np.real(values)))
        if values[worst].real > AXIS * np.linalg.norm(A, 2):
            return Obstacle(vertex, complex(values[worst]), False, _support(vectors[:, [worst]]))
    return None


def vertices_of(As: Array) -> Array:
    """Return As as a float64 array (K, n, n), K >= 1, of finite numbers."""
    As = np.asarray(As, dtype=np.float64)
    if As.ndim != 3 or As.shape[1] != As.shape[2] or not As.size or not np.isfinite(As).all():
        raise GainError(f"`As` has shape {As.shape}, and must be (K, n, n) finite numbers, K >= 1.")
    return As


def axis_modes(A: Array) -> list[tuple[complex, Array, Array]]:
    """Return each s = i w, w >= 0, on the imaginary axis with right and left null space of A - s I.

    Rounding scatters the eigenvalues of a Jordan block and leaves their mean in place, so means of
    clusters are tried, the widest first.
    """
    size, values = float(np.linalg.norm(A, 2)) or 1.0, np.linalg.eigvals(A)
    points: dict[float, complex] = {}
    # A block of k scatters by eps^(1/k), which is 1e-3 for five: hence radii from a tenth of the
    # norm.
    for radius in size * 10.0 ** np.arange(-1.0, -11.0, -1.0):
        close = np.abs(values[:, None] - values) <= radius
        for mean in (close @ values) / close.sum(1):
            # A is real, so -w mirrors w.
            if abs(mean.real) <= AXIS * size and mean.imag >= -AXIS * size:
                points.setdefault(round(float(mean.imag / size), 10), 1j * mean.imag)
    cuts = [(s, *np.linalg.svd(A - s * np.eye(len(A)))) for s in points.values()]
    modes = [(s, v[w <= AXIS * size].conj().T, u[:, w <= AXIS * size]) for s, u, w, v in cuts]
    return [mode for mode in modes if mode[1].size]


def _support(vectors: Array) -> tuple[int, ...]:
    """Return the rows that hold a tenth or more of a column's largest entry."""
    sizes = np.abs(vectors)
    return tuple(np.flatnonzero((sizes >= 0.1 * sizes.max(0)).any(1)).tolist())


# ---- the metric ----------------------------------------------------------------------------------
# `As` holds the vertices A_k of the polytope; what eigenvalues show there holds on the convex hull.
# Under u = u_ff - c R^-1 B'P z a disagreement along an eigenvector of the grounded Laplacian with
# eigenvalue lambda obeys A - c lambda B R^-1 B'P. So with
#
# P A_k + A_k'P - rho P B R^-1 B'P <= -2 rate P for every k
#
# any coupling c >= rho / (2 lambda_min) makes V = sum delta_i'P delta_i fall like exp(-2 rate t) or
# faster: the strength rho = 2 c lambda_min is all that a metric needs of the graph. A solver
# proposes P and decides nothing: eigenvalues in the caller's own states accept or refuse it.

_STRICT = 1e-6  # the solver must keep, in scaled states, so that its own error does not reach zero
_FIRST, _BATCH = 16, 12  # vertices that the solver sees at first; violated ones added at a time


class Metric(NamedTuple):
    """A constant metric and what eigenvalues say of it on every vertex.

    Attributes:
        P: (n, n) symmetric positive definite, in the caller's states.
        rho: strength 2 c lambda_min that it needs; 0 where the drift alone does not expand P.
        rate: the largest alpha, 1/s, with P A_k + A_k'P - rho P B R^-1 B'P <= -2 alpha P.
        condition: largest over smallest eigenvalue of P.
        margin: largest eigenvalue, over k, of P A_k + A_k'P - rho P B R^-1 B'P.
    """

    P: Array
    rho: float
    rate: float
    condition: float
    margin: float


def rate_of(
    P: Array, As: Array, B: Array | None = None, R: Array | None = None, strength: float = 0.0
) -> float:
    """Return the largest alpha with P A_k + A_k'P - strength P B R^-1 B'P <= -2 alpha P for all k.

    Args:
        P: (n, n) symmetric positive definite.
        As: (K, n, n) vertices, 1/s.
        B: (n, m), or (K, n, m) where the input map differs from vertex to vertex.
        R: (m, m) weight of the inputs; the identity when left out.
        strength: 2 c lambda_min.

    Raises:
        GainError: P is not symmetric positive definite, or a number is not finite.
    """
    fine = np.isfinite(P).all() and np.allclose(P, P.T, 1e-9, 0.0)
    if not (fine and np.linalg.eigvalsh(with_unit_diagonal(P))[0] > 0.0):
        raise GainError("`P` must be a symmetric positive definite matrix of finite numbers.")
    return _rate(P, vertices_of(As), None if B is None else _weigh_inputs(B, R), strength)


def monotone(As: Array, condition_max: float = 1e4, names: Sequence[str] | None = None) -> Metric:
    """Return the best conditioned P with P A_k + A_k'P <= 0 for all k (the paper's Assumption 5).

    One that the smallest change of the vertices would spoil may be missed.

    Args:
        As: (K, n, n) vertices, 1/s.
        condition_max: a P whose condition number reaches it counts as none.
        names: of the states, for the message.

    Raises:
        GainError: a mode forbids it, and is named, or no such P was found.
        MissingExtraError: cvxpy or clarabel is not installed.
    """
    As, forbidden = vertices_of(As), obstacle(As)
    if forbidden is not None:
        along = listing(names[i] if names else f"x{i + 1}" for i in forbidden.states)
        kind = "a Jordan block on the imaginary axis" if forbidden.defective else "an unstable mode"
        mode = f"{eigenvalue_text(forbidden.eigenvalue)} 1/s along {along}"
        what = f"matrix {forbidden.vertex} has {kind}, at {mode}"
        raise GainError(
            f"no P > 0 keeps this drift from expanding: {what}; damp it by an inner loop, shrink "
            "the domain, or take a method with feedback."
        )
    cp = _cvxpy()
    # One scaling for all vertices: that which balances the sum of their sizes.
    d = scipy.linalg.matrix_balance(np.abs(As).sum(0), permute=False, separate=True)[1][0]
    basis, slopes = _face(As * d / d[:, None])
    x, kappa, unit = cp.Variable(len(basis)), cp.Variable(), np.diag(d**2)
    P = _matrix(cp, basis, x)
    cones = [P - unit >> 0, kappa * unit - P >> 0, kappa <= condition_max]
    solved = _least(cp, kappa, cones, _gaps(cp, slopes, x))
    P = symmetric_part(P.value / d[:, None] / d) if solved else np.zeros_like(unit)
    # A P at the bound has no optimum there: it would go on growing, as where none exists.
    if _condition(P) >= 0.999 * condition_max or not falls(P, As):
        raise GainError(
            f"no constant metric of condition number below {condition_max:g} was found that no "
            f"vertex of {len(As)} expands, though none alone forbids it; shrink the domain, add "
            "damping by an inner loop, or take a method with feedback."
        )
    metric = _measure(P / np.linalg.eigvalsh(P)[0], As, None, 0.0)
    # The inequality guarantees no rate; a rate below 0 is rounding.
    return metric._replace(rate=max(0.0, metric.rate))


def robust_lqr(As: Array, B: Array, Q: Array, R: Array, W: Array | None = None) -> Metric:
    """Return the P of least trace with A_k'P + P A_k + Q - P B R^-1 B'P <= 0 for all k.

    The rate is measured at rho = 1, the edge c = 1/(2 lambda_min); the inequality makes it half the
    smallest eigenvalue of P^-1 Q or more, to the solver's accuracy, and a larger rho no smaller.

    Args:
        As: (K, n, n) vertices, 1/s.
        B: (n, m), or (K, n, m) where the input map differs from vertex to vertex.
        Q: (n, n) symmetric positive semidefinite.
        R: (m, m) symmetric positive definite.
        W: (K, n, n), what stands for B R^-1 B' at each vertex of a hull of pairs, where that hull
            goes beyond products; B then only scales the states.

    Raises:
        GainError: no such P was found.
        MissingExtraError: cvxpy or clarabel is not installed.
    """
    cp, As = _cvxpy(), vertices_of(As)
    M, S = _scale(As, B, Q, R), _weigh_inputs(B, R) if W is None else W
    basis, one = symmetric_basis(len(M)), np.eye(len(M))
    values, vectors = np.linalg.eigh(Q)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T @ np.linalg.inv(M)
    v, y = cp.Variable(len(basis)), cp.Variable(len(basis))
    Z = cp.Variable(one.shape, symmetric=True)
    # Y stands for V Q V, V = P^-1, once for all vertices: each vertex's own cone stays n x n.
    V, Y = _matrix(cp, basis, v), _matrix(cp, basis, y)
    # Schur complements: Z >= V^-1 = P and Y >= V Q V.
    cones = [cp.bmat([[Z, one], [one, V]]) >> 0, cp.bmat([[Y, V @ root.T], [root @ V, one]]) >> 0]
    # Times V from both sides the inequality is A V + V A' + V Q V - S <= 0, linear in V and Y.
    gaps = _gaps(cp, _stack(As, S, M, basis), cp.hstack([v, y, [-1.0]]))
    solved = _least(cp, cp.trace(M @ M.T @ Z), cones, gaps)
    P = _unscale(V.value, M) if solved else None
    if P is None or _rate(P, As, S, 1.0) <= 0.0:
        raise GainError(
            f"no constant metric was found that one gain contracts on all of the {len(As)} "
            "matrices; shrink the domain, or weigh the input less in `R`."
        )
    return _measure(P, As, S, 1.0)


def contraction(
    As: Array, B: Array, rate: float, condition_max: float = 1e4, W: Array | None = None
) -> Metric:
    """Return the metric of least strength rho that contracts every vertex at `rate`, with R = I.

    V = P^-1 solves: min rho, A_k V + V A_k' - rho B B' + 2 rate V < 0, I <= V <= condition_max I.

    Args:
        As: (K, n, n) vertices, 1/s.
        B: (n, m), or (K, n, m) where the input map differs from vertex to vertex.
        rate: 1/s, not negative.
        condition_max: largest condition number of P.
        W: (K, n, n) in place of B B', as in `robust_lqr`.

    Raises:
        GainError: `rate` is out of range, or no such P was found.
        MissingExtraError: cvxpy or clarabel is not installed.
    """
    if not 0.0 <= rate < np.inf:
        raise GainError(f"`rate` is {rate}, and must be finite and not negative.")
    cp, As = _cvxpy(), vertices_of(As)
    n = As.shape[-1]
    M = _scale(As + rate * np.eye(n), B, np.eye(n), np.eye(B.shape[-1]))
    S = _weigh_inputs(B, None) if W is None else W
    # The solver's error grows with V: a little more is requested than eigenvalues must show.
    more = _STRICT * np.linalg.norm(M @ As @ np.linalg.inv(M), axis=(1, 2)).max()
    shifted, basis, unit = As + (rate + more) * np.eye(n), symmetric_basis(n), M @ M.T
    v, rho = cp.Variable(len(basis)), cp.Variable(nonneg=True)
    V = _matrix(cp, basis, v)
    gaps = _gaps(cp, _stack(shifted, S, M, basis[:0]), cp.hstack([v, -rho]))
    # A thousandth inside the bound, which the solver's error may then use up.
    solved = _least(cp, rho, [V - unit >> 0, 0.999 * condition_max * unit - V >> 0], gaps)
    P = _unscale(V.value, M) if solved else None
    # None at all where the drift needs none, of which a solver makes 1e-10. A little more strength
    # than the solver's makes up for its error and costs nothing else.
    tried = max(0.0, float(rho.value)) * np.array([0.0, 1.0, 1.0001, 1.01, 1.1]) if solved else []
    enough = [float(s) for s in tried if P is not None and _rate(P, As, S, float(s)) >= rate]
    if P is None or _condition(P) > condition_max or not enough:
        raise GainError(
            f"no constant metric of condition number up to {condition_max:g} was found that one "
            f"gain contracts at {rate:g} 1/s on all of the {len(As)} matrices; take a smaller "
            "`rate` or shrink the domain."
        )
    return _measure(P, As, S, enough[0])


def _weigh_inputs(B: Array, R: Array | None) -> Array:
    """Return B R^-1 B', (n, n) or (K, n, n)."""
    return B @ (B.swapaxes(-1, -2) if R is None else np.linalg.solve(R, B.swapaxes(-1, -2)))


def _drift(P: Array, As: Array, S: Array | None, strength: float) -> Array:
    """Return P A_k + A_k'P - strength P S P, (K, n, n), symmetric."""
    pull = P @ As
    if S is not None and strength:
        pull = pull - 0.5 * strength * (P @ S @ P)
    return pull + pull.swapaxes(-1, -2)


def _rate(P: Array, As: Array, S: Array | None, strength: float) -> float:
    # The pencil (X, P) has the eigenvalues of L^-1 X L^-T for P = L L', which is symmetric.
    inverse = np.linalg.inv(np.linalg.cholesky(P))
    X = inverse @ _drift(P, As, S, strength) @ inverse.T
    return -0.5 * float(np.linalg.eigvalsh(0.5 * (X + X.swapaxes(-1, -2))).max())


def _condition(P: Array) -> float:
    low, high = np.linalg.eigvalsh(P)[[0, -1]]
    return float(high / low) if low > 0.0 else np.inf


def falls(P: Array, As: Array, error: float | None = None) -> bool:
    """Return whether no P^-1 (P A_k + A_k'P) has an eigenvalue above what an error makes of it.

    The error is relative to the entries, and that of rounding when left out.
    """
    error = 4.0 * len(P) * np.finfo(float).eps if error is None else error
    inverse = np.abs(np.linalg.inv(np.linalg.cholesky(P)))
    size = inverse @ _drift(np.abs(P), np.abs(As), None, 0.0) @ inverse.T
    return -2.0 * rate_of(P, As) <= error * float(size.sum(-1).max())


def _measure(P: Array, As: Array, S: Array | None, rho: float) -> Metric:
    margin = float(np.linalg.eigvalsh(_drift(P, As, S, rho)).max())
    return Metric(P, rho, _rate(P, As, S, rho), _condition(P), margin)


def _cvxpy() -> Any:
    try:
        # Imported here: both are an extra, and slow to load.
        import clarabel  # noqa: F401
        import cvxpy
    except ImportError:
        raise MissingExtraError(
            "a metric for a polytope of Jacobians needs cvxpy and clarabel; "
            "install them with `pip install '.[certify]'` in echelon's clone."
        ) from None
    return cvxpy


def _least(cp: Any, goal: Any, cones: list[Any], gaps: list[Any]) -> bool:
    """Few vertices bind, so those that a solution violates are added until there are none."""
    new = np.unique(np.linspace(0, len(gaps) - 1, min(len(gaps), _FIRST)).astype(int)).tolist()
    active = list[int]()
    while True:
        active += new
        cones = [*cones, *(gaps[k] + _STRICT * np.eye(gaps[k].shape[0]) << 0 for k in new)]
        with without_warnings():
            try:
                # What a solver calls inaccurate may do, and what it calls solved may not:
                # eigenvalues decide.
                cp.Problem(cp.Minimize(goal), cones).solve(solver=cp.CLARABEL, accept_unknown=True)
            except cp.SolverError:
                return False
        if goal.value is None or not np.isfinite(goal.value):
            return False
        # Half of the margin, since the solver keeps the whole of it to its own accuracy only.
        over = np.array([np.linalg.eigvalsh(gap.value)[-1] for gap in gaps]) + 0.5 * _STRICT
        new = [k for k in np.argsort(-over)[:_BATCH].tolist() if over[k] > 0.0 and k not in active]
        if not new:
            return True


def _matrix(cp: Any, basis: Array, x: Any) -> Any:
    """Return sum_i x_i basis_i."""
    return cp.reshape(basis.reshape(len(basis), -1).T @ x, basis.shape[1:], order="C")


def _pull(As: Array, basis: Array) -> Array:
    """Return A_k E_i + E_i A_k', (K, d, n, n)."""
    return (product := As[:, None] @ basis) + product.swapaxes(-1, -2)


def _gaps(cp: Any, slopes: list[Array], x: Any) -> list[Any]:
    """Turned by a dense orthogonal matrix: unturned, 60 x 12 states take ten times as long."""
    # Here, since it takes long to load.
    import scipy.fft

    turns = [np.asarray(scipy.fft.dct(np.eye(X.shape[1]), norm="ortho")) for X in slopes]
    return [_matrix(cp, U @ X @ U.T, x) for U, X in zip(turns, slopes, strict=True)]


def _stack(As: Array, S: Array, M: Array, more: Array) -> list[Array]:
    """Return A_k E_i + E_i A_k', then `more`, then S_k, in the states M x, for each k."""
    S = np.broadcast_to(M @ S @ M.T, As.shape)
    pulls = _pull(M @ As @ np.linalg.inv(M), symmetric_basis(len(M)))
    return [np.concatenate([X, more, s[None]]) for X, s in zip(pulls, S, strict=True)]


def _scale(As: Array, B: Array, Q: Array, R: Array) -> Array:
    """Return M with M'M the Riccati P of the mean, so that metrics are near I in the states M x."""
    try:
        return np.linalg.cholesky(riccati(As.mean(0), B if B.ndim == 2 else B.mean(0), Q, R)).T
    except (GainError, np.linalg.LinAlgError):
        return np.eye(As.shape[-1])


def _unscale(W: Array, M: Array) -> Array | None:
    """Return P in the caller's states from W = P^-1 in the states M x."""
    return None if _condition(W) == np.inf else symmetric_part(M.T @ np.linalg.inv(W) @ M)


def _face(A: Array) -> tuple[Array, list[Array]]:
    """Return a basis E of the P that modes on the axis allow, and X_k(E) where it may be negative.

    Along a mode v on the imaginary axis v*(P A + A'P) v = 0, so that a semidefinite X = P A + A'P
    must send v to 0: an equation for P. Where X_k vanishes for every P that is left, it has no room
    to be negative, and the solver must not look for any.
    """
    A = A.swapaxes(1, 2) / (np.abs(A).max() or 1.0)
    basis = symmetric_basis(A.shape[-1])
    equations = [
        np.moveaxis(X @ part, 0, -1).reshape(-1, len(basis))
        for X, a in zip(_pull(A, basis), A, strict=True)
        for _, v, _ in axis_modes(a.T)
        for part in (np.real(v), np.imag(v))
    ]
    if not equations:
        return basis, list(_pull(A, basis))
    # R has the right singular vectors of the equations and far fewer rows.
    _, size, right = np.linalg.svd(np.linalg.qr(np.vstack(equations), mode="r"))
    allowed = right[int((size > AXIS).sum()) :]
    basis = np.tensordot(allowed, basis, 1) if len(allowed) else basis  # then there is no point
    cuts = [np.linalg.svd(np.hstack([*X]), full_matrices=False)[:2] for X in _pull(A, basis)]
    frees = [left[:, size > AXIS] for left, size in cuts]
    return basis, [F.T @ X @ F for F, X in zip(frees, _pull(A, basis), strict=True) if F.size]
