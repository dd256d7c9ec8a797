"""A run as a video by matplotlib: the agents in space, and curves with cursors beside them."""

import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import numpy as np

from echelon.core.errors import MissingExtraError, OutputError
from echelon.core.files import make_atomic
from echelon.core.types import Array
from echelon.experiments.results.recording import Recording, recording_of
from echelon.output.plots import style as draw
from echelon.output.plots.over_time import above, error_rounding, mark_events, shade_rounding
from echelon.output.plots.space import Space, body_width, clipped_places, space_of
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH: Final = 9.6
"""Inches of the picture, whatever its pixels: letters and lines are sized in them."""
_SCENE: Final = 6.1
"""Inches of the scene; the rest is for curves."""
_SIZES: Final = {".mp4": (960, 540), ".gif": (640, 360)}
_RATES: Final = {".mp4": 25.0, ".gif": 12.5}
"""Pixels, and pictures a second; fewer of a GIF, whose pictures are stored nearly one by one."""
_COLOURS: Final = 96
_FEW = 60
"""Agents that are drawn as vehicles; more are drawn as dots."""
_TRAILS: Final = {True: (4.0, 60), False: (1.0, 8)}
"""Seconds and points of a trail, of few agents and of many."""
_LINK, _SHADOW, _TOUCHING = "#4f5b68", "#c4cad1", "#c73329"
_TURNS = np.linspace(0.0, 2.0 * np.pi, 25)
_RING = np.column_stack([np.cos(_TURNS), np.sin(_TURNS), 0.0 * _TURNS])
_HUBS = 0.34 * np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, -1.0, 0.0]])
_QUADROTOR = np.concatenate(
    [part for hub in _HUBS for part in ([0.0 * hub], hub + 0.23 * _RING, [hub + np.nan])]
)
"""Arms and rotors of a quadrotor of width 1, as lines with gaps."""
_ACROSS = np.array([[3**0.5 / 2, 0.5, 0.0], [-0.25, 3**0.5 / 4, 3**0.5 / 2]])
"""To the right and up in a picture in space: it is seen from 30 degrees above, at -60 degrees."""
_VIEW = np.cross(*_ACROSS)


def save_video(
    run: Result | Recording,
    file: Path,
    speed: float = 1.0,
    *,
    size: tuple[int, int] | None = None,
    rate: float | None = None,
    begin: float | None = None,
    end: float | None = None,
    progress: Callable[[int, int], None] = lambda done, pictures: None,
) -> int:
    """Write a run as MP4, by ffmpeg, or as GIF, and return the number of pictures.

    Args:
        run: a result, or a recording of one.
        file: that ends in `.mp4` or `.gif`.
        speed: of the playback; 2 plays twice as fast.
        size: width and height in pixels, even numbers; by default 960 x 540, of a GIF 640 x 360.
        rate: pictures a second; by default 25, of a GIF 12.5.
        begin: of the part that is shown, s; by default of the run.
        end: of that part, s; by default of the run.
        progress: called with how many pictures are drawn, and of how many.

    Raises:
        OutputError: the run has no frames between these times, or ffmpeg fails.
        MissingExtraError: an MP4 needs ffmpeg, and there is none.
    """
    run, kind = recording_of(run), file.suffix.lower()
    if len(run.times) < 2:
        raise OutputError("the run has fewer than two stored frames; a video needs at least two.")
    rate, (width, height) = rate or _RATES[kind], size or _SIZES[kind]
    times = times_of(run, speed, rate, begin, end)
    with draw.style(), tempfile.TemporaryDirectory() as folder:
        film, writer = Film(run, height / width, times[[0, -1]]), _writer(kind, rate)
        # Writers choose a format by the ending, which an unfinished file does not have.
        made = Path(folder) / f"video{kind}"
        try:
            with writer.saving(film.figure, str(made), width / _WIDTH):
                for done, time in enumerate(times, start=1):
                    film.show(time)
                    writer.grab_frame()
                    progress(done, len(times))
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines() or ["without a message"]
            raise OutputError(f"ffmpeg failed: {lines[-1]}.") from error
        make_atomic(file, lambda part: shutil.copyfile(made, part))
    return len(times)


