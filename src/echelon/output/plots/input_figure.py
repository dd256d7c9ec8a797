"""The figure of the inputs of a run, or of the loads of its actuators."""

import functools
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw
from echelon.output.plots.agent_style import leaders_first, name_of, pen_of
from echelon.output.plots.over_time import bands, over_time

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PANELS = 12  # that fit on a page
_DWARFS = 4.0
"""Times the range of nearly all inputs from which on the others are cut off."""


def inputs(run: Recording) -> "Figure | None":
    """Return the loads of actuators with their limits, at the start and over the whole run.

    Without limits it is each input in its unit. An axis is clipped where few values dwarf the rest,
    and its title says so.
    """
    loads = run.loads
    rows = _loads(loads) if loads is not None else _inputs(run)

    def show(ax: "Axes", frames: Array, name: str, values: Array) -> None:
        _agents_over(ax, run, run.times[frames], values[frames])
        if loads is not None:
            _limits(ax, values)
        _clip(ax, values, loads is not None)
        ax.set_ylabel(name)

    shows = [functools.partial(show, name=name, values=values) for name, values in rows.items()]
    figure, axes = over_time(run, shows, 1.5, run.agents, narrow_start=True)
    for row in axes:
        for ax in row[:-1]:
            ax.set_title("", loc="right")
    return draw.finish(figure, legends=[axes[0][-1]], once=True)


def _clip(ax: "Axes", values: Array, limited: bool) -> None:
    """Clip an axis to what 98 % of the values need, where the others are beyond four times that."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return
    (low, high), (least, most) = np.percentile(finite, [1.0, 99.0]), (finite.min(), finite.max())
    if limited:
        low, high = min(low, 0.0), max(high, 100.0)
    size = max(float(high - low), 1e-12)
    if most - least <= _DWARFS * size:
        return
    ax.set_ylim(low - 0.15 * size, high + 0.15 * size)
    text = f"clipped: values from {least:.3g} to {most:.3g}"
    ax.set_title(text, size=draw.page().letters - 1.0, loc="right")


def _loads(loads: Array) -> dict[str, Array]:
    """Return loads (T, N, k) in % of their limits: the only one, or the largest and smallest."""
    percent = 100.0 * loads
    if percent.shape[2] == 1:
        return {"input\n(% of limit)": percent[:, :, 0]}
    return {
        "largest\n(% of limit)": percent.max(axis=2),
        "smallest\n(% of limit)": percent.min(axis=2),
    }


def _inputs(run: Recording) -> dict[str, Array]:
    pairs = list(zip(run.input_names, run.input_units, strict=True))[:_PANELS]
    return {draw.label(*pair): run.inputs[:, :, k] for k, pair in enumerate(pairs)}


def _limits(ax: "Axes", values: Array) -> None:
    """Draw the limits 0 and 100 %, and shade the area beyond."""
    for value in (0.0, 100.0):
        look = {"color": draw.EDGE, "linewidth": 0.9, "linestyle": (0, (6, 2)), "zorder": 2}
        ax.axhline(value, label="limit" if value else None, **look)
    low, high = min(-8.0, float(np.nanmin(values))), max(108.0, float(np.nanmax(values)))
    ax.axhspan(low, 0.0, color="0.92", zorder=0)
    ax.axhspan(100.0, high, color="0.92", zorder=0)
    ax.set_ylim(low, high)


def _agents_over(ax: "Axes", run: Recording, times: Array, values: Array) -> None:
    """Draw a number of each agent (T, N) as lines, or as quantiles of a large swarm."""
    if run.agents > draw.NAMED:
        bands(ax, times, values[:, list(run.followers)])
        first = run.leaders[0]
        draw.plot(ax, times, values[:, first], label=f"leader {first}", **pen_of(run, first))
        return
    for agent in leaders_first(run, range(run.agents)):
        line, _ = draw.drop_runaways(values[:, agent, None], values[:1, agent, None])
        draw.plot(ax, times, line, label=name_of(run, agent), **pen_of(run, agent))
