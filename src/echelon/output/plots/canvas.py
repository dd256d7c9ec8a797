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
        width, side = draw.page().width, draw.page().side
        low, high = fit_box(ax, half, (0.07 * width, 0.45, side, side))
        ax.figure.set_figheight(high[1] - low[1] + 0.75)
        fit_box(ax, half, (0.07 * width, 0.45, side, high[1] - low[1]))
    elif alike:
        ax.set_aspect("equal")
        wide, figure = draw.page().width / 1.4, cast("Figure", ax.figure)
        if draw.target() is None:
            figure.set_figheight(np.clip(0.7 + wide * half[1] / half[0], 2.0, 1.04 * wide))


def fit_box(ax: Any, size: Array, room: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """Scale the box of a space until it fits into a part of its figure, and label its axes.

    Args:
        ax: in space, with its limits.
        size: of the box.
        room: left, bottom, width and height of the part, inches.

    Returns:
        The lower left and the upper right corner of the drawn box, inches.
    """
    zoom = 1.0
    # Under perspective the size is not quite proportional to the zoom.
    for _ in range(3):
        ax.set_box_aspect(size / size.max(), zoom=zoom)
        low, high = _box_on_paper(ax)
        zoom *= (room[2:] / (high - low)).min()
    shift = np.array(room[:2]) + 0.5 * np.array(room[2:]) - 0.5 * (low + high)
    page = ax.figure.get_size_inches()
    ax.set_position(ax.get_position(original=True).translated(*(shift / page)))
    for k, name in enumerate("xyz"):
        # Matplotlib measures these distances in widths of the box.
        wide = size.max() / np.delete(size, k).max()
        getattr(ax, f"{name}axis").labelpad = 18.5 * wide - 21.0
        ax.tick_params(axis=name, pad=8.0 * wide - 8.0)
        ax.locator_params(axis=name, nbins=5 if size[k] > 0.4 * size.max() else 3)
    return low + shift, high + shift


def _box_on_paper(ax: Any) -> tuple[Array, Array]:
    """Return the lower left and upper right corners of a space's box, in inches."""
    ax.apply_aspect()
    corners = list(itertools.product(ax.get_xlim(), ax.get_ylim(), ax.get_zlim(), [1.0]))
    x, y, _, scale = ax.get_proj() @ np.array(corners).T
    pixels = ax.transData.transform(np.column_stack([x, y]) / scale[:, None])
    inches = pixels / ax.figure.dpi
    return inches.min(axis=0), inches.max(axis=0)
