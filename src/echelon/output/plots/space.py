"""The axes and bodies with which agents are drawn: space, plane, phase plane or time."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording

_FAR = 10.0
"""Places beyond this multiple of the extent of leaders and goals are drawn at its border."""
_MARGIN = 0.06
_ROLL, _PITCH, _TURN = ("roll", "phi"), ("pitch", "theta"), ("yaw", "psi", "heading", "theta")


class Space(NamedTuple):
    """The axes of a picture.

    Attributes:
        kind: `space`, `plane`, `phase` (two states that are no position) or `time`.
        axes: indices of the states on them.
        names, units: of the axes as drawn, time before the state in `time`.
        stretch: factors on the first two axes that give a picture of three to two.
        angles: indices of roll, pitch and yaw, or of the angle in the plane; empty of a point.
        sign: of that angle relative to the rotation from the first axis to the second.
        low, high: (3,) corners of the box around all places and goals, stretched.
        clipped: whether some places lie beyond the border.
    """

    kind: str
    axes: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    stretch: tuple[float, float]
    angles: tuple[int, ...]
    sign: float
    low: Array
    high: Array
    clipped: bool

    @property
    def shape(self) -> str:
        """The body of an agent: `quadrotor`, `birotor`, `car`, `ball` or `dot`."""
        if self.kind == "space":
            return "quadrotor" if len(self.angles) == 3 else "ball"
        if self.kind != "plane" or not self.angles:
            return "dot"
        return "birotor" if self.names[1] == "z" else "car"


def space_of(run: Recording) -> Space:
    """Return the space for the agents of a run."""
    axes, kind = _axes(run)
    names = tuple(run.state_names[k] for k in axes)
    units = tuple(run.state_units[k] for k in axes)
    if kind == "time":
        names, units = ("time", *names), ("s", *units)
    angles, sign = _angles(run, kind, names)
    places, clipped = clipped_places(run, axes)
    low, high = _box(run, kind, axes, places)
    stretch = (1.0, 1.0)
    if kind in ("phase", "time"):
        size = np.maximum(high - low, 1e-9)[:2]
        # A picture of three to two.
        stretch = (3.0 / float(size[0]), 2.0 / float(size[1]))
        low[:2], high[:2] = low[:2] * stretch, high[:2] * stretch
    return Space(kind, axes, names, units, stretch, angles, sign, low, high, clipped)


def _axes(run: Recording) -> tuple[tuple[int, ...], str]:
    if len(run.position) > 1:
        return run.position[:3], "space" if len(run.position) > 2 else "plane"
    if not run.position and len(run.state_names) == 2:
        return (0, 1), "phase"
    return (run.position or (0,))[:1], "time"


def _angles(run: Recording, kind: str, names: tuple[str, ...]) -> tuple[tuple[int, ...], float]:
    """Return the indices of the angles of a body, by their usual names, and their sign."""

    def indices(*groups: tuple[str, ...]) -> tuple[int, ...]:
        states = run.state_names
        first = (next((states.index(n) for n in group if n in states), None) for group in groups)
        return tuple(k for k in first if k is not None)

    if kind == "space":
        three = indices(_ROLL, _PITCH, _TURN[:2])
        return (three if len(three) == 3 else ()), 1.0
    if kind != "plane":
        return (), 1.0
    if names[1] != "z":
        return indices(_TURN)[:1], 1.0
    # A rotation about x goes from y to z, but one about y from z to x.
    return (indices(_ROLL), 1.0) if names[0] == "y" else (indices(_PITCH), -1.0)


def clipped_places(run: Recording, axes: tuple[int, ...]) -> tuple[Array, bool]:
    """Return places (T, N, k) within ten times the extent of leaders and goals.

    Places that are not finite, and those of absent agents, are NaN. The second value is
    whether others were farther away.
    """
    places, columns = run.states[:, :, list(axes)], list(axes)
    goals, leaders = run.goals([0])[0][:, columns], places[:, list(run.leaders)]
    points = np.concatenate([leaders.reshape(-1, len(axes)), goals, places[0]])
    low, high = _corners(points)
    reach, finite = max(1.0, float((high - low).max())), np.isfinite(places)
    if run.presence is not None:
        finite &= run.presence[:, :, None]
    clipped = np.clip(places, low - _FAR * reach, high + _FAR * reach)
    return np.where(finite, clipped, np.nan), bool(((clipped != places) & finite).any())


def _corners(points: Array) -> tuple[Array, Array]:
    """Return the corners of the box around points (K, k), without those that are not finite."""
    points = points[np.isfinite(points).all(axis=1)]
    return points.min(axis=0), points.max(axis=0)


def _box(run: Recording, kind: str, axes: tuple[int, ...], places: Array) -> tuple[Array, Array]:
    low, high = np.zeros(3), np.zeros(3)
    drawn = slice(1, 2) if kind == "time" else slice(0, len(axes))
    low[drawn], high[drawn] = _extent(run, axes, places)
    if kind == "time":
        low[0], high[0] = 0.0, max(run.times[-1], 1e-9)
    reach = float((high - low)[: 3 if kind == "space" else 2].max()) or 1.0
    if kind in ("space", "plane"):
        low[drawn], high[drawn] = low[drawn] - _MARGIN * reach, high[drawn] + _MARGIN * reach
    if kind == "space" and low[2] > 0.0 and low[2] < reach:
        # The box of vehicles above the ground begins at the ground.
        low[2] = 0.0
    # A line or a plane needs a box of some thickness too.
    thin = (high - low) < 0.1 * reach
    thin[2] &= kind == "space"
    middle = 0.5 * (low + high)
    return np.where(thin, middle - 0.05 * reach, low), np.where(thin, middle + 0.05 * reach, high)


def _extent(run: Recording, axes: tuple[int, ...], places: Array) -> tuple[Array, Array]:
    """Return the corners of all places, limited to the goals of a formation that diverges."""
    goals = places[0] - run.deviations([0])[0][:, list(axes)]
    leaders = places[:, list(run.leaders)]
    # Goals move with the leaders.
    motion = leaders[:, 0] - leaders[0, 0]
    points = np.concatenate(
        [leaders.reshape(-1, len(axes)), goals, places[0]]
        + [goals + shift for shift in _corners(motion)]
    )
    low, high = _corners(points)
    # Agents that keep apart go around each other.
    away = 0.15 if run.avoidance is None else 1.0
    margin = away * float((high - low).max()) or 1.0
    least, most = _corners(places.reshape(-1, len(axes)))
    return (
        np.maximum(np.minimum(low, least), low - margin),
        np.minimum(np.maximum(high, most), high + margin),
    )


def body_width(run: Recording, space: Space) -> float:
    """Return the width of drawn bodies, a fraction of the distance between goals."""
    from scipy.spatial import KDTree

    reach = float((space.high - space.low)[: 3 if space.kind == "space" else 2].max())
    goals = run.goals([0])[0][:, list(space.axes)]
    apart = KDTree(goals).query(goals, k=2)[0][:, 1] if run.agents > 1 else np.zeros(1)
    apart = apart[np.isfinite(apart) & (apart > 0.0)]
    if space.kind not in ("space", "plane") or not apart.size:
        return reach / 36.0
    return float(np.clip(0.45 * np.median(apart), reach / 60.0, reach / 12.0))
