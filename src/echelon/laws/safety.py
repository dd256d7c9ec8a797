"""Collision avoidance with a proof: a filter of the rate of an agent's stopping point."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.model import ControlAffine, in_metres
from echelon.agents.network.exchange import Near
from echelon.core.errors import LawError, is_number, listing
from echelon.core.types import Array

# ---- the point of a hull of up to four points that is nearest to the origin ----------------------

MOST_POINTS = 4
"""Of more points there would be too many faces to try them all."""
_FLAT = 64.0
"""Times the rounding of 1: the height over the length of a triangle that is left to its edges."""
_NOISE = 64.0
"""Times the rounding of 1 and the size cubed; what rounding makes of a volume of 0."""

_Row: TypeAlias = Float[jax.Array, " K"]
_Point: TypeAlias = Sequence[_Row]
"""The coordinates of one point of each of K hulls: scalars, which compile to a single loop."""


def nearest_point(points: Float[jax.Array, "K r d"]) -> Float[jax.Array, "K d"]:
    """Return the point of each hull of r points that is nearest to the origin, to rounding.

    It is the nearest one of all edges and triangles; of a tetrahedron about the origin it is 0. A
    thin triangle's point is off by the root of the rounding of 1, times the size, in its plane: its
    distance D from the origin by as much where D is 0, and by d^2 / (2 D) where that is less.
    """
    corners = [[points[:, k, a] for a in range(points.shape[2])] for k in range(points.shape[1])]
    best = corners[0]
    least = _dot(best, best)
    for inside, foot in _feet(corners):
        square = _dot(foot, foot)
        nearer = inside & (square < least)
        least = jnp.where(nearer, square, least)
        best = [jnp.where(nearer, new, old) for new, old in zip(foot, best, strict=True)]
    if len(corners) == MOST_POINTS and len(best) == 3:
        around = _around(*corners)
        best = [jnp.where(around, 0.0, x) for x in best]
    return jnp.stack(best, axis=1)


def _feet(corners: Sequence[_Point]) -> Iterator[tuple[Bool[jax.Array, " K"], _Point]]:
    """Yield the nearest points of edges and of the planes of triangles, and if they are inside."""
    for a, b in itertools.combinations(corners, 2):
        edge = _less(b, a)
        square = _dot(edge, edge)
        share = jnp.clip(-_dot(a, edge) / jnp.where(square > 0.0, square, 1.0), 0.0, 1.0)
        yield square > 0.0, [x + share * e for x, e in zip(a, edge, strict=True)]
    for a, b, c in itertools.combinations(corners, 3):
        e, f = _less(b, a), _less(c, a)
        ee = _dot(e, e)
        inverse = 1.0 / jnp.where(ee > 0.0, ee, 1.0)
        # The height over an edge, which loses fewer digits than a volume by products of squares.
        lean = inverse * _dot(e, f)
        g = [y - lean * x for x, y in zip(e, f, strict=True)]
        gg, flat = _dot(g, g), _FLAT * jnp.finfo(ee.dtype).eps
        solid = (ee > 0.0) & (gg > flat * flat * _dot(f, f))
        t = -_dot(a, g) / jnp.where(solid, gg, 1.0)
        s = -_dot(a, e) * inverse - t * lean
        inside = solid & (s >= 0.0) & (t >= 0.0) & (s + t <= 1.0)
        yield inside, [x + s * y + t * z for x, y, z in zip(a, e, f, strict=True)]


def _around(a: _Point, b: _Point, c: _Point, d: _Point) -> Bool[jax.Array, " K"]:
    """Return which tetrahedra contain the origin."""
    parts = _volume(b, d, c), _volume(a, c, d), _volume(a, d, b), _volume(a, b, c)
    low, high = (pick(pick(parts[0], parts[1]), pick(parts[2], parts[3])) for pick in _ENDS)
    # Of points that nearly coincide the volumes are rounding, with any signs.
    size = jnp.maximum(jnp.maximum(_dot(a, a), _dot(b, b)), jnp.maximum(_dot(c, c), _dot(d, d)))
    least = _NOISE * jnp.finfo(size.dtype).eps * size * jnp.sqrt(size)
    return (low > least) | (high < -least)


_ENDS = jnp.minimum, jnp.maximum


def _volume(a: _Point, b: _Point, c: _Point) -> _Row:
    across = [b[i] * c[j] - b[j] * c[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    return _dot(a, across)


def _less(a: _Point, b: _Point) -> _Point:
    return [x - y for x, y in zip(a, b, strict=True)]


def _dot(a: _Point, b: _Point) -> _Row:
    products = [x * y for x, y in zip(a, b, strict=True)]
    return sum(products[1:], products[0])


# ---- the filter ----------------------------------------------------------------------------------
# With roots rho_k of the inner loop, the points c_0 = p, c_k = c_(k-1) + c_(k-1)' / rho_k end in
# the stopping point, and each of them moves straight towards the next one. So the hull of two
# agents' differences changes by its last point alone, which the filter holds back (theory page,
# T10).

AXES = ("x", "y", "z")
_SIZES = np.repeat([0.5, 5.0, 50.0], 16)
"""Of samples about the trim, at which outputs are compared with the position."""
_DOWNWASH = 3.0
"""Height over width of the ellipsoid about a model with a radius: rotors blow downward."""
_MOST_CORRECTIONS, _SOLVED = 60, 1e-9
"""Corrections of a rate by single rows, and the size (m/s) of one that ends them."""


@final
@dataclasses.dataclass(frozen=True)
class Safety:
    """Keeps upright ellipsoids about agents apart, under the law `stopping-point`.

    Distances are scaled: heights are divided by the ellipsoid's height over its width, so that two
    ellipsoids touch where the scaled distance is twice the horizontal radius.

    Args:
        radii: of the ellipsoid along x, y and z, m, the first two equal; by default the model's
            radius, and three times as much upward.
        gain: rate at which agents may use up their distance, 1/s; at most 1 over the step.
        swirl: how fast an agent that is held back turns aside, m/s; agents that meet head-on then
            pass each other on the right.
        margin: added to the distance that the filter keeps, m.
        reach: scaled distance up to which others are regarded, m.
        of_model: the radii where none are given; set by `prepared`.

    Raises:
        LawError: a number is out of its range.
    """

    radii: tuple[float, ...] | None = None
    gain: float = 4.0
    swirl: float = 0.5
    margin: float = 0.05
    reach: float = 3.0
    of_model: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.radii is not None:
            radii = tuple(np.atleast_1d(np.asarray(self.radii, object)).tolist())
            object.__setattr__(self, "radii", radii)
            if len(radii) != 3 or not all(map(_positive, radii)) or radii[0] != radii[1]:
                raise LawError(
                    f"`radii` of `safety` are {list(radii)}, and must be three positive numbers, "
                    "m, the first two equal."
                )
        for name, least in (("gain", 1e-9), ("reach", 1e-9), ("swirl", 0.0), ("margin", 0.0)):
            value = getattr(self, name)
            if not (value == 0.0 and least == 0.0 or _positive(value)):
                allowed = "positive" if least else "not negative"
                raise LawError(f"`{name}` of `safety` is {value}, and must be {allowed}.")

    @property
    def size(self) -> tuple[float, ...]:
        """The radii of the ellipsoid along x, y and z, m, as given or of the model."""
        size = self.radii or self.of_model
        assert size is not None, "`prepared` finds the radii"
        return size

    @property
    def touching(self) -> float:
        """The scaled distance at which two ellipsoids touch, m."""
        return 2.0 * self.size[0]

    @property
    def distance(self) -> float:
        """The scaled distance that hulls keep, m."""
        return self.touching + self.margin

    def prepared(self, model: ControlAffine) -> "Safety":
        """Return it with radii, checked for a model.

        Raises:
            LawError: the model has no position in x, y and z, or no radius, or its outputs with the
                names of the position are other values, as seen at samples, or are not in m.
        """
        name, odd = type(model).__name__, [x for x in model.position if x not in AXES]
        if not model.position or odd:
            what = f"the position {listing(model.position)}" if odd else "no `position`"
            raise LawError(f"`safety` needs a position in x, y or z, and `{name}` has {what}.")
        _check_position(model)
        if not in_metres(model):
            raise LawError(f"`safety` needs the position in m, and `{name}` has another unit.")
        if self.radii is not None:
            return self
        radius = model.radius
        if radius is None:
            raise LawError(f"`safety` needs `radii`, since `{name}` has no `radius`.")
        if not _positive(radius):
            raise LawError(f"`radius` of `{name}` is {radius}, and must be positive, m.")
        return dataclasses.replace(self, of_model=(radius, radius, _DOWNWASH * radius))

    def scales(self, model: ControlAffine) -> Array:
        """Return the factors (d,) of the position's coordinates in scaled distances."""
        return np.array([self.size[0] / self.size[AXES.index(x)] for x in model.position])

    def needed_reach(self, speeds: Float[Array, " d"], scales: Float[Array, " d"]) -> float:
        """Return the distance beyond which no row can act, for agents of some speeds, m/s."""
        return self.distance + 2.0 * math.hypot(*(scales * speeds).tolist()) / self.gain

    def filtered(
        self,
        rate: Float[jax.Array, " d"],
        near: Near,
        scales: Float[jax.Array, " d"],
        speeds: Float[jax.Array, " d"],
    ) -> tuple[Float[jax.Array, " d"], jax.Array]:
        """Return the rate nearest to a desired one that lets no hull come too near.

        Return also how many rows act on it; `speeds` are those that its entries may have.
        """
        corners = jnp.where(near.known[:, None, None], near.gaps, 0.0) * scales[None, None]
        nearest = nearest_point(corners)
        far = jnp.sqrt((nearest * nearest).sum(axis=1))
        normals = nearest / jnp.maximum(far, jnp.finfo(far.dtype).tiny)[:, None]
        # Of hulls that are too near already, the nearest points are driven apart.
        room = jnp.where(far >= self.distance, (normals * corners[:, -1]).sum(axis=1), far)
        low = -self.gain * jnp.where(near.leads, 1.0, 0.5) * (room - self.distance)
        used = near.known & (far <= self.reach)
        short = jnp.where(used, low - normals @ (rate * scales), 0.0)
        u = rate * scales + self._aside(normals, short)
        u = _projected(u, normals, low, used)
        # The largest part that meets all rows which 0 meets; less of it still meets them.
        along = normals @ u
        over = used & (low <= 0.0) & (along < low)
        u = u * jnp.where(over, low / jnp.where(over, along, -1.0), 1.0).min(initial=1.0) / scales
        u = u * (speeds / jnp.maximum(jnp.abs(u), speeds)).min()
        active = (short > 0.0).sum()
        return jnp.where(active > 0, u, rate), active.astype(rate.dtype)

    def _aside(
        self, normals: Float[jax.Array, "K d"], short: Float[jax.Array, " K"]
    ) -> Float[jax.Array, " d"] | float:
        """Return the velocity to the right of the agent that is most in the way."""
        if normals.shape[1] < 2:
            return 0.0
        worst = jnp.argmax(short)
        x, y, *rest = normals[worst]
        size = jnp.sqrt(x * x + y * y)
        right = jnp.stack([-y, x, *(0.0 * height for height in rest)])
        amount = self.swirl * jnp.clip(short[worst], 0.0, 1.0)
        return amount * right / jnp.where(size > 0.0, size, 1.0)


