"""Where agents are drawn, and as what: in space, from above, in a phase plane, or over time."""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording

_FAR = 10.0
"""Times the reach of leaders and goals, beyond which places are drawn at its border."""
_MARGIN = 0.06
_ROLL, _PITCH, _TURN = ("roll", "phi"), ("pitch", "theta"), ("yaw", "psi", "heading", "theta")


class Space(NamedTuple):
    """What a picture's axes are.

    Attributes:
        kind: `space`, `plane`, `phase` (two states that are no position) or `time`.
        axes: indices of the states that are drawn.
        names, units: of the axes as drawn, time before the state in `time`.
        stretch: what the two axes of a picture are multiplied by, so that it is no sliver.
        angles: indices of roll, pitch and yaw, or of the one angle of the plane; none of a point.
        sign: of that angle, against the turn from the first axis to the second.
        low, high: (3,) the box that holds all places and goals, stretched.
        clipped: whether some places lie beyond what is drawn.
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
    """Return where the agents of a run are drawn."""
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
    """Return the angles that turn a body, by the names that the field gives them."""

    def found(*groups: tuple[str, ...]) -> tuple[int, ...]:
        known = run.state_names
        each = (next((known.index(n) for n in group if n in known), None) for group in groups)
        return tuple(k for k in each if k is not None)

    if kind == "space":
        three = found(_ROLL, _PITCH, _TURN[:2])
        return (three if len(three) == 3 else ()), 1.0
    if kind != "plane":
        return (), 1.0
    if names[1] != "z":
        return found(_TURN)[:1], 1.0
    # Seen along the axis that is not drawn: about x from y to z, but about y from z to x.
    return (found(_ROLL), 1.0) if names[0] == "y" else (found(_PITCH), -1.0)


def clipped_places(run: Recording, axes: tuple[int, ...]) -> tuple[Array, bool]:
    """Return the places (T, N, k), none farther off than ten times what leaders and goals reach."""
    places, columns = run.states[:, :, list(axes)], list(axes)
    goals = places - run.errors[:, :, columns]
    led = goals[:, list(run.leaders)].reshape(-1, len(axes))
    known = np.concatenate([led, goals[0], places[0]])
    low, high = known.min(axis=0), known.max(axis=0)
    reach = max(1.0, float((high - low).max()))
    held = np.clip(places, low - _FAR * reach, high + _FAR * reach)
    return held, bool((held != places).any())


def _box(run: Recording, kind: str, axes: tuple[int, ...], places: Array) -> tuple[Array, Array]:
    """Return the box of goals and starts as drawn, with what lies a little farther off."""
    low, high = np.zeros(3), np.zeros(3)
    shown = slice(1, 2) if kind == "time" else slice(0, len(axes))
    low[shown], high[shown] = _reached(run, axes, places)
    if kind == "time":
        low[0], high[0] = 0.0, max(run.times[-1], 1e-9)
    reach = float((high - low)[: 3 if kind == "space" else 2].max()) or 1.0
    if kind in ("space", "plane"):
        low[shown], high[shown] = low[shown] - _MARGIN * reach, high[shown] + _MARGIN * reach
    if kind == "space" and low[2] > 0.0 and low[2] < reach:
        # What flies above the ground is shown above it.
        low[2] = 0.0
    # A line or a plane still needs a box that can be looked at.
    thin = (high - low) < 0.1 * reach
    thin[2] &= kind == "space"
    middle = 0.5 * (low + high)
    return np.where(thin, middle - 0.05 * reach, low), np.where(thin, middle + 0.05 * reach, high)


def _reached(run: Recording, axes: tuple[int, ...], places: Array) -> tuple[Array, Array]:
    """Return the ends of all places, but of a formation that flies apart those of goals."""
    goals = places[0] - run.errors[0][:, list(axes)]
    led = places[:, list(run.leaders)]
    known = np.concatenate([led.reshape(-1, len(axes)), goals, places[0]])
    # Where the leaders carry the goals in the end.
    moved = led[:, 0] - led[0, 0]
    known = np.concatenate([known, goals + moved.min(axis=0), goals + moved.max(axis=0)])
    low, high = known.min(axis=0), known.max(axis=0)
    room = 0.15 * float((high - low).max()) or 1.0
    every = places.reshape(-1, len(axes))
    return (
        np.maximum(np.minimum(low, every.min(axis=0)), low - room),
        np.minimum(np.maximum(high, every.max(axis=0)), high + room),
    )


def body_width(run: Recording, space: Space) -> float:
    """Return how wide bodies are drawn: a part of how far apart goals are, so that all are seen."""
    from scipy.spatial import KDTree

    reach = float((space.high - space.low)[: 3 if space.kind == "space" else 2].max())
    goals = (run.states[0] - run.errors[0])[:, list(space.axes)]
    apart = KDTree(goals).query(goals, k=2)[0][:, 1] if run.agents > 1 else np.zeros(1)
    apart = apart[np.isfinite(apart) & (apart > 0.0)]
    if space.kind not in ("space", "plane") or not apart.size:
        return reach / 36.0
    return float(np.clip(0.45 * np.median(apart), reach / 60.0, reach / 12.0))
