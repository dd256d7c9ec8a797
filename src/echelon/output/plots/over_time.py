"""Panels over time: the start of a run enlarged beside the whole of it."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SETTLES = 0.05
"""Share of their largest value that errors have where the start of a run ends."""
_SPANS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_USUAL = 3.0
"""Seconds of a start whose errors do not settle."""
_ULPS = 8.0
"""Units in the last place of the largest coordinate below which a difference is rounding."""

_RUNAWAY = 1e6
"""Times its size at the start from which on a coordinate has run away."""

Show: TypeAlias = "Callable[[Axes, Int[np.ndarray, ' F']], None]"
"""Draws some frames of a panel."""


def start_of(run: Recording) -> float:
    """Return the seconds at the start in which the errors settle, rounded up to a plain number."""
    worst = run.formation_errors.max(axis=1, initial=0.0)
    worst = np.where(np.isfinite(worst), worst, np.inf)
    late = np.flatnonzero(worst > _SETTLES * worst[0])
    if not late.size or late[-1] + 1 >= len(worst):
        return _USUAL
    settled = float(run.times[late[-1] + 1] - run.times[0])
    if settled <= 0.0:
        return _USUAL
    power = 10.0 ** np.floor(np.log10(settled))
    return float(next(span * power for span in _SPANS if span * power >= 0.999 * settled))


def over_time(
    run: Recording,
    shows: "Sequence[Show]",
    height: float,
    lines: int = 1,
    narrow_start: bool = False,
    alike: bool = True,
) -> "tuple[Figure, list[list[Axes]]]":
    """Return a row of panels for each of what is shown: the start of the run, and the whole.

    The whole alone where the run is short, on a narrow page and in the caller's axes; the start
    alone on a narrow page with `narrow_start`.

    Args:
        run: of T frames.
        shows: draw some frames into a panel.
        height: of a row, inches.
        lines: that a panel has, of which each has fewer points the more there are.
        narrow_start: whether a narrow page has the start.
        alike: whether the start has the value axis of the whole.
    """
    parts, narrow = _parts(run, narrow_start), draw.page().narrow
    height *= draw.page().letters / 10.0 if narrow else 1.0
    size = float(np.clip(height * len(shows), 2.3 if narrow else 3.2, draw.HIGHEST))
    share = "row" if alike else False
    figure, axes = draw.sheet(size, len(shows), len(parts), sharex="col", sharey=share)
    for show, row in zip(shows, axes, strict=True):
        for part, ax in zip(parts, row, strict=True):
            show(ax, part[draw.thin(len(part), lines)])
            ax.set_ylabel(ax.get_ylabel() if ax is row[0] else "")
    for part, ax in zip(parts, axes[-1], strict=True):
        _label_time(ax, run, part)
    for row in axes:
        for ax in row:
            mark_events(ax, run, row is axes[0] and ax is row[-1])
    return figure, axes


def mark_events(ax: "Axes", run: Recording, named: bool) -> None:
    """Draw a line at the time of each event, with what happened."""
    for event in run.events:
        ax.axvline(event["at"], color="0.55", linewidth=0.8, linestyle=(0, (3.0, 2.0)), zorder=1)
        if named:
            where = {"transform": ax.get_xaxis_transform(), "rotation": 90, "va": "top"}
            look = {"ha": "right", "size": 7, "color": "0.35", "clip_on": True}
            ax.text(event["at"], 0.98, f"{event['text']} ", **where, **look)


def _parts(run: Recording, narrow_start: bool) -> list[Int[np.ndarray, " F"]]:
    """Return the frames of each column."""
    whole, start = np.arange(len(run.times)), np.flatnonzero(run.times <= start_of(run))
    if run.times[-1] <= 2.0 * start_of(run) or len(start) < 3 or draw.target() is not None:
        return [whole]
    if draw.page().narrow:
        return [start] if narrow_start else [whole]
    return [start, whole]


def _label_time(ax: "Axes", run: Recording, part: Int[np.ndarray, " F"]) -> None:
    """Set the limits of a column, and name it."""
    first, last, whole = run.times[part[0]], run.times[part[-1]], run.times[-1]
    # A margin for a single frame, whose dot the axis would cut in half.
    ends = (float(first), float(last)) if last > first else (-0.02 * run.horizon, run.horizon)
    ax.set_xlim(ends)
    ax.set_xlabel("time (s)" if last == whole else f"time (s), of {whole:.4g} s")
    ax.tick_params(labelbottom=True)


# ---- rounding ---------------------------------------------------------------------------------


def rounding_of(run: Recording) -> Float[np.ndarray, " n"]:
    """Return what rounding leaves of differences between agents, for each state."""
    single = run.attributes.get("precision") == "float32"
    eps = np.finfo(np.float32 if single else np.float64).eps
    sizes, begin = np.abs(run.states), np.abs(run.offsets).max(axis=0)
    begin = np.maximum(begin, sizes[0].max(axis=0))
    # Of a run that diverged what it was before.
    within = np.where(sizes <= _RUNAWAY * np.maximum(begin, 1.0), sizes, 0.0)
    return _ULPS * eps * np.maximum(within.max(axis=(0, 1)), begin)


def error_rounding(run: Recording) -> float:
    """Return the formation error that is rounding."""
    return float(np.linalg.norm(rounding_of(run)[list(run.measured)]))


def potential_rounding(run: Recording) -> float:
    """Return the V that is rounding; 0 if no P is stored.

    V is 1/2 sum_ij L_ij delta_i'P delta_j, and no eigenvalue of L is above twice the largest sum of
    an agent's weights.
    """
    if run.metric is None:
        return 0.0
    size = rounding_of(run)
    degrees = np.zeros(run.agents)
    for end in (0, 1):
        np.add.at(degrees, run.edges[:, end], run.weights)
    return float(len(run.followers) * degrees.max() * (size @ np.abs(run.metric) @ size))


def shade_rounding(ax: "Axes", floor: float, *values: Array) -> bool:
    """Shade what is rounding at the lower end of a logarithmic axis, if values lie there."""
    finite = np.concatenate([np.ravel(value) for value in values])
    below = finite[np.isfinite(finite) & (finite > 0.0)] < floor
    if not below.any():
        return False
    low, high = np.log10(floor), np.log10(ax.get_ylim()[1])
    ax.set_ylim(bottom=10.0 ** (low - 0.06 * (high - low)))
    ax.axhspan(ax.get_ylim()[0], floor, color="0.88", zorder=0.5, label="rounding")
    return True


def above(values: Array, floor: float) -> Array:
    """Return values with NaN where they are rounding, which is shaded instead."""
    return np.where(values >= floor, draw.above_zero(values), np.nan)


def bands(
    ax: "Axes", times: Array, values: Array, of: str = "follower", floor: float | None = None
) -> None:
    """Draw quantiles of values (T, N) and the median, cut off where they are rounding."""
    with np.errstate(invalid="ignore"):
        # At times at which all values are 0 there is nothing to draw, and no warning.
        some = np.isfinite(values).any(axis=1)
        ends = np.full((5, len(times)), np.nan)
        ends[:, some] = np.nanpercentile(values[some], [5, 25, 50, 75, 95], axis=1)
    if floor is not None:
        # Of all values: without those below it the quantiles of the others would be higher.
        ends[:2], ends[2:] = np.maximum(ends[:2], floor), above(ends[2:], floor)
    look = {"color": draw.COLOURS[0], "linewidth": 0.0, "zorder": 1.5}
    ax.fill_between(times, ends[0], ends[4], alpha=0.18, label="5 to 95 %", **look)
    ax.fill_between(times, ends[1], ends[3], alpha=0.35, label="25 to 75 %", **look)
    draw.plot(ax, times, ends[2], label=f"median {of}", color=draw.COLOURS[0])
