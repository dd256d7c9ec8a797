"""Atoms of polynomials: box variables, angles, and unknowns given only by their range.

An atom has a range, and its powers or waves lie in a polygon. An expression that is not polynomial
becomes a new atom.
"""

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from echelon.core.enclosure.curve_polygons import common_unit, power_points, wave_points
from echelon.core.enclosure.interval import ELEMENTARY, Interval, circle, point, wave
from echelon.core.enclosure.polynomial import (
    Exponent,
    Monomial,
    Polynomial,
    Wave,
    constant,
    monomial_quotient,
    order,
)
from echelon.core.errors import GainError, listing

_HALF = Fraction(1, 2)
MOST_VERTICES = 16384
"""Largest number of vertices of a hull; no solver could use more."""

_MOST_ORDER = 16  # of the waves that share a polygon
_FEW = 64  # a range is sharpened at the corners where there are no more than these
_THIN = Fraction(1, 1 << 64)  # relative width of what is a number in all but name


@dataclass(frozen=True)
class Atom:
    """A variable or an angle: its name, its range and the box variables it depends on.

    A variable without bounds has no range.
    """

    name: str
    interval: Interval | None
    sources: frozenset[str]
    border: Polynomial | None = None  # of a side, see `Atoms.side`

    @property
    def reach(self) -> Interval:
        """Return the range.

        Raises:
            OpenError: the atom has none.
        """
        if self.interval is None:
            raise OpenError(self.name)
        return self.interval


class OpenError(GainError):
    """The range of a variable is needed, but the box leaves it unbounded."""

    def __init__(self, name: str) -> None:
        self.name = name
        super().__init__(f"the domain leaves `{name}` unbounded, and must give it a bound.")


