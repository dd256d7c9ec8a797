"""Axes in the plane or in space whose directions have one scale."""

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from echelon.core.errors import OutputError
from echelon.core.types import Array
from echelon.output.plots import style as draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def canvas(labels: Sequence[str]) -> "tuple[Figure, Axes]":
    """Return axes in the plane or in space, for two or three labels."""
    if len(labels) == 2:
        figure, ((ax,),) = draw.sheet(0.6 * draw.page().width)
    else:
        figure, ax = _space()
    for name, text in zip("xyz", labels, strict=False):
        getattr(ax, f"set_{name}label")(text)
    return figure, ax


def _space() -> "tuple[Figure, Any]":
    from matplotlib.figure import Figure

    if draw.target() is not None:
        raise OutputError("this figure is in space and sets its own box; leave `ax` out.")
    figure = Figure((draw.page().width, draw.page().width))
    ax: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", computed_zorder=False)
    ax.view_init(elev=30.0, azim=-60.0)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_color("0.5")
    return figure, ax


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
    if len(half) == 3:
        _fit_box(ax, half)
    elif alike:
        ax.set_aspect("equal")
        wide, figure = draw.page().width / 1.4, cast("Figure", ax.figure)
        if draw.target() is None:
            figure.set_figheight(np.clip(0.7 + wide * half[1] / half[0], 2.0, 1.04 * wide))


def _fit_box(ax: Any, half: Array) -> None:
    """Scale the box of a space to the width or height of the figure, and fit the figure to it."""
    width, side = draw.page().width, draw.page().side
    available, left = np.array([side, side]), 0.07 * width
    ax.set_position((0.0, 0.0, side / width, side / width))
    ax.set_box_aspect(half / half.max())
    zoom = 1.0
    # Under perspective the size is not quite proportional to the zoom, so it is corrected once.
    for _ in range(2):
        low, high = _box_on_paper(ax)
        zoom *= (available / (high - low)).min()
        ax.set_box_aspect(half / half.max(), zoom=zoom)
    low, high = _box_on_paper(ax)
    height = high[1] - low[1] + 0.75
    corner = np.array([left + 0.5 * (available[0] - high[0] + low[0]), 0.45]) - low
    ax.figure.set_figheight(height)
    ax.set_position((corner[0] / width, corner[1] / height, side / width, side / height))
    _label_box(ax, half)


def _label_box(ax: Any, half: Array) -> None:
    """Choose the ticks of a box, with the same distance of labels for any box."""
    from matplotlib.ticker import MaxNLocator

    for k, name in enumerate("xyz"):
        axis, count = getattr(ax, f"{name}axis"), 5 if half[k] > 0.4 * half.max() else 3
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))
        # Matplotlib measures these distances in widths of the box.
        stretch = draw.page().side / 5.6 * half.max() / np.delete(half, k).max()
        axis.labelpad = 24.5 * stretch - (15.0 if draw.page().narrow else 21.0)
        ax.tick_params(axis=name, pad=11.0 * stretch - 8.0)


def _box_on_paper(ax: Any) -> tuple[Array, Array]:
    """Return the lower left and upper right corners of a space's box, in inches."""
    ax.apply_aspect()
    corners = list(itertools.product(ax.get_xlim(), ax.get_ylim(), ax.get_zlim(), [1.0]))
    x, y, _, scale = ax.get_proj() @ np.array(corners).T
    pixels = ax.transData.transform(np.column_stack([x, y]) / scale[:, None]) - ax.bbox.p0
    inches = pixels / ax.figure.dpi
    return inches.min(axis=0), inches.max(axis=0)
