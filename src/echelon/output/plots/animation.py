"""The moving parts of a video: links, goals, trails and bodies."""

import abc
from typing import TYPE_CHECKING, Any, ClassVar, final

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw
from echelon.output.plots.agent_style import pen_of
from echelon.output.plots.camera import Camera
from echelon.output.plots.space import Space, body_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FEW = 60
"""Agents that are drawn as vehicles; more are drawn as dots, all of a kind by one artist."""
_SOLID = ("space", "plane")
"""Kinds of pictures in which agents have a size."""
_NEAR: Any = np.array([[0.0, 0.0, 0.0, 1.0], [0.85, 0.56, 0.0, 1.0], [0.78, 0.2, 0.17, 1.0]])
"""Colours of ellipsoids: none of their own, below the limit, overlapping."""
_LINK, _GOAL, _SHADOW = "#4f5b68", "#d99000", "#d3d9e0"


def moving_of(ax: "Axes", run: Recording, space: Space, camera: Camera) -> "MovingScene":
    """Return the moving scene of a run, on axes of pixels."""
    return (_Vehicles if run.agents <= _FEW else _Dots)(ax, run, space, camera)


class MovingScene(abc.ABC):
    """Draws the agents at a time.

    Attributes:
        trail: duration of a trail, s.
        points: maximum number of points of a trail.
        artists: of matplotlib, from back to front.
    """

    trail: ClassVar[float]
    points: ClassVar[int]

    def __init__(self, ax: "Axes", run: Recording, space: Space, camera: Camera) -> None:
        """Create the artists."""
        from matplotlib.colors import to_rgba_array

        self.run, self.space, self.camera, self.ax = run, space, camera, ax
        # As an array, which matplotlib need not parse for each picture.
        self.colours: Any = to_rgba_array(
            [pen_of(run, agent)["color"] for agent in range(run.agents)]
        )
        self.black: Any = to_rgba_array(draw.LEADER)
        self.bodies: Any = self.colours
        self.size = body_width(run, space)
        every = [run.offsets] if run.moving is None else run.moving
        self.offsets = np.stack([scene_offsets(rows, space) for rows in every])
        thick = 1.1 if run.agents <= _FEW else 0.4
        self.links = _stroke(ax, color=_LINK, linewidth=thick, alpha=0.8)
        self.heads = _heads_on(ax) if run.agents <= _FEW and len(run.arrows) else None
        self.clock = ax.text(14, ax.get_ylim()[1] - 12, "", size=13, va="top")
        self.artists: list[Any] = []
        self.prepare()
        self.artists += [self.clock] if self.heads is None else [self.heads, self.clock]

    @abc.abstractmethod
    def prepare(self) -> None:
        """Create the artists of this kind of scene, with the links among them."""

    @abc.abstractmethod
    def draw(self, now: Array, trail: Array, goals: Array, angles: Array | None) -> None:
        """Move agents (N, 3), their trails (K, N, 3) and goals (N, 3)."""

    def show(self, time: float, now: Array, trail: Array, angles: Array | None) -> None:
        """Move all artists to a time."""
        past = [event for event in self.run.events if event["at"] <= time]
        last = "\n{at:.4g} s: {text}".format(**past[-1]) if past else ""
        self.clock.set_text(f"{time:.2f} s{last}")
        links = self.run.linked(time)
        _set_lines(self.links, self.camera.project(now[self.run.edges[links]])[0])
        if self.heads is not None:
            self.heads.set_verts(self._heads(now, links))
        offsets, schedule = self._offsets(time), self.run.schedule
        nearest = self.run.nearest
        if schedule is not None and schedule.nearest is not None:
            nearest = schedule.nearest[schedule.row(time)]
        # An heir is drawn as the leader that it is.
        leads = nearest == np.arange(len(nearest))
        self.bodies = np.where(leads[:, None], self.black, self.colours)
        goals = np.where(np.isfinite(now), now[nearest] + offsets - offsets[nearest], np.nan)
        if self.space.kind == "time":
            goals[:, 0] = now[:, 0]
        self.draw(now, trail, goals, angles)

    def _offsets(self, time: float) -> Array:
        """Return the offsets (N, 3) at a time."""
        if len(self.offsets) < 2:
            return self.offsets[0]
        after, share = frame_after(self.run.times, time)
        return (1.0 - share) * self.offsets[after - 1] + share * self.offsets[after]

    def _heads(self, now: Array, links: Array) -> list[Array]:
        """Return the arrow heads of one-way links, at the edge of the receivers' bodies."""
        arrows = self.run.arrows[links[self.run.heard.sum(axis=1) == 1]]
        first, second = (self.camera.project(now[ends])[0] for ends in arrows.T)
        beside = now[arrows[:, 1]] + 0.6 * self.size * self.camera.axes[0]
        body = np.linalg.norm(self.camera.project(beside)[0] - second, axis=1)
        whole = np.maximum(np.linalg.norm(second - first, axis=1), 1e-9)
        way = ((second - first) / whole[:, None])[:, None]
        gap, tall = np.minimum(body, 0.5 * whole), np.minimum(11.0, 0.4 * whole)
        aside = np.stack([-way[..., 1], way[..., 0]], axis=-1)
        back, out = np.array([[0.0], [1.0], [1.0]]), np.array([[0.0], [0.4], [-0.4]])
        tip = (second - gap[:, None] * way[:, 0])[:, None]
        return list(tip + tall[:, None, None] * (out * aside - back * way))


