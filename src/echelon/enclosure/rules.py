"""What JAX's primitives mean for arrays of polynomials: one rule each.

A comparison that the box does not decide is None.
"""

import functools
import math
import operator
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np

from echelon.core.errors import GainError
from echelon.core.jaxpr import dot, each
from echelon.enclosure.interval import ELEMENTARY, Interval
from echelon.enclosure.polynomial import Atoms, Polynomial, constant

Rule: TypeAlias = Callable[..., np.ndarray]
"""(atoms, parameters of the primitive, operands) -> result."""


def number(p: object) -> Fraction | None:
    """Return the number that an entry is, else None."""
    return p.value() if isinstance(p, Polynomial) else None


def _arithmetic(function: Callable[..., object]) -> Rule:
    return lambda atoms, params, *arrays: each(function, *arrays)


def _function(function: Callable[..., object]) -> Rule:
    return lambda atoms, params, *arrays: each(functools.partial(function, atoms), *arrays)


def _elementary(name: str) -> Rule:
    return _function(lambda atoms, p: atoms.elementary(name, p))


def _reciprocal(atoms: Atoms, p: Polynomial) -> Polynomial:
    value = p.value()
    return constant(1 / value) if value else atoms.elementary("reciprocal", p)


def _quotient(atoms: Atoms, a: Polynomial, b: Polynomial) -> Polynomial:
    return a * _reciprocal(atoms, b)


def _whole_power(atoms: Atoms, p: Polynomial, k: int) -> Polynomial:
    return p.power(k) if k >= 0 else _reciprocal(atoms, p).power(-k)


def _power(atoms: Atoms, p: Polynomial, exponent: Any) -> Polynomial:
    """Return p to a constant power: whole, a half, or exp(k log p)."""
    k = exponent.value() if isinstance(exponent, Polynomial) else Fraction(int(exponent))
    if k is None:
        raise GainError(
            "the Jacobian of the model raises to a power that varies, which the hull of Jacobians "
            "does not know; write it by `exp` and `log`."
        )
    if k.denominator == 1:
        return _whole_power(atoms, p, int(k))
    if abs(k) == Fraction(1, 2):
        return atoms.elementary("sqrt" if k > 0 else "rsqrt", p)
    return atoms.elementary("exp", constant(k) * atoms.elementary("log", p))


def _atan2(atoms: Atoms, y: Polynomial, x: Polynomial) -> Polynomial:
    reached = atoms.range(x)
    if reached.lo <= 0:
        raise GainError(
            "the Jacobian of the model takes `atan2` with a second argument that may be anything "
            f"in {reached.text()} on the domain, and must be positive; make the domain smaller."
        )
    return atoms.elementary("atan", _quotient(atoms, y, x))


def _absolute(atoms: Atoms, p: Polynomial) -> Polynomial:
    reached = atoms.range(p)
    if reached.lo >= 0:
        return p
    return -p if reached.hi <= 0 else atoms.elementary("abs", p)


def _larger(atoms: Atoms, a: Polynomial, b: Polynomial) -> Polynomial:
    """Return max(a, b)."""
    left, right = atoms.range(a), atoms.range(b)
    difference = atoms.range(a - b)
    if difference.lo >= 0 or difference.hi <= 0:
        return a if difference.lo >= 0 else b
    reached = Interval(max(left.lo, right.lo), max(left.hi, right.hi))
    return atoms.fresh(("max", frozenset([a.key(), b.key()])), reached, a, b)


def _smaller(atoms: Atoms, a: Polynomial, b: Polynomial) -> Polynomial:
    """Return min(a, b)."""
    return -_larger(atoms, -a, -b)


def _clamp(atoms: Atoms, low: Polynomial, p: Polynomial, high: Polynomial) -> Polynomial:
    return _smaller(atoms, _larger(atoms, low, p), high)


def _comparison(certain: Callable[[Interval], bool], never: Callable[[Interval], bool]) -> Rule:
    """Return the rule of a comparison by where the difference of its operands may lie."""

    def compare(atoms: Atoms, a: object, b: object) -> bool | None:
        if not (isinstance(a, Polynomial) and isinstance(b, Polynomial)):
            return None
        difference = atoms.range(a - b)
        return True if certain(difference) else False if never(difference) else None

    return lambda atoms, params, a, b: _decided(each(functools.partial(compare, atoms), a, b))


def _decided(answers: np.ndarray) -> np.ndarray:
    """Return booleans where every answer is known."""
    return answers if any(a is None for a in answers.flat) else answers.astype(bool)


