"""The point of a convex hull that is nearest to the origin, of hulls of up to four points."""

import itertools
from collections.abc import Iterator, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

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