@final
class _Vehicles(MovingScene):
    """Few agents, drawn as vehicles."""

    trail, points = 4.0, 60

    def prepare(self) -> None:
        from matplotlib.collections import LineCollection, PolyCollection

        ring = np.linspace(0.0, 2.0 * np.pi, 33)
        self.ring = np.column_stack([np.cos(ring), np.sin(ring), 0.0 * ring])
        self.trails = LineCollection([], linewidths=1.3, alpha=0.75, colors=self.colours)
        self.goals = PolyCollection([], facecolors="none", edgecolors=_GOAL, linewidths=1.2)
        self.arms = LineCollection([], linewidths=2.2)
        self.rotors = PolyCollection([], linewidths=0.4, edgecolors="white")
        self.shadows = PolyCollection([], facecolors=_SHADOW, edgecolors="none")
        self.falls = LineCollection([], colors=_SHADOW, linewidths=0.8)
        self.shells = PolyCollection([], linewidths=0.8)
        parts = self.shadows, self.falls, self.trails, self.goals, self.arms, self.rotors
        for part in (*parts, self.shells):
            self.ax.add_collection(part)
        ground = [self.shadows, self.falls] if self.space.kind == "space" else []
        self.artists = [*ground, self.trails, self.links, self.goals, self.arms, self.rotors]
        self.artists += [self.shells] if self.run.avoidance is not None else []

    def draw(self, now: Array, trail: Array, goals: Array, angles: Array | None) -> None:
        project = self.camera.project
        self.trails.set_segments(list(project(trail.swapaxes(0, 1))[0]))
        rings = goals[list(self.run.followers)][:, None] + 0.55 * self.size * self.ring
        self.goals.set_verts(list(project(rings)[0]))
        self._shade(now)
        self._surround(now)
        # Far vehicles first, so that near ones cover them.
        order = np.argsort(-project(now)[1], kind="stable")
        if self.space.shape != "quadrotor" or angles is None:
            discs = project(now[:, None] + 0.3 * self.size * self._facing())[0]
            self.rotors.set_verts(list(discs[order]))
            self.rotors.set_facecolor(self.bodies[order])
            return
        self._quadrotors(now, angles, order)

    def _shade(self, now: Array) -> None:
        """Draw shadows under the agents, which make heights visible."""
        project = self.camera.project
        below = now * (1.0, 1.0, 0.0) + (0.0, 0.0, self.space.low[2])
        self.shadows.set_verts(list(project(below[:, None] + 0.35 * self.size * self.ring)[0]))
        self.falls.set_segments(list(project(np.stack([now, below], axis=1))[0]))

    def _surround(self, now: Array) -> None:
        """Draw the outlines of ellipsoids, coloured where another is too near."""
        sizes, names = self.run.ellipsoid, self.space.names
        if self.run.avoidance is None or sizes is None or self.space.kind not in _SOLID:
            return
        near: Any = sizes.too_near(now[:, : len(names)], names)
        squares = np.resize(sizes.radii(names), 3) ** 2
        # Where an ellipsoid with these semi-axes is touched by planes through a direction w.
        w = self.ring[:, :1] * self.camera.axes[0] + self.ring[:, 1:2] * self.camera.axes[1]
        outline = squares * w / np.sqrt((squares * w * w).sum(axis=1, keepdims=True))
        self.shells.set_verts(list(self.camera.project(now[:, None] + outline)[0]))
        edges: Any = np.where(near[:, None] > 0.0, _NEAR[near.astype(int)], self.bodies)
        faces: Any = edges.copy()
        faces[:, 3] = np.where(near > 0.0, 0.35, 0.1)
        self.shells.set_edgecolor(edges)
        self.shells.set_facecolor(faces)

    def _quadrotors(self, now: Array, angles: Array, order: Array) -> None:
        project, size, turns = self.camera.project, self.size, rotations(angles)
        hubs = size * 0.34 * np.array([[1, 1, 0], [-1, -1, 0], [1, -1, 0], [-1, 1, 0]], float)
        placed = now[:, None] + hubs @ turns.swapaxes(1, 2)
        arms = project(placed.reshape(-1, 2, 2, 3))[0]
        self.arms.set_segments(list(arms[order].reshape(-1, 2, 2)))
        pens: Any = np.repeat(self.bodies[order], 4, axis=0)
        self.arms.set_color(pens[::2])
        discs = (hubs[:, None] + 0.23 * size * self.ring) @ turns[:, None].swapaxes(2, 3)
        discs = project(now[:, None, None] + discs)[0]
        self.rotors.set_verts(list(discs[order].reshape(-1, *self.ring.shape[:1], 2)))
        self.rotors.set_facecolor(pens)
        self.rotors.set_alpha(0.8)

    def _facing(self) -> Array:
        """Return a disc that faces the camera."""
        return self.ring[:, :1] * self.camera.axes[0] + self.ring[:, 1:2] * self.camera.axes[1]


