"""Proofs about float64 matrices in exact arithmetic: definiteness, and a rate of contraction.

Every float is a whole number over a power of two, so a matrix of floats is a matrix of integers
times a power of two. Elimination without fractions (Bareiss) keeps it so, and the signs of its
pivots, which are the leading minors, are facts, not measurements.
"""

from fractions import Fraction
from typing import NamedTuple, TypeAlias

import numpy as np

from echelon.core.cache import memoize
from echelon.core.errors import GainError
from echelon.core.types import Array
from echelon.core.words import amount

Number: TypeAlias = float | Fraction

_ASYMMETRY = 1e-9  # relative; more than rounding can explain


class Definiteness(NamedTuple):
    """Whether a matrix is positive definite, and the smallest pivot d of M = L diag(d) L'.

    Elimination ends at the first pivot that fails, which then is the smallest. `pivot` is rounded
    to a float, `holds` is exact.
    """

    holds: bool
    pivot: float


class ContractionProof(NamedTuple):
    """What `prove_contraction` found.

    `holds` is exact. `proved` counts the matrices shown definite: P, then the vertices in turn, up
    to the first that fails, whose number is `failed` (-1 for P, None where all hold).
    `smallest_pivot` is that of P and of all -M_k together.
    """

    holds: bool
    proved: int
    failed: int | None
    smallest_pivot: float


class _Scaled(NamedTuple):
    """The matrix `integers` / 2^`bits`, exactly; the integers are Python's, which never wrap."""

    integers: np.ndarray
    bits: int

    def times(self, other: "_Scaled") -> "_Scaled":
        if other.integers.ndim == 0:
            return _Scaled(self.integers * other.integers[()], self.bits + other.bits)
        return _Scaled(self.integers @ other.integers, self.bits + other.bits)

    def plus(self, other: "_Scaled") -> "_Scaled":
        bits = max(self.bits, other.bits)
        left, right = 1 << (bits - self.bits), 1 << (bits - other.bits)
        return _Scaled(self.integers * left + other.integers * right, bits)

    def minus(self, other: "_Scaled") -> "_Scaled":
        return self.plus(_Scaled(-other.integers, other.bits))

    def transpose(self) -> "_Scaled":
        return _Scaled(self.integers.T, self.bits)

    def absolute(self) -> "_Scaled":
        return _Scaled(abs(self.integers), self.bits)

    def row_sums(self) -> "_Scaled":
        return _Scaled(np.diag(self.integers.sum(axis=1)), self.bits)


