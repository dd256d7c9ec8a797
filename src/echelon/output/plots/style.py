"""The style of figures: settings of matplotlib, pens of agents, axes, legends; without pyplot."""

import bisect
import contextlib
import importlib
import itertools
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

import numpy as np

from echelon.core.errors import OutputError
from echelon.core.types import Array
from echelon.experiments.results.recording import Recording, group_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers can distinguish; without black, which is the
# leader's, and yellow, which is too pale on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LEADER, EDGE = "black", "0.3"

FLOOR = 1e-17
"""Below the rounding error of a metre in float64."""

NAMED = 10
"""With more agents than this, followers have one colour, and no name in the legend."""
MOST = 2000
"""Agents that a figure draws one by one; more would hide each other and take minutes."""
HIGHEST = 9.0
"""Inches: a page of a journal, less a caption."""
_TOP = 1e9  # of a logarithmic axis; above it the interesting part would be flat
_POINTS = 2000  # of a line, more than the pixels that it covers
_ALL_POINTS = 200_000  # of all lines of one figure

_SIZES = ("linewidth", "markersize")

Style: TypeAlias = dict[str, Any]
"""Keywords of matplotlib."""

STYLE: Style = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": "small",
    "figure.titlesize": "small",
    "figure.constrained_layout.h_pad": 0.07,
    "figure.constrained_layout.w_pad": 0.07,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": "small",
    "legend.handlelength": 1.8,
    "lines.linewidth": 1.1,
    "lines.markersize": 5.0,
    "xtick.labelsize": "small",
    "ytick.labelsize": "small",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "pdf.fonttype": 42,  # Journals refuse fonts of type 3.
    "svg.fonttype": "none",  # so that text can be searched and takes the font of a page
    "svg.hashsalt": "echelon",  # so that the same figure gives the same file
    "savefig.dpi": 150,
}
"""Settings of matplotlib for figures; those that the user has changed remain the user's."""


class FigureSize(NamedTuple):
    """The width of a figure and of a space in it (inches), and its font size (pt)."""

    width: float
    side: float
    letters: float

    @property
    def narrow(self) -> bool:
        """Whether legends have no room beside the axes."""
        return self.width < 5.0


SCREEN = FigureSize(7.0, 4.3, 10.0)
ONE_COLUMN, TWO_COLUMNS = FigureSize(3.5, 2.6, 8.0), FigureSize(7.16, 4.4, 8.0)
"""Widths of a journal page."""

_page: ContextVar[FigureSize] = ContextVar("page", default=SCREEN)
_target: "ContextVar[Axes | None]" = ContextVar("target", default=None)


@contextmanager
def style(page: FigureSize = SCREEN, ax: "Axes | None" = None) -> Iterator[None]:
    """Use echelon's style for a page, and restore matplotlib's settings.

    With axes `ax`, figures are drawn into these and not into figures of their own.
    """
    matplotlib = _matplotlib()
    ours, usual = matplotlib.rcParams, matplotlib.rcParamsDefault
    looks = STYLE | {"font.size": page.letters}
    settings = {key: value for key, value in looks.items() if ours[key] == usual[key]}
    token, into = _page.set(page), _target.set(ax)
    try:
        with (
            matplotlib.rc_context(settings),
            np.errstate(over="ignore", invalid="ignore"),
        ):
            yield
    finally:
        _page.reset(token)
        _target.reset(into)


def _matplotlib() -> Any:
    """Jupyter sets `MPLBACKEND` for its child processes, whose Python may lack that backend."""
    if "matplotlib" in sys.modules or not os.environ.get("MPLBACKEND"):
        return importlib.import_module("matplotlib")
    asked = os.environ.pop("MPLBACKEND")
    try:
        matplotlib = importlib.import_module("matplotlib")
    finally:
        os.environ["MPLBACKEND"] = asked
    # As matplotlib does itself when it is imported, but that would then fail.
    with contextlib.suppress(ValueError):
        matplotlib.rcParams["backend"] = asked
    return matplotlib


def page() -> FigureSize:
    """Return the present page."""
    return _page.get()


def target() -> "Axes | None":
    """Return the caller's axes, if figures are drawn into these."""
    return _target.get()


# ---- pens -------------------------------------------------------------------------------------

# In grey print colours of the palette are alike, so that neighbours in it differ in their dashes.
_DASHES = ("-", (0, (5.0, 1.5)), (0, (1.2, 1.2)), (0, (5.0, 1.5, 1.2, 1.5)), (0, (9.0, 2.0)))
# Broad and pale, so that it stays visible under the thin line of its leader.
REFERENCE: Style = {"color": "0.7", "linestyle": (0, (1.6, 0.9)), "linewidth": 3.0, "zorder": 2}
MARK: Style = {"color": "0.5", "linestyle": ":", "zorder": 1}
"""A value that others are compared with."""
LIMIT: Style = {"color": EDGE, "linestyle": (0, (5.0, 2.0)), "zorder": 2.2}
"""A limit or a guarantee."""