def _and(a: bool | None, b: bool | None) -> bool | None:
    if a is None or b is None:
        return False if a is not None and not a or b is not None and not b else None
    return bool(a and b)


def _not(a: bool | None) -> bool | None:
    return None if a is None else not a


def _or(a: bool | None, b: bool | None) -> bool | None:
    return _not(_and(_not(a), _not(b)))


def _logic(function: Callable[..., bool | None]) -> Rule:
    return lambda atoms, params, *arrays: _decided(each(function, *arrays))


def _chosen(atoms: Atoms, which: Any, *cases: Any) -> Any:
    """Return the case that is chosen, or a value that may be any of them."""
    if which is not None:
        return cases[int(which)]
    if all(isinstance(case, bool) or case is None for case in cases):
        return cases[0] if all(case is cases[0] for case in cases) else None
    if not all(isinstance(case, Polynomial) for case in cases):
        raise GainError(
            "the Jacobian of the model picks a whole number by a comparison that the domain does "
            "not decide; make the domain smaller."
        )
    keys = [case.key() for case in cases]
    if all(key == keys[0] for key in keys):
        return cases[0]
    reached = functools.reduce(Interval.union, (atoms.range(case) for case in cases))
    return atoms.fresh(("choice", frozenset(keys)), reached, *cases)


def _convert(atoms: Atoms, params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    """Return entries under another type; a change of float precision is none to the reals."""
    kind = np.dtype(params["new_dtype"]).kind
    polynomials = all(isinstance(v, Polynomial) for v in x.flat)
    if polynomials and kind not in "biu" or not polynomials and kind == "b":
        return x
    if not polynomials and kind not in "iu":
        return each(functools.partial(_as_number, atoms), x)
    numbers = each(number, x)
    if any(v is None for v in numbers.flat):
        raise GainError(
            "the Jacobian of the model turns a state into a whole number, "
            "which the hull of Jacobians does not know."
        )
    return each(bool if kind == "b" else math.trunc, numbers).astype(params["new_dtype"])


def _as_number(atoms: Atoms, answer: bool | None) -> Polynomial:
    """Return 1 for true, 0 for false and anything between for what is not decided."""
    if answer is None:
        return atoms.fresh(("undecided", object()), Interval(Fraction(0), Fraction(1)))
    return constant(int(answer))


def _reduction(function: np.ufunc, start: int) -> Rule:
    return lambda atoms, params, x: np.asarray(
        function.reduce(x, axis=tuple(params["axes"]), initial=constant(start)), object
    )


RULES: dict[str, Rule] = {
    **{name: _elementary(name) for name in ELEMENTARY if name not in ("reciprocal", "abs")},
    "add": _arithmetic(operator.add),
    "add_any": _arithmetic(operator.add),
    "sub": _arithmetic(operator.sub),
    "mul": _arithmetic(operator.mul),
    "neg": _arithmetic(operator.neg),
    "square": _arithmetic(lambda p: p * p),
    "div": _function(_quotient),
    "integer_pow": lambda atoms, params, x: each(lambda p: _whole_power(atoms, p, params["y"]), x),
    "pow": _function(_power),
    "sin": _function(lambda atoms, p: atoms.circle(p)[1]),
    "cos": _function(lambda atoms, p: atoms.circle(p)[0]),
    "atan2": _function(_atan2),
    "abs": _function(_absolute),
    "max": _function(_larger),
    "min": _function(_smaller),
    "clamp": _function(_clamp),
    "lt": _comparison(lambda d: d.hi < 0, lambda d: d.lo >= 0),
    "le": _comparison(lambda d: d.hi <= 0, lambda d: d.lo > 0),
    "gt": _comparison(lambda d: d.lo > 0, lambda d: d.hi <= 0),
    "ge": _comparison(lambda d: d.lo >= 0, lambda d: d.hi < 0),
    "eq": _comparison(lambda d: d.lo == d.hi == 0, lambda d: not d.holds(0)),
    "ne": _comparison(lambda d: not d.holds(0), lambda d: d.lo == d.hi == 0),
    "is_finite": lambda atoms, params, x: np.ones(x.shape, bool),
    "and": _logic(_and),
    "or": _logic(_or),
    "not": _logic(_not),
    "select_n": _function(_chosen),
    "convert_element_type": _convert,
    "dot_general": lambda atoms, params, a, b: dot(params, a, b, constant(0)),
    "reduce_sum": _reduction(np.add, 0),
    "reduce_prod": _reduction(np.multiply, 1),
}
"""What each primitive of JAX means for polynomials."""
