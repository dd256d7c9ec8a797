"""Slopes of a function on a box in exact arithmetic, independent of derivatives of JAX."""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import TypeAlias, final

import numpy as np
from jax.extend.core import JaxprEqn

from echelon_ranges import rules
from echelon_ranges.atoms import Atoms, Polynomial, constant, divides
from echelon_ranges.errors import JumpError, RangeError, listing
from echelon_ranges.interval import Interval
from echelon_ranges.jaxpr import Algebra, Params, Rule, dot, map_entries, reduction

# ---- values with slopes --------------------------------------------------------------------------
# A slope of a function is the difference of two values divided by that of the arguments.


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


# ---- slopes of a function ------------------------------------------------------------------------
# Each entry is a value with its slopes, and each primitive has a rule for both. Wrong derivatives
# (`stop_gradient`, a handwritten rule) therefore have no effect, and discontinuous functions are
# refused: a step, or a choice whose cases differ where it switches. At a kink (`max`, `abs`,
# `clip`, a continuous `where`) the slope is an unknown convex combination of both sides, the same
# one for all uses of one switch.


@final
@dataclasses.dataclass(frozen=True)
class UndecidedComparison:
    """A comparison whose result varies on the box.

    Attributes:
        chosen: 1 where it is true and 0 where it is false, except where a border is 0.
        borders: polynomials, one of which is 0 wherever the result changes.
        moves: whether a border has a slope; otherwise both ends of a secant have one result.
    """

    chosen: Polynomial
    borders: tuple[Polynomial, ...]
    moves: bool


_Entry: TypeAlias = Sloped | UndecidedComparison | bool | int
"""What an array in this algebra holds: values, or answers to comparisons."""
_ANSWERS = bool | np.bool_ | UndecidedComparison


def slopes_in(atoms: Atoms) -> Algebra:
    """Return the algebra of values with slopes; it raises `RangeError` where one is missing."""
    bound = {name: functools.partial(rule, atoms) for name, rule in _RULES.items()}
    return Algebra({**bound, **_SUMS}, number, _lift, rules.outside, _fold)


def _lift(array: np.ndarray) -> np.ndarray:
    lifted = rules.lift(array)
    return map_entries(number, lifted) if lifted.dtype == object else lifted


