"""Values with their slopes, and what smooth functions do to both.

A slope of a function is what its values differ by, over what its argument differs by.
"""

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import TypeAlias, final

from echelon.core.enclosure import rules
from echelon.core.enclosure.atoms import Atoms
from echelon.core.enclosure.polynomial import Polynomial, constant


@final
class Sloped:
    """A value, and its slopes by the number of the variable; a slope left out is 0."""

    __slots__ = ("slopes", "value")

    def __init__(self, value: Polynomial, slopes: Mapping[int, Polynomial]) -> None:
        self.value = value
        self.slopes = {k: p for k, p in slopes.items() if p.terms}

    def __add__(self, other: "Sloped") -> "Sloped":
        return chain(self.value + other.value, (self, constant(1)), (other, constant(1)))

    def __sub__(self, other: "Sloped") -> "Sloped":
        return self + (-other)

    def __neg__(self) -> "Sloped":
        return chain(-self.value, (self, constant(-1)))

    def __mul__(self, other: "Sloped") -> "Sloped":
        return chain(self.value * other.value, (self, other.value), (other, self.value))


def chain(value: Polynomial, *parts: tuple[Sloped, Polynomial]) -> Sloped:
    """Return a value whose slopes are those of its parts, each times the slope in that part."""
    total: dict[int, Polynomial] = {}
    for part, factor in parts:
        for k, slope in part.slopes.items():
            total[k] = total.get(k, constant(0)) + factor * slope
    return Sloped(value, total)


def number(x: float | Polynomial) -> Sloped:
    """Return a number, taken exactly, or what depends on no variable."""
    return Sloped(x if isinstance(x, Polynomial) else constant(x), {})


def variable(k: int, value: Polynomial) -> Sloped:
    """Return variable k of those that slopes are taken in."""
    return Sloped(value, {k: constant(1)})


# ---- functions without a bend --------------------------------------------------------------------

_Made: TypeAlias = Callable[[str, Polynomial], Polynomial]
_ONE = constant(1)

DERIVATIVES: dict[str, Callable[[_Made, Polynomial], Polynomial]] = {
    "reciprocal": lambda made, p: -made("reciprocal", p).power(2),
    # Slopes are written in the function itself where they can be: its value is an unknown already,
    # and a second one would widen the hull.
    "exp": lambda made, p: made("exp", p),
    "expm1": lambda made, p: made("exp", p),
    "log": lambda made, p: made("reciprocal", p),
    "log1p": lambda made, p: made("reciprocal", p + _ONE),
    # A root has no slope at 0, which its reciprocal refuses.
    "sqrt": lambda made, p: constant(Fraction(1, 2)) * made("rsqrt", p),
    "rsqrt": lambda made, p: constant(Fraction(-1, 2)) * made("rsqrt", p).power(3),
    "tan": lambda made, p: _ONE + made("tan", p).power(2),
    # At the ends of their range these have no slope, which `rsqrt` refuses.
    "asin": lambda made, p: made("rsqrt", _ONE - p * p),
    "acos": lambda made, p: -made("rsqrt", _ONE - p * p),
    "atan": lambda made, p: made("reciprocal", _ONE + p * p),
    "sinh": lambda made, p: made("cosh", p),
    "cosh": lambda made, p: made("sinh", p),
    "tanh": lambda made, p: _ONE - made("tanh", p).power(2),
    "logistic": lambda made, p: made("logistic", p) * (_ONE - made("logistic", p)),
}
"""The derivatives of the functions of `ELEMENTARY`, but for those that bend or jump."""


def elementary(atoms: Atoms, name: str, p: Sloped) -> Sloped:
    """Return a function of `ELEMENTARY` of p."""
    value = atoms.elementary(name, p.value)
    # Of a parameter no slope is wanted, and it may have none.
    return (
        chain(value, (p, DERIVATIVES[name](atoms.elementary, p.value)))
        if p.slopes
        else number(value)
    )


def quotient(atoms: Atoms, a: Sloped, b: Sloped) -> Sloped:
    """Return a / b."""
    # So all that is divided by b shares one unknown 1/b, and their ratios are not lost.
    return a * _reciprocal(atoms, b)


def _reciprocal(atoms: Atoms, p: Sloped) -> Sloped:
    value = rules.reciprocal(atoms, p.value)
    return chain(value, (p, -(value * value)))


def whole_power(atoms: Atoms, p: Sloped, k: int) -> Sloped:
    """Return p to the power of a whole number, which may be negative."""
    # Without the case 0 x^-1 would refuse a box that holds 0.
    slope = constant(k) * rules.whole_power(atoms, p.value, k - 1) if k else constant(0)
    return chain(rules.whole_power(atoms, p.value, k), (p, slope))


def power(atoms: Atoms, p: Sloped, exponent: Sloped | int) -> Sloped:
    """Return p to a constant power."""
    k = exponent.value if isinstance(exponent, Sloped) else constant(int(exponent))
    value = rules.power(atoms, p.value, k)
    return (
        chain(value, (p, k * rules.power(atoms, p.value, k - _ONE))) if p.slopes else number(value)
    )


def sine(atoms: Atoms, p: Sloped) -> Sloped:
    """Return sin p."""
    cosine, sine = atoms.circle(p.value)
    return chain(sine, (p, cosine))


def cosine(atoms: Atoms, p: Sloped) -> Sloped:
    """Return cos p."""
    cosine, sine = atoms.circle(p.value)
    return chain(cosine, (p, -sine))


def atan2(atoms: Atoms, y: Sloped, x: Sloped) -> Sloped:
    """Return the angle of the point (x, y) for x > 0."""
    value = rules.atan2(atoms, y.value, x.value)
    # Of numbers no slope is wanted, and none may exist.
    if not (y.slopes or x.slopes):
        return number(value)
    r = rules.reciprocal(atoms, x.value * x.value + y.value * y.value)
    return chain(value, (y, x.value * r), (x, -(y.value * r)))
