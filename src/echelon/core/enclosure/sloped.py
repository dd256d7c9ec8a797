"""Values with slopes, and the rules of smooth functions for both.

A slope of a function is the difference of two values divided by that of the arguments.
"""

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import TypeAlias, final

from echelon.core.enclosure import rules
from echelon.core.enclosure.atoms import Atoms
from echelon.core.enclosure.polynomial import Polynomial, constant


@final
class Sloped:
    """A value and its slopes by variable; a missing slope is 0."""

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
    """Return a value whose slopes follow from its parts by the chain rule."""
    total: dict[int, Polynomial] = {}
    for part, factor in parts:
        for k, slope in part.slopes.items():
            total[k] = total.get(k, constant(0)) + factor * slope
    return Sloped(value, total)


def number(x: float | Polynomial) -> Sloped:
    """Return an entry without slopes: an exact number or a polynomial."""
    return Sloped(x if isinstance(x, Polynomial) else constant(x), {})


def variable(k: int, value: Polynomial) -> Sloped:
    """Return slope variable k."""
    return Sloped(value, {k: constant(1)})


# ---- smooth functions ----------------------------------------------------------------------------

_Apply: TypeAlias = Callable[[str, Polynomial], Polynomial]
_ONE = constant(1)

DERIVATIVES: dict[str, Callable[[_Apply, Polynomial], Polynomial]] = {
    "reciprocal": lambda apply, p: -apply("reciprocal", p).power(2),
    # Written with the function itself if possible: its value is already an unknown, and a second
    # one would widen the hull.
    "exp": lambda apply, p: apply("exp", p),
    "expm1": lambda apply, p: apply("exp", p),
    "log": lambda apply, p: apply("reciprocal", p),
    "log1p": lambda apply, p: apply("reciprocal", p + _ONE),
    # sqrt has no slope at 0; `rsqrt` refuses this.
    "sqrt": lambda apply, p: constant(Fraction(1, 2)) * apply("rsqrt", p),
    "rsqrt": lambda apply, p: constant(Fraction(-1, 2)) * apply("rsqrt", p).power(3),
    "tan": lambda apply, p: _ONE + apply("tan", p).power(2),
    # No slope at the ends of the range; `rsqrt` refuses these.
    "asin": lambda apply, p: apply("rsqrt", _ONE - p * p),
    "acos": lambda apply, p: -apply("rsqrt", _ONE - p * p),
    "atan": lambda apply, p: apply("reciprocal", _ONE + p * p),
    "sinh": lambda apply, p: apply("cosh", p),
    "cosh": lambda apply, p: apply("sinh", p),
    "tanh": lambda apply, p: _ONE - apply("tanh", p).power(2),
    "logistic": lambda apply, p: apply("logistic", p) * (_ONE - apply("logistic", p)),
}
"""Derivatives of the smooth functions of `ELEMENTARY`."""


def elementary(atoms: Atoms, name: str, p: Sloped) -> Sloped:
    """Return a function of `ELEMENTARY` of p."""
    value = atoms.elementary(name, p.value)
    # A constant needs no slope, and the derivative may not exist there.
    return (
        chain(value, (p, DERIVATIVES[name](atoms.elementary, p.value)))
        if p.slopes
        else number(value)
    )


def quotient(atoms: Atoms, a: Sloped, b: Sloped) -> Sloped:
    """Return a / b."""
    # All quotients by b share one unknown 1/b, which preserves their ratios.
    return a * _reciprocal(atoms, b)


def _reciprocal(atoms: Atoms, p: Sloped) -> Sloped:
    value = rules.reciprocal(atoms, p.value)
    return chain(value, (p, -(value * value)))


def whole_power(atoms: Atoms, p: Sloped, k: int) -> Sloped:
    """Return p to an integer power, which may be negative."""
    # k = 0 separately: 0 x^-1 would refuse a box that contains 0.
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
    # Constants need no slope, and the derivative may not exist there.
    if not (y.slopes or x.slopes):
        return number(value)
    r = rules.reciprocal(atoms, x.value * x.value + y.value * y.value)
    return chain(value, (y, x.value * r), (x, -(y.value * r)))