class _Ascent(NamedTuple):
    """Corrections so far, the vector, the pull of each row, and the size of the last one."""

    steps: jax.Array
    u: Float[jax.Array, " d"]
    pull: Float[jax.Array, " K"]
    last: jax.Array


def _projected(
    u: Float[jax.Array, " d"],
    normals: Float[jax.Array, "K d"],
    low: Float[jax.Array, " K"],
    used: Bool[jax.Array, " K"],
) -> Float[jax.Array, " d"]:
    """Hildreth's dual ascent: the row that is off most is corrected, again and again."""

    def corrected(now: _Ascent) -> _Ascent:
        change = jnp.where(used, jnp.maximum(-now.pull, low - normals @ now.u), 0.0)
        worst = jnp.argmax(jnp.abs(change))
        by = change[worst]
        pull = now.pull.at[worst].add(by)
        return _Ascent(now.steps + 1, now.u + by * normals[worst], pull, jnp.abs(by))

    def off(now: _Ascent) -> jax.Array:
        return (now.steps < _MOST_CORRECTIONS) & (now.last > _SOLVED)

    start = _Ascent(jnp.zeros((), jnp.int32), u, 0.0 * low, jnp.full((), jnp.inf, u.dtype))
    return jax.lax.while_loop(off, corrected, start).u


