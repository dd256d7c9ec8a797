"""The slopes of a function on a box, found in exact arithmetic and not taken from JAX.

Each entry is a value with its slopes, and each primitive says what it does to both. So a derivative
that is none (`stop_gradient`, a rule written by hand) is never seen, and what has no slope is
refused: a step, or a choice whose cases differ where it switches. Where a function only bends (as
`max`, `abs`, `clip` and a continuous `where` do), its slope is an unknown mixture of those on
either side, the same one wherever the same switch decides.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable
from fractions import Fraction
from typing import TypeAlias, final

import numpy as np
from jax.extend.core import JaxprEqn

from echelon.core.enclosure import rules, sloped
from echelon.core.enclosure.atoms import Atoms
from echelon.core.enclosure.interval import Interval
from echelon.core.enclosure.polynomial import Polynomial, constant, divides
from echelon.core.enclosure.sloped import Sloped, chain, number
from echelon.core.errors import GainError, listing
from echelon.core.jaxpr import Algebra, Params, Rule, dot, map_entries, reduction


@final
@dataclasses.dataclass(frozen=True)
class Switch:
    """An answer that the box does not decide.

    Attributes:
        chosen: 1 where it is yes and 0 where it is no, but for points where a border is 0.
        borders: polynomials, one of which is 0 wherever the answer changes.
        moves: whether a border has a slope; else the answer is the same at both ends of a secant.
    """

    chosen: Polynomial
    borders: tuple[Polynomial, ...]
    moves: bool


_Entry: TypeAlias = Sloped | Switch | bool | int
"""What an array in this algebra holds: values, or answers to comparisons."""
_ANSWERS = bool | np.bool_ | Switch


def slopes_in(atoms: Atoms) -> Algebra:
    """Return the algebra of values with their slopes.

    Evaluating in it raises `GainError` where a function has no enclosure, or no slope.
    """
    bound = {name: functools.partial(rule, atoms) for name, rule in _RULES.items()}
    return Algebra({**bound, **_SUMS}, number, _lift, rules.outside, _fold)


def _lift(array: np.ndarray) -> np.ndarray:
    lifted = rules.lift(array)
    return map_entries(number, lifted) if lifted.dtype == object else lifted


def _fold(equation: JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return what an unknown primitive makes of parameters alone: parameters again."""
    plain = [map_entries(_parameter, a) if a.dtype == object else a for a in operands]
    result = rules.fold(equation, plain)
    return [map_entries(number, a) if a.dtype == object else a for a in result]


def _parameter(entry: object) -> Polynomial | None:
    """Return an entry that depends on no variable, else None."""
    return entry.value if isinstance(entry, Sloped) and not entry.slopes else None


def _function(function: Callable[..., object]) -> Rule:
    return lambda atoms, params, *arrays: map_entries(functools.partial(function, atoms), *arrays)


# ---- functions that bend -------------------------------------------------------------------------


def _mixture(value: Polynomial, side: Polynomial, one: Sloped, other: Sloped) -> Sloped:
    """Return a value with the slopes of `one` where the side is 1 and of `other` where it is 0."""
    return chain(value, (one, side), (other, constant(1) - side))


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
    if not p.slopes:
        return number(atoms.elementary("sign", p.value))
    raise _jump(atoms, "a `sign` changes", p.value)


def _comparison(name: str) -> Rule:
    """Return the rule of a comparison, by where the difference of its operands may lie."""
    certain, never, chosen = _COMPARED[name]

    def compare(atoms: Atoms, a: object, b: object) -> bool | Switch:
        if not (isinstance(a, Sloped) and isinstance(b, Sloped)):
            raise GainError("the model compares answers that the domain does not decide.")
        difference = a - b
        border, reached = difference.value, atoms.range(difference.value)
        if certain(reached) or never(reached):
            return certain(reached)
        return Switch(chosen(atoms.side, border), (border,), bool(difference.slopes))

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
    return dataclasses.replace(a, chosen=constant(1) - a.chosen) if isinstance(a, Switch) else not a


def _and(atoms: Atoms, a: bool | Switch, b: bool | Switch) -> bool | Switch:
    if not isinstance(a, Switch):
        return b if a else False
    if not isinstance(b, Switch):
        return a if b else False
    return Switch(a.chosen * b.chosen, a.borders + b.borders, a.moves or b.moves)


