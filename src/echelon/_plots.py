"""The figures of a run, ready for print: made apart from pyplot, so that no state is shared."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon._errors import Outcome
from echelon._metrics import SETTLED, formation_errors, output_errors
from echelon._result import Result
from echelon._types import Matrix

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's palette, told apart by colour-blind readers; black is the leader's.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D00")
LEADER, REFERENCE, EDGE = "black", "0.6", "0.35"

FLOOR = 1e-17
"""The least error that a logarithmic axis shows: below the rounding of a metre in float64."""

_NAMED = 10  # With more agents than this, followers look alike and the legend names none of them.
_POINTS = 2000  # a line's, more than the pixels that it covers
_ALL_POINTS = 200_000  # of all lines of one figure
_SNAPSHOTS = 6
_EDGES = 5000  # Snapshots of a graph with more edges than this would be black.
_WIDTH = 7.0  # inches: two columns of a journal
_STYLE = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.labelsize": 10,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.92",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "lines.solid_capstyle": "round",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "pdf.fonttype": 42,  # Journals refuse fonts of type 3.
    "savefig.dpi": 150,
}


def figures(result: Result, lyapunov: Sequence[Matrix] | None = None) -> "dict[str, Figure]":
    """Return the figures that make sense for a run, by name.

    `leader_3d` is the leader with its reference: in space or in the plane where the model has a
    position, else in the phase plane or over time. `trajectories` are all agents, with the graph
    drawn at a few times. `tracking_error` is each output of the leader minus the reference's, and
    exists with a reference. `formation_error` is each follower's distance from its goal, never
    drawn below 1e-17. `lyapunov` is V with its derivative, and exists where V is given.

    A run without a stored frame has no figures. Where a run diverged, what lies far beyond its
    start and its reference is left out, and the figure says so.

    Args:
        result: the run.
        lyapunov: V (T,) and dV/dt (T,), such as `echelon.lyapunov(result)` returns.
    """
    if not len(result.times):
        return {}
    makers: dict[str, Callable[[], Figure | None]] = {
        "leader_3d": lambda: _leader(result),
        "trajectories": lambda: _trajectories(result),
        "tracking_error": lambda: _tracking_error(result),
        "formation_error": lambda: _formation_error(result),
        "lyapunov": lambda: None if lyapunov is None else _lyapunov(result, *lyapunov[:2]),
    }
    with _style():
        made = {name: make() for name, make in makers.items()}
    return {name: figure for name, figure in made.items() if figure is not None}


def save_figures(
    result: Result, folder: Path, lyapunov: Sequence[Matrix] | None = None
) -> list[Path]:
    """Write each figure of a run as PNG (150 dpi) and PDF under `folder`/figures; return the paths.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    paths = []
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    for name, figure in figures(result, lyapunov).items():
        path = folder / "figures" / name
        with _style():
            figure.savefig(path.with_suffix(".png"))
            # Without its date, the same run writes the same file.
            figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
        paths += [path.with_suffix(".png"), path.with_suffix(".pdf")]
    return paths


@contextmanager
def _style() -> Iterator[None]:
    import matplotlib

    with matplotlib.rc_context(_STYLE), np.errstate(over="ignore", invalid="ignore"):
        yield


# ---- in space ---------------------------------------------------------------------------------


def _leader(result: Result) -> "Figure":
    """Return the first leader with its reference."""
    agent = result.graph.leaders[0]
    lines = {f"leader {agent}": (result.states[:, agent], _pen(result, agent))}
    if result.reference is not None:
        wanted = result.reference + result.formation.offsets[agent]
        dashed = {"color": REFERENCE, "linestyle": (0, (4, 2)), "linewidth": 1.4}
        lines = {"reference": (wanted, dashed)} | lines
    axes = _space(result)
    if not axes:
        return _states_over_time(result, lines)
    keep = _thin(len(result.times))
    lines = {name: (path[keep][:, axes], pen) for name, (path, pen) in lines.items()}
    anchors = [lines[next(iter(lines))][0], result.states[:1, agent][:, axes]]
    figure, ax = _canvas(result, axes)
    bounded = [(name, *_bounded(path, *anchors), pen) for name, (path, pen) in lines.items()]
    for name, path, _, pen in bounded:
        _plot(ax, path, label=name, **pen)
    path = bounded[-1][1]
    _plot(ax, path[:1], label="start", **_marker("o", LEADER, hollow=True))
    _plot(ax, path[-1:], label="end", **_marker("s", LEADER))
    _frame(ax, [path for _, path, _, _ in bounded])
    return _finish(figure, ax, any(cut for _, _, cut, _ in bounded))


