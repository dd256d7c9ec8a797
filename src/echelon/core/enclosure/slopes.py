"""The slopes of a function on a box, found in exact arithmetic and not taken from JAX.

Each entry is a value with its slopes, and each primitive says what it does to both. So a derivative
that is none (`stop_gradient`, a rule written by hand) is never seen, and what has no slope is
refused: a step, or a choice whose cases differ where it switches. Where a function only bends (as
`max`, `abs`, `clip` and a continuous `where` do), its slope is an unknown mixture of those on
either side, the same one wherever the same switch decides.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any, TypeAlias, final

import numpy as np

from echelon.core.enclosure import rules
from echelon.core.enclosure.atoms import Atoms
from echelon.core.enclosure.polynomial import Polynomial, constant, divides
from echelon.core.errors import GainError, listing
from echelon.core.jaxpr import Algebra, dot, map_entries, reduction

Rule: TypeAlias = Callable[..., np.ndarray]
"""(parameters of the primitive, operands) -> result."""


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


@final
@dataclasses.dataclass(frozen=True)
class Switch:
    """An answer that the box does not decide.

    Attributes:
        chosen: 1 where it is yes and 0 where it is no, but for points where a border is 0.
        borders: polynomials, one of which is 0 wherever the answer changes.
    """

    chosen: Polynomial
    borders: tuple[Polynomial, ...]


def number(x: float | Polynomial) -> Sloped:
    """Return a number, taken exactly, or what depends on no variable."""
    return Sloped(x if isinstance(x, Polynomial) else constant(x), {})


def variable(k: int, value: Polynomial) -> Sloped:
    """Return variable k of those that slopes are taken in."""
    return Sloped(value, {k: constant(1)})


def slopes_in(atoms: Atoms) -> Algebra:
    """Return the algebra of values with their slopes.

    Evaluating in it raises `GainError` where a function has no enclosure, or no slope.
    """
    bound = {name: functools.partial(rule, atoms) for name, rule in _RULES.items()}
    return Algebra({**bound, **_SUMS}, number, _lift, rules.outside, _fold)


def _lift(array: np.ndarray) -> np.ndarray:
    lifted = rules.lift(array)
    return map_entries(number, lifted) if lifted.dtype == object else lifted


def _fold(equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return what an unknown primitive makes of parameters alone: parameters again."""
    plain = [map_entries(_parameter, a) if a.dtype == object else a for a in operands]
    found = rules.fold(equation, plain)
    return [map_entries(number, a) if a.dtype == object else a for a in found]


def _parameter(entry: object) -> Polynomial | None:
    """Return an entry that depends on no variable, else None."""
    return entry.value if isinstance(entry, Sloped) and not entry.slopes else None


# ---- functions without a bend --------------------------------------------------------------------

_Made: TypeAlias = Callable[[str, Polynomial], Polynomial]
_ONE = constant(1)

