"""A run as a video: moving parts drawn by matplotlib on a fixed background, encoded by ffmpeg."""

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, final

import numpy as np

from echelon.core.errors import MissingExtraError, OutputError
from echelon.core.files import make_atomic
from echelon.core.types import Array
from echelon.experiments.results.recording import Recording, recording_of
from echelon.output.plots import style as draw
from echelon.output.plots.agent_style import pen_of
from echelon.output.plots.animation import MovingScene, frame_after, moving_of
from echelon.output.plots.camera import Camera, camera_for
from echelon.output.plots.over_time import above, error_rounding, mark_events, shade_rounding
from echelon.output.plots.space import Space, clipped_places, space_of
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH: Final = 960.0
"""Units of the picture across, whatever its pixels: letters and lines are sized in them."""
_SCENE: Final = 620
"""Width of the scene in these units; the rest is for curves."""
_PAPER, _GRID = "#f7f8fa", "#dde2e8"
_SIZES: Final = {".mp4": (960, 540), ".gif": (640, 360)}
_UNITS: Final = 100.0
"""Units per inch."""
_RATES: Final = {".mp4": 25.0, ".gif": 12.5}
"""Pixels, and pictures a second; fewer of a GIF, whose pictures are stored nearly one by one."""
_COLOURS: Final = 96


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
    """Write a run as MP4 or GIF, by ffmpeg, and return the number of pictures.

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
        MissingExtraError: there is no ffmpeg.
    """
    run, kind = recording_of(run), file.suffix.lower()
    rate = _RATES[kind] if rate is None else rate
    if len(run.times) < 2:
        raise OutputError("the run has fewer than two stored frames; a video needs at least two.")
    program, pictures = encoder(), times_of(run, speed, rate, begin, end)
    with draw.style():
        film = _Film(run, _SIZES[kind] if size is None else size, pictures[[0, -1]])
        film.progress = progress
        make_atomic(file, lambda part: _encode(program, film, pictures, part, kind, rate))
    return len(pictures)


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
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise MissingExtraError(
            "a video needs ffmpeg, and none is on the PATH; install it, or "
            "`pip install '.[video]'` in echelon's clone."
        ) from error


def _encode(program: str, film: "_Film", times: Array, part: Path, kind: str, rate: float) -> None:
    raw = ["-f", "rawvideo", "-pix_fmt", "rgba", "-s", "{}x{}".format(*film.size)]
    # One palette for all pictures, and of each picture the rectangle that changed.
    palette = f"split[a][b];[a]palettegen=max_colors={_COLOURS}:stats_mode=full[p];"
    options = {
        # A third of the time of the default preset, and a tenth more bytes.
        ".mp4": ["-c:v", "libx264", "-preset", "veryfast", "-pix_fmt", "yuv420p", "-crf", "20"]
        + ["-f", "mp4", "-movflags", "+faststart"],
        ".gif": ["-filter_complex", f"{palette}[b][p]paletteuse=dither=none:diff_mode=rectangle"]
        + ["-f", "gif"],
    }[kind]
    command = [program, "-loglevel", "error", "-y", *raw, "-r", f"{rate:g}", "-i", "-"]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([*command, *options, str(part)], **pipes) as process:
        assert process.stdin is not None and process.stderr is not None
        _feed(process.stdin, film, times)
        message = process.stderr.read().decode(errors="replace").strip()
    if process.returncode:
        reason = message.splitlines()[-1] if message else "without a message"
        raise OutputError(f"ffmpeg failed: {reason}.")


def _feed(pipe: IO[bytes], film: "_Film", times: Array) -> None:
    # If ffmpeg ends early, its message says why.
    with contextlib.suppress(BrokenPipeError), pipe:
        for done, picture in enumerate(film.pictures(times), start=1):
            pipe.write(picture)
            film.progress(done, len(times))