def _fold(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return the results of an unknown primitive whose operands are all constants."""
    plain = [map_entries(_parameter, a) if a.dtype == object else a for a in operands]
    result = rules.fold(equation, plain)
    return [map_entries(number, a) if a.dtype == object else a for a in result]


def _parameter(entry: object) -> Polynomial | None:
    """Return the value of an entry without slopes, otherwise None."""
    return entry.value if isinstance(entry, Sloped) and not entry.slopes else None


def _function(function: Callable[..., object]) -> Rule:
    return lambda atoms, params, *arrays: map_entries(functools.partial(function, atoms), *arrays)


# ---- functions with a kink -----------------------------------------------------------------------


def _mixture(value: Polynomial, side: Polynomial, one: Sloped, other: Sloped) -> Sloped:
    """Return a value with the slopes of `one` where the side is 1 and of `other` where it is 0."""
    return chain(value, (one, side), (other, constant(1) - side))


def _larger(atoms: Atoms, a: Sloped, b: Sloped) -> Sloped:
    difference = a.value - b.value
    reached = atoms.range(difference)
    if reached.lo >= 0 or reached.hi <= 0:
        return a if reached.lo >= 0 else b
    return _mixture(rules.larger(atoms, a.value, b.value), atoms.side(difference), a, b)


def _smaller(atoms: Atoms, a: Sloped, b: Sloped) -> Sloped:
    # By `_larger`, so that min and max of a pair share one unknown side.
    return -_larger(atoms, -a, -b)


def _clamp(atoms: Atoms, low: Sloped, p: Sloped, high: Sloped) -> Sloped:
    return _smaller(atoms, _larger(atoms, low, p), high)


def _absolute(atoms: Atoms, p: Sloped) -> Sloped:
    reached = atoms.range(p.value)
    if reached.lo >= 0 or reached.hi <= 0:
        return p if reached.lo >= 0 else -p
    return _mixture(rules.absolute(atoms, p.value), atoms.side(p.value), p, -p)


# ---- comparisons and choices ---------------------------------------------------------------------


def _jump(atoms: Atoms, what: str, *borders: Polynomial) -> JumpError:
    behind = listing(sorted(frozenset[str]().union(*(atoms.sources(d) for d in borders))))
    return JumpError(
        f"the model may jump with {behind or 'a constant'} inside the domain, where {what}; make "
        "the domain smaller, or the model continuous."
    )


def _sign(atoms: Atoms, p: Sloped) -> Sloped:
    reached = atoms.range(p.value)
    if reached.lo > 0 or reached.hi < 0 or reached.lo == reached.hi:
        return number((reached.lo > 0) - (reached.hi < 0))
    if not p.slopes:
        return number(atoms.elementary("sign", p.value))
    raise _jump(atoms, "a `sign` changes", p.value)


def _comparison(name: str) -> Rule:
    certain, never, chosen = _COMPARED[name]

    def compare(atoms: Atoms, a: object, b: object) -> bool | UndecidedComparison:
        if not (isinstance(a, Sloped) and isinstance(b, Sloped)):
            raise RangeError("the model compares answers that the domain does not decide.")
        difference = a - b
        border, reached = difference.value, atoms.range(difference.value)
        if certain(reached) or never(reached):
            return certain(reached)
        return UndecidedComparison(chosen(atoms.side, border), (border,), bool(difference.slopes))

    return _function(compare)


_COMPARED: dict[str, tuple[Callable[..., bool], Callable[..., bool], Callable[..., Polynomial]]] = {
    "gt": (lambda d: d.lo > 0, lambda d: d.hi <= 0, lambda side, d: side(d)),
    "ge": (lambda d: d.lo >= 0, lambda d: d.hi < 0, lambda side, d: side(d)),
    "lt": (lambda d: d.hi < 0, lambda d: d.lo >= 0, lambda side, d: side(-d)),
    "le": (lambda d: d.hi <= 0, lambda d: d.lo > 0, lambda side, d: side(-d)),
    # Equality holds at the border alone, where all cases must agree anyway.
    "eq": (lambda d: d.lo == d.hi == 0, lambda d: not d.holds(0), lambda side, d: constant(0)),
    "ne": (lambda d: not d.holds(0), lambda d: d.lo == d.hi == 0, lambda side, d: constant(1)),
}
"""Per comparison: when it is certainly true, when certainly false, and otherwise its side."""


def _not(atoms: Atoms, a: bool | UndecidedComparison) -> bool | UndecidedComparison:
    return (
        dataclasses.replace(a, chosen=constant(1) - a.chosen)
        if isinstance(a, UndecidedComparison)
        else not a
    )


def _and(
    atoms: Atoms, a: bool | UndecidedComparison, b: bool | UndecidedComparison
) -> bool | UndecidedComparison:
    if not isinstance(a, UndecidedComparison):
        return b if a else False
    if not isinstance(b, UndecidedComparison):
        return a if b else False
    return UndecidedComparison(a.chosen * b.chosen, a.borders + b.borders, a.moves or b.moves)


def _or(
    atoms: Atoms, a: bool | UndecidedComparison, b: bool | UndecidedComparison
) -> bool | UndecidedComparison:
    # De Morgan: a single rule combines two undecided results.
    return _not(atoms, _and(atoms, _not(atoms, a), _not(atoms, b)))


def _choose(atoms: Atoms, which: bool | UndecidedComparison, *cases: _Entry) -> _Entry:
    """Return the chosen case, or an enclosure of both if the choice is undecided."""
    if not isinstance(which, UndecidedComparison):
        return cases[int(which)]
    no, yes = cases
    if isinstance(no, Sloped) and isinstance(yes, Sloped):
        return _bend(atoms, which, no, yes)
    if not (isinstance(no, _ANSWERS) and isinstance(yes, _ANSWERS)):
        raise _jump(atoms, "a comparison picks a whole number", *which.borders)
    # Equal results need no decision.
    if not any(isinstance(case, UndecidedComparison) for case in cases) and no == yes:
        return yes
    return _or(atoms, _and(atoms, which, yes), _and(atoms, _not(atoms, which), no))


def _bend(atoms: Atoms, which: UndecidedComparison, no: Sloped, yes: Sloped) -> Sloped:
    """Return a choice between cases that agree wherever the choice switches."""
    difference = yes.value - no.value
    if not all(divides(border, difference) for border in which.borders):
        if not which.moves:
            return _either(atoms, which, no, yes)
        raise _jump(atoms, "the cases of a choice are not the same at its border", *which.borders)
    if which.chosen.value() is not None:
        return yes if which.chosen.value() else no
    if not difference.terms:
        value = no.value
    else:
        reached = atoms.range(no.value).union(atoms.range(yes.value))
        key = ("choice", which.chosen.key(), no.value.key(), yes.value.key())
        value = atoms.fresh(key, reached, no.value, yes.value, *which.borders)
    return _mixture(value, which.chosen, yes, no)


def _either(atoms: Atoms, which: UndecidedComparison, no: Sloped, yes: Sloped) -> Sloped:
    """Return an enclosure of either case, the same at both ends of every secant."""
    reached = atoms.range(no.value).union(atoms.range(yes.value))
    # New unknowns: at a border, another choice between the same cases may differ.
    value = atoms.fresh(("choice", object()), reached, no.value, yes.value, *which.borders)
    return _mixture(value, _undecided(atoms), yes, no)


def _undecided(atoms: Atoms) -> Polynomial:
    return atoms.fresh(("undecided", object()), Interval(Fraction(0), Fraction(1)))


def _convert(atoms: Atoms, params: Params, x: np.ndarray) -> np.ndarray:
    """Return entries converted to a type; float precision does not matter for reals."""
    kind = np.dtype(params["new_dtype"]).kind
    if kind not in "biu":
        return map_entries(functools.partial(_as_number, atoms), x)
    answers = map_entries(functools.partial(_as_integer, atoms, kind), x)
    decided = not any(isinstance(entry, UndecidedComparison) for entry in answers.flat)
    return answers.astype(params["new_dtype"]) if decided else answers


def _as_number(atoms: Atoms, entry: _Entry) -> Sloped:
    if isinstance(entry, Sloped):
        return entry
    if not isinstance(entry, UndecidedComparison):
        return number(int(entry))
    if entry.moves:
        raise _jump(atoms, "a comparison becomes a number", *entry.borders)
    return number(_undecided(atoms))


def _as_integer(atoms: Atoms, kind: str, entry: _Entry) -> bool | int | UndecidedComparison:
    if isinstance(entry, UndecidedComparison):
        if kind == "b":
            return entry
        raise _jump(atoms, "a comparison becomes a number", *entry.borders)
    if not isinstance(entry, Sloped):
        return entry
    value = entry.value.value()
    if entry.slopes:
        raise _jump(atoms, "a state becomes a whole number", entry.value)
    if value is None:
        raise RangeError(
            "the model turns a state into a whole number, "
            "which the hull of Jacobians does not know."
        )
    return bool(value) if kind == "b" else math.trunc(value)


def _reduction(join: Callable[[Atoms, Sloped, Sloped], Sloped]) -> Rule:
    return lambda atoms, params, x: reduction(functools.partial(join, atoms), None)(params, x)


_RULES: dict[str, Rule] = {
    **{
        name: _function(lambda atoms, p, name=name: elementary(atoms, name, p))
        for name in DERIVATIVES
        if name != "reciprocal"  # JAX has none
    },
    "div": _function(quotient),
    "integer_pow": lambda atoms, params, x: map_entries(
        lambda p: whole_power(atoms, p, params["y"]), x
    ),
    "pow": _function(power),
    "sin": _function(sine),
    "cos": _function(cosine),
    "atan2": _function(atan2),
    "abs": _function(_absolute),
    "max": _function(_larger),
    "min": _function(_smaller),
    "clamp": _function(_clamp),
    "sign": _function(_sign),
    **{name: _comparison(name) for name in _COMPARED},
    # Reals are finite; undefined values were refused by their own rule.
    "is_finite": lambda atoms, params, x: np.ones(x.shape, bool),
    "and": _function(_and),
    "or": _function(_or),
    "not": _function(_not),
    "select_n": _function(_choose),
    "convert_element_type": _convert,
    "reduce_max": _reduction(_larger),
    "reduce_min": _reduction(_smaller),
}
"""Rules of the primitives of JAX for values and slopes, besides `COMMON`."""

_SUMS = {
    "dot_general": dot(number(0)),
    "reduce_sum": reduction(operator.add, number(0)),
    "reduce_prod": reduction(operator.mul, number(1)),
}
