"""Polytopes of matrices that provably contain all values or slopes of a function on a box.

The function is traced and evaluated in exact polynomial arithmetic (`rules`, `slopes`). Each entry
is affine in the coordinates of every atom (a variable's powers, an angle's waves), and each atom
lies in a polygon with rational vertices (`atoms`): the products of these vertices hold every value.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple, TypeAlias

import jax
import numpy as np

from echelon_ranges.atoms import (
    Atoms,
    Corners,
    CornerValues,
    Exponent,
    Polynomial,
    check_count,
    constant,
    corner_values,
)
from echelon_ranges.errors import RangeError
from echelon_ranges.interval import Interval, float_above
from echelon_ranges.jaxpr import evaluate, map_entries
from echelon_ranges.slopes import Sloped, number, slopes_in, variable

Bounds: TypeAlias = Sequence[float | Fraction] | np.ndarray
_Function: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]


class Box(NamedTuple):
    """Exact bounds (k,) of k entries; infinite if an entry is open.

    A function may be linear in an open entry, but its slopes must not depend on it.
    """

    lower: Bounds
    upper: Bounds


class Hull(NamedTuple):
    """Every matrix is a convex combination of `vertices` plus a matrix within +- `error`.

    `vertices` (K, k, n) float64 are the exact ones rounded, and `error` (k, n) bounds the rounding
    entry by entry; it is 0 where floats are exact.
    """

    vertices: np.ndarray
    error: np.ndarray


def value_hull(function: _Function, states: Box, inputs: Box, names: Sequence[str] = ()) -> Hull:
    """Return matrices whose hull contains function(x, v) for all x and v of a box.

    It is rigorous for the function over the reals, with float constants taken exactly. A primitive
    without a rule may act on constants (an inverse of the inertia, for example); its float64 result
    is then a constant.

    Args:
        function: (x (n,), v (m,)) -> (k, l), traceable by JAX.
        states: bounds of x, (n,) each.
        inputs: bounds of v, (m,) each.
        names: of the entries of x and v, for messages; else x[0], ..., v[0], ...

    Raises:
        UnboundedError: the function depends on an entry that the box leaves open.
        RangeError: a bound is NaN or above its partner, the function has no enclosure on the box
            (the primitive is named), or there are more than `MOST_VERTICES` vertices.
    """
    atoms = Atoms()
    # No entry is a slope variable, so the function may be discontinuous.
    x, v = (map_entries(number, some) for some in _variables(atoms, states, inputs, names))
    return _hull_of(map_entries(_value, _evaluate(function, x, v, atoms)), atoms)


def slope_hull(
    function: _Function,
    states: Box,
    inputs: Box,
    names: Sequence[str] = (),
    weight: _Function | None = None,
) -> Hull:
    """Return matrices whose hull H contains every slope in x of a function on a box.

    For any x, y and v of the box function(x, v) - function(y, v) is a matrix of H times x - y,
    for smooth and for piecewise smooth functions. Derivatives of JAX are not used.

    Args:
        function: (x (n,), v (m,)) -> (k,), traceable by JAX.
        states: bounds of x, (n,) each.
        inputs: bounds of v, (m,) each.
        names: of the entries of x and v.
        weight: (x, v) -> (k, l), whose values are appended to the slopes and enclosed jointly.

    Raises:
        UnboundedError: the slopes depend on an entry that the box leaves open.
        RangeError: as in `value_hull`; or the function or the weight is discontinuous on the box.
    """
    atoms = Atoms()
    x, v = _variables(atoms, states, inputs, names)
    x, v = _sloped(x), map_entries(number, v)
    matrix = _slopes(_evaluate(function, x, v, atoms), len(x), atoms)
    if weight is not None:
        # Its slopes are evaluated too, so that a discontinuous weight is refused.
        values = map_entries(_value, _evaluate(weight, x, v, atoms))
        matrix = np.concatenate([matrix, values], axis=1)
    return _hull_of(matrix, atoms)


def slope_columns(function: _Function, states: Box, inputs: Box) -> tuple[int, ...]:
    """Return the entries of x in which a function (x, v) -> (k,) has slope 0; as `slope_hull`."""
    atoms = Atoms()
    x, v = _variables(atoms, states, inputs, ())
    values = _evaluate(function, _sloped(x), map_entries(number, v), atoms)
    slopes = _slopes(values, len(x), atoms)
    return tuple(k for k in range(len(x)) if not any(p.terms for p in slopes[:, k]))


def _value(entry: Sloped) -> Polynomial:
    return entry.value


def _sloped(x: np.ndarray) -> np.ndarray:
    return map_entries(variable, np.arange(len(x)), x)


def _evaluate(function: _Function, x: np.ndarray, v: np.ndarray, atoms: Atoms) -> np.ndarray:
    [result] = evaluate(function, [x, v], slopes_in(atoms))
    return result if result.dtype == object else map_entries(number, result)


def _slopes(values: np.ndarray, n: int, atoms: Atoms) -> np.ndarray:
    """Return the slopes (k, n) of values (k,), polynomials."""
    slopes = np.full((len(values), n), constant(0), object)
    for row, entry in enumerate(values):
        for k, slope in entry.slopes.items():
            slopes[row, k] = atoms.settle(slope)
    return slopes


def _variables(
    atoms: Atoms, states: Box, inputs: Box, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    n, m = _count_bounds(states, "x"), _count_bounds(inputs, "v")
    called = list(names) or [f"x[{k}]" for k in range(n)] + [f"v[{k}]" for k in range(m)]
    if len(called) != n + m:
        raise RangeError(f"`names` has {len(called)} entries, and must have {n + m}.")
    bounds = [*zip(*states, strict=True), *zip(*inputs, strict=True)]
    result = np.empty(n + m, object)
    for k, (low, high) in enumerate(bounds):
        result[k] = atoms.variable(called[k], _interval(low, high))
    return result[:n], result[n:]


def _interval(low: float | Fraction, high: float | Fraction) -> Interval | None:
    if math.isinf(low) or math.isinf(high):
        return None
    ends = (x if isinstance(x, Fraction) else Fraction(float(x)) for x in (low, high))
    return Interval(*ends)


def _count_bounds(box: Box, name: str) -> int:
    lower, upper = (list(side) for side in box)
    if len(lower) != len(upper):
        raise RangeError(
            f"the bounds of `{name}` have {len(lower)} and {len(upper)} entries, "
            "and must be two vectors of the same length."
        )
    for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not low <= high:
            raise RangeError(
                f"the bounds of `{name}[{k}]` are {float(low):g} and {float(high):g}, "
                "and must be in rising order."
            )
    return len(lower)


def _hull_of(entries: np.ndarray, atoms: Atoms) -> Hull:
    # Common corners for all entries: separate ones would lose that entries share angles.
    used: dict[int, set[Exponent]] = {}
    for p in entries.flat:
        for atom, exponents in p.exponents().items():
            used.setdefault(atom, set()).update(exponents)
    corners = {atom: atoms.corners(atom, used[atom]) for atom in sorted(used)}
    counts = {atom: len(c.points) for atom, c in corners.items()}
    # Before anything is built, as each atom multiplies the count.
    check_count(math.prod(counts.values()))
    parts = [_round_values(p, corners) for p in entries.flat]
    spread = [_expand_values(values, array, counts) for values, array, _ in parts]
    error = np.array([bound for _, _, bound in parts]).reshape(entries.shape)
    # Different products may give equal matrices, and each vertex is a constraint for a solver.
    vertices = np.unique(np.stack(spread, axis=-1), axis=0)
    return Hull(vertices.reshape(-1, *entries.shape), error)


def _round_values(
    p: Polynomial, corners: dict[int, Corners]
) -> tuple[CornerValues, np.ndarray, float]:
    """Return an entry's vertex values, exactly and rounded, with the bound of their difference."""
    values = corner_values(p, corners)
    rounded = np.empty(values.array.shape)
    worst = Fraction(0)
    for place, exact in np.ndenumerate(values.array):
        try:
            # Rounded to the nearest float; the exact difference becomes part of `error`.
            rounded[place] = float(exact)
        except OverflowError as fault:
            raise RangeError("an entry of the hull exceeds float64 on the domain.") from fault
        worst = max(worst, abs(Fraction(float(rounded[place])) - exact))
    return values, rounded, float_above(worst + values.slack)


def _expand_values(values: CornerValues, array: np.ndarray, counts: dict[int, int]) -> np.ndarray:
    """Return an entry's values at every product of vertices, in the order of `counts`."""
    shape = [count if atom in values.atoms else 1 for atom, count in counts.items()]
    # An entry is constant along the atoms that it does not use.
    return np.broadcast_to(array.reshape(shape), list(counts.values())).ravel()
