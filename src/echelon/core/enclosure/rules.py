"""What JAX's primitives mean for arrays of polynomials: one rule each.

An array of floats is an array of `Polynomial`, integers and booleans stay numbers, and a comparison
that the box does not decide is None.
"""

import functools
import math
import operator
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np

from echelon.core.enclosure.atoms import Atoms
from echelon.core.enclosure.interval import ELEMENTARY, Interval
from echelon.core.enclosure.polynomial import Polynomial, constant
from echelon.core.errors import GainError
from echelon.core.jaxpr import Algebra, compute, dot, map_entries, reduction

Rule: TypeAlias = Callable[..., np.ndarray]
"""(atoms, parameters of the primitive, operands) -> result."""


def polynomials(atoms: Atoms) -> Algebra:
    """Return the algebra of polynomials in atoms; the walk adds to these what it needs.

    Evaluating in it raises `GainError` at a primitive that has no rule, or is outside of its
    domain, and at a constant that is complex or not finite.
    """
    bound = {name: functools.partial(rule, atoms) for name, rule in RULES.items()}
    return Algebra({**bound, **_SUMS}, constant, lift, outside, fold)


def lift(array: np.ndarray) -> np.ndarray:
    """Return floats as constant polynomials, each taken exactly, and anything else as it is."""
    if array.dtype.kind in "biu":
        return array
    if array.dtype.kind == "c":
        raise GainError("the model is complex, and must be real.")
    numbers = array.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise GainError("the model holds a constant that is not finite.")
    return map_entries(constant, numbers)


def outside() -> object:
    """Refuse what stands outside of an array, of which nothing is known."""
    raise GainError("the model reads outside of an array.")


