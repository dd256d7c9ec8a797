"""Linear systems theory: discretization, controllability, observability, Riccati equation."""

import contextlib
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias, cast

import numpy as np
import scipy.linalg
from scipy.sparse.csgraph import connected_components

from echelon.core.errors import GainError
from echelon.core.limits import LARGEST
from echelon.core.numerics import INTEGRATORS
from echelon.core.rational import bisect
from echelon.core.types import Array

_DEGREE = 18  # of Taylor's polynomial: at norm 1 its remainder is 1e-17
_INTERVALS = 512  # of strengths at a time, each with a P of its own
_DOUBLINGS = 40  # of the number of steps, over which errors must vanish
_ENDED = 1e-9  # of what is left of an error then
_ROUNDING = 16 * float(np.finfo(float).eps)  # of a norm, times a condition number
_SCALINGS = 20  # each halves the decades by which rows and columns differ
_AXIS = 64 * float(np.finfo(float).eps)  # of the fastest mode's rate, that of rounding


_ROUNDS, _RESIDUAL = 20, 1e-10
"""Newton's, and what may be left."""


def newton_least(
    left: Callable[[Array], tuple[Array, Array]], start: Array, free: Array | None = None
) -> Array | None:
    """Return where `left`, which returns a remainder and its slope, is zero, by least changes.

    None where Newton's method finds none. Changes of entries count the less the larger their `free`
    (k,) is.
    """
    z, free = np.asarray(start, float), np.ones(len(start)) if free is None else free
    for _ in range(_ROUNDS):
        rest, slope = left(z)
        if np.abs(rest).max() <= _RESIDUAL:
            return z
        if not (np.isfinite(rest).all() and np.isfinite(slope).all()):
            return None
        z = z - free * np.linalg.lstsq(slope * free, rest, rcond=None)[0]
    return None


