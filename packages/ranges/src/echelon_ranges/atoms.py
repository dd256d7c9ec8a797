"""Polynomials with rational coefficients in atoms: box variables, angles, unknowns with a range."""

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from math import comb, gcd, lcm
from typing import NamedTuple, TypeAlias, final

import numpy as np

from echelon_ranges.errors import RangeError, UnboundedError, listing
from echelon_ranges.interval import ELEMENTARY, Interval, circle, pi, point, wave

# ---- polynomials ---------------------------------------------------------------------------------
# A monomial contains each variable once, as a power x^k, and each angle once, as cos(w theta) or
# sin(w theta). Products of waves are expanded to sums of waves at once, so c^2 + s^2 is 1 and equal
# terms cancel.

Wave: TypeAlias = tuple[Fraction, int]
"""Frequency w > 0 in units of the angle, and 0 for cos(w theta) or 1 for sin(w theta)."""

Exponent: TypeAlias = int | Wave
Monomial: TypeAlias = tuple[tuple[int, Exponent], ...]
"""Indices of atoms, ascending, each with its power or its wave."""

_HALF = Fraction(1, 2)
_MOST_TERMS = 256  # of a quotient


def _wave_product(a: Wave, b: Wave) -> list[tuple[Fraction, Wave | None]]:
    """Return cos or sin of a times cos or sin of b as a sum of waves; None stands for 1."""
    (p, i), (q, j) = a, b
    # Two cosines or two sines make cosines, and one of each makes sines.
    part = i ^ j
    sum_sign = Fraction(-1 if i and j else 1)
    difference_sign = Fraction(-1 if j and not i else 1)
    terms: list[tuple[Fraction, Wave | None]] = [(_HALF * sum_sign, (p + q, part))]
    if p != q:
        # sin((p - q) x) is odd, and frequencies are kept positive.
        if part and p < q:
            difference_sign = -difference_sign
        terms.append((_HALF * difference_sign, (abs(p - q), part)))
    elif not part:
        terms.append((_HALF * difference_sign, None))
    return terms


def _monomial_product(a: Monomial, b: Monomial) -> list[tuple[Fraction, Monomial]]:
    result: list[tuple[Fraction, dict[int, Exponent]]] = [(Fraction(1), dict(a))]
    # A monomial contains each atom once: powers are merged, products of waves become two terms.
    for atom, exponent in b:
        present = dict(a).get(atom)
        for _, factors in result:
            factors.pop(atom, None)
        if present is None:
            options: list[tuple[Fraction, Exponent | None]] = [(Fraction(1), exponent)]
        elif isinstance(present, int) and isinstance(exponent, int):
            options = [(Fraction(1), present + exponent)]
        else:
            # Angles are atoms of their own (`_angle`), so no atom has both powers and waves.
            assert isinstance(present, tuple) and isinstance(exponent, tuple)
            options = [*_wave_product(present, exponent)]
        result = [
            (c * k, factors if new is None else {**factors, atom: new})
            for c, factors in result
            for k, new in options
        ]
    return [(c, tuple(sorted(factors.items()))) for c, factors in result]


@final
class Polynomial:
    """An immutable sum of monomials with nonzero rational coefficients."""

    __slots__ = ("terms",)

    def __init__(self, terms: dict[Monomial, Fraction]) -> None:
        self.terms = {monomial: c for monomial, c in terms.items() if c}

    def __add__(self, other: "Polynomial") -> "Polynomial":
        terms = dict(self.terms)
        for monomial, c in other.terms.items():
            terms[monomial] = terms.get(monomial, Fraction(0)) + c
        return Polynomial(terms)

    def __neg__(self) -> "Polynomial":
        return Polynomial({monomial: -c for monomial, c in self.terms.items()})

    def __sub__(self, other: "Polynomial") -> "Polynomial":
        return self + (-other)

    def __mul__(self, other: "Polynomial") -> "Polynomial":
        terms: dict[Monomial, Fraction] = {}
        for a, p in self.terms.items():
            for b, q in other.terms.items():
                for c, monomial in _monomial_product(a, b) if a and b else [(1, a or b)]:
                    terms[monomial] = terms.get(monomial, Fraction(0)) + p * q * c
        return Polynomial(terms)

    def power(self, k: int) -> "Polynomial":
        """Return the k-th power, k >= 0."""
        result = constant(1)
        for _ in range(k):
            result = result * self
        return result

    def key(self) -> frozenset[tuple[Monomial, Fraction]]:
        """Return a hashable key, equal only for equal polynomials."""
        return frozenset(self.terms.items())

    def value(self) -> Fraction | None:
        """Return the value of a constant polynomial, otherwise None."""
        return self.terms.get((), Fraction(0)) if set(self.terms) <= {()} else None

    def exponents(self) -> dict[int, set[Exponent]]:
        """Return which powers or waves of each atom occur."""
        result: dict[int, set[Exponent]] = {}
        for monomial in self.terms:
            for atom, exponent in monomial:
                result.setdefault(atom, set()).add(exponent)
        return result