def _scale(values: object, name: str) -> _Scaled:
    """Return floats (or dyadic fractions) as integers over one power of two."""
    # As objects they stay Python's numbers: float64 would round an integer above 2^53.
    array = np.asarray(values, object)
    try:
        fractions = [Fraction(x) for x in array.flat]
    except (ValueError, OverflowError, TypeError) as fault:
        raise GainError(f"`{name}` holds an entry that is no finite number.") from fault
    bits = max((f.denominator.bit_length() - 1 for f in fractions), default=0)
    # A power of two has one bit.
    if any(f.denominator & (f.denominator - 1) for f in fractions):
        raise GainError(f"`{name}` holds an entry that is no whole number over a power of two.")
    integers = np.empty(len(fractions), object)
    integers[:] = [f.numerator * ((1 << bits) // f.denominator) for f in fractions]
    return _Scaled(integers.reshape(array.shape), bits)


def _symmetrize(values: object, name: str) -> _Scaled:
    """Return the symmetric part of a square matrix, exactly; more than rounding is refused."""
    matrix = _scale(values, name)
    skew = matrix.minus(matrix.transpose()).absolute().integers
    if skew.size and skew.max() > _ASYMMETRY * Fraction(matrix.absolute().integers.max()):
        raise GainError(f"`{name}` is not symmetric, and must be.")
    both = matrix.plus(matrix.transpose())
    # One bit more halves, without rounding.
    return _Scaled(both.integers, both.bits + 1)


def _definiteness(matrix: _Scaled) -> Definiteness:
    rest, previous, smallest = matrix.integers, 1, None
    while len(rest):
        pivot, row, rest = rest[0, 0], rest[0, 1:], rest[1:, 1:]
        # The ratio of successive minors is the pivot of Gauss.
        size = Fraction(pivot, previous)
        smallest = size if smallest is None else min(smallest, size)
        if pivot <= 0:
            return Definiteness(False, _real(smallest, matrix.bits))
        # Bareiss: every entry is a minor of the matrix, so the division leaves no remainder.
        rest, previous = (rest * pivot - np.outer(row, row)) // previous, pivot
    return Definiteness(True, _real(smallest or Fraction(0), matrix.bits))


def _real(x: Fraction, bits: int) -> float:
    """Return x / 2^bits as a float."""
    return float(x / (1 << bits))


@memoize
def prove_contraction(
    vertices: Array, error: Array, B: Array, P: Array, rho: Number, rate: Number
) -> ContractionProof:
    """Prove P A + A'P - rho P B B'P + 2 rate P < 0 and P > 0 for every A of a polytope.

    A runs over the convex hull of the vertices plus every matrix within +- error, entry by entry.
    The inequality is affine in A, so vertices suffice. An error dA adds S = P dA + dA'P, whose
    entries are at most D = |P| error + error' |P|; the diagonal of D's row sums minus S is
    diagonally dominant, so that diagonal is added instead. All numbers are taken as the exact
    rationals that they are, P after symmetrizing it.

    Args:
        vertices: (K, n, n).
        error: (n, n), not negative.
        B: (n, m).
        P: (n, n).
        rho: weight of the feedback, 2 c lambda_min for the law of coupling c, not negative.
        rate: of contraction, 1/s; e^(-rate t) bounds the P-norm.

    Raises:
        GainError: shapes do not fit, a number is not finite, `error` or `rho` is negative, or P is
            not symmetric.
    """
    _check_shapes(vertices, error, B, P)
    metric, slack = _symmetrize(P, "P"), _scale(error, "error")
    weight, speed = _scale(rho, "rho"), _scale(rate, "rate")
    if weight.integers[()] < 0 or (slack.integers < 0).any():
        raise GainError("`rho` and `error` must not be negative.")
    definite = _definiteness(metric)
    smallest, proved, failed = definite.pivot, int(definite.holds), None if definite.holds else -1
    # The same for all vertices, so that each costs one product and one elimination.
    constant = _constant_part(metric, slack, _scale(B, "B"), weight, speed)
    for number, vertex in enumerate(vertices) if definite.holds else ():
        drift = metric.times(_scale(vertex, "vertices"))
        definite = _definiteness(constant.minus(drift.plus(drift.transpose())))
        smallest = min(smallest, definite.pivot)
        if not definite.holds:
            failed = number
            break
        proved += 1
    return ContractionProof(failed is None, proved, failed, smallest)


def _constant_part(
    metric: _Scaled, slack: _Scaled, B: _Scaled, weight: _Scaled, speed: _Scaled
) -> _Scaled:
    """Return rho P B B'P - 2 rate P minus the diagonal that errors of A may add."""
    gain = metric.times(B)
    feedback = gain.times(gain.transpose()).times(weight)
    decay = metric.times(speed)
    spread = metric.absolute().times(slack)
    lost = spread.plus(spread.transpose()).row_sums()
    return feedback.minus(decay.plus(decay)).minus(lost)


def _check_shapes(vertices: Array, error: Array, B: Array, P: Array) -> None:
    n = len(P)
    shapes = {
        "vertices": (np.shape(vertices), (len(vertices), n, n)),
        "error": (np.shape(error), (n, n)),
        "B": (np.shape(B), (n, *np.shape(B)[1:2])),
        "P": (np.shape(P), (n, n)),
    }
    for name, (got, expected) in shapes.items():
        if got != expected or name == "B" and len(got) != 2:
            raise GainError(
                f"`{name}` has shape {got}, and must fit the {amount(n, 'state')} of `P`."
            )
    if not len(vertices):
        raise GainError("`vertices` is empty, and must hold at least one matrix.")