def _trajectories(result: Result) -> "Figure":
    """Return the paths of all agents, with the graph drawn at a few times."""
    axes = _space(result)
    agents = range(result.graph.agents)
    if not axes:
        pens = {_name(result, i): (result.states[:, i], _pen(result, i)) for i in agents}
        return _states_over_time(result, pens)
    paths = result.states[:, :, axes]
    anchors = [paths[0]] if result.reference is None else [paths[0], result.reference[:, axes]]
    paths, cut = _bounded(paths, *anchors)
    figure, ax = _canvas(result, axes)
    keep = _thin(len(paths), len(agents))
    many = len(agents) > _NAMED
    for i in sorted(agents, key=lambda i: i in result.graph.leaders):
        label = None if many and i not in result.graph.leaders[:1] else _name(result, i)
        _plot(ax, paths[keep, i], label=label, rasterized=many, **_pen(result, i))
    _snapshots(ax, result, paths)
    _frame(ax, [paths])
    return _finish(figure, ax, cut)


def _snapshots(ax: Any, result: Result, paths: Matrix) -> None:
    """Draw the graph at a few times, agents as dots: hollow at the start, square at the end."""
    frames = np.unique(np.linspace(0, len(paths) - 1, _SNAPSHOTS).round().astype(int))
    size = 4.0 if result.graph.agents <= _NAMED else 1.2
    if len(result.graph.edges) <= _EDGES:
        ends = paths[frames][:, result.graph.edges]
        gaps = np.full_like(ends[:, :, :1], np.nan)
        links = np.concatenate([ends, gaps], axis=2).reshape(-1, paths.shape[2])
        _plot(ax, links, label="graph", color=EDGE, linewidth=0.8, zorder=3)
    for agent in range(result.graph.agents):
        colour = _pen(result, agent)["color"]
        _plot(ax, paths[frames[1:-1], agent], **_marker(".", colour, size=size))
        _plot(ax, paths[:1, agent], **_marker("o", colour, size=size, hollow=True))
        _plot(ax, paths[-1:, agent], **_marker("s", colour, size=size))
    for name, shape in (("start", "o"), ("end", "s")):
        nowhere = np.full((1, paths.shape[2]), np.nan)
        _plot(ax, nowhere, label=name, **_marker(shape, EDGE, hollow=name == "start"))


def _space(result: Result) -> list[int]:
    """Return the states that span the picture: the position's, both of two, or none."""
    position = list(result.model.position_indices()[:3])
    if len(position) > 1:
        return position
    return [0, 1] if len(result.model.state_names) == 2 else []


def _canvas(result: Result, axes: Sequence[int]) -> "tuple[Figure, Any]":
    """Return a figure with one set of axes, in the plane or in space, labelled."""
    from matplotlib.figure import Figure

    labels = [_label(result.model.state_names[k], result.model.state_units[k]) for k in axes]
    if len(axes) == 2:
        figure = Figure((_WIDTH, 4.4), layout="constrained")
        ax: Any = figure.add_subplot()
    else:
        figure = Figure((_WIDTH, 4.8))
        ax = figure.add_axes((-0.02, 0.0, 0.84, 1.0), projection="3d", computed_zorder=False)
        ax.view_init(elev=28.0, azim=-60.0)
        _quiet_panes(ax)
    for name, label in zip("xyz", labels, strict=False):
        getattr(ax, f"set_{name}label")(label)
    return figure, ax


def _quiet_panes(ax: Any) -> None:
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_color("0.5")
        axis._axinfo["grid"].update(color="0.9", linewidth=0.5)
        axis.set_major_locator(_ticks(5))


def _ticks(count: int) -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(count, steps=[1, 2, 2.5, 5, 10])


def _frame(ax: Any, paths: Sequence[Matrix]) -> None:
    """Fit the axes around all points, one metre alike in all directions."""
    points = np.concatenate([path.reshape(-1, path.shape[-1]) for path in paths])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    # A flat path still needs a box with some height.
    least = 0.25 * (high - low).max() or 1.0
    half = 0.54 * np.maximum(high - low, least)
    for name, middle, reach in zip("xyz", 0.5 * low + 0.5 * high, half, strict=False):
        getattr(ax, f"set_{name}lim")(middle - reach, middle + reach)
    if len(half) == 3:
        ax.set_box_aspect(half / half.max(), zoom=1.05)
    else:
        ax.set_aspect("equal")
        ax.figure.set_figheight(np.clip(0.7 + 5.2 * half[1] / half[0], 2.6, 5.6))