@final
class _Dots(MovingScene):
    """Many agents, drawn as dots whose size depends on the distance; leaders are on top."""

    trail, points = 1.0, 8

    def prepare(self) -> None:
        self.followers, self.leaders = list(self.run.followers), list(self.run.leaders)
        groups = (self.followers, self.leaders)
        self.groups = [(agents, self.colours[agents[0]]) for agents in groups if agents]
        pens = [{"color": colour, "linewidth": 0.6, "alpha": 0.6} for _, colour in self.groups]
        self.trails = [_stroke(self.ax, **pen) for pen in pens]
        none: dict[str, Any] = {"s": 1.0, "linewidths": 0.5}
        self.goals = self.ax.scatter([], [], facecolors="none", edgecolors=_GOAL, **none)
        self.dots = [self.ax.scatter([], [], color=colour, **none) for _, colour in self.groups]
        self.artists = [*self.trails, self.links, self.goals, *self.dots]

    def draw(self, now: Array, trail: Array, goals: Array, angles: Array | None) -> None:
        project = self.camera.project
        self._move_dots(self.goals, goals[self.followers], 0.45)
        for (agents, _), lines, dots in zip(self.groups, self.trails, self.dots, strict=True):
            _set_lines(lines, project(trail[:, agents].swapaxes(0, 1))[0])
            self._move_dots(dots, now[agents], 0.25)

    def _move_dots(self, dots: Any, places: Array, part: float) -> None:
        """Move dots to places (K, 3), with a radius that is a part of a body's width."""
        middle = self.camera.project(places)[0]
        beside = self.camera.project(places + part * self.size * self.camera.axes[0])[0]
        points = 0.72  # of a hundredth of an inch
        dots.set_offsets(middle)
        # The size of a marker is the area of the square around it, in points.
        dots.set_sizes((2.0 * points * (beside - middle)[:, 0]) ** 2)


def _heads_on(ax: "Axes") -> Any:
    """Return the artist of arrow heads."""
    from matplotlib.collections import PolyCollection

    return ax.add_collection(PolyCollection([], facecolors=_LINK, edgecolors="none", zorder=1.1))


def _stroke(ax: "Axes", **pen: Any) -> Any:
    """Return the artist of many lines, drawn as one with gaps."""
    return ax.plot([], [], **{"zorder": 1, **pen})[0]


def _set_lines(stroke: Any, lines: Array) -> None:
    """Set the points of lines (K, P, 2)."""
    gaps = np.full((len(lines), 1, 2), np.nan)
    stroke.set_data(*np.concatenate([lines, gaps], axis=1).reshape(-1, 2).T)


def frame_after(times: Array, time: float) -> tuple[int, float]:
    """Return the frame after a time (s), and the share of the way to it from the one before."""
    after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
    first, last = times[after - 1 : after + 1]
    return after, float(np.clip((time - first) / (last - first), 0.0, 1.0))


def scene_offsets(rows: Array, space: Space) -> Array:
    """Return offsets (N, n) as they are in the scene, (N, 3)."""
    offsets = np.zeros((len(rows), 3))
    columns = rows[:, list(space.axes)]
    first = 1 if space.kind == "time" else 0
    offsets[:, first : first + columns.shape[1]] = columns
    offsets[:, :2] *= space.stretch
    return offsets


def rotations(angles: Array) -> Array:
    """Return the matrices (N, 3, 3) of ZYX angles (N, 3)."""
    (a, b, c), (d, e, f) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [b * c, d * e * c - a * f, a * e * c + d * f],
        [b * f, d * e * f + a * c, a * e * f - d * c],
        [-e, d * b, a * b],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