def fold(equation: Any, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Return what an unknown primitive makes of parameters alone, in float64: parameters again."""
    values = [map_entries(number, a) if a.dtype == object else a for a in operands]
    if any(v is None for a in values for v in a.flat):
        raise GainError(
            f"the model uses `{equation.primitive.name}`, which the hull of "
            "Jacobians does not know; allowed are arithmetic, powers, trigonometric and hyperbolic "
            "functions, exponentials, logarithms, absolute values and choices by `where`."
        )
    # In float64, since that is what the program itself computes of its constants.
    numbers = [np.asarray(a, np.float64) if a.dtype == object else a for a in values]
    return [lift(a) for a in compute(equation, numbers)]


# ---- the rules -----------------------------------------------------------------------------------


def number(p: object) -> Fraction | None:
    """Return the number that an entry is, else None."""
    return p.value() if isinstance(p, Polynomial) else None


def _function(function: Callable[..., object]) -> Rule:
    return lambda atoms, params, *arrays: map_entries(functools.partial(function, atoms), *arrays)


def _elementary(name: str) -> Rule:
    return _function(lambda atoms, p: atoms.elementary(name, p))


def reciprocal(atoms: Atoms, p: Polynomial) -> Polynomial:
    """Return 1 / p, exactly where p is a number."""
    value = p.value()
    return constant(1 / value) if value else atoms.elementary("reciprocal", p)


def _quotient(atoms: Atoms, a: Polynomial, b: Polynomial) -> Polynomial:
    return a * reciprocal(atoms, b)


def whole_power(atoms: Atoms, p: Polynomial, k: int) -> Polynomial:
    """Return p to the power of a whole number, which may be negative."""
    return p.power(k) if k >= 0 else reciprocal(atoms, p).power(-k)


def power(atoms: Atoms, p: Polynomial, exponent: Any) -> Polynomial:
    """Return p to a constant power: whole, a half, or exp(k log p)."""
    k = exponent.value() if isinstance(exponent, Polynomial) else Fraction(int(exponent))
    if k is None:
        raise GainError(
            "the model raises to a power that varies, which the hull of Jacobians "
            "does not know; write it by `exp` and `log`."
        )
    if k.denominator == 1:
        return whole_power(atoms, p, int(k))
    # A root has an enclosure of its own, which holds at 0 too, where a logarithm has none.
    if abs(k) == Fraction(1, 2):
        return atoms.elementary("sqrt" if k > 0 else "rsqrt", p)
    return atoms.elementary("exp", constant(k) * atoms.elementary("log", p))


def atan2(atoms: Atoms, y: Polynomial, x: Polynomial) -> Polynomial:
    """Return the angle of the point (x, y) for x > 0.

    Raises:
        GainError: x may be anything else.
    """
    reached = atoms.range(x)
    if reached.lo <= 0:
        raise GainError(
            "the model takes `atan2` with a second argument that may be anything "
            f"in {reached.text()} on the domain, and must be positive; make the domain smaller."
        )
    # atan2(y, x) = atan(y / x) for x > 0; elsewhere it jumps, and a hull over the jump says little.
    return atoms.elementary("atan", _quotient(atoms, y, x))


def absolute(atoms: Atoms, p: Polynomial) -> Polynomial:
    """Return |p|, p itself or -p where its sign is certain."""
    reached = atoms.range(p)
    if reached.lo >= 0:
        return p
    return -p if reached.hi <= 0 else atoms.elementary("abs", p)


def larger(atoms: Atoms, a: Polynomial, b: Polynomial) -> Polynomial:
    """Return max(a, b)."""
    left, right = atoms.range(a), atoms.range(b)
    # Equal terms cancel in a - b, so its sign may be certain where the ranges overlap.
    difference = atoms.range(a - b)
    if difference.lo >= 0 or difference.hi <= 0:
        return a if difference.lo >= 0 else b
    reached = Interval(max(left.lo, right.lo), max(left.hi, right.hi))
    return atoms.fresh(("max", frozenset([a.key(), b.key()])), reached, a, b)


def _smaller(atoms: Atoms, a: Polynomial, b: Polynomial) -> Polynomial:
    """Return min(a, b)."""
    # min(a, b) = -max(-a, -b), which keeps one variable for both.
    return -larger(atoms, -a, -b)


def _clamp(atoms: Atoms, low: Polynomial, p: Polynomial, high: Polynomial) -> Polynomial:
    return _smaller(atoms, larger(atoms, low, p), high)


def _comparison(certain: Callable[[Interval], bool], never: Callable[[Interval], bool]) -> Rule:
    """Return the rule of a comparison by where the difference of its operands may lie."""

    def compare(atoms: Atoms, a: object, b: object) -> bool | None:
        if not (isinstance(a, Polynomial) and isinstance(b, Polynomial)):
            return None
        difference = atoms.range(a - b)
        # Neither holds where the box does not decide.
        return True if certain(difference) else False if never(difference) else None

    return lambda atoms, params, a, b: _as_booleans(
        map_entries(functools.partial(compare, atoms), a, b)
    )


def _as_booleans(answers: np.ndarray) -> np.ndarray:
    """Return booleans where every answer is known."""
    return answers if any(a is None for a in answers.flat) else answers.astype(bool)


def _and(a: bool | None, b: bool | None) -> bool | None:
    if a is None or b is None:
        # Kleene's logic: one false decides, whatever the other is.
        return False if a is not None and not a or b is not None and not b else None
    return bool(a and b)


def _not(a: bool | None) -> bool | None:
    return None if a is None else not a


def _or(a: bool | None, b: bool | None) -> bool | None:
    # De Morgan, which holds in it too.
    return _not(_and(_not(a), _not(b)))


def _logic(function: Callable[..., bool | None]) -> Rule:
    return lambda atoms, params, *arrays: _as_booleans(map_entries(function, *arrays))


def _choose_case(atoms: Atoms, which: Any, *cases: Any) -> Any:
    """Return the case that is chosen, or a value that may be any of them."""
    if which is not None:
        return cases[int(which)]
    if all(isinstance(case, bool) or case is None for case in cases):
        return cases[0] if all(case is cases[0] for case in cases) else None
    if not all(isinstance(case, Polynomial) for case in cases):
        raise GainError(
            "the model picks a whole number by a comparison that the domain does "
            "not decide; make the domain smaller."
        )
    # Cases that agree need no decision.
    if all(case.key() == cases[0].key() for case in cases):
        return cases[0]
    # Sound and coarse: of the choice nothing is kept but a range that holds all cases. Each is an
    # unknown of its own, as another choice between the same cases may be decided otherwise.
    reached = functools.reduce(Interval.union, (atoms.range(case) for case in cases))
    return atoms.fresh(("choice", object()), reached, *cases)


def convert(atoms: Atoms, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Return entries under another type; a change of float precision is none to the reals."""
    kind = np.dtype(params["new_dtype"]).kind
    polynomials = all(isinstance(v, Polynomial) for v in x.flat)
    if polynomials and kind not in "biu" or not polynomials and kind == "b":
        return x
    if not polynomials and kind not in "iu":
        return map_entries(functools.partial(_as_number, atoms), x)
    numbers = map_entries(number, x)
    if any(v is None for v in numbers.flat):
        raise GainError(
            "the model turns a state into a whole number, "
            "which the hull of Jacobians does not know."
        )
    return map_entries(bool if kind == "b" else math.trunc, numbers).astype(params["new_dtype"])


def _as_number(atoms: Atoms, answer: bool | None) -> Polynomial:
    """Return 1 for true, 0 for false and anything between for what is not decided."""
    if answer is None:
        # A key of its own each time, as two open answers need not be the same.
        return atoms.fresh(("undecided", object()), Interval(Fraction(0), Fraction(1)))
    return constant(int(answer))


RULES: dict[str, Rule] = {
    # JAX has no `reciprocal`, and `abs` looks at the sign first.
    **{name: _elementary(name) for name in ELEMENTARY if name not in ("reciprocal", "abs")},
    "div": _function(_quotient),
    "integer_pow": lambda atoms, params, x: map_entries(
        lambda p: whole_power(atoms, p, params["y"]), x
    ),
    "pow": _function(power),
    "sin": _function(lambda atoms, p: atoms.circle(p)[1]),
    "cos": _function(lambda atoms, p: atoms.circle(p)[0]),
    "atan2": _function(atan2),
    "abs": _function(absolute),
    "max": _function(larger),
    "min": _function(_smaller),
    "clamp": _function(_clamp),
    "lt": _comparison(lambda d: d.hi < 0, lambda d: d.lo >= 0),
    "le": _comparison(lambda d: d.hi <= 0, lambda d: d.lo > 0),
    "gt": _comparison(lambda d: d.lo > 0, lambda d: d.hi <= 0),
    "ge": _comparison(lambda d: d.lo >= 0, lambda d: d.hi < 0),
    "eq": _comparison(lambda d: d.lo == d.hi == 0, lambda d: not d.holds(0)),
    "ne": _comparison(lambda d: not d.holds(0), lambda d: d.lo == d.hi == 0),
    # Reals are finite; what has no value on the box was refused by its own rule.
    "is_finite": lambda atoms, params, x: np.ones(x.shape, bool),
    "and": _logic(_and),
    "or": _logic(_or),
    "not": _logic(_not),
    "select_n": _function(_choose_case),
    "convert_element_type": convert,
}
"""What each primitive of JAX means for polynomials, beyond what the walk itself knows."""

_SUMS = {
    "dot_general": dot(constant(0)),
    "reduce_sum": reduction(operator.add, constant(0)),
    "reduce_prod": reduction(operator.mul, constant(1)),
}