def times_of(
    run: Recording, speed: float, rate: float, begin: float | None = None, end: float | None = None
) -> Array:
    """Return the times (s) of pictures, `rate` a second of the video.

    Raises:
        OutputError: the run has nothing between the times.
    """
    first, last = float(run.times[0]), float(run.times[-1])
    start, stop = max(first, begin or first), last if end is None else min(last, end)
    if not start < stop:
        raise OutputError(
            f"nothing lies between {start:g} and {stop:g} s; the run is stored from {first:g} to "
            f"{last:g} s."
        )
    count = max(2, round(rate * (stop - start) / speed) + 1)
    return start + np.linspace(0.0, stop - start, count)


def encoder() -> str:
    """Return the path of ffmpeg: on the PATH, or from the extra `video`.

    Raises:
        MissingExtraError: there is none.
    """
    program = shutil.which("ffmpeg")
    if program is not None:
        return program
    try:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise MissingExtraError(
            "an MP4 needs ffmpeg, and none is on the PATH; install it, or "
            "`pip install '.[video]'` in echelon's clone; a GIF needs none."
        ) from error


def _writer(kind: str, rate: Any) -> Any:
    """Return matplotlib's writer of a kind of file, within a context of its settings."""
    import matplotlib
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from PIL import Image

    class OnePalette(PillowWriter):
        """Writes a GIF with one palette for all pictures, a fifth of the size of one for each."""

        def finish(self) -> None:
            few = self._frames[:: len(self._frames) // 8 + 1]
            strip = Image.fromarray(np.concatenate([np.asarray(each) for each in few]))
            # Other methods give the few pixels of an agent the colour of another one.
            palette = strip.quantize(_COLOURS, Image.Quantize.FASTOCTREE)
            look = {"palette": palette, "dither": Image.Dither.NONE}
            self._frames = [each.quantize(**look) for each in self._frames]
            super().finish()

    if kind == ".gif":
        return OnePalette(rate)
    matplotlib.rcParams["animation.ffmpeg_path"] = encoder()
    # A third of the time of the default preset, and a tenth more bytes.
    options = ["-preset", "veryfast", "-pix_fmt", "yuv420p", "-crf", "20"]
    return FFMpegWriter(rate, "libx264", extra_args=[*options, "-movflags", "+faststart"])


@final
class Film:
    """The figure of a video, which shows a run at any time."""

    def __init__(self, run: Recording, tall: float, ends: Array) -> None:
        """Draw what does not move, in a picture of width 1, with curves between two times."""
        from matplotlib.figure import Figure

        self.run, self.space = run, space_of(run)
        self.figure = Figure((_WIDTH, _WIDTH * tall))
        self.places = _in_scene(self.space, clipped_places(run, self.space.axes)[0], run.times)
        self.ax, inches = _scene(self.figure, self.space, self.places)
        few = run.agents <= _FEW
        self.cursors = _curves(self.figure, run, ends)
        self.clock = self.figure.text(0.012, 0.985, "", size=12, va="top")
        _name_closest(self.figure, run)
        self.colours = np.array([draw.pen_of(run, agent)["color"] for agent in range(run.agents)])
        self.size, self.trail, self.count = body_width(run, self.space), *_TRAILS[few]
        wide, names = 1.2 if few else 0.5, sorted({*self.colours, draw.LEADER})
        rotors = few and self.space.shape == "quadrotor"
        self.shape = _QUADROTOR if rotors else np.zeros((1, 3))
        dot = max(3.0, 0.6 * 72.0 * inches * self.size)
        body = {"linewidth": 1.8} if rotors else {"marker": "o", "markersize": dot}
        self.shadows = self._line(_SHADOW, linewidth=0.8)
        self.trails = {name: self._line(name, linewidth=wide, alpha=0.7) for name in names}
        self.links = self._line(_LINK, linewidth=wide, alpha=0.8)
        self.heads = self._line(_LINK, linewidth=wide)
        self.goals = self._line(draw.COLOURS[4], linewidth=wide)
        self.shells = [self._line(c, linewidth=1.0) for c in ("0.5", draw.COLOURS[4], _TOUCHING)]
        self.bodies = {name: self._line(name, **body) for name in names}

    def show(self, time: float) -> None:
        """Move everything to a time, s."""
        from scipy.spatial.transform import Rotation

        run, space, times = self.run, self.space, self.run.times
        after = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1))
        first, last = times[after - 1 : after + 1]
        share = float(np.clip((time - first) / (last - first), 0.0, 1.0))

        def between(two: Array) -> Array:
            return (1.0 - share) * two[0] + share * two[1]

        now, links = between(self.places[after - 1 : after + 1]), run.linked(time)
        begin = 0 if space.kind == "time" else np.searchsorted(times, time - self.trail)
        stride = max(1, (after - begin) // self.count)
        passed = np.concatenate([self.places[begin:after:stride], now[None]]).swapaxes(0, 1)
        shape = np.broadcast_to(self.shape, (run.agents, *self.shape.shape))
        if self.space.shape == "quadrotor":
            angles = run.states[after - 1 : after + 1][:, :, list(space.angles)]
            angles = np.nan_to_num(between(np.unwrap(angles, axis=0)))
            shape = shape @ Rotation.from_euler("xyz", angles).as_matrix().swapaxes(1, 2)
        bodies = now[:, None] + self.size * shape
        leads = self.leaders(time)
        colours = np.where(leads, draw.LEADER, self.colours)
        for name, line in self.bodies.items():
            self._move(line, bodies[colours == name])
            self._move(self.trails[name], passed[colours == name])
        goals = between(run.goals([after - 1, after]))[None, :, list(space.axes)]
        goals = np.where(np.isfinite(now), _in_scene(space, goals, np.array([time]))[0], np.nan)
        self._move(self.goals, goals[~leads, None] + 0.5 * self.size * _RING)
        self._move(self.links, now[run.edges[links]])
        if space.kind == "space":
            below = now[:, None] * (1.0, 1.0, 0.0) + (0.0, 0.0, space.low[2])
            ring = below + 0.35 * self.size * _RING
            self._move(self.shadows, np.concatenate([now[:, None], below, ring], axis=1))
        if run.agents <= _FEW:
            self._move(self.heads, self._heads(now, links))
            self._surround(now)
        for cursor in self.cursors:
            cursor.set_xdata([time, time])
        past = [event for event in run.events if event["at"] <= time]
        words = "\n{at:.4g} s: {text}".format(**past[-1]) if past else ""
        self.clock.set_text(f"{time:.2f} s{words}")

    def leaders(self, time: float) -> Array:
        """Return which agents lead at a time, backup leaders among them."""
        nearest, schedule = self.run.nearest, self.run.schedule
        if schedule is not None and schedule.nearest is not None:
            nearest = schedule.nearest[schedule.row(time)]
        return nearest == np.arange(len(nearest))

    def _line(self, colour: str, **look: Any) -> Any:
        return self.ax.plot(*[[]] * (3 if self.ax.name == "3d" else 2), color=colour, **look)[0]

    def _move(self, line: Any, lines: Array) -> None:
        """Set the points of lines (K, P, 3) in the scene, drawn as one with gaps."""
        gaps = np.full((len(lines), 1, 3), np.nan)
        points = np.concatenate([lines, gaps], axis=1).reshape(-1, 3) / (*self.space.stretch, 1.0)
        if self.ax.name == "3d":
            line.set_data_3d(*points.T)
        else:
            line.set_data(*points.T[:2])

    def _heads(self, now: Array, links: Array) -> Array:
        """Return the arrow heads (K, 3, 3) of one-way links, beside the receivers' bodies."""
        ends = now[self.run.arrows[links[self.run.heard.sum(axis=1) == 1]]]
        way = ends[:, 1] - ends[:, 0]
        whole = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        way /= whole
        aside = 0.4 * np.cross(way, _VIEW if self.space.kind == "space" else (0.0, 0.0, 1.0))
        tall = np.minimum(0.5 * self.size, 0.3 * whole)
        tip = ends[:, 1] - np.minimum(0.6 * self.size, 0.5 * whole) * way
        return np.stack([tip - tall * (way + aside), tip, tip - tall * (way - aside)], axis=1)

    def _surround(self, now: Array) -> None:
        """Draw the outlines of ellipsoids, coloured where another is too near."""
        sizes, names = self.run.ellipsoid, self.space.names
        if self.run.avoidance is None or sizes is None or self.space.kind not in ("space", "plane"):
            return
        # Where an ellipsoid with these semi-axes is touched by planes through a direction w.
        squares = np.resize(sizes.radii(names), 3) ** 2
        w = _RING[:, :2] @ (_ACROSS if self.space.kind == "space" else np.eye(3)[:2])
        outline = squares * w / np.sqrt((squares * w * w).sum(axis=1, keepdims=True))
        near = sizes.too_near(now[:, : len(names)], names)
        for level, line in enumerate(self.shells):
            self._move(line, now[near == level, None] + outline)


def _in_scene(space: Space, columns: Array, times: Array) -> Array:
    """Return values (T, N, k) of the states on the axes as places (T, N, 3) in the scene."""
    if space.kind == "time":
        columns = np.stack([np.broadcast_to(times[:, None], columns.shape[:2]), columns[..., 0]], 2)
    places = np.zeros((*columns.shape[:2], 3))
    places[..., : columns.shape[2]] = columns
    return places * (*space.stretch, 1.0)


def _scene(figure: Any, space: Space, places: Array) -> tuple[Any, float]:
    """Return the axes in which the agents move, and the inches of a unit in them."""
    low, high, tall = space.low, space.high, figure.get_figheight()
    if space.kind == "space":
        ax = draw.space_axes(figure)
        room = 0.06 * float((high - low).max())
        # Down to the ground, on which the shadows are.
        low = np.maximum(low, np.nanmin(places, axis=(0, 1)) - room) * (1, 1, 0) + low * (0, 0, 1)
        high = np.minimum(high, np.nanmax(places, axis=(0, 1)) + room)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        left, right = draw.fit_box(ax, (0.4, 0.6, _SCENE - 1.0, tall - 1.1))
        inches = float((right - left)[0] / np.hypot(*(high - low)[:2]))
    else:
        ax = figure.add_axes((0.065, 0.12, _SCENE / _WIDTH - 0.075, 0.76))
        (left, right), (bottom, top) = np.array([low, high])[:, :2].T / np.array([space.stretch]).T
        ax.set(xlim=(left, right), ylim=(bottom, top))
        ax.set_aspect(space.stretch[1] / space.stretch[0])
        inches = float((0.8 * np.array([_SCENE, tall]) / (high - low)[:2]).min())
    for name, text, unit in zip("xyz", space.names, space.units, strict=False):
        getattr(ax, f"set_{name}label")(draw.label(text, unit))
    return ax, inches


def _name_closest(figure: Any, run: Recording) -> None:
    """Write which agents came closest to each other, in a warning colour if they touched."""
    closest, sizes = run.closest_pair(run.scales), run.ellipsoid
    if closest is not None:
        text = "smallest {}distance in the frames {:.3g} m: {} and {} at {:.4g} s".format(
            "scaled " * (run.avoidance is not None), closest.distance, *closest.agents, closest.time
        )
        touch = closest.touch(None if sizes is None else sizes.radius)
        figure.text(0.012, 0.02, text, color=draw.COLOURS[1] if touch else "0.45", size=9)


def _curves(figure: Any, run: Recording, ends: Array) -> list[Any]:
    """Draw numbers of a run between two times, and return their cursors."""
    within = np.flatnonzero((run.times >= ends[0]) & (run.times <= ends[1]))
    keep = within[draw.thin(len(within))]
    shows = [_draw_errors, *[_draw_near] * (run.avoidance is not None), _draw_inputs]
    left, tall, axes = (_SCENE + 0.62) / _WIDTH, 0.96 / len(shows), list["Axes"]()
    for place, show in enumerate(shows):
        box = (left, 0.95 - tall * (place + 1) + 0.11, 0.985 - left, tall - 0.13)
        axes.append(figure.add_axes(box, facecolor="none"))
        show(axes[-1], run, keep)
        axes[-1].tick_params(labelsize=8)
        axes[-1].set_xlim(*ends)
        mark_events(axes[-1], run, False)
    axes[-1].set_xlabel("time (s)", size=9)
    return [ax.axvline(ends[0], color=draw.COLOURS[0], linewidth=1.4) for ax in axes]


def _draw_errors(ax: "Axes", run: Recording, keep: Array) -> None:
    followers, floor = list(run.followers), error_rounding(run)
    errors = run.goal_distances(keep)[:, followers]
    if run.agents > draw.NAMED:
        lines = {"worst": errors.max(axis=1), "median": np.median(errors, axis=1)}
        for name, colour in (("worst", 1), ("median", 0)):
            line = above(lines[name], floor)
            ax.plot(run.times[keep], line, color=draw.COLOURS[colour], label=name)
        ax.legend(loc="upper right", fontsize=8)
    else:
        for agent, line in zip(followers, above(errors, floor).T, strict=True):
            ax.plot(run.times[keep], line, **draw.pen_of(run, agent))
    draw.logarithmic(ax, errors)
    # Powers as mathematics would take half of the time of a picture.
    ax.yaxis.set_major_formatter("{x:.0e}")
    shade_rounding(ax, floor, errors)
    ax.set_title(draw.label("formation error", run.length_unit), size=9, loc="left")


def _draw_inputs(ax: "Axes", run: Recording, keep: Array) -> None:
    """Draw the largest load, or each input's largest value without limits."""
    loads, title = run.loads, "largest input"
    sizes = np.abs(run.inputs).max(axis=1)[keep]
    if loads is not None:
        sizes, title = 100.0 * np.nanmax(loads, axis=(1, 2))[keep], "largest input, % of limit"
    ax.plot(run.times[keep], sizes, color=draw.LEADER)
    ax.set_title(title, size=9, loc="left")


def _draw_near(ax: "Axes", run: Recording, keep: Array) -> None:
    """Draw the smallest distance and its limits, and how many rows act, along the bottom."""
    near = run.near(keep)
    if near is None:
        return
    distance, active = (near.over(run.times[keep], each) for each in (near.distance, near.active))
    ax.plot(run.times[keep], distance, color=draw.LEADER)
    for value, name, side in (
        (near.ellipsoid.limit, "kept", "bottom"),
        (near.ellipsoid.touching, "touching", "top"),
    ):
        ax.axhline(value, color=draw.COLOURS[1], linewidth=1.0)
        where = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": side, "size": 7}
        ax.text(1.0, value, name, color=draw.COLOURS[1], **where)
    ax.set_ylim(0.0, 1.05 * max(np.nanmax(distance), near.ellipsoid.limit))
    rows = active * 0.25 * ax.get_ylim()[1] / max(1.0, active.max())
    ax.fill_between(run.times[keep], rows, step="post", color=draw.COLOURS[1], alpha=0.3)
    ax.set_title("smallest scaled distance (m), active rows", size=9, loc="left")