# ---- over time --------------------------------------------------------------------------------


def _states_over_time(result: Result, lines: dict[str, tuple[Matrix, dict[str, Any]]]) -> "Figure":
    """Return a panel for each state (twelve at most) with all lines (T, n)."""
    model, keep = result.model, _thin(len(result.times), len(lines))
    figure, panels = _panels(result, min(len(model.state_names), 12))
    many = len(lines) > _NAMED
    cut = False
    for k, ax in enumerate(panels):
        first = np.concatenate([path[:1, [k]] for path, _ in lines.values()])
        for name, (path, pen) in reversed(lines.items()):
            values, over = _bounded(path[keep, k, None], first)
            label = None if many and not name.startswith("leader") else name
            points = np.column_stack([result.times[keep], values])
            _plot(ax, points, label=label, rasterized=many, **pen)
            cut |= over
        ax.set_ylabel(_label(model.state_names[k], model.state_units[k]))
    return _finish(figure, panels[0], cut)


def _tracking_error(result: Result) -> "Figure | None":
    """Return the leader's output minus its reference's, a panel for each unit."""
    errors = output_errors(result)
    if errors is None:
        return None
    units = dict(zip(result.model.state_names, result.model.state_units, strict=True))
    names = result.model.output_names
    kinds = list(dict.fromkeys(units.get(name, "") for name in names))
    figure, panels = _panels(result, len(kinds))
    keep, cut = _thin(len(errors), len(names)), False
    for k, name in enumerate(names):
        ax = panels[kinds.index(units.get(name, ""))]
        values, over = _bounded(errors[keep, k, None], errors[:1, k, None])
        points = np.column_stack([result.times[keep], values])
        _plot(ax, points, label=name, color=COLOURS[k % len(COLOURS)])
        cut |= over
    for ax, unit in zip(panels, kinds, strict=True):
        ax.set_ylabel(_label("tracking error", unit))
        ax.axhline(0.0, color="0.75", linewidth=0.6, zorder=1)
        _legend(ax)
    return _finish(figure, None, cut)


def _formation_error(result: Result) -> "Figure":
    """Return each follower's distance from its goal, on a logarithmic axis."""
    errors = np.maximum(formation_errors(result), FLOOR)
    figure, (ax,) = _panels(result, 1, height=3.4)
    followers = list(result.graph.followers)
    many, keep = result.graph.agents > _NAMED, _thin(len(errors), len(followers))
    times = result.times[keep]
    for agent in followers:
        label = None if many else _name(result, agent)
        points = np.column_stack([times, errors[keep, agent]])
        _plot(ax, points, label=label, rasterized=many, **_pen(result, agent))
    if many:
        for name, of, style in (("worst", np.max, "-"), ("median", np.median, "--")):
            points = np.column_stack([times, of(errors[keep][:, followers], axis=1)])
            _plot(ax, points, label=f"{name} follower", color=LEADER, linestyle=style)
    if result.unit == "m":
        ax.axhline(SETTLED, color="0.5", linewidth=0.8, linestyle=":", label="1 cm", zorder=1)
    ax.set_ylabel(_label("formation error", "m" if result.unit == "m" else ""))
    _logarithmic(ax, errors[:, followers])
    return _finish(figure, ax, False)


def _lyapunov(result: Result, value: Matrix, rate: Matrix) -> "Figure":
    """Return V, and how fast it falls or rises, on logarithmic axes."""
    figure, (above, below) = _panels(result, 2, height=2.0)
    keep, floor = _thin(len(value)), FLOOR**2
    times = result.times[keep]
    value, rate = np.maximum(value[keep], floor), rate[keep]
    _plot(above, np.column_stack([times, value]), label="V", color=LEADER)
    speeds = (("falls", -rate, COLOURS[0]), ("rises", rate, COLOURS[1]))
    for name, speed, colour in speeds:
        shown = np.where(speed > 0.0, np.maximum(speed, floor), np.nan)
        if np.isfinite(shown).any():
            points = np.column_stack([times, shown])
            _plot(below, points, label=f"V {name}", color=colour, linewidth=0.8)
    above.set_ylabel("V")
    below.set_ylabel("|dV/dt| (1/s)")
    _logarithmic(above, value)
    _logarithmic(below, np.maximum(np.abs(rate), floor))
    _legend(below)
    return _finish(figure, None, False)