def constant(x: Fraction | int | float) -> Polynomial:
    """Return the constant polynomial x, exactly."""
    return Polynomial({(): Fraction(x)})


def divides(divisor: Polynomial, p: Polynomial) -> bool:
    """Return whether p is a multiple of the divisor, and hence 0 wherever the divisor is 0."""
    lead = max(divisor.terms, key=order)
    quotient, rest = constant(0), p
    # With one divisor, the remainder is 0 if and only if every leading term is divisible.
    for _ in range(_MOST_TERMS):
        if not rest.terms:
            # A product of waves is not a monomial, so the result is verified by multiplication.
            return (quotient * divisor - p).terms == {}
        top = max(rest.terms, key=order)
        factor = monomial_quotient(top, lead)
        if factor is None:
            return False
        step = Polynomial({factor: rest.terms[top] / divisor.terms[lead]})
        quotient, rest = quotient + step, rest - step * divisor
    return False


def order(monomial: Monomial) -> list[tuple[int, int, str]]:
    """Return the key of the lexicographic order of monomials, low atom indices first."""
    # An atom that is missing has the power 0, which sorts below any other: hence the minus.
    return [(-atom, e, "") if isinstance(e, int) else (-atom, 1, repr(e)) for atom, e in monomial]


def monomial_quotient(top: Monomial, lead: Monomial) -> Monomial | None:
    """Return the monomial top / lead, or None if `lead` does not divide `top`."""
    left = dict(top)
    for atom, e in lead:
        power = left.pop(atom, None)
        if isinstance(power, int) and isinstance(e, int) and power >= e:
            if power > e:
                left[atom] = power - e
        elif power != e:
            return None
    return tuple(sorted(left.items()))


# ---- polygons around curves ----------------------------------------------------------------------
# A polynomial curve lies in the hull of its Bezier control points, and so does a curve of waves of
# degree d on an arc below 180 degrees, written as a form of degree 2 d in the half-angle's
# direction and divided by the form of the constant 1, whose coefficients are positive there. An
# arc's ends are rational points of the circle just outside of its own, so that every control point
# is an exact rational. Cut in two, an arc of degree 1 gives the trapezoid between chord and three
# tangents.

Gaussian: TypeAlias = tuple[int, int]
"""A direction in the plane, as a complex integer."""

# Ends of an arc are turned outward by 2^-60, more than the rounding of 2^-64 of a direction.
_UNIT = 1 << 64
_TILT = 1 << 60
_FAR = 1 << 199  # rad; beyond it `circle` cannot locate an angle
# At half the angles a full turn is half a turn, here in four pieces.
_FULL: list[Gaussian] = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)]


def power_points(interval: Interval, powers: Iterable[int]) -> list[dict[int, Fraction]]:
    """Return points whose hull contains (x^k for k in powers), x in the interval."""
    exponents = sorted(powers)
    if len(exponents) == 1:
        # A single power has a range, which is tighter than the control points of its curve.
        reached = interval.power(exponents[0])
        return [{exponents[0]: end} for end in (reached.lo, reached.hi)]
    degree = exponents[-1]
    lo, hi = interval.lo, interval.hi
    return [
        {
            k: sum(
                (
                    # The polar form of x^k at i times hi and degree - i times lo.
                    Fraction(comb(i, m) * comb(degree - i, k - m), comb(degree, k))
                    * hi**m
                    * lo ** (k - m)
                    for m in range(max(0, k - degree + i), min(i, k) + 1)
                ),
                Fraction(0),
            )
            for k in exponents
        }
        for i in range(degree + 1)
    ]


def common_unit(frequencies: Iterable[Fraction]) -> Fraction:
    """Return the largest rational of which all frequencies are integer multiples."""
    rationals = list(frequencies)
    denominator = lcm(*(w.denominator for w in rationals))
    return Fraction(gcd(*(int(w * denominator) for w in rationals)), denominator)