def hull_points(
    values: Float[jax.Array, "r d"], roots: tuple[float, ...]
) -> Float[jax.Array, "r d"]:
    """Return c_0 .. c_(r-1) of a position with its derivatives, for roots (r - 1 of them)."""
    rows = np.zeros((len(values),) * 2)
    for k in range(len(values)):
        whole = np.atleast_1d(np.poly(-np.array(roots[:k])))[::-1]
        rows[k, : k + 1] = whole / whole[0]
    return jnp.asarray(rows, values.dtype) @ values


def _check_position(model: ControlAffine) -> None:
    """Check that outputs with the names of the position are the position, near the trim and far."""
    names = [name for name in model.position if name in model.output_names]
    both = model.output_names, model.state_names
    outputs, states = (np.array([each.index(x) for x in names], int) for each in both)
    draw = np.random.default_rng(0)
    away = _SIZES[:, None] * draw.uniform(-1.0, 1.0, (len(_SIZES), len(model.state_names)))
    x = jnp.asarray(np.asarray(model.trim[0], float) + away)
    off = np.abs(np.asarray(jax.vmap(model.output)(x)[:, outputs] - x[:, states]))
    wrong = np.flatnonzero(~(off.max(axis=0) <= _SOLVED))
    if len(wrong):
        raise LawError(
            f"`safety` needs the position of `{type(model).__name__}` among its flat outputs, and "
            f"its output `{names[wrong[0]]}` is not the state of that name."
        )


def _positive(value: object) -> bool:
    return is_number(value) and 0.0 < float(value) < math.inf
