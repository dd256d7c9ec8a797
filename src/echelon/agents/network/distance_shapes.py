"""Shapes of which distances are given: places that have them, and what else has them.

A shape is infinitesimally rigid where the rigidity matrix has the rank of that of all pairs at the
same points. It is the only one (up to mirror images), for generic points, where a stress matrix has
rank N - d - 1 (Connelly 2005; Gortler, Healy and Thurston 2010).
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy  # loads scipy.optimize when a shape is sought
import scipy.sparse.csgraph as csgraph
from jaxtyping import Float

from echelon.core.digits import about
from echelon.core.errors import FormationError
from echelon.core.types import Array

_STARTS, _SEED = 40, 0
"""From where places are sought."""
_SAME, _REALIZED, _FLAT = 1e-6, 1e-9, 1e-7
"""Of the largest distance: apart by less is the same; off by less is realized; thinner is flat."""
_TIGHT = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
_RANK = 1e-8
"""Relative, of a singular value."""
_CLIQUES = 20_000
"""Groups of agents, all of whose distances are given, that are looked at."""

_ENTRIES = 10_000_000
"""Of the rigidity matrix, at most."""

Distances: TypeAlias = Sequence[tuple[int, int, float]]
"""Of pairs of agents, m."""


class DistanceShape(NamedTuple):
    """Places that have given distances.

    Attributes:
        places: (N, d), m.
        residual: the largest difference of a distance, m.
        rigid: whether every small motion that keeps these distances keeps those of all pairs, to
            first order.
        unique: whether only mirror images have these distances; None where it is not decided.
        mirrored: whether the mirror image is another shape: not of points in a line or a plane.
        others: shapes with the same distances that were found, each (N, d).
    """

    places: Float[Array, "N d"]
    residual: float
    rigid: bool
    unique: bool | None
    mirrored: bool
    others: tuple[Float[Array, "N d"], ...]

    def remarks(self) -> Iterator[str]:
        """Yield what should be known of the shape, in sentences."""
        if not self.rigid:
            yield (
                "the distances leave the shape flexible: the agents keep the places that were "
                "found first; give more distances"
            )
        elif self.unique is None:
            yield (
                "whether another shape has these distances is not decided, since the agents lie in "
                "a line or a plane"
            )
        elif not self.unique:
            count = len(self.others)
            found = f"; {count} more {'was' if count == 1 else 'were'} found" if count else ""
            yield f"other shapes may have the same distances{found}; give more distances"


def realize(
    agents: int, axes: int, distances: Distances, near: Array | None = None
) -> DistanceShape:
    """Return a shape with given distances.

    Args:
        agents: N.
        axes: d, 1 to 3.
        distances: of pairs, m.
        near: places (N, d), to which it is turned (never mirrored), and the closer one is chosen of
            it and its mirror image; by default agent 0 is at 0, the first agent apart from it on
            the first axis, and so on.

    Raises:
        FormationError: a pair is none; there are too many; `near` has another shape; no shape has
            the distances, with the reason where one is proved; or none was found.
    """
    pairs, lengths = _checked(agents, distances)
    if near is not None and (np.shape(near) != (agents, axes) or not np.isfinite(near).all()):
        raise FormationError(f"`near` must be {agents} places of {axes} finite numbers.")
    if len(pairs) * agents * axes > _ENTRIES:
        raise FormationError(f"{len(pairs)} distances of {agents} agents are too many.")
    search, size = _search(agents, axes, pairs, lengths), float(lengths.max())
    if fault := _contradiction(agents, axes, pairs, lengths):
        raise _impossible(axes, fault, min(off for _, off in search))
    first, residual = _first(search, _REALIZED * size)
    flat, rigid = _rank_of(first) < axes, _is_rigid(first, pairs)
    unique = None if flat else rigid and _is_unique(first, pairs)
    if len(pairs) == agents * (agents - 1) // 2:
        unique = True
    others = tuple[Array, ...]()
    if rigid and unique is False:
        # A generic shape whose stress does not decide may be the only one all the same.
        same = [places for places, off in search if off <= _REALIZED * size]
        others = tuple(_distinct([first, *same], size)[1:])
    return DistanceShape(_turned(first, near), residual, rigid, unique, not flat, others)


def _impossible(axes: int, fault: str, least: float) -> FormationError:
    return FormationError(
        f"no shape in {axes} dimensions has these distances: {fault}. The closest one that was "
        f"found is off by {about(least)} m."
    )


def _first(search: Iterator[tuple[Array, float]], bound: float) -> tuple[Array, float]:
    """Return the first places of a search that are off by a bound (m) at most, and by how much."""
    least = np.inf
    for places, off in search:
        if off <= bound:
            return places, off
        least = min(least, off)
    raise FormationError(
        f"no shape with these distances was found: the best one is off by {about(least)} m."
    )


def _checked(agents: int, distances: Distances) -> tuple[Array, Array]:
    if not distances:
        raise FormationError("`distances` is empty, and must name pairs of agents.")
    seen = dict[tuple[int, int], float]()
    for i, j, length in distances:
        if i == j or not (0 <= i < agents and 0 <= j < agents):
            raise FormationError(
                f"a distance is given between agents {i} and {j}, and must be between two of the "
                f"agents 0 to {agents - 1}."
            )
        if not 0.0 < length < np.inf:
            raise FormationError(
                f"the distance between agents {i} and {j} is {length:g} m, and must be above 0."
            )
        if seen.setdefault((min(i, j), max(i, j)), length) != length:
            raise FormationError(f"two distances are given between agents {i} and {j}.")
    return np.array([*seen], int), np.array([*seen.values()], float)


# ---- what cannot be ------------------------------------------------------------------------------
# No distance is longer than a way over others, and the Gram matrix of points has no negative
# eigenvalue and rank d at most (Cayley and Menger).


def _contradiction(agents: int, axes: int, pairs: Array, lengths: Array) -> str:
    """Return a proof that no places have the distances; empty where none is found."""
    D = np.zeros((agents, agents))
    D[pairs[:, 0], pairs[:, 1]] = D[pairs[:, 1], pairs[:, 0]] = lengths
    ways = np.asarray(csgraph.shortest_path(D, directed=False))
    for (i, j), length in zip(pairs.tolist(), lengths.tolist(), strict=True):
        if length > ways[i, j] * (1.0 + _REALIZED):
            return (
                f"agents {i} and {j} are {about(length)} m apart, and a way over others has "
                f"{about(float(ways[i, j]))} m"
            )
    for group in itertools.islice(_cliques(D, axes + 2), _CLIQUES):
        squares = D[np.ix_(group, group)] ** 2
        gram = 0.5 * (squares[1:, :1] + squares[:1, 1:] - squares[1:, 1:])
        values, scale = np.linalg.eigvalsh(gram), squares.max()
        if values[0] < -_REALIZED * scale or (
            len(values) > axes and values[-axes - 1] > _SAME * scale
        ):
            *names, last = map(str, group)
            return (
                f"no {len(names) + 1} points have those among agents {', '.join(names)} and {last}"
            )
    return ""


def _cliques(D: Array, most: int) -> Iterator[tuple[int, ...]]:
    """Yield groups of 3 to `most` agents, between all of which distances are given."""
    near = [{*np.flatnonzero(row).tolist()} for row in D]

    def grown(group: tuple[int, ...], common: set[int]) -> Iterator[tuple[int, ...]]:
        if len(group) >= 3:
            yield group
        if len(group) < most:
            for k in sorted(x for x in common if x > max(group)):
                yield from grown((*group, k), common & near[k])

    for k in range(len(D)):
        yield from grown((k,), near[k])


# ---- what has the distances ----------------------------------------------------------------------


def _search(agents: int, axes: int, pairs: Array, lengths: Array) -> Iterator[tuple[Array, float]]:
    """Yield the places at which a search from some starts ends, and by how much they are off, m."""
    i, j = pairs.T
    size, draws = lengths.max(), np.random.default_rng(_SEED)

    def off(p: Array) -> Array:
        q = p.reshape(agents, axes)
        # Of squares, which are smooth everywhere; by 2 d, so that it is in units of distances.
        return (((q[i] - q[j]) ** 2).sum(axis=1) - lengths**2) / (2.0 * lengths)

    def slope(p: Array) -> Array:
        q, rows = p.reshape(agents, axes), np.zeros((len(i), agents, axes))
        each, apart = np.arange(len(i)), (q[i] - q[j]) / lengths[:, None]
        rows[each, i], rows[each, j] = apart, -apart
        return rows.reshape(len(i), -1)

    given: Any = {"jac": slope, "x_scale": "jac", "max_nfev": 400, **_TIGHT}
    drawn = (draws.normal(size=(agents, axes)) * size for _ in range(_STARTS))
    for start in itertools.chain([_scaled(agents, axes, pairs, lengths)], drawn):
        end = scipy.optimize.least_squares(off, start.reshape(-1), **given)
        places = end.x.reshape(agents, axes)
        apart = np.linalg.norm(places[i] - places[j], axis=1)
        yield places - places[0], float(np.abs(apart - lengths).max())


def _scaled(agents: int, axes: int, pairs: Array, lengths: Array) -> Array:
    """Return where to begin: classical scaling of the shortest ways."""
    graph = np.zeros((agents, agents))
    graph[pairs[:, 0], pairs[:, 1]] = lengths
    ways = np.asarray(csgraph.shortest_path(graph, directed=False))
    ways[~np.isfinite(ways)] = 2.0 * lengths.sum()
    centre = np.eye(agents) - 1.0 / agents
    values, vectors = np.linalg.eigh(-0.5 * centre @ ways**2 @ centre)
    values, vectors = values[::-1][:axes], vectors[:, ::-1][:, :axes]
    places = np.zeros((agents, axes))
    places[:, : len(values)] = vectors * np.sqrt(np.maximum(values, 1e-6 * values[0]))
    return places


def _distinct(shapes: list[Array], size: float) -> list[Array]:
    """Return shapes of which no two have all distances in common, the first one first."""
    kept = list[tuple[Array, Array]]()
    for places in shapes:
        apart = np.linalg.norm(places[:, None] - places[None], axis=2)
        if all(np.abs(apart - other).max() > _SAME * size for _, other in kept):
            kept.append((places, apart))
    return [places for places, _ in kept]


def _rank_of(matrix: Array) -> int:
    centred = matrix - matrix.mean(axis=0)
    sizes = np.linalg.svd(centred, compute_uv=False)
    return int((sizes > _FLAT * sizes[0]).sum())


def rigidity_matrix(places: Float[Array, "N d"], pairs: Array) -> Float[Array, "E Nd"]:
    """Return the derivative of half of the squared distances of pairs (E, 2) by the places."""
    i, j = pairs.T
    rows, each = np.zeros((len(i), *places.shape)), np.arange(len(i))
    rows[each, i], rows[each, j] = places[i] - places[j], places[j] - places[i]
    return rows.reshape(len(i), -1)


def _rank(matrix: Array) -> int:
    sizes = np.linalg.svd(matrix, compute_uv=False)
    return int((sizes > _RANK * sizes.max(initial=1e-300)).sum())


def _is_rigid(places: Array, pairs: Array) -> bool:
    """Tell whether distances of pairs fix to first order what those of all pairs do."""
    # All pairs of points that span r dimensions have this rank, in whatever space they lie.
    span = _rank_of(places)
    return _rank(rigidity_matrix(places, pairs)) == span * len(places) - span * (span + 1) // 2


def _is_unique(places: Array, pairs: Array) -> bool:
    """Return whether a random stress has a matrix of rank N - d - 1."""
    agents, axes = places.shape
    rows = rigidity_matrix(places, pairs)
    left, sizes, _ = np.linalg.svd(rows)
    stresses = left[:, (np.append(sizes, np.zeros(len(rows)))[: len(rows)] <= _RANK * sizes[0])]
    if not stresses.shape[1]:
        return False
    stress = stresses @ np.random.default_rng(_SEED).normal(size=stresses.shape[1])
    matrix = np.zeros((agents, agents))
    for (i, j), weight in zip(pairs.tolist(), stress.tolist(), strict=True):
        matrix[[i, j], [j, i]] -= weight
        matrix[[i, j], [i, j]] += weight
    return _rank(matrix) == agents - axes - 1


# ---- how it lies ---------------------------------------------------------------------------------


def _turned(places: Array, near: Array | None) -> Array:
    """Return places turned about agent 0, of the two mirror images the closer one."""
    if near is None:
        # Agent by agent a new axis: Q R of the differences, with a positive diagonal.
        _, R = np.linalg.qr(places[1:].T)
        order = list[int]()
        for k in range(len(R)):
            found = np.flatnonzero(np.abs(R[k]) > _FLAT * np.abs(R).max(initial=1e-300))
            order += found[:1].tolist()
        signs = np.ones(len(R))
        signs[: len(order)] = np.sign([R[k, c] for k, c in enumerate(order)])
        turned = np.zeros_like(places)
        turned[1:, : len(R)] = (signs[:, None] * R).T
        return turned
    goals, ends = near - near.mean(axis=0), []
    for mirror in (1.0, -1.0):
        image = places * np.append(np.ones(places.shape[1] - 1), mirror)
        U, sizes, V = np.linalg.svd((image - image.mean(axis=0)).T @ goals)
        sign = np.append(np.ones(len(sizes) - 1), np.sign(np.linalg.det(U @ V)))
        turned = image @ (U * sign) @ V
        off = ((turned - turned.mean(axis=0) - goals) ** 2).sum()
        ends.append((off, len(ends), turned - turned[0]))
    return min(ends)[2]
