"""The style of figures, and their canvases, axes and lines; without pyplot and its state."""

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

import numpy as np

from echelon.core.errors import OutputError
from echelon.core.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers can distinguish; without black, which is the
# leader's, and yellow, which is too pale on white.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LEADER, REFERENCE, EDGE = "black", "0.7", "0.3"

FLOOR = 1e-17
"""Below the rounding error of a metre in float64."""

NAMED = 10
"""With more agents than this, followers have one colour, and no name in the legend."""

_TOP = 1e9  # of a logarithmic axis; above it the interesting part would be flat
HIGHEST = 9.0
"""Inches: a page of a journal, less a caption."""
_POINTS = 2000  # of a line, more than the pixels that it covers
_ALL_POINTS = 200_000  # of all lines of one figure

Style: TypeAlias = dict[str, Any]
"""Keywords of matplotlib."""


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
_STYLE: dict[Any, Any] = {
    "font.family": "STIXGeneral",
    "mathtext.fontset": "stix",
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "pdf.fonttype": 42,  # Journals refuse fonts of type 3.
    "svg.fonttype": "none",  # so that text can be searched and takes the font of a page
    "svg.hashsalt": "echelon",  # so that the same figure gives the same file
    "savefig.dpi": 150,
}


@contextmanager
def style(page: FigureSize = SCREEN, ax: "Axes | None" = None) -> Iterator[None]:
    """Use echelon's style for a page, and restore matplotlib's settings.

    With axes `ax`, figures are drawn into these and not into figures of their own.
    """
    matplotlib = _matplotlib()
    large, small = ("font.size", "axes.labelsize"), ("xtick", "ytick")
    letters: dict[Any, Any] = dict.fromkeys(large, page.letters)
    letters |= {f"{axis}.labelsize": page.letters - 1.0 for axis in small}
    letters["legend.fontsize"] = page.letters - 1.0
    token, into = _page.set(page), _target.set(ax)
    try:
        with matplotlib.rc_context(_STYLE | letters), np.errstate(over="ignore", invalid="ignore"):
            yield
    finally:
        _page.reset(token)
        _target.reset(into)


def _matplotlib() -> Any:
    """Return matplotlib, whatever `MPLBACKEND` says: figures are files and need no backend.

    Jupyter sets the variable for all its child processes, whose Python may lack that backend.
    """
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


# ---- lines ------------------------------------------------------------------------------------


def crowding(agents: int) -> float:
    """Return 1 for as many agents as a legend can name, and less for more."""
    return min(1.0, NAMED / agents)


# In grey print colours of the palette are alike, so that neighbours in it differ in their dashes.
_DASHES = ("-", (0, (5.0, 1.5)), (0, (1.2, 1.2)), (0, (5.0, 1.5, 1.2, 1.5)), (0, (9.0, 2.0)))


def leader_pen(place: int, agents: int) -> Style:
    """Return the line style of a leader, by its place among the leaders."""
    order = 2.5 if crowding(agents) == 1.0 else 5.0
    dash = _DASHES[place % len(_DASHES)]
    return {"color": LEADER, "linewidth": 1.4, "zorder": order, "linestyle": dash}


def pen(place: int, agents: int) -> Style:
    """Return the line style of a follower, by its place among the followers."""
    if (crowd := crowding(agents)) < 1.0:
        look = {"linewidth": 1.1 * crowd**0.22, "alpha": crowd**0.35, "rasterized": agents > 100}
        return {"color": COLOURS[0]} | look
    again, hue = divmod(place, len(COLOURS))
    return {"color": COLOURS[hue], "linestyle": _DASHES[(hue + 3 * again) % len(_DASHES)]}


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
    """Draw a line through points, given as arrays (T, k) of coordinates; one point as a dot."""
    points = np.column_stack(columns)
    if len(points) == 1 and "marker" not in look:
        look |= {"marker": "o", "markersize": 4.0}
    # The box of a space extends beyond its axes.
    ax.plot(*points.T, clip_on=ax.name != "3d", **look)


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


# ---- canvases ---------------------------------------------------------------------------------


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