def _or(atoms: Atoms, a: bool | Switch, b: bool | Switch) -> bool | Switch:
    # By De Morgan, so that one rule alone says what two undecided answers make.
    return _not(atoms, _and(atoms, _not(atoms, a), _not(atoms, b)))


def _choose(atoms: Atoms, which: bool | Switch, *cases: _Entry) -> _Entry:
    """Return the case that is chosen, or what bends from one to the other."""
    if not isinstance(which, Switch):
        return cases[int(which)]
    no, yes = cases
    if isinstance(no, Sloped) and isinstance(yes, Sloped):
        return _bend(atoms, which, no, yes)
    if not (isinstance(no, _ANSWERS) and isinstance(yes, _ANSWERS)):
        raise _jump(atoms, "a comparison picks a whole number", *which.borders)
    # Answers that agree need no decision.
    if not any(isinstance(case, Switch) for case in cases) and no == yes:
        return yes
    return _or(atoms, _and(atoms, which, yes), _and(atoms, _not(atoms, which), no))


def _bend(atoms: Atoms, which: Switch, no: Sloped, yes: Sloped) -> Sloped:
    """Return a choice of cases that agree wherever the answer changes between two points."""
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


def _either(atoms: Atoms, which: Switch, no: Sloped, yes: Sloped) -> Sloped:
    """Return what may be either case, the same one at both ends of every secant."""
    reached = atoms.range(no.value).union(atoms.range(yes.value))
    # Unknowns of their own: at a border another choice between the same cases may fall otherwise.
    value = atoms.fresh(("choice", object()), reached, no.value, yes.value, *which.borders)
    return _mixture(value, _undecided(atoms), yes, no)


def _undecided(atoms: Atoms) -> Polynomial:
    """Return an unknown between 0 and 1."""
    return atoms.fresh(("undecided", object()), Interval(Fraction(0), Fraction(1)))


def _convert(atoms: Atoms, params: Params, x: np.ndarray) -> np.ndarray:
    """Return entries under another type; a change of float precision is none to the reals."""
    kind = np.dtype(params["new_dtype"]).kind
    if kind not in "biu":
        return map_entries(functools.partial(_as_number, atoms), x)
    answers = map_entries(functools.partial(_as_integer, atoms, kind), x)
    decided = not any(isinstance(entry, Switch) for entry in answers.flat)
    return answers.astype(params["new_dtype"]) if decided else answers


def _as_number(atoms: Atoms, entry: _Entry) -> Sloped:
    if isinstance(entry, Sloped):
        return entry
    if not isinstance(entry, Switch):
        return number(int(entry))
    if entry.moves:
        raise _jump(atoms, "a comparison becomes a number", *entry.borders)
    return number(_undecided(atoms))


def _as_integer(atoms: Atoms, kind: str, entry: _Entry) -> bool | int | Switch:
    """Return an entry as a boolean or as a whole number, which is cut towards 0."""
    if isinstance(entry, Switch):
        if kind == "b":
            return entry
        raise _jump(atoms, "a comparison becomes a number", *entry.borders)
    if not isinstance(entry, Sloped):
        return entry
    value = entry.value.value()
    if entry.slopes:
        raise _jump(atoms, "a state becomes a whole number", entry.value)
    if value is None:
        raise GainError(
            "the model turns a state into a whole number, "
            "which the hull of Jacobians does not know."
        )
    return bool(value) if kind == "b" else math.trunc(value)


def _reduction(join: Callable[[Atoms, Sloped, Sloped], Sloped]) -> Rule:
    return lambda atoms, params, x: reduction(functools.partial(join, atoms), None)(params, x)


_RULES: dict[str, Rule] = {
    **{
        name: _function(lambda atoms, p, name=name: sloped.elementary(atoms, name, p))
        for name in sloped.DERIVATIVES
        if name != "reciprocal"  # JAX has none
    },
    "div": _function(sloped.quotient),
    "integer_pow": lambda atoms, params, x: map_entries(
        lambda p: sloped.whole_power(atoms, p, params["y"]), x
    ),
    "pow": _function(sloped.power),
    "sin": _function(sloped.sine),
    "cos": _function(sloped.cosine),
    "atan2": _function(sloped.atan2),
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
    "reduce_max": _reduction(_larger),
    "reduce_min": _reduction(_smaller),
}
"""What each primitive of JAX does to values and slopes, beyond what the walk itself knows."""

_SUMS = {
    "dot_general": dot(number(0)),
    "reduce_sum": reduction(operator.add, number(0)),
    "reduce_prod": reduction(operator.mul, number(1)),
}
