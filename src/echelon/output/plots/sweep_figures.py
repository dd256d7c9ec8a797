"""Figures of a sweep: distributions of errors, and the share of runs that settle over keys."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.run_numbers import RUN_NUMBERS
from echelon.experiments.sweeps.plan import SEED, SUMMARIZED
from echelon.experiments.sweeps.sweep_dataset import share_bounds, succeeded
from echelon.output.plots import style as draw
from echelon.output.plots.figure_files import save

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_TICKS, _COUNTED = 9, 100
"""Most values named at an axis of a map, and most cells with their counts."""


def sweep_figures(data: "xr.Dataset") -> "dict[str, Figure]":
    """Return the figures of a sweep, by name.

    `errors` shows how errors and times are distributed, `success` the share of runs that settle
    over each key of numbers but the seed, with intervals of 95 %, and `region` that share over the
    first two of them.
    """
    keys = [key for key in map(str, data["outcome"].dims) if key != SEED and _is_line(data, key)]
    with draw.style():
        drawings = {"errors": _distributions(data)}
        if keys:
            drawings["success"] = _success(data, keys)
        if len(keys) > 1:
            drawings["region"] = _region(data, keys[0], keys[1])
    return drawings


def save_sweep_figures(data: "xr.Dataset", folder: Path) -> None:
    """Write each figure of a sweep as PNG and PDF under `folder`/figures.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    save(sweep_figures(data), folder / "figures")


def _is_line(data: "xr.Dataset", key: str) -> bool:
    """Return whether the values of a key are several numbers."""
    return data.sizes[key] > 1 and np.issubdtype(data[key].dtype, np.number)


def _canvas(columns: int) -> "tuple[Figure, list[Axes]]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False)[0]
    return figure, list(axes)


def _distributions(data: "xr.Dataset") -> "Figure":
    """Return the shares of runs below each value, as lines."""
    figure, axes = _canvas(len(SUMMARIZED))
    for ax, name in zip(axes, SUMMARIZED, strict=True):
        values = np.sort(data[name].values.ravel())
        values = values[np.isfinite(values)]
        ax.set_xlabel(draw.label(RUN_NUMBERS[name].label, data[name].attrs.get("units", "")))
        ax.set_ylim(0.0, 1.02)
        if not values.size:
            continue
        # A share of all runs: those without the number count as above any value.
        share = np.arange(1, len(values) + 1) / data["outcome"].size
        keep = draw.thin(len(values))
        ax.step(values[keep], share[keep], where="post", color=draw.COLOURS[0])
        _scale(ax, "x", values)
    axes[0].set_ylabel("share of runs below")
    return draw.finish(figure)


def _share(data: "xr.Dataset", keys: list[str]) -> "tuple[xr.DataArray, xr.DataArray]":
    """Return the numbers of settled runs and of all runs over some keys."""
    others = [dim for dim in data["outcome"].dims if dim not in keys]
    present = data["outcome"] != data["outcome"].attrs["flag_values"][0]
    return succeeded(data).sum(others), present.sum(others)


def _success(data: "xr.Dataset", keys: list[str]) -> "Figure":
    figure, axes = _canvas(len(keys[:3]))
    for ax, key in zip(axes, keys, strict=False):
        settled, runs = (part.sortby(key) for part in _share(data, [key]))
        values, rate = settled[key].values, settled.values / np.maximum(1, runs.values)
        low, high = share_bounds(settled.values, np.maximum(1, runs.values))
        bars = np.abs(np.stack([rate - low, high - rate]))
        look = {"marker": "o", "markersize": 3, "linestyle": ":", "elinewidth": 0.9, "capsize": 2}
        ax.errorbar(values, rate, bars, color=draw.COLOURS[0], linewidth=0.7, **look)
        _name_values(ax, "x", values)
        ax.set_xlabel(_label(data, key))
        ax.set_ylim(-0.03, 1.03)
    axes[0].set_ylabel("share of runs that settle")
    return draw.finish(figure)


def _region(data: "xr.Dataset", first: str, second: str) -> "Figure":
    """Return the share of settled runs as colours over two keys."""
    settled, runs = (part.sortby([first, second]) for part in _share(data, [first, second]))
    rate = (settled / runs.clip(min=1)).transpose(second, first)
    figure, (ax,) = _canvas(1)
    ends = []
    for which, key in (("x", first), ("y", second)):
        values = rate[key].values
        _name_values(ax, which, values)
        ends.append(_cell_ends(values))
        getattr(ax, f"set_{which}label")(_label(data, key))
    x, y = ends
    mesh = ax.pcolormesh(x, y, rate.values, vmin=0.0, vmax=1.0, cmap="viridis")
    ax.grid(False)
    if rate.size <= _COUNTED:
        _count(ax, settled.transpose(second, first), runs.transpose(second, first))
    figure.colorbar(mesh, ax=ax, label="share of runs that settle")
    return draw.finish(figure)


def _count(ax: "Axes", settled: "xr.DataArray", runs: "xr.DataArray") -> None:
    """Write into each cell how many of its runs settle."""
    second, first = map(str, settled.dims)
    for (row, column), count in np.ndenumerate(settled.values):
        total = int(runs.values[row, column])
        # The upper end of the colours is bright.
        colour = "black" if count > 0.6 * total else "white"
        place = float(settled[first].values[column]), float(settled[second].values[row])
        look: draw.Style = {"color": colour, "size": draw.page().letters - 3.0}
        ax.text(*place, f"{int(count)}/{total}", ha="center", va="center", **look)


def _label(data: "xr.Dataset", key: str) -> str:
    """Return the label of a key: its meaning and unit, or itself."""
    attributes = data[key].attrs
    return draw.label(str(attributes.get("long_name", key)), str(attributes.get("units", "")))


def _is_geometric(values: Array) -> bool:
    """Return whether values belong on a logarithmic axis: over decades, or by equal factors."""
    values = np.unique(values)
    if values[0] <= 0.0 or len(values) < 2:
        return False
    factors = values[1:] / values[:-1]
    equal = len(values) > 2 and factors.min() > 1.2 and factors.max() < 1.3 * factors.min()
    return bool(values[-1] >= 30.0 * values[0] or equal)


def _scale(ax: "Axes", which: str, values: Array) -> None:
    """Choose a logarithmic axis where values need one."""
    if _is_geometric(values):
        getattr(ax, f"set_{which}scale")("log")


def _name_values(ax: "Axes", which: str, values: Array) -> None:
    """Put ticks of an axis at values, or at some of many."""
    _scale(ax, which, values)
    ticks = values if len(values) <= _TICKS else values[:: -(-len(values) // _TICKS)]
    getattr(ax, f"set_{which}ticks")(ticks, [f"{value:g}" for value in ticks])
    getattr(ax, f"set_{which}ticks")([], minor=True)


def _cell_ends(values: Array) -> Array:
    """Return the ends of cells around ascending values, half way between them on their axis."""
    places = np.log(values) if _is_geometric(values) else values.astype(float)
    between = 0.5 * (places[1:] + places[:-1])
    first, last = 1.5 * places[0] - 0.5 * places[1], 1.5 * places[-1] - 0.5 * places[-2]
    ends = np.concatenate([[first], between, [last]])
    return np.exp(ends) if _is_geometric(values) else ends