def scale(key: str) -> float:
    """Return by how much the user's setting, as of `lines.linewidth`, is larger than echelon's."""
    return _matplotlib().rcParams[key] / STYLE[key]


def hue(place: int) -> Style:
    """Return the colour of a line by its place: of the palette, or as the user's cycle has it."""
    matplotlib = _matplotlib()
    cycle = matplotlib.rcParams["axes.prop_cycle"]
    if cycle == matplotlib.rcParamsDefault["axes.prop_cycle"] or "color" not in cycle.keys:
        return {"color": COLOURS[place % len(COLOURS)]}
    looks = [*cycle]
    look = looks[place % len(looks)]
    return {key: look[key] for key in ("color", "linestyle", "linewidth") if key in look}


def colour(place: int) -> Any:
    """Return the colour of `hue`."""
    return hue(place)["color"]


def crowding(agents: int) -> float:
    """Return 1 for as many agents as a legend can name, and less for more."""
    return min(1.0, NAMED / agents)


def leader_pen(place: int, agents: int) -> Style:
    """Return the line style of a leader, by its place among the leaders."""
    order = 2.5 if crowding(agents) == 1.0 else 5.0
    return {"color": LEADER, "zorder": order, "linestyle": _DASHES[place % len(_DASHES)]}


def pen(place: int, agents: int) -> Style:
    """Return the line style of a follower, by its place among the followers."""
    if (crowd := crowding(agents)) < 1.0:
        return {"color": colour(0), "alpha": crowd**0.5, "rasterized": agents > 100}
    again, one = divmod(place, len(COLOURS))
    return {"linestyle": _DASHES[(one + 3 * again) % len(_DASHES)], **hue(place)}


def pen_of(run: Recording, agent: int) -> Style:
    """Return the line style of an agent."""
    leads = agent in run.leaders
    place = bisect.bisect_left(run.leaders if leads else run.followers, agent)
    return (leader_pen if leads else pen)(place, run.agents)


def name_of(run: Recording, agent: int, short: bool = False) -> str | None:
    """Return an agent's name; with `short`, None for all of a large swarm but its first leader."""
    leaders, few = run.leaders, run.agents <= NAMED
    if agent in leaders:
        if not short or few or len(leaders) <= NAMED:
            return _with_group(run, f"leader {agent}", agent)
        return f"{len(leaders)} leaders" if agent == leaders[0] else None
    if few or not short:
        return _with_group(run, f"follower {agent}", agent)
    return f"{len(run.followers)} followers" if agent == run.followers[0] else None


def _with_group(run: Recording, name: str, agent: int) -> str:
    group = group_name(run, agent)
    return f"{name}, {group}" if group else name


def leaders_first(run: Recording, agents: Iterable[int]) -> list[int]:
    """Return agents in the order in which they are drawn."""
    # The order of drawing is that of the legend; `zorder` decides which line is on top.
    return sorted(agents, key=lambda agent: agent not in run.leaders)