_DERIVATIVES: dict[str, Callable[[_Made, Polynomial], Polynomial]] = {
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


def _function(function: Callable[..., object]) -> Rule:
    return lambda atoms, params, *arrays: map_entries(functools.partial(function, atoms), *arrays)


def _elementary(atoms: Atoms, name: str, p: Sloped) -> Sloped:
    value = atoms.elementary(name, p.value)
    # Of a parameter no slope is wanted, and it may have none.
    return (
        chain(value, (p, _DERIVATIVES[name](atoms.elementary, p.value)))
        if p.slopes
        else number(value)
    )


def _quotient(atoms: Atoms, a: Sloped, b: Sloped) -> Sloped:
    # So all that is divided by b shares one unknown 1/b, and their ratios are not lost.
    return a * _reciprocal(atoms, b)


def _reciprocal(atoms: Atoms, p: Sloped) -> Sloped:
    value = rules.reciprocal(atoms, p.value)
    return chain(value, (p, -(value * value)))


def _whole_power(atoms: Atoms, p: Sloped, k: int) -> Sloped:
    # Without the case 0 x^-1 would refuse a box that holds 0.
    slope = constant(k) * rules.whole_power(atoms, p.value, k - 1) if k else constant(0)
    return chain(rules.whole_power(atoms, p.value, k), (p, slope))


def _power(atoms: Atoms, p: Sloped, exponent: Any) -> Sloped:
    k = exponent.value if isinstance(exponent, Sloped) else constant(int(exponent))
    value = rules.power(atoms, p.value, k)
    return (
        chain(value, (p, k * rules.power(atoms, p.value, k - _ONE))) if p.slopes else number(value)
    )


def _sine(atoms: Atoms, p: Sloped) -> Sloped:
    cosine, sine = atoms.circle(p.value)
    return chain(sine, (p, cosine))


def _cosine(atoms: Atoms, p: Sloped) -> Sloped:
    cosine, sine = atoms.circle(p.value)
    return chain(cosine, (p, -sine))


def _atan2(atoms: Atoms, y: Sloped, x: Sloped) -> Sloped:
    value = rules.atan2(atoms, y.value, x.value)
    r = rules.reciprocal(atoms, x.value * x.value + y.value * y.value)
    return chain(value, (y, x.value * r), (x, -(y.value * r)))


# ---- functions that bend -------------------------------------------------------------------------


def _mixture(value: Polynomial, side: Polynomial, one: Sloped, other: Sloped) -> Sloped:
    """Return a value with the slopes of `one` where the side is 1 and of `other` where it is 0."""
    return chain(value, (one, side), (other, _ONE - side))


def _larger(atoms: Atoms, a: Sloped, b: Sloped) -> Sloped:
    """Return max(a, b)."""
    difference = a.value - b.value
    reached = atoms.range(difference)
    if reached.lo >= 0 or reached.hi <= 0:
        return a if reached.lo >= 0 else b
    return _mixture(rules.larger(atoms, a.value, b.value), atoms.side(difference), a, b)


def _smaller(atoms: Atoms, a: Sloped, b: Sloped) -> Sloped:
    # Not a rule of its own: so the min of a pair has the same unknown side as its max.
    return -_larger(atoms, -a, -b)


def _clamp(atoms: Atoms, low: Sloped, p: Sloped, high: Sloped) -> Sloped:
    return _smaller(atoms, _larger(atoms, low, p), high)


def _absolute(atoms: Atoms, p: Sloped) -> Sloped:
    reached = atoms.range(p.value)
    if reached.lo >= 0 or reached.hi <= 0:
        return p if reached.lo >= 0 else -p
    return _mixture(rules.absolute(atoms, p.value), atoms.side(p.value), p, -p)


# ---- answers, and what depends on them -----------------------------------------------------------


class JumpError(GainError):
    """A function is not shown to be continuous on the box, and so has no slopes there."""


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
    raise _jump(atoms, "a `sign` changes", p.value)


def _comparison(name: str) -> Rule:
    """Return the rule of a comparison, by where the difference of its operands may lie."""
    certain, never, chosen = _COMPARED[name]

    def compare(atoms: Atoms, a: object, b: object) -> bool | Switch:
        if not (isinstance(a, Sloped) and isinstance(b, Sloped)):
            raise GainError("the model compares answers that the domain does not decide.")
        difference = a.value - b.value
        reached = atoms.range(difference)
        if certain(reached) or never(reached):
            return certain(reached)
        return Switch(chosen(atoms.side, difference), (difference,))

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
"""Where a comparison holds for certain, where it never does, and which side of its border else."""


def _not(atoms: Atoms, a: bool | Switch) -> bool | Switch:
    return Switch(_ONE - a.chosen, a.borders) if isinstance(a, Switch) else not a


def _and(atoms: Atoms, a: bool | Switch, b: bool | Switch) -> bool | Switch:
    if not isinstance(a, Switch):
        return b if a else False
    if not isinstance(b, Switch):
        return a if b else False
    return Switch(a.chosen * b.chosen, a.borders + b.borders)


def _or(atoms: Atoms, a: bool | Switch, b: bool | Switch) -> bool | Switch:
    # By De Morgan, so that one rule alone says what two undecided answers make.
    return _not(atoms, _and(atoms, _not(atoms, a), _not(atoms, b)))


def _choose(atoms: Atoms, which: Any, *cases: Any) -> Any:
    """Return the case that is chosen, or what bends from one to the other."""
    if not isinstance(which, Switch):
        return cases[int(which)]
    no, yes = cases
    if all(isinstance(case, Sloped) for case in cases):
        return _bend(atoms, which, no, yes)
    if not all(isinstance(case, bool | np.bool_ | Switch) for case in cases):
        raise _jump(atoms, "a comparison picks a whole number", *which.borders)
    return _or(atoms, _and(atoms, which, yes), _and(atoms, _not(atoms, which), no))


def _bend(atoms: Atoms, which: Switch, no: Sloped, yes: Sloped) -> Sloped:
    """Return a choice of cases that agree wherever the answer changes."""
    difference = yes.value - no.value
    if not all(divides(border, difference) for border in which.borders):
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


def _convert(atoms: Atoms, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Return entries under another type; a change of float precision is none to the reals."""
    kind = np.dtype(params["new_dtype"]).kind
    for entry in x.flat:
        if isinstance(entry, Switch) and kind != "b":
            raise _jump(atoms, "a comparison becomes a number", *entry.borders)
        if isinstance(entry, Sloped) and entry.slopes and kind in "biu":
            raise _jump(atoms, "a state becomes a whole number", entry.value)
    if kind not in "biu":
        return map_entries(lambda e: e if isinstance(e, Sloped) else number(int(e)), x)
    plain = map_entries(lambda e: e.value if isinstance(e, Sloped) else e, x)
    return rules.convert(atoms, params, plain)


def _reduction(join: Callable[[Atoms, Sloped, Sloped], Sloped]) -> Rule:
    return lambda atoms, params, x: reduction(functools.partial(join, atoms), None)(params, x)


_RULES: dict[str, Rule] = {
    **{
        name: _function(lambda atoms, p, name=name: _elementary(atoms, name, p))
        for name in _DERIVATIVES
        if name != "reciprocal"  # JAX has none
    },
    "div": _function(_quotient),
    "integer_pow": lambda atoms, params, x: map_entries(
        lambda p: _whole_power(atoms, p, params["y"]), x
    ),
    "pow": _function(_power),
    "sin": _function(_sine),
    "cos": _function(_cosine),
    "atan2": _function(_atan2),
    "abs": _function(_absolute),
    "max": _function(_larger),
    "min": _function(_smaller),
    "clamp": _function(_clamp),
    "sign": _function(_sign),
    **{name: _comparison(name) for name in _COMPARED},
    # Reals are finite; what has no value on the box was refused by its own rule.
    "is_finite": lambda atoms, params, x: np.ones(x.shape, bool),
    "and": _function(_and),
    "or": _function(_or),
    "not": _function(_not),
    "select_n": _function(_choose),
    "convert_element_type": _convert,
    "reduce_max": lambda atoms, params, x: reduction(functools.partial(_larger, atoms), None)(
        params, x
    ),
    "reduce_min": lambda atoms, params, x: reduction(functools.partial(_smaller, atoms), None)(
        params, x
    ),
}
"""What each primitive of JAX does to values and slopes, beyond what the walk itself knows."""

_SUMS = {
    "dot_general": dot(number(0)),
    "reduce_sum": reduction(operator.add, number(0)),
    "reduce_prod": reduction(operator.mul, number(1)),
}