def wave_points(arc: Interval, orders: Iterable[int]) -> list[dict[tuple[int, int], Fraction]]:
    """Return points whose hull contains (cos k t, sin k t for k in orders), t in the arc (rad).

    Keys are (k, 0) for cos and (k, 1) for sin.
    """
    degrees = sorted(orders)
    degree = degrees[-1]
    cuts = _cuts(arc)
    closed = cuts == _FULL
    result = []
    for number, (a, b) in enumerate(zip(cuts, cuts[1:], strict=False)):
        first = 0 if number == 0 and not closed else 1
        last = 2 * degree if number == len(cuts) - 2 and not closed else 2 * degree - 1
        # Where two pieces meet, the curve's tangent runs between the neighbouring control points.
        result += [_control_point(a, b, degree, i, degrees) for i in range(first, last + 1)]
    return result


def _cuts(arc: Interval) -> list[Gaussian]:
    """Two pieces below 180 degrees, four above; the full circle if the ends nearly meet."""
    start, end = arc.lo / 2, arc.hi / 2
    if end - start >= pi().lo - Fraction(1, 1 << 40) or max(abs(start), abs(end)) > _FAR:
        return _FULL
    # Each piece is below 90 degrees: towards 180 the end tangents intersect ever farther away.
    pieces = 2 if end - start < pi().lo / 2 else 4
    between = [start + (end - start) * Fraction(k, pieces) for k in range(1, pieces)]
    return [_direction(start, -1), *(_direction(a, 0) for a in between), _direction(end, 1)]


def _direction(angle: Fraction, turn: int) -> Gaussian:
    """Return a direction at most 2^-59 rad below (-1), near (0) or above (1) an angle.

    Rounding moves the direction by less than 2^-63, the turn by arctan 2^-60.
    """
    # Exact, with short fractions.
    if angle == 0:
        return 1, 0
    cosine, sine = circle(angle)
    c, s = round(cosine.lo * _UNIT), round(sine.lo * _UNIT)
    return c * _TILT - turn * s, s * _TILT + turn * c


def _times(a: Gaussian, b: Gaussian) -> Gaussian:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


# Every control point of an arc takes powers of the same few directions.
@lru_cache(maxsize=4096)
def _power(a: Gaussian, k: int) -> Gaussian:
    return (1, 0) if k == 0 else _times(a, _power(a, k - 1))


def _form(a: Gaussian, b: Gaussian, degree: int, i: int, k: int) -> tuple[Fraction, Fraction]:
    """Return the polar form of z^(d + k) conj(z)^(d - k) at 2 d - i times a and i times b."""
    real, imaginary = Fraction(0), Fraction(0)
    bar_a, bar_b, plain = (a[0], -a[1]), (b[0], -b[1]), degree + k
    for m in range(max(0, plain - 2 * degree + i), min(i, plain) + 1):
        # The polar form averages over which of the arguments go to z, m of them b.
        weight = Fraction(comb(i, m) * comb(2 * degree - i, plain - m), comb(2 * degree, plain))
        one = _times(_power(b, m), _power(a, plain - m))
        other = _times(_power(bar_b, i - m), _power(bar_a, 2 * degree - i - plain + m))
        product = _times(one, other)
        real, imaginary = real + weight * product[0], imaginary + weight * product[1]
    return real, imaginary


def _control_point(
    a: Gaussian, b: Gaussian, degree: int, i: int, orders: list[int]
) -> dict[tuple[int, int], Fraction]:
    """Return control point i of the waves on the arc from twice the angle of a to that of b."""
    weight = _form(a, b, degree, i, 0)[0]
    assert weight > 0, "an arc's piece must be shorter than 180 degrees"
    result = {}
    for k in orders:
        real, imaginary = _form(a, b, degree, i, k)
        result[k, 0], result[k, 1] = real / weight, imaginary / weight
    return result


# ---- atoms ---------------------------------------------------------------------------------------
# An atom has a range, and its powers or waves lie in a polygon. An expression that is not
# polynomial becomes a new atom.

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
        """Return the range; raise `UnboundedError` if there is none."""
        if self.interval is None:
            raise UnboundedError(self.name)
        return self.interval


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
        """Return a variable of a known range, one for each `key`; a number if that is one point."""
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
        """Return a function of `ELEMENTARY`; `RangeError` if it is not defined on the whole box."""
        function, interval = ELEMENTARY[name], self.range(p)
        if not function.defined(interval):
            verb = "divides by" if name == "reciprocal" else f"takes `{name}` of"
            behind = listing(sorted(self.sources(p))) or "constants"
            raise RangeError(
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
    """Raise `RangeError` if a hull has more than `MOST_VERTICES` vertices."""
    if count > MOST_VERTICES:
        raise RangeError(
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
