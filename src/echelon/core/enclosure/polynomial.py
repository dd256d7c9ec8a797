"""Polynomials in box variables and in sines and cosines of them, with rational coefficients.

A monomial contains each variable once, as a power x^k, and each angle once, as cos(w theta) or
sin(w theta). Products of waves are expanded to sums of waves at once, so c^2 + s^2 is 1 and equal
terms cancel.
"""

from fractions import Fraction
from typing import TypeAlias, final

Wave: TypeAlias = tuple[Fraction, int]
"""Frequency w > 0 in units of the angle, and 0 for cos(w theta) or 1 for sin(w theta)."""

Exponent: TypeAlias = int | Wave
Monomial: TypeAlias = tuple[tuple[int, Exponent], ...]
"""Indices of atoms, ascending, each with its power or its wave."""

_HALF = Fraction(1, 2)
_MOST_TERMS = 256  # of a quotient


def _wave_product(a: Wave, b: Wave) -> list[tuple[Fraction, Wave | None]]:
    """Return cos or sin of a times cos or sin of b as a sum of waves; None stands for 1."""
    (p, i), (q, j) = a, b
    # Two cosines or two sines make cosines, and one of each makes sines.
    part = i ^ j
    sum_sign = Fraction(-1 if i and j else 1)
    difference_sign = Fraction(-1 if j and not i else 1)
    terms: list[tuple[Fraction, Wave | None]] = [(_HALF * sum_sign, (p + q, part))]
    if p != q:
        # sin((p - q) x) is odd, and frequencies are kept positive.
        if part and p < q:
            difference_sign = -difference_sign
        terms.append((_HALF * difference_sign, (abs(p - q), part)))
    elif not part:
        terms.append((_HALF * difference_sign, None))
    return terms


def _monomial_product(a: Monomial, b: Monomial) -> list[tuple[Fraction, Monomial]]:
    """Return the product of two monomials as a sum of monomials."""
    result: list[tuple[Fraction, dict[int, Exponent]]] = [(Fraction(1), dict(a))]
    # A monomial contains each atom once: powers are merged, products of waves become two terms.
    for atom, exponent in b:
        present = dict(a).get(atom)
        for _, factors in result:
            factors.pop(atom, None)
        if present is None:
            options: list[tuple[Fraction, Exponent | None]] = [(Fraction(1), exponent)]
        elif isinstance(present, int) and isinstance(exponent, int):
            options = [(Fraction(1), present + exponent)]
        else:
            # Angles are atoms of their own (`_angle`), so no atom has both powers and waves.
            assert isinstance(present, tuple) and isinstance(exponent, tuple)
            options = [*_wave_product(present, exponent)]
        result = [
            (c * k, factors if new is None else {**factors, atom: new})
            for c, factors in result
            for k, new in options
        ]
    return [(c, tuple(sorted(factors.items()))) for c, factors in result]


@final
class Polynomial:
    """An immutable sum of monomials with nonzero rational coefficients."""

    __slots__ = ("terms",)

    def __init__(self, terms: dict[Monomial, Fraction]) -> None:
        self.terms = {monomial: c for monomial, c in terms.items() if c}

    def __add__(self, other: "Polynomial") -> "Polynomial":
        terms = dict(self.terms)
        for monomial, c in other.terms.items():
            terms[monomial] = terms.get(monomial, Fraction(0)) + c
        return Polynomial(terms)

    def __neg__(self) -> "Polynomial":
        return Polynomial({monomial: -c for monomial, c in self.terms.items()})

    def __sub__(self, other: "Polynomial") -> "Polynomial":
        return self + (-other)

    def __mul__(self, other: "Polynomial") -> "Polynomial":
        terms: dict[Monomial, Fraction] = {}
        for a, p in self.terms.items():
            for b, q in other.terms.items():
                for c, monomial in _monomial_product(a, b) if a and b else [(1, a or b)]:
                    terms[monomial] = terms.get(monomial, Fraction(0)) + p * q * c
        return Polynomial(terms)

    def power(self, k: int) -> "Polynomial":
        """Return the k-th power, k >= 0."""
        result = constant(1)
        for _ in range(k):
            result = result * self
        return result

    def key(self) -> frozenset[tuple[Monomial, Fraction]]:
        """Return a hashable key, equal only for equal polynomials."""
        return frozenset(self.terms.items())

    def value(self) -> Fraction | None:
        """Return the value of a constant polynomial, otherwise None."""
        return self.terms.get((), Fraction(0)) if set(self.terms) <= {()} else None

    def exponents(self) -> dict[int, set[Exponent]]:
        """Return which powers or waves of each atom occur."""
        result: dict[int, set[Exponent]] = {}
        for monomial in self.terms:
            for atom, exponent in monomial:
                result.setdefault(atom, set()).add(exponent)
        return result


def constant(x: Fraction | int | float) -> Polynomial:
    """Return the constant polynomial x, exactly."""
    return Polynomial({(): Fraction(x)})


def divides(divisor: Polynomial, p: Polynomial) -> bool:
    """Return whether p is a multiple of the divisor, and hence 0 wherever the divisor is 0."""
    lead = max(divisor.terms, key=order)
    quotient, rest = constant(0), p
    # With one divisor, the remainder is 0 if and only if every leading term is divisible.
    for _ in range(_MOST_TERMS):
        if not rest.terms:
            # A product of waves is not a monomial, so the result is verified by multiplication.
            return (quotient * divisor - p).terms == {}
        top = max(rest.terms, key=order)
        factor = monomial_quotient(top, lead)
        if factor is None:
            return False
        step = Polynomial({factor: rest.terms[top] / divisor.terms[lead]})
        quotient, rest = quotient + step, rest - step * divisor
    return False


def order(monomial: Monomial) -> list[tuple[int, int, str]]:
    """Return the key of the lexicographic order of monomials, low atom indices first."""
    # An atom that is missing has the power 0, which sorts below any other: hence the minus.
    return [(-atom, e, "") if isinstance(e, int) else (-atom, 1, repr(e)) for atom, e in monomial]


def monomial_quotient(top: Monomial, lead: Monomial) -> Monomial | None:
    """Return the monomial top / lead, or None if `lead` does not divide `top`."""
    left = dict(top)
    for atom, e in lead:
        power = left.pop(atom, None)
        if isinstance(power, int) and isinstance(e, int) and power >= e:
            if power > e:
                left[atom] = power - e
        elif power != e:
            return None
    return tuple(sorted(left.items()))