def drawn(run: Recording) -> list[int]:
    """Return the agents that are drawn: all, or evenly spread ones of a huge swarm."""
    step = -(-run.agents // MOST)
    return leaders_first(run, sorted({*range(0, run.agents, step), *run.leaders[:MOST]}))


def count_title(run: Recording, count: int) -> str:
    """Return the number of agents that are drawn, if that is not all of them."""
    return "" if count == run.agents else f"{count:,} of {run.agents:,} agents"


def reference_of(run: Recording, leader: int) -> Array | None:
    """Return the desired states (T, n) of a leader; None without a reference."""
    return None if run.reference is None else run.reference + run.offsets_in()[..., leader, :]


def dots(shape: str, colour: str, size: float = 5.0, hollow: bool = False) -> Style:
    """Return the style of markers without a line."""
    return {
        "linestyle": "none",
        "marker": shape,
        "color": colour,
        "markersize": size,
        "markerfacecolor": "white" if hollow else colour,
        "markeredgewidth": 0.2 * size,
        # Above the lines whose ends they mark.
        "zorder": 4,
    }


def plot(ax: "Axes", *columns: Array, **look: Any) -> None:
    """Draw a line through points, given as arrays (T, k) of coordinates; one point as a dot.

    Widths and sizes are those at echelon's settings, in whose proportions a user's are drawn.
    """
    points = np.column_stack(columns)
    if len(points) == 1 and "marker" not in look:
        look |= {"marker": "o", "markersize": 4.0}
    sized = {key: look[key] * scale(f"lines.{key}") for key in _SIZES if key in look}
    # The box of a space extends beyond its axes.
    ax.plot(*points.T, clip_on=ax.name != "3d", **(look | sized))


def thin(frames: int, lines: int = 1) -> Array:
    """Return the frames to draw: all, or evenly spread ones with the first and the last."""
    # All lines share the points of a figure; a line of fewer than 100 would show corners.
    count = int(np.clip(_ALL_POINTS // max(lines, 1), 100, _POINTS))
    return np.unique(np.linspace(0, frames - 1, min(frames, count)).round().astype(int))


def drop_runaways(values: Array, *anchors: Array) -> tuple[Array, bool]:
    """Return values (..., k) with NaN where they diverge, and whether any does.

    Values diverge if some are a million times farther away than the extent of the anchors (..., k);
    those within ten times that extent are kept.
    """
    points = np.concatenate([anchor.reshape(-1, values.shape[-1]) for anchor in anchors])
    low, high = points.min(axis=0), points.max(axis=0)
    # Halved before they are added: a sum of two huge numbers may overflow.
    middle, reach = 0.5 * low + 0.5 * high, max(1.0, (0.5 * high - 0.5 * low).max())
    away = np.abs(values - middle).max(axis=-1)
    if away.max(initial=0.0) <= 1e6 * reach:
        return values, False
    return np.where(away[..., None] > 10.0 * reach, np.nan, values), True


# ---- axes -------------------------------------------------------------------------------------


def label(name: str, unit: str) -> str:
    """Return the label of an axis: the name, with the unit if there is one."""
    name = name.replace("_", " ")
    return f"{name} ({raised(unit)})" if unit else name


def raised(unit: str) -> str:
    """Return a unit with raised powers, m/s\u00b2 for m/s^2."""
    return unit.replace("^2", "\u00b2").replace("^3", "\u00b3")


def sheet(
    height: float, rows: int = 1, columns: int = 1, **share: Any
) -> "tuple[Figure, list[list[Axes]]]":
    """Return a figure `height` inches high with its axes, or the caller's `ax` and its figure.

    Raises:
        OutputError: the figure has several axes, and the caller gave one.
    """
    from matplotlib.figure import Figure

    ax = target()
    if ax is None:
        figure = Figure((page().width, height), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **share)
        return figure, [list(row) for row in axes]
    if rows * columns > 1:
        raise OutputError("this figure has several axes; leave `ax` out.")
    return cast("Figure", ax.figure), [[ax]]


def canvas(labels: Sequence[str]) -> "tuple[Figure, Axes]":
    """Return axes in the plane or in space, for two or three labels."""
    from matplotlib.figure import Figure

    if len(labels) == 2:
        figure, ((ax,),) = sheet(0.6 * page().width)
    elif target() is not None:
        raise OutputError("this figure is in space and sets its own box; leave `ax` out.")
    else:
        figure = Figure((page().width, page().width))
        ax = space_axes(figure)
    for name, text in zip("xyz", labels, strict=False):
        getattr(ax, f"set_{name}label")(text)
    return figure, ax


def space_axes(figure: "Figure") -> Any:
    """Return axes in space, seen from 30 degrees above, at -60 degrees."""
    ax: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", computed_zorder=False)
    ax.view_init(elev=30.0, azim=-60.0)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_color("0.5")
    return ax


def frame(ax: "Axes", points: Array, alike: bool = True) -> None:
    """Fit axes around points (..., 2 or 3), with one scale for all directions if `alike`."""
    points = points.reshape(-1, points.shape[-1])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low
    # A flat path needs a box of some height, a single point one of any size.
    least = np.full_like(size, 0.25 * size.max()) if alike else 0.05 * np.abs(high)
    half = 0.54 * np.maximum(size, np.where(least > 0.0, least, 1.0))
    for name, middle, reach in zip("xyz", 0.5 * low + 0.5 * high, half, strict=False):
        getattr(ax, f"set_{name}lim")(middle - reach, middle + reach)
    if len(half) == 2 and alike:
        ax.set_aspect("equal")
        wide, figure = page().width / 1.4, cast("Figure", ax.figure)
        if target() is None:
            figure.set_figheight(np.clip(0.7 + wide * half[1] / half[0], 2.0, 1.04 * wide))


def fit_box(ax: Any, room: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """Scale the box of a space until it fits into a part of its figure, and label its axes.

    Args:
        ax: in space, with its limits.
        room: left, bottom, width and height of the part, inches.

    Returns:
        The lower left and the upper right corner of the drawn box, inches.
    """
    zoom, ends = 1.0, np.array([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()])
    corners = np.array([*itertools.product(*ends, [1.0])])
    size = np.ptp(ends, axis=1)
    low = high = np.zeros(2)
    # Under perspective the size is not quite proportional to the zoom.
    for _ in range(3):
        ax.set_box_aspect(size / size.max(), zoom=zoom)
        ax.apply_aspect()
        x, y, _, scale = ax.get_proj() @ corners.T
        inches = ax.transData.transform(np.column_stack([x, y]) / scale[:, None]) / ax.figure.dpi
        low, high = inches.min(axis=0), inches.max(axis=0)
        zoom *= (room[2:] / (high - low)).min()
    shift = np.array(room[:2]) + 0.5 * np.array(room[2:]) - 0.5 * (low + high)
    place = ax.get_position(original=True)
    ax.set_position(place.translated(*(shift / ax.figure.get_size_inches())))
    for k, name in enumerate("xyz"):
        # Matplotlib measures these distances in widths of the box.
        wide = size.max() / np.delete(size, k).max()
        getattr(ax, f"{name}axis").labelpad = 18.5 * wide - 21.0
        ax.tick_params(axis=name, pad=8.0 * wide - 8.0)
        ax.locator_params(axis=name, nbins=5 if size[k] > 0.4 * size.max() else 3)
    return low + shift, high + shift


def above_zero(values: Array) -> Array:
    """Return values with NaN where they are 0, which a logarithmic axis cannot show."""
    return np.where(values > 0.0, values, np.nan)


def say_zero(name: str | None, values: Array) -> str | None:
    """Return the name of a line, with a remark if all its values are 0."""
    empty = name is not None and len(values) and np.isnan(values).all()
    return f"{name} (always 0)" if empty else name


def logarithmic(ax: "Axes", *values: Array) -> None:
    """Make the value axis logarithmic, with limits around the finite values."""
    from matplotlib.ticker import LogLocator, NullLocator

    finite = np.concatenate([np.ravel(value) for value in values])
    finite = finite[np.isfinite(finite) & (finite > 0.0)]
    ends = np.log10([finite.min(), finite.max()]) if finite.size else np.array([-1.0, 0.0])
    low, high = np.minimum(ends, np.log10(_TOP))
    margin = 0.03 * (high - low)
    # Over less than two decades the limits are whole powers of ten, which have labels.
    low, high = (low - margin, high + margin) if high - low > 2 else (np.floor(low), np.ceil(high))
    ax.set_autoscaley_on(False)
    ax.set(yscale="log", ylim=(10.0**low, 10.0 ** max(high, low + 1.0)))
    ax.yaxis.set_major_locator(LogLocator(numticks=8))
    ax.yaxis.set_minor_locator(NullLocator())


def finish(figure: "Figure", cut: bool = False) -> "Figure":
    """Add a legend of all axes beside them, or above on a narrow page, and a note on missing parts.

    The layout is computed here, once for all file formats. In the caller's `ax` it is the caller's.
    """
    if (ax := target()) is not None:
        if ax.get_legend_handles_labels()[1]:
            ax.legend()
        return figure
    pairs = [zip(*ax.get_legend_handles_labels(), strict=True) for ax in figure.axes]
    lines = {text: line for line, text in itertools.chain(*pairs)}
    solid, narrow, above = figure.axes[0].name == "3d", page().narrow, 0.0
    if lines:
        where: Any = "upper left" if narrow else "upper right" if solid else "right upper"
        columns = max(1, min(4, int(78 / (max(map(len, lines)) + 6)))) if narrow else 1
        where = where if solid else f"outside {where}"
        legend = figure.legend([*lines.values()], [*lines], ncols=columns, loc=where)
        for line in legend.get_lines():
            line.set_alpha(1.0)
        above = 0.17 * -(-len(lines) // columns) * narrow
    if cut:
        figure.suptitle("The run diverged beyond these axes; the rest is not drawn.", wrap=True)
    if narrow and not solid:
        figure.set_figheight(min(HIGHEST, figure.get_figheight() + above))
    if solid:
        room = 0.07 * page().width, 0.45, page().side, page().side
        low, high = fit_box(figure.axes[0], room)
        figure.set_figheight(high[1] - low[1] + 0.75 + above)
        fit_box(figure.axes[0], (*room[:3], high[1] - low[1]))
        return figure
    import matplotlib

    for ax in figure.axes:
        # Ticks are chosen by the font size, which a later style must not change.
        ax.tick_params("x", labelsize=matplotlib.rcParams["xtick.labelsize"])
        ax.tick_params("y", labelsize=matplotlib.rcParams["ytick.labelsize"])
    figure.align_ylabels()
    # Axes of equal scales change their shape, and so the places of labels, with each pass.
    engine: Any = figure.get_layout_engine()
    for _ in range(1 if figure.axes[0].get_aspect() == "auto" else 4):
        engine.execute(figure)
    figure.set_layout_engine("none")
    return figure
