"""Draw docs/assets/paper.gif: ten seconds of the scenario `paper`, in eight.

Run it from anywhere with `python docs/make_animation.py`; it takes about half a minute.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import echelon as ech
from echelon.plots.style import COLOURS, EDGE, LEADER, logarithmic, style
from echelon.results.metrics import formation_errors

TARGET = Path(__file__).parent / "assets" / "paper.gif"
SETTINGS = ("simulation.horizon=10", "simulation.dt=0.0025", "simulation.store_every=25")
FRAME = 50  # ms, for 62.5 ms of the run
HOLD = 1500  # ms for which the last frame stays
TRAIL = 24  # frames
SIZE, DPI = (9.0, 4.5), 100

ENLARGED = 4
ARM, ROTOR = 0.0325 * ENLARGED, 0.02 * ENLARGED  # m; the scene is too wide for the real ones
FLOOR = 0.0  # m
PALETTE = (LEADER, *COLOURS)


class Scene(NamedTuple):
    """The figure and all in it that moves."""

    figure: Figure
    vehicles: list[Any]
    shadows: list[Any]
    trails: list[list[Any]]
    edges: Any
    clock: Any
    readouts: list[Any]
    curves: list[Any]


def main() -> None:
    """Run the scenario, draw each frame and write the file."""
    result = ech.run(ech.load_scenario("paper", SETTINGS))
    with style():
        scene, errors = make_scene(result), distances(result)
        canvas = FigureCanvasAgg(scene.figure)
        frames = [picture(scene, canvas, result, errors, k) for k in range(len(result.times))]
    TARGET.parent.mkdir(exist_ok=True)
    write_gif(frames, TARGET)
    print(f"{TARGET}: {len(frames)} frames, {TARGET.stat().st_size / 1e6:.2f} MB")


def distances(result: ech.Result) -> np.ndarray:
    """Return how far each agent is from its goal, (T, N): the leader from its reference."""
    errors = formation_errors(result)
    errors[:, 0] = np.linalg.norm((result.states[:, 0] - result.reference)[:, :3], axis=1)
    return errors


# ---- vehicles ---------------------------------------------------------------------------------


def rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the matrix (3, 3) that turns body into world coordinates, from ZYX angles."""
    (a, b, c), (d, e, f) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    about_z = np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def outline() -> np.ndarray:
    """Return a vehicle in body coordinates, (K, 3): two arms and four rotors, NaN between them."""
    gap = np.full((1, 3), np.nan)
    hubs = ARM * np.array([[1, 1, 0], [-1, -1, 0], [1, -1, 0], [-1, 1, 0]])
    angle = np.linspace(0.0, 2.0 * np.pi, 17)
    disc = ROTOR * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    rotors = [part for hub in hubs for part in (gap, hub + disc)]
    return np.concatenate([hubs[:2], gap, hubs[2:], *rotors])


def placed(state: np.ndarray) -> np.ndarray:
    """Return a vehicle's outline in the world, (K, 3)."""
    return state[:3] + outline() @ rotation(*state[6:9]).T


# ---- the scene --------------------------------------------------------------------------------


def make_scene(result: ech.Result) -> Scene:
    """Return the figure with everything that stands still, and the moving parts without data."""
    figure = Figure(SIZE, dpi=DPI)
    ax: Any = figure.add_axes((-0.145, -0.305, 0.97, 1.74), projection="3d", computed_zorder=False)
    points = result.states[:, :, :3].reshape(-1, 3)
    low, high = points.min(axis=0) - 0.2, points.max(axis=0) + 0.2
    low[2] = FLOOR
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(high - low, zoom=1.0)
    ax.view_init(elev=30.0, azim=-70.0)
    ax.set_axis_off()
    draw_floor(ax, low, high)
    ax.plot(*result.reference[:, :3].T, color="0.72", linewidth=1.4, linestyle=(0, (3, 2)))

    def empty(**look: Any) -> Any:
        return ax.plot([], [], [], **look)[0]

    colours = PALETTE[: result.graph.agents]
    shadows = [empty(color="0.84", linewidth=1.2, zorder=1) for _ in colours]
    shades = [[mixed(colour, part) for part in (0.75, 0.5, 0.2)] for colour in colours]
    trails = [[empty(color=c, linewidth=1.6, zorder=3) for c in three] for three in shades]
    edges = empty(color=EDGE, linewidth=1.0, zorder=4)
    vehicles = [empty(color=colour, linewidth=1.5, zorder=5) for colour in colours]
    clock, readouts = write_readouts(figure, result)
    return Scene(
        figure, vehicles, shadows, trails, edges, clock, readouts, draw_errors(figure, result)
    )


