"""A polytope of matrices that provably contains every Jacobian of a model on a box.

The Jacobian is traced and evaluated in exact polynomial arithmetic (`rules`, `polynomial`); each
entry is affine in the coordinates of every atom (a variable's powers, an angle's waves), each atom
lies in a polygon with rational vertices (`curves`), and so the products of these vertices hold
every value.
"""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import numpy as np

from echelon.core.errors import GainError
from echelon.core.jaxpr import evaluate
from echelon.core.types import Array
from echelon.enclosure.interval import Interval
from echelon.enclosure.polynomial import (
    Atoms,
    Corners,
    CornerValues,
    Polynomial,
    check_count,
    corner_values,
)
from echelon.enclosure.rules import polynomials


class Box(NamedTuple):
    """Bounds (k,) of k entries, each taken as the exact number that its float is."""

    lower: Array
    upper: Array


class HullAtom(NamedTuple):
    """What the vertices are products of.

    `name` is the box variable (or the expression), `kind` is `interval`, `powers`, `arc` or
    `constant`; its range is (lower, upper), angles in rad; `vertices` is how many points stand
    around it.
    """

    name: str
    kind: str
    lower: float
    upper: float
    vertices: int


class Hull(NamedTuple):
    """Every Jacobian is a convex combination of `vertices` plus a matrix within +- `error`.

    `vertices` (K, n, n) float64 are the exact ones rounded, and `error` (n, n) bounds the rounding
    entry by entry; it is 0 where floats are exact.
    """

    vertices: Array
    error: Array
    atoms: tuple[HullAtom, ...]


def jacobian_hull(
    jacobian: Callable[[jax.Array, jax.Array], jax.Array],
    states: Box,
    inputs: Box,
    names: Sequence[str] = (),
) -> Hull:
    """Return matrices whose hull holds jacobian(x, v) for every x and v of a box.

    It is sound for the function over the reals, float constants taken exactly; what a primitive
    without a rule makes of constants alone (an inverse of the inertia, say) is a constant too, the
    float64 that the program computes.

    Args:
        jacobian: (x (n,), v (m,)) -> (n, n), traceable by JAX.
        states: bounds of x, (n,) each.
        inputs: bounds of v, (m,) each.
        names: of the entries of x and v, for messages and `atoms`; else x[0], ..., v[0], ...

    Raises:
        GainError: a bound is not finite or above its partner, the Jacobian has no enclosure on the
            box (the primitive is named), or there are more than `MOST_VERTICES` vertices.
    """
    n, m = _count_bounds(states, "x"), _count_bounds(inputs, "v")
    called = list(names) or [f"x[{k}]" for k in range(n)] + [f"v[{k}]" for k in range(m)]
    if len(called) != n + m:
        raise GainError(f"`names` has {len(called)} entries, and must have {n + m}.")
    atoms = Atoms()
    bounds = [*zip(*states, strict=True), *zip(*inputs, strict=True)]
    variables = np.empty(n + m, object)
    for k, (low, high) in enumerate(bounds):
        # A float is a fraction with a power of two below, so nothing is rounded here.
        interval = Interval(Fraction(float(low)), Fraction(float(high)))
        variables[k] = atoms.variable(called[k], interval)
    results = evaluate(jacobian, [variables[:n], variables[n:]], polynomials(atoms))
    if len(results) != 1 or results[0].ndim != 2 or results[0].dtype != object:
        raise GainError("`jacobian` must return one matrix of floats.")
    return _hull_of(results[0], atoms)


def _count_bounds(box: Box, name: str) -> int:
    """Return how many bounds a box has."""
    lower, upper = (np.asarray(side, float) for side in box)
    if lower.ndim != 1 or lower.shape != upper.shape:
        raise GainError(
            f"the bounds of `{name}` have shapes {lower.shape} and {upper.shape}, "
            "and must be two vectors of the same length."
        )
    for k, (low, high) in enumerate(zip(lower, upper, strict=True)):
        if not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise GainError(
                f"the bounds of `{name}[{k}]` are {low:g} and {high:g}, "
                "and must be finite and in rising order."
            )
    return len(lower)


def _hull_of(entries: np.ndarray, atoms: Atoms) -> Hull:
    """Return the hull of a matrix of polynomials."""
    # Over all entries together: corners for each entry alone would lose that they share angles.
    used: dict[int, set[Any]] = {}
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
    # Entries may not tell all products apart, and each vertex is a constraint for a solver.
    vertices = np.unique(np.stack(spread, axis=-1), axis=0)
    return Hull(vertices.reshape(-1, *entries.shape), error, _describe_atoms(atoms, used, counts))


def _round_values(
    p: Polynomial, corners: dict[int, Corners]
) -> tuple[CornerValues, np.ndarray, float]:
    """Return an entry's vertex values, exactly and rounded, with the bound of their difference."""
    values = corner_values(p, corners)
    rounded = np.empty(values.array.shape)
    worst = Fraction(0)
    for place, exact in np.ndenumerate(values.array):
        try:
            # To the nearest float; what that moves is measured exactly and becomes part of `error`.
            rounded[place] = float(exact)
        except OverflowError as fault:
            raise GainError("an entry of the Jacobian exceeds float64 on the domain.") from fault
        worst = max(worst, abs(Fraction(float(rounded[place])) - exact))
    return values, rounded, _round_up(worst + values.slack)


def _round_up(x: Fraction) -> float:
    """Return the smallest float that is not below x."""
    near = float(x)
    # `float` rounds to nearest, and a bound must not be rounded down.
    return near if Fraction(near) >= x else math.nextafter(near, math.inf)


def _expand_values(values: CornerValues, array: np.ndarray, counts: dict[int, int]) -> np.ndarray:
    """Return an entry's values at every product of vertices, in the order of `counts`."""
    shape = [count if atom in values.atoms else 1 for atom, count in counts.items()]
    # An entry is constant along the atoms that it does not use.
    return np.broadcast_to(array.reshape(shape), list(counts.values())).ravel()


def _describe_atoms(
    atoms: Atoms, used: dict[int, set[Any]], counts: dict[int, int]
) -> tuple[HullAtom, ...]:
    """Return what the hull is made of, in the order in which the model uses it."""
    found = []
    for atom, count in counts.items():
        known = atoms.known[atom]
        powers = [e for e in used[atom] if isinstance(e, int)]
        kind = "arc" if not powers else "interval" if powers == [1] else "powers"
        low, high = float(known.interval.lo), float(known.interval.hi)
        found.append(HullAtom(known.name, "constant" if count == 1 else kind, low, high, count))
    return tuple(found)