def _panels(result: Result, rows: int, height: float = 1.7) -> "tuple[Figure, list[Any]]":
    """Return a figure of panels above each other that share the axis of time."""
    from matplotlib.figure import Figure

    figure = Figure((_WIDTH, max(3.4, height * rows)), layout="constrained")
    axes = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
    last = float(result.times[-1]) or result.settings.horizon
    axes[-1].set(xlabel="time (s)", xlim=(0.0, last))
    figure.align_ylabels(axes)
    return figure, axes


def _logarithmic(ax: Any, values: Matrix) -> None:
    """Make the value axis logarithmic, with room for the finite values and a sensible top."""
    from matplotlib.ticker import LogLocator, NullLocator

    finite = values[np.isfinite(values)]
    low, high = (np.log10(finite.min()), np.log10(finite.max())) if finite.size else (-2.0, 0.0)
    top = min(high, 9.0)
    low = min(low, top)
    margin = max(0.04 * (top - low), 0.3)
    ax.set(yscale="log", ylim=(10.0 ** (low - margin), 10.0 ** (top + margin)))
    ax.yaxis.set_major_locator(LogLocator(numticks=8))
    ax.yaxis.set_minor_locator(NullLocator())


# ---- lines ------------------------------------------------------------------------------------


def _name(result: Result, agent: int) -> str:
    return f"{'leader' if agent in result.graph.leaders else 'follower'} {agent}"


def _pen(result: Result, agent: int) -> dict[str, Any]:
    """Return the look of an agent's line."""
    if agent in result.graph.leaders:
        return {"color": LEADER, "linewidth": 1.4, "zorder": 2.5}
    if result.graph.agents > _NAMED:
        return {"color": COLOURS[0], "linewidth": 0.4, "alpha": 0.3}
    place = result.graph.followers.index(agent)
    dash = "-" if place < len(COLOURS) else "--"
    return {"color": COLOURS[place % len(COLOURS)], "linestyle": dash}


def _marker(shape: str, colour: str, size: float = 5.0, hollow: bool = False) -> dict[str, Any]:
    """Return the look of points without a line."""
    inside = "white" if hollow else colour
    return {"marker": shape, "color": colour, "markerfacecolor": inside, "markersize": size} | {
        "linestyle": "none",
        "zorder": 4,
        "markeredgewidth": 0.25 * size,
    }


def _plot(ax: Any, points: Matrix, **look: Any) -> None:
    """Draw a line through points (T, 2) or (T, 3); a single point as a dot."""
    if len(points) == 1 and "marker" not in look:
        look |= {"marker": "o", "markersize": 4.0}
    ax.plot(*points.T, **look)


def _thin(frames: int, lines: int = 1) -> Matrix:
    """Return the frames to draw: all of them, or evenly spread ones with the first and the last."""
    count = int(np.clip(_ALL_POINTS // max(lines, 1), 100, _POINTS))
    return np.unique(np.linspace(0, frames - 1, min(frames, count)).round().astype(int))


def _bounded(values: Matrix, *anchors: Matrix) -> tuple[Matrix, bool]:
    """Return values (..., d) with NaN where they have run away, and whether any has.

    They have where some are a thousand times farther off than the anchors reach; what is within ten
    times stays.
    """
    known = np.concatenate([anchor.reshape(-1, values.shape[-1]) for anchor in anchors])
    low, high = known.min(axis=0), known.max(axis=0)
    middle, reach = 0.5 * low + 0.5 * high, max(1.0, (0.5 * high - 0.5 * low).max())
    away = np.abs(values - middle).max(axis=-1)
    if away.max() <= 1000.0 * reach:
        return values, False
    return np.where(away[..., None] > 10.0 * reach, np.nan, values), True


def _label(name: str, unit: str) -> str:
    """Return the text of an axis: the name, with the unit where there is one."""
    name = name.replace("_", " ")
    return f"{name} ({unit})" if unit else name


def _legend(ax: Any) -> None:
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0)


def _finish(figure: "Figure", ax: Any, cut: bool) -> "Figure":
    """Add the legend and the note on what is left out; settle the layout once for all formats."""
    if ax is not None and ax.get_legend_handles_labels()[1]:
        _legend(ax)
    if cut:
        figure.suptitle("The run grew beyond these axes; what lies farther is not drawn.", size=9)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
    return figure