def discretize(
    A: np.ndarray, B: np.ndarray, dt: float, integrator: str | None = None, substeps: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return (F, G) of a step x+ = F x + G u of xdot = A x + B u, u held over dt (s).

    An integrator makes of a linear field a linear map, read off what it does to unit vectors in one
    of its substeps; the exact flow is taken without one. Shapes are (..., n, n) and (..., n, m).
    """
    n, m = B.shape[-2:]
    unit = np.eye(n + m)
    if integrator is None:
        # exp([[A, B], [0, 0]] dt) = [[e^(A dt), G], [0, I]] with G = int_0^dt e^(A s) B ds
        # (Van Loan).
        block = np.zeros((*A.shape[:-2], n + m, n + m))
        block[..., :n, :n], block[..., :n, n:] = A, B
        step_map = scipy.linalg.expm(block * dt)[..., :n, :]
    else:
        step = cast(Callable[..., np.ndarray], INTEGRATORS[integrator])
        step_map = step(lambda x, u: A @ x + B @ u, unit[:n], unit[n:], dt / substeps)
        if substeps > 1:
            held = np.broadcast_to(unit[n:], (*step_map.shape[:-2], m, n + m))
            whole = np.concatenate([step_map, held], axis=-2)
            step_map = np.linalg.matrix_power(whole, substeps)[..., :n, :]
    return step_map[..., :n], step_map[..., n:]


def matrix_exponential(X: np.ndarray) -> np.ndarray:
    """Return exp(X) of matrices (..., n, n), all scaled and squared alike.

    SciPy's waits on other threads for each of a stack of small matrices; products of a stack do
    not, and are as exact: the error of both is that of the squarings.
    """
    size = float(np.linalg.norm(X, 1, axis=(-2, -1)).max(initial=0.0))
    # A loop that is lost has no flow, and what comes of it is no number either way.
    squarings = max(0, int(np.ceil(np.log2(size)))) if 0.0 < size < np.inf else 0
    X, one = X * 0.5**squarings, np.eye(X.shape[-1])
    result = one + X / _DEGREE
    for k in range(_DEGREE - 1, 0, -1):
        result = one + X @ result / k
    for _ in range(squarings):
        result = result @ result
    return result


def sampled_radius(
    A: np.ndarray,
    B: np.ndarray,
    gains: np.ndarray,
    dt: float,
    integrator: str | None = None,
    substeps: int = 1,
) -> float:
    """Return the largest spectral radius of a step of xdot = A x - B K x(t_k), u held over dt.

    Args:
        A: (..., n, n).
        B: (..., n, m).
        gains: (..., m, n), broadcast with them for several loops.
        dt: s.
        integrator: its name; the exact flow without.
        substeps: of the integrator in a step.
    """
    F, G = discretize(A, B, dt, integrator, substeps)
    return float(spectral_radii(F - G @ gains).max())


def radius_between(F: Array, G: Array, low: float, high: float) -> float:
    """Return the largest spectral radius found of F - k G, low <= k <= high; 1 where undecided.

    (F - k G)'P (F - k G) is convex in k. So a P above it at both ends of an interval is above it
    on all of it, and no radius there reaches 1: intervals are halved until each has such a P.
    """
    ends, largest = np.array([[low, high]]), 0.0
    while len(ends) and largest < 1.0:
        middles = ends.mean(axis=1)
        radii = spectral_radii(steps := F - middles[:, None, None] * G)
        largest = max(largest, float(radii.max()))
        # A P in which errors decay half as fast as they do, in every direction.
        middle = steps / (0.5 + 0.5 * radii)[:, None, None]
        open_ = ~_fall(F - ends[..., None, None] * G, middle)
        if open_.sum() > _INTERVALS:
            return max(largest, 1.0)
        halves = np.stack([ends[:, 0], middles, ends[:, 1]], axis=1)[open_]
        ends = np.concatenate([halves[:, :2], halves[:, 1:]])
        # Halves of rounding's width say nothing more.
        if (ends[:, 1] - ends[:, 0] <= _ROUNDING * high).any():
            return max(largest, 1.0)
    return largest


def spectral_radii(matrices: Array) -> Array:
    """Return the spectral radius of each of matrices (..., n, n)."""
    return np.abs(np.linalg.eigvals(matrices)).max(axis=-1)


def _fall(steps: Array, middles: Array) -> Array:
    """Return (K,) whether a P that falls in a step (K, n, n) falls in both of its (K, 2, n, n)."""
    P, power = np.broadcast_to(np.eye(middles.shape[-1]), middles.shape), middles
    # The sum of all M^k' M^k, of which each round doubles the number of terms; one that grows
    # ends beyond all numbers.
    with np.errstate(all="ignore"):
        for _ in range(_DOUBLINGS):
            P, power = P + power.swapaxes(1, 2) @ P @ power, power @ power
    ended, one = np.abs(power).max(axis=(1, 2)) < _ENDED, np.eye(P.shape[-1])
    root = np.linalg.cholesky(np.where(ended[:, None, None], P, one)).swapaxes(1, 2)
    norms = np.linalg.norm(root[:, None] @ steps @ np.linalg.inv(root)[:, None], 2, (-2, -1))
    return ended & (norms.max(axis=1) < 1.0 - _ROUNDING * np.linalg.cond(root))


def longest_step(
    A: np.ndarray,
    B: np.ndarray,
    gains: np.ndarray,
    integrator: str | None = None,
    substeps: int = 1,
) -> float:
    """Return the longest dt (s) with which every loop xdot = A x - B K x(t_k) still decays.

    The step is lengthened by tenths from a thousandth of the fastest mode's time until a loop
    grows, and that last tenth is bisected; infinite where none grows up to a thousand times the
    slowest mode's. Shapes are those of `sampled_radius`.
    """

    def decays(dt: float) -> bool:
        return sampled_radius(A, B, gains, dt, integrator, substeps) < 1.0

    return longest_decay(decays, np.linalg.eigvals(A - B @ gains))


def longest_decay(decays: Callable[[float], bool], poles: Array) -> float:
    """Return the longest step (s) with which loops decay, searched as `longest_step` does."""
    # A mode on the imaginary axis has no slowest time; 1e-9 1/s keeps the search finite.
    dt, end = 1e-3 / np.abs(poles).max(), 1e3 / max(1e-9, float(np.abs(np.real(poles)).min()))
    while decays(1.1 * dt):
        dt *= 1.1
        if dt > end:
            return float("inf")
    # 20 halvings of a tenth leave 1e-7 of the step.
    return float(bisect(decays, dt, 1.1 * dt, 20))


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Let NumPy and SciPy compute without warnings what is judged by its result."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def eigenvalue_text(eigenvalue: complex) -> str:
    """Return an eigenvalue as text, without an imaginary part that is zero."""
    # Adding zero makes 0.0 of -0.0, whose sign would read as decay.
    real = f"{eigenvalue.real + 0.0:.3g}"
    return real if eigenvalue.imag == 0.0 else f"{real} +- {abs(eigenvalue.imag):.3g}i"


def symmetric_part(matrix: np.ndarray) -> np.ndarray:
    """Return (M + M^T) / 2."""
    return 0.5 * (matrix + matrix.T)


def symmetric_basis(n: int) -> np.ndarray:
    """Return a basis of the symmetric matrices, (n (n + 1) / 2, n, n)."""
    i, j = np.triu_indices(n)
    basis = np.zeros((len(i), n, n))
    basis[range(len(i)), i, j] = basis[range(len(i)), j, i] = 1.0
    return basis


def uncontrollable_modes(A: np.ndarray, B: np.ndarray) -> list[tuple[complex, np.ndarray]]:
    """Return the eigenvalues of A that input B cannot move, each with its left eigenvector.

    This is the PBH test, in any units: rows and columns of [s I - A, B] are scaled, which keeps
    its rank, until their largest entries are 1. A mode counts as uncontrollable when the smallest
    singular value is then below 1e-9.
    """
    balanced = scipy.linalg.matrix_balance(A, permute=False)[0]
    zero = 1e-9 * float(np.linalg.norm(balanced, 2))
    result = []
    for s in np.linalg.eigvals(A):
        shifted = s * np.eye(len(A)) - A
        # An eigenvalue is as exact as rounding lets it be.
        shifted[np.diag(np.abs(np.diag(shifted)) <= zero)] = 0.0
        pencil, rows = _equilibrated(np.hstack([shifted, B]))
        # u'[s I - A, B] = 0 for the last left singular vector u: a left eigenvector that B does not
        # see.
        left, singular, _ = np.linalg.svd(pencil)
        if singular[-1] <= 1e-9:
            result.append((complex(s), left[:, -1].conj() * rows))
    return result


def _equilibrated(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a matrix whose rows and columns have largest entries of 1, and the rows' scales."""
    rows = np.ones(len(matrix))
    for _ in range(_SCALINGS):
        sizes = np.abs(matrix).max(axis=1)
        sizes = 1.0 / np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
        across = np.abs(matrix).max(axis=0)
        matrix = sizes[:, None] * matrix / np.sqrt(np.where(across > 0.0, across, 1.0))
        rows *= sizes
    return matrix, rows


def equilibrated_rank(matrix: np.ndarray) -> int:
    """Return the rank of a matrix in any units: singular values above 1e-9 of the scaled one."""
    return int((np.linalg.svd(_equilibrated(matrix)[0], compute_uv=False) > 1e-9).sum())


def observability_rank(A: np.ndarray, C: np.ndarray) -> int:
    """Return the rank of the observability matrix [C; C A; ...], each block scaled to size 1."""
    block, rows = C, [C]
    for _ in range(len(A) - 1):
        block = block @ A
        # Powers of A spread over decades, in which the tolerance of a rank would lose the small
        # blocks.
        # Not by squares, which of 1e200 are beyond all numbers.
        size = np.abs(block).max()
        if size == 0.0:
            break
        block = block / size
        rows.append(block)
    return int(np.linalg.matrix_rank(np.vstack(rows)))


def riccati(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the stabilizing P of A'P + P A - P B R^-1 B'P + Q = 0, else raise `GainError`."""
    # SciPy refuses empty matrices, and an integrator has no state that an inner loop must damp.
    if not len(A):
        return np.zeros((0, 0))
    P = np.zeros_like(A, float)
    try:
        # Part by part, so that what has nothing to do with each other is 0 and not rounding: it
        # then costs nothing in a step.
        with without_warnings():
            for part in _uncoupled(A, B, Q, R):
                block = np.ix_(part, part)
                P[block] = _stabilizing(A[block], B[part], Q[block], R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise GainError(
            f"the Riccati equation has no stabilizing solution ({str(error).rstrip('.').lower()}); "
            "check that every undamped mode is weighted by `Q`."
        ) from error
    # Rounding leaves P asymmetric, and routines that read one triangle would differ from the rest.
    return symmetric_part(P)


def _stabilizing(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return SciPy's solution, after checking that it stabilizes."""
    P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    S = B @ np.linalg.solve(R, B.T)
    # The Hamiltonian's eigenvalues are those of A - S P and their mirror images. They are 0 where
    # rounding of P moves the loop's by a little; and its rates are those of the loop in any units.
    modes = np.linalg.eigvals(np.block([[A, -S], [-Q, -A.T]]))
    slowest = min(np.abs(modes.real).min(), -np.linalg.eigvals(A - S @ P).real.max())
    if not slowest > _AXIS * np.abs(modes).max():
        raise np.linalg.LinAlgError("a mode stays on the imaginary axis")
    return P


def _uncoupled(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> list[np.ndarray]:
    """Return the sets of states that neither the dynamics nor an input nor a weight couples."""
    coupled = np.block([[(A != 0.0) | (Q != 0.0), B != 0.0], [B.T != 0.0, R != 0.0]])
    count, label = connected_components(coupled, directed=False)
    parts = (np.flatnonzero(label[: len(A)] == k) for k in range(count))
    return [part for part in parts if len(part)]


Weight: TypeAlias = Sequence[float] | Sequence[Sequence[float]] | Array


def check_definite(name: str, matrix: np.ndarray) -> None:
    """Raise `GainError` unless a matrix is finite, symmetric (to 1e-9 of its size) and definite."""
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise GainError(f"`{name}` has shape {matrix.shape}, and must be square.")
    if not np.isfinite(matrix).all():
        raise GainError(f"`{name}` holds a number that is not finite.")
    _check_size(name, matrix)
    scaled = with_unit_diagonal(matrix)
    gap = np.abs(scaled - scaled.T)
    if gap.max() > 1e-9 * np.abs(scaled).max():
        i, j = np.unravel_index(np.argmax(gap), gap.shape)
        raise GainError(
            f"`{name}` is not symmetric: entry [{i}, {j}] is {matrix[i, j]:.6g} "
            f"and entry [{j}, {i}] is {matrix[j, i]:.6g}."
        )
    # `eigvalsh` reads one triangle, which is why symmetry comes first.
    check_eigenvalues(name, "positive definite", matrix, 0.0)


def check_eigenvalues(name: str, what: str, matrix: Array, bound: float) -> None:
    """Raise `GainError` that a matrix is not `what` unless its eigenvalues exceed a bound."""
    scaled, raw = (np.linalg.eigvalsh(m)[0] for m in (with_unit_diagonal(matrix), matrix))
    if not scaled > bound:
        least = raw if raw < 0.0 else scaled
        raise GainError(f"`{name}` is not {what}: its smallest eigenvalue is {least:.6g}.")


def with_unit_diagonal(matrix: Array) -> Array:
    """Return D M D with a diagonal of 1/2 to 2 in size, where that of M is not 0.

    D is diagonal and of powers of two, so that nothing is rounded. What is definite stays so, and
    the rounding of what has large units no longer hides it.
    """
    diagonal = np.abs(np.diag(matrix))
    halves = np.log2(diagonal, out=np.zeros(len(matrix)), where=diagonal > 0.0)
    places = -np.round(0.5 * halves).astype(int)
    return np.ldexp(matrix, places[:, None] + places)


def as_matrix(name: str, value: Weight, size: int) -> Array:
    """Return a weight as `size` x `size` matrix, a list as a diagonal; else raise `GainError`."""
    try:
        # A copy, so that no later change of the caller's own array changes a gain.
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise GainError(
            f"`{name}` is {value}, and must be {size} numbers or {size} x {size}."
        ) from None
    if array.shape == (size,):
        array = np.diag(array)
    if array.shape != (size, size):
        raise GainError(
            f"`{name}` has shape {array.shape}, and must be {size} numbers or {size} x {size}."
        )
    _check_size(name, array)
    return array


def _check_size(name: str, matrix: Array) -> None:
    largest = np.abs(matrix).max(initial=0.0)
    if LARGEST <= largest < np.inf:
        raise GainError(f"`{name}` goes up to {largest:.3g}, and must stay below {LARGEST:g}.")