class Atoms:
    """The numbered variables and angles of polynomials, with their ranges."""

    def __init__(self) -> None:
        self.known: list[Atom] = []
        self._numbers: dict[object, int] = {}
        self._ranges: dict[tuple[int, Exponent], Interval] = {}

    def _add(self, key: object, atom: Atom) -> int:
        if key not in self._numbers:
            self._numbers[key] = len(self.known)
            self.known.append(atom)
        return self._numbers[key]

    def variable(self, name: str, interval: Interval | None) -> Polynomial:
        """Return a new box variable (open without a range), or a constant if it is fixed."""
        if interval is not None and interval.lo == interval.hi:
            return constant(interval.lo)
        atom = self._add(("box", len(self.known)), Atom(name, interval, frozenset([name])))
        return Polynomial({((atom, 1),): Fraction(1)})

    def fresh(self, key: object, interval: Interval, *behind: Polynomial) -> Polynomial:
        """Return a variable for a value of which only the range is known.

        The same `key` gives the same variable; a range of one point gives a number.
        """
        # A constant keeps polynomials short and does not double the vertices of a hull.
        if interval.lo == interval.hi:
            return constant(interval.lo)
        sources = frozenset().union(*(self.sources(p) for p in behind))
        name = f"expression of {', '.join(sorted(sources))}" if sources else "constant"
        atom = self._add(("fresh", key), Atom(name, interval, sources))
        return Polynomial({((atom, 1),): Fraction(1)})

    def side(self, border: Polynomial) -> Polynomial:
        """Return an unknown that is 1 where `border` > 0 and 0 where `border` < 0.

        Positive multiples of a border share it, negative ones have its complement to 1. Where
        the border is 0, it is anything between 0 and 1.
        """
        # Normalized by one coefficient, multiples of a border have one unknown, so that two `max`
        # of one pair switch together.
        lead = border.terms[max(border.terms, key=order)]
        if lead < 0:
            return constant(1) - self.side(-border)
        scaled = constant(1 / lead) * border
        name = f"side of {', '.join(sorted(self.sources(scaled)))}"
        range_ = Interval(Fraction(0), Fraction(1))
        atom = self._add(("side", scaled.key()), Atom(name, range_, self.sources(scaled), scaled))
        return Polynomial({((atom, 1),): Fraction(1)})

    def settle(self, p: Polynomial) -> Polynomial:
        """Return a polynomial simplified by the identities of sides: s d = (d + |d|) / 2, s s = s.

        For example the slope of x |x|, computed as |x| + (2 s - 1) x, becomes 2 |x|.
        """
        for atom in p.exponents():
            border = self.known[atom].border
            if border is not None:
                p = self._settle(p, atom, border)
        return p

    def _settle(self, p: Polynomial, side: int, border: Polynomial) -> Polynomial:
        chosen, lead = Polynomial({((side, 1),): Fraction(1)}), max(border.terms, key=order)
        # lead * s = s d - s (d - lead), of which s d is simplified.
        rest = chosen * (border - Polynomial({lead: Fraction(1)}))
        settled = constant(_HALF) * (border + self.elementary("abs", border)) - rest
        # Each replacement multiplies the side by smaller monomials only, so the loop ends.
        done, left = constant(0), p
        while left.terms:
            top = max(left.terms, key=order)
            c, factors = left.terms[top], dict(top)
            left = left - Polynomial({top: c})
            if side not in factors:
                done = done + Polynomial({top: c})
                continue
            factors.pop(side)
            others = tuple(sorted(factors.items()))
            q = monomial_quotient(others, lead)
            if q is None:
                done = done + Polynomial({others: c}) * chosen
            else:
                left = left + Polynomial({q: c}) * settled
        return done

    def sources(self, p: Polynomial) -> frozenset[str]:
        """Return the names of the box variables that a polynomial depends on."""
        return frozenset().union(*(self.known[atom].sources for atom in p.exponents()))

    def elementary(self, name: str, p: Polynomial) -> Polynomial:
        """Return a function of `ELEMENTARY` of a polynomial.

        Raises:
            GainError: it is not defined on the whole box.
        """
        function, interval = ELEMENTARY[name], self.range(p)
        if not function.defined(interval):
            verb = "divides by" if name == "reciprocal" else f"takes `{name}` of"
            behind = listing(sorted(self.sources(p))) or "constants"
            raise GainError(
                f"the model {verb} an expression of {behind}, which may be "
                f"anything in {interval.text()} on the domain, and {function.domain}; "
                "make the domain smaller."
            )
        return self.fresh((name, p.key()), function.range(interval), p)

    def circle(self, p: Polynomial) -> tuple[Polynomial, Polynomial]:
        """Return cos p and sin p, expanded by the addition theorems."""
        linear = self._linear(p)
        shift = linear.pop((), Fraction(0))
        # The cosine of a number is irrational: an interval 2^-99 wide, and hence a variable.
        if not linear:
            cosine, sine = circle(shift)
            return self.fresh(("cos", shift), cosine), self.fresh(("sin", shift), sine)
        # By the addition theorem, one angle after the other.
        result = (constant(1), constant(0))
        for ((atom, _),), factor in linear.items():
            # The constant is added to the first angle, where it shifts a range and adds no term.
            c, s = self._angle(atom, factor, shift)
            result = result[0] * c - result[1] * s, result[1] * c + result[0] * s
            shift = Fraction(0)
        return result

    def _linear(self, p: Polynomial) -> dict[Monomial, Fraction]:
        """Return the constant and linear terms; all other terms become one new variable."""
        bent = {m: c for m, c in p.terms.items() if m and not (len(m) == 1 and m[0][1] == 1)}
        if not bent:
            return dict(p.terms)
        rest = Polynomial(bent)
        return (p - rest + self.fresh(("angle", rest.key()), self.range(rest), rest)).terms

    def _angle(self, atom: int, factor: Fraction, shift: Fraction) -> tuple[Polynomial, Polynomial]:
        """Return cos and sin of factor x + shift for a variable x."""
        # factor x + shift = factor (x + phase).
        phase, behind = shift / factor, self.known[atom]
        theta = Atom(behind.name, behind.reach + point(phase), behind.sources)
        angle = self._add(("angle", atom, phase), theta)
        # cos is even and sin is odd, so frequencies can be positive.
        cosine = Polynomial({((angle, (abs(factor), 0)),): Fraction(1)})
        sine = Polynomial({((angle, (abs(factor), 1)),): Fraction(1 if factor > 0 else -1)})
        return cosine, sine

    def factor_range(self, atom: int, exponent: Exponent) -> Interval:
        """Return the range of a power or of a wave of an atom."""
        key = (atom, exponent)
        if key not in self._ranges:
            interval = self.known[atom].reach
            self._ranges[key] = (
                interval.power(exponent)
                if isinstance(exponent, int)
                else wave(interval.scale(exponent[0]), sine=bool(exponent[1]))
            )
        return self._ranges[key]

    def range(self, p: Polynomial) -> Interval:
        """Return an interval that contains every value of a polynomial on the box."""
        total = point(0)
        for monomial, c in p.terms.items():
            product = point(c)
            for atom, exponent in monomial:
                product = product * self.factor_range(atom, exponent)
            total = total + product
        # A monomial contains each atom once, so its interval product is already exact.
        if len(p.terms) < 2:
            return total
        # Terms that share atoms are dependent; evaluation at common corners uses that.
        corners = {atom: self.corners(atom, used) for atom, used in p.exponents().items()}
        if math.prod(len(c.points) for c in corners.values()) > _FEW:
            return total
        values = corner_values(p, corners)
        low, high = min(values.array.flat), max(values.array.flat)
        return total.intersect(Interval(low - values.slack, high + values.slack))

    def corners(self, atom: int, used: Iterable[Exponent]) -> "Corners":
        """Return points whose hull contains the used powers or waves of an atom jointly."""
        exponents = list(used)
        # For a single coordinate the range is the tightest enclosure.
        if len(exponents) == 1:
            return _gather_points(self._ends(atom, exponents[0]))
        powers = [e for e in exponents if isinstance(e, int)]
        if powers:
            return _gather_points([{**p} for p in power_points(self.known[atom].reach, powers)])
        arc, result = self.known[atom].reach, [dict[Exponent, Fraction]()]
        for group in _harmonics(e for e in exponents if isinstance(e, tuple)):
            around = _wave_corners(arc, group) if len(group) > 1 else self._ends(atom, group[0])
            check_count(len(result) * len(around))
            result = [{**p, **q} for p in result for q in around]
        return _gather_points(result)

    def _ends(self, atom: int, exponent: Exponent) -> list[dict[Exponent, Fraction]]:
        reached = self.factor_range(atom, exponent)
        return [{exponent: end} for end in (reached.lo, reached.hi)]


