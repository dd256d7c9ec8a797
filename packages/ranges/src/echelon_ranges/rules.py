"""Rules that evaluate constants and primitives of JAX for polynomials."""

from fractions import Fraction

import numpy as np
from jax.extend.core import JaxprEqn

from echelon_ranges.atoms import Atoms, Polynomial, constant
from echelon_ranges.errors import RangeError
from echelon_ranges.interval import Interval
from echelon_ranges.jaxpr import compute, map_entries


def lift(array: np.ndarray) -> np.ndarray:
    """Return floats as exact constant polynomials, and integers and booleans unchanged."""
    if array.dtype.kind in "biu":
        return array
    if array.dtype.kind == "c":
        raise RangeError("the model is complex, and must be real.")
    numbers = array.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise RangeError("the model holds a constant that is not finite.")
    return map_entries(constant, numbers)


def outside() -> object:
    """Raise an error for a read outside of an array, whose value is unknown."""
    raise RangeError("the model reads outside of an array.")


def fold(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return the float64 results of an unknown primitive whose operands are all constants."""
    values = [map_entries(number, a) if a.dtype == object else a for a in operands]
    if any(v is None for a in values for v in a.flat):
        raise RangeError(
            f"the model uses `{equation.primitive.name}`, which the hull of "
            "Jacobians does not know; allowed are arithmetic, powers, trigonometric and hyperbolic "
            "functions, exponentials, logarithms, absolute values and choices by `where`."
        )
    # In float64, as the program itself computes with its constants.
    numbers = [np.asarray(a, np.float64) if a.dtype == object else a for a in values]
    return [lift(a) for a in compute(equation, numbers)]


def number(p: object) -> Fraction | None:
    """Return the value of a constant entry, otherwise None."""
    return p.value() if isinstance(p, Polynomial) else None


def reciprocal(atoms: Atoms, p: Polynomial) -> Polynomial:
    """Return 1 / p, exact if p is a constant."""
    value = p.value()
    return constant(1 / value) if value else atoms.elementary("reciprocal", p)


def whole_power(atoms: Atoms, p: Polynomial, k: int) -> Polynomial:
    """Return p to an integer power, which may be negative."""
    return p.power(k) if k >= 0 else reciprocal(atoms, p).power(-k)


def power(atoms: Atoms, p: Polynomial, exponent: Polynomial | int) -> Polynomial:
    """Return p to a constant power: integer, 1/2, or exp(k log p)."""
    k = exponent.value() if isinstance(exponent, Polynomial) else Fraction(int(exponent))
    if k is None:
        raise RangeError(
            "the model raises to a power that varies, which the hull of Jacobians "
            "does not know; write it by `exp` and `log`."
        )
    if k.denominator == 1:
        return whole_power(atoms, p, int(k))
    # A root has its own enclosure, valid at 0, where the logarithm has none.
    if abs(k) == Fraction(1, 2):
        return atoms.elementary("sqrt" if k > 0 else "rsqrt", p)
    return atoms.elementary("exp", constant(k) * atoms.elementary("log", p))


def atan2(atoms: Atoms, y: Polynomial, x: Polynomial) -> Polynomial:
    """Return the angle of the point (x, y) for x > 0, else raise `RangeError`."""
    reached = atoms.range(x)
    if reached.lo <= 0:
        raise RangeError(
            "the model takes `atan2` with a second argument that may be anything "
            f"in {reached.text()} on the domain, and must be positive; make the domain smaller."
        )
    # atan2(y, x) = atan(y / x) for x > 0. Elsewhere it is discontinuous.
    return atoms.elementary("atan", y * reciprocal(atoms, x))


def absolute(atoms: Atoms, p: Polynomial) -> Polynomial:
    """Return |p|; this is p or -p if the sign is certain."""
    reached = atoms.range(p)
    if reached.lo >= 0:
        return p
    return -p if reached.hi <= 0 else atoms.elementary("abs", p)


def larger(atoms: Atoms, a: Polynomial, b: Polynomial) -> Polynomial:
    """Return max(a, b)."""
    left, right = atoms.range(a), atoms.range(b)
    # Equal terms cancel in a - b, so its sign may be certain even if the ranges overlap.
    difference = atoms.range(a - b)
    if difference.lo >= 0 or difference.hi <= 0:
        return a if difference.lo >= 0 else b
    reached = Interval(max(left.lo, right.lo), max(left.hi, right.hi))
    return atoms.fresh(("max", frozenset([a.key(), b.key()])), reached, a, b)