def finish(
    figure: "Figure",
    cut: bool = False,
    legends: "Sequence[Axes] | None" = None,
    once: bool = False,
) -> "Figure":
    """Add legends beside all axes, or some, and a note on missing parts.

    On a narrow page, where legends are above the axes, the only one (`once`) is on top.

    The layout is computed here, once for all file formats. In the caller's `ax` it is the caller's.
    """
    if (ax := target()) is not None:
        if ax.get_legend_handles_labels()[1]:
            ax.legend()
        return figure
    if once and page().narrow:
        legends = figure.axes[:1]
    for ax in figure.axes if legends is None else legends:
        if ax.get_legend_handles_labels()[1]:
            _add_legend(figure, ax, once)
    for each in (*figure.legends, *(ax.get_legend() for ax in figure.axes)):
        if each is not None:
            _widen_swarm(each)
    if cut:
        text = "The run diverged beyond these axes; the rest is not drawn."
        figure.suptitle(text, size=page().letters - 1.0, wrap=True)
    for ax in figure.axes:
        # Ticks are chosen by the font size, which a later style must not change.
        ax.tick_params(labelsize=page().letters - 1.0)
        _label_power(ax)
    engine: Any = figure.get_layout_engine()
    if engine is not None:
        figure.align_ylabels()
        engine.set(w_pad=0.07, h_pad=0.07)
        # Axes of equal scales change their shape, and so the places of labels, with each pass.
        for _ in range(1 if figure.axes[0].get_aspect() == "auto" else 4):
            engine.execute(figure)
        figure.set_layout_engine("none")
    return figure


def _label_power(ax: "Axes") -> None:
    """Put the power of ten of a value axis into its label, since the legend is above the axis."""
    from matplotlib.ticker import ScalarFormatter

    formatter = ax.yaxis.get_major_formatter()
    if ax.name == "3d" or not isinstance(formatter, ScalarFormatter):
        return
    formatter.set_useOffset(False)
    formatter.set_locs(list(ax.get_yticks()))
    offset = formatter.get_offset().replace("\u2212", "-")
    if offset:
        ax.yaxis.get_offset_text().set_visible(False)
        name, _, unit = ax.get_ylabel().partition(" (")
        power = f"$10^{{{int(offset.removeprefix('1e'))}}}$"
        ax.set_ylabel(f"{name} ({power} {unit}" if unit else f"{name} ({power})")


def _add_legend(figure: "Figure", ax: "Axes", once: bool) -> None:
    """Add a legend beside the axes, or above them on a narrow page."""
    narrow = page().narrow
    if once and not narrow:
        # Beside all rows, which would otherwise be as high as it.
        figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    elif not narrow and ax.name == "3d":
        figure.legend(loc="upper right", bbox_to_anchor=(0.995, 0.97))
    elif not narrow:
        ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), borderaxespad=0.0)
    elif ax.name == "3d":
        _legend_above_space(figure, ax)
    else:
        look = {"handlelength": 1.4, "columnspacing": 1.0, "handletextpad": 0.5}
        ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=_columns(ax), **look)


def _widen_swarm(legend: Any) -> None:
    """Show the many lines of a swarm as a band."""
    for line, text in zip(legend.get_lines(), legend.get_texts(), strict=False):
        if text.get_text().endswith(" followers"):
            line.set(linewidth=6.0, alpha=0.35)


def _columns(ax: "Axes") -> int:
    """Return how many entries of a legend fit side by side in one column of a page."""
    longest = max(len(text) for text in ax.get_legend_handles_labels()[1])
    return max(1, min(4, int(66 / (longest + 6))))


def _legend_above_space(figure: "Figure", ax: "Axes") -> None:
    """Add a legend above a space, in a higher figure."""
    columns = _columns(ax)
    rows = -(-len(ax.get_legend_handles_labels()[1]) // columns)
    old, more = figure.get_figheight(), 0.17 * rows
    box = ax.get_position()
    scale = old / (old + more)
    figure.set_figheight(old + more)
    ax.set_position((box.x0, box.y0 * scale, box.width, box.height * scale))
    figure.legend(loc="upper left", ncols=columns, handlelength=1.4, columnspacing=1.0)