def _harmonics(waves: Iterable[Wave]) -> list[list[Wave]]:
    """Return waves in groups, each of low multiples of one frequency.

    A group has one polygon, whose corners increase with the highest multiple (as floats, 0.7 and
    1.3 are multiples of 2^-53).
    Groups are enclosed separately; products of their corners enclose all.
    """
    groups = list[list[Wave]]()
    for w in sorted(waves):
        fitting = (
            g for g in groups if w[0] <= _MOST_ORDER * common_unit([w[0], *(v for v, _ in g)])
        )
        group = next(fitting, None)
        groups.append([w]) if group is None else group.append(w)
    return groups


def _wave_corners(arc: Interval, waves: list[Wave]) -> list[dict[Exponent, Fraction]]:
    """Return points whose hull contains the waves of a group jointly."""
    unit = common_unit(w for w, _ in waves)
    orders = {w: int(w / unit) for w, _ in waves}
    around = wave_points(arc.scale(unit), set(orders.values()))
    return [{(w, s): p[orders[w], s] for w, s in waves} for p in around]


def check_count(count: int) -> None:
    """Check the number of vertices of a hull.

    Raises:
        GainError: there are more than `MOST_VERTICES`.
    """
    if count > MOST_VERTICES:
        raise GainError(
            f"the hull of Jacobians has {count} vertices, and may have {MOST_VERTICES}; "
            "fix some states or inputs of the domain at one value."
        )


class Corners(NamedTuple):
    """Points whose hull, widened by `radius`, contains an atom's powers or waves."""

    points: list[dict[Exponent, Fraction]]
    radius: dict[Exponent, Fraction]

    def bound(self, exponent: Exponent) -> Fraction:
        """Return the largest absolute value of a coordinate."""
        return max(abs(p[exponent]) for p in self.points) + self.radius[exponent]


def _gather_points(points: list[dict[Exponent, Fraction]]) -> Corners:
    """Return distinct points, or their midpoint if they are nearly equal."""
    ends = {e: (min(p[e] for p in points), max(p[e] for p in points)) for e in points[0]}
    # Two corners for the cosine of a constant would double the hull only for rounding.
    if all(hi - lo <= _THIN * max(1, abs(hi)) for lo, hi in ends.values()):
        middle = {e: (lo + hi) / 2 for e, (lo, hi) in ends.items()}
        return Corners([middle], {e: (hi - lo) / 2 for e, (lo, hi) in ends.items()})
    distinct = {tuple(p.items()): p for p in points}
    return Corners(list(distinct.values()), {e: Fraction(0) for e in ends})


class CornerValues(NamedTuple):
    """Values of a polynomial at all products of corners, one axis per atom, within `slack`."""

    atoms: list[int]
    array: np.ndarray
    slack: Fraction


def corner_values(p: Polynomial, corners: Mapping[int, Corners]) -> CornerValues:
    """Return the values of a polynomial at all products of its atoms' corners.

    It is affine in the coordinates of each atom, so their hull and the slack contain its values.
    """
    atoms = sorted(p.exponents())
    array = np.empty([len(corners[atom].points) for atom in atoms], object)
    for place in itertools.product(*(range(k) for k in array.shape)):
        chosen = {a: corners[a].points[k] for a, k in zip(atoms, place, strict=True)}
        array[place] = sum(
            (c * math.prod(chosen[a][e] for a, e in m) for m, c in p.terms.items()), Fraction(0)
        )
    return CornerValues(atoms, array, _slack(p, corners))


def _slack(p: Polynomial, corners: Mapping[int, Corners]) -> Fraction:
    """Bound the effect of the radii: each factor's radius times the bounds of the others."""
    return sum(
        (
            abs(c) * corners[a].radius[e] * math.prod(corners[b].bound(d) for b, d in m if b != a)
            for m, c in p.terms.items()
            for a, e in m
            if corners[a].radius[e]
        ),
        Fraction(0),
    )