def mixed(colour: str, white: float) -> tuple[float, ...]:
    """Return a colour with a part of it made white: a GIF has no shades of transparency."""
    from matplotlib.colors import to_rgb

    return tuple(white + (1.0 - white) * part for part in to_rgb(colour))


def draw_floor(ax: Any, low: np.ndarray, high: np.ndarray) -> None:
    """Draw the floor as tiles of half a metre."""
    (x0, y0), (x1, y1) = np.round(2.0 * low[:2]) / 2.0, np.round(2.0 * high[:2]) / 2.0
    for x in np.arange(x0, x1 + 0.1, 0.5):
        ax.plot([x, x], [y0, y1], [FLOOR, FLOOR], color="0.92", linewidth=0.7, zorder=0)
    for y in np.arange(y0, y1 + 0.1, 0.5):
        ax.plot([x0, x1], [y, y], [FLOOR, FLOOR], color="0.92", linewidth=0.7, zorder=0)


def write_readouts(figure: Figure, result: ech.Result) -> tuple[Any, list[Any]]:
    """Write the lines of the table at the right; return the clock and the numbers."""
    clock = figure.text(0.975, 0.925, "", size=15, ha="right")
    figure.text(0.735, 0.845, "distance from goal", size=10, color="0.35")
    figure.text(0.02, 0.03, f"vehicles drawn {ENLARGED} times their size", size=9, color="0.45")
    readouts = []
    for agent in range(result.graph.agents):
        height = 0.785 - 0.06 * agent
        name = "leader" if agent in result.graph.leaders else f"follower {agent}"
        figure.text(0.735, height, name, size=11, color=PALETTE[agent])
        readouts.append(figure.text(0.975, height, "", size=11, ha="right", color=PALETTE[agent]))
    return clock, readouts


def draw_errors(figure: Figure, result: ech.Result) -> list[Any]:
    """Draw the axes of the followers' errors over time; return the curves."""
    ax = figure.add_axes((0.78, 0.13, 0.195, 0.38))
    ax.set(xlim=(0.0, result.times[-1]), xlabel="time (s)", ylabel="formation error (m)")
    ax.set_xticks(np.linspace(0.0, result.times[-1], 3))
    logarithmic(ax, distances(result)[:, 1:])
    return [ax.plot([], [], color=colour)[0] for colour in PALETTE[1 : result.graph.agents]]


def picture(
    scene: Scene, canvas: FigureCanvasAgg, result: ech.Result, errors: np.ndarray, k: int
) -> Image.Image:
    """Return the picture of frame k."""
    states = result.states[k]
    for agent, state in enumerate(states):
        shape = placed(state)
        scene.vehicles[agent].set_data_3d(*shape.T)
        scene.shadows[agent].set_data_3d(*shape[:, :2].T, shape[:, 2] * 0.0 + FLOOR)
        for part, line in enumerate(scene.trails[agent]):
            since, until = (k - TRAIL * (3 - part) // 3, k - TRAIL * (2 - part) // 3)
            path = result.states[max(since, 0) : max(until, 0) + 1, agent, :3]
            line.set_data_3d(*path.T)
        scene.readouts[agent].set_text(length(errors[k, agent]))
    ends = states[result.graph.edges, :3]
    gaps = np.full_like(ends[:, :1], np.nan)
    scene.edges.set_data_3d(*np.concatenate([ends, gaps], axis=1).reshape(-1, 3).T)
    for curve, error in zip(scene.curves, errors[: k + 1, 1:].T, strict=True):
        curve.set_data(result.times[: k + 1], error)
    scene.clock.set_text(f"t = {result.times[k]:.1f} s")
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())


def length(metres: float) -> str:
    """Return a length in the unit that suits it."""
    for factor, unit in ((1.0, "m"), (1e2, "cm"), (1e3, "mm")):
        if metres * factor >= 1.0:
            return f"{metres * factor:.2f} {unit}"
    return f"{metres * 1e6:.1f} µm"


def write_gif(frames: list[Image.Image], path: Path) -> None:
    """Write frames in one palette, without dithering, so that what stands still costs nothing."""
    sample = Image.new("RGB", (frames[0].width, frames[0].height * 4))
    for place, k in enumerate(np.linspace(0, len(frames) - 1, 4).astype(int)):
        sample.paste(frames[k], (0, place * frames[0].height))
    palette = sample.quantize(64, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    # Of nearly white points the palette has the average, and the ground is to be white.
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) > 248] = 255
    for frame in drawn:
        frame.putpalette(colours.ravel().tolist())
    durations = [FRAME] * (len(drawn) - 1) + [HOLD]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=durations, loop=0)


if __name__ == "__main__":
    main()