@final
class _Film:
    """The figure of a video, its background and its moving parts."""

    progress: Callable[[int, int], None] = staticmethod(lambda done, pictures: None)

    def __init__(self, run: Recording, size: tuple[int, int], ends: Array) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self.run, self.space = run, space_of(run)
        self.places = scene_places(run, self.space)
        self.size, tall = size, _WIDTH * size[1] / size[0]
        self.camera = camera_for(self.space, _SCENE, round(tall), 0, self.places)
        inches = _WIDTH / _UNITS, tall / _UNITS
        self.figure = Figure(inches, dpi=size[0] / inches[0], facecolor=_PAPER)
        self.canvas: FigureCanvasAgg = FigureCanvasAgg(self.figure)
        self.ax = self.figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self.ax.set(xlim=(0, _WIDTH), ylim=(0, tall))
        self.ax.axis("off")
        draw_floor(self.ax, self.camera, self.space)
        _name_closest(self.ax, run)
        self.cursors = _curves(self.figure, run, ends)
        self.moving: MovingScene = moving_of(self.ax, run, self.space, self.camera)

    def pictures(self, times: Array) -> Iterator[bytes]:
        """Yield the pixels at each time."""
        for part in (*self.moving.artists, *self.cursors):
            part.set_animated(True)
        self.canvas.draw()
        background = self.canvas.copy_from_bbox(self.figure.bbox)
        for time in times:
            self.canvas.restore_region(background)
            self.moving.show(time, *self.between(time))
            for part in self.moving.artists:
                self.ax.draw_artist(part)
            for line in self.cursors:
                line.set_xdata([time, time])
                line.axes.draw_artist(line)
            yield bytes(self.canvas.buffer_rgba())

    def between(self, time: float) -> tuple[Array, Array, Array | None]:
        """Return places (N, 3), what trails have passed (K, N, 3), and angles at a time."""
        run = self.run
        after, share = frame_after(run.times, time)
        now = self.places[after - 1] + share * (self.places[after] - self.places[after - 1])
        begin = (
            0 if self.space.kind == "time" else np.searchsorted(run.times, time - self.moving.trail)
        )
        stride = max(1, (after - begin) // self.moving.points)
        passed = np.concatenate([self.places[begin:after:stride], now[None]])
        if not self.space.angles:
            return now, passed, None
        two = np.unwrap(run.states[after - 1 : after + 1][:, :, list(self.space.angles)], axis=0)
        return now, passed, self.space.sign * (two[0] + share * (two[1] - two[0]))


def scene_places(run: Recording, space: Space) -> Array:
    """Return the places of agents in the scene, (T, N, 3)."""
    clipped, places = clipped_places(run, space.axes)[0], np.zeros((len(run.times), run.agents, 3))
    if space.kind == "time":
        places[:, :, 0], places[:, :, 1] = run.times[:, None], clipped[:, :, 0]
    else:
        places[:, :, : clipped.shape[2]] = clipped
    places[:, :, :2] *= space.stretch
    return places


def draw_floor(ax: "Axes", camera: Camera, space: Space) -> None:
    """Draw a grid under the agents, with its step as a text."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    low, high, stretch = space.low, space.high, (*space.stretch, 1.0)
    lines, steps = [], []
    for k in (0, 1):
        step = _nice((high[k] - low[k]) / stretch[k] / 10.0)
        steps.append(f"{step:g}{f' {space.units[k]}' if space.units[k] else ''}")
        ends = np.array([low, high])
        ends[:, 2] = low[2]
        first = np.ceil(low[k] / stretch[k] / step)
        for value in np.arange(first, np.floor(high[k] / stretch[k] / step) + 1.0):
            line = ends.copy()
            line[:, k] = value * step * stretch[k]
            lines.append(camera.project(line)[0])
    floor = ax.add_collection(LineCollection(lines, colors=_GRID, linewidths=0.9))
    # Its corners may be outside of the scene, of which the curves are beside.
    left, bottom = camera.middle - (0.5 * _SCENE, camera.middle[1])
    floor.set_clip_path(
        Rectangle((left, bottom), _SCENE, 2.0 * camera.middle[1], transform=ax.transData)
    )
    names = " and ".join(dict.fromkeys(steps))
    words = (
        f"grid {names}"
        if space.kind == "space"
        else f"{space.names[0]} \u2192 {space.names[1]} \u2191, grid {names}"
    )
    ax.text(14, 14, words.replace("_", " "), color="0.45", size=8)


def _name_closest(ax: "Axes", run: Recording) -> None:
    """Write which agents came closest to each other, in a warning colour if they touched."""
    closest, sizes = run.closest_pair(run.scales), run.ellipsoid
    if closest is not None:
        text = "smallest {}distance in the frames {:.3g} m: {} and {} at {:.4g} s".format(
            "scaled " * (run.avoidance is not None),
            closest.distance,
            *closest.agents,
            closest.time,
        )
        touch = closest.touch(None if sizes is None else sizes.radius)
        colour = draw.COLOURS[1] if touch else "0.45"
        ax.text(14, 32, text, color=colour, size=9)


def _nice(value: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is not below a value."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-12)))
    return float(next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value * 0.999))


def _curves(figure: Any, run: Recording, ends: Array) -> list[Any]:
    """Draw numbers of a run between two times, and return their cursors."""
    within = np.flatnonzero((run.times >= ends[0]) & (run.times <= ends[1]))
    keep = within[draw.thin(len(within))]
    shows = [_draw_errors, *[draw_near] * (run.avoidance is not None), _draw_inputs]
    left, tall, axes = (_SCENE + 62) / _WIDTH, 0.96 / len(shows), list["Axes"]()
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
    """Draw the formation errors, or the worst and the median of a large swarm."""
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
            ax.plot(run.times[keep], line, **pen_of(run, agent))
    draw.logarithmic(ax, errors)
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


def draw_near(ax: "Axes", run: Recording, keep: Array) -> None:
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
        ax.axhline(value, color=draw.COLOURS[1], linewidth=0.9)
        where = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": side, "size": 7}
        ax.text(1.0, value, name, color=draw.COLOURS[1], **where)
    ax.set_ylim(0.0, 1.05 * max(np.nanmax(distance), near.ellipsoid.limit))
    rows = active * 0.25 * ax.get_ylim()[1] / max(1.0, active.max())
    ax.fill_between(run.times[keep], rows, step="post", color=draw.COLOURS[1], alpha=0.3)
    ax.set_title("smallest scaled distance (m), active rows", size=9, loc="left")
