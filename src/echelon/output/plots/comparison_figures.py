"""Figures of a comparison, with one line per method."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.metrics import SETTLED, output_errors
from echelon.experiments.results.run_numbers import settling_bound
from echelon.experiments.studies.compare import Comparison
from echelon.output.plots import style as draw
from echelon.output.plots.canvas import canvas, frame
from echelon.output.plots.figure_files import save
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def comparison_figures(comparison: Comparison) -> "dict[str, Figure]":
    """Return the figures of a comparison, by name.

    `formation_error` is the worst follower's distance from its goal, `tracking_error` the leader's
    from its reference, and `approach` the path of one follower to its goal.
    """
    runs = [
        (k, row.label, row.flight.result)
        for k, row in enumerate(comparison.rows)
        if row.flight is not None and len(row.flight.result.times) > 1
    ]
    if not runs:
        return {}
    with draw.style():
        drawings = {
            "formation_error": _formation_error(runs),
            "tracking_error": _tracking_error(runs),
            "approach": _approach(runs),
        }
    return {name: figure for name, figure in drawings.items() if figure is not None}


def save_comparison_figures(comparison: Comparison, folder: Path) -> None:
    """Write each figure of a comparison as PNG and PDF under `folder`/figures.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    save(comparison_figures(comparison), folder / "figures")


_Runs = list[tuple[int, str, Result]]
"""Place among the methods, label and result of each."""


def _formation_error(runs: _Runs) -> "Figure":
    lines = {k: run.formation_errors.max(axis=1) for k, _, run in runs}
    return _over_time(runs, lines, draw.label("worst formation error", runs[0][2].length_unit))


def _tracking_error(runs: _Runs) -> "Figure | None":
    tracking = {k: output_errors(run) for k, _, run in runs}
    # Only the position, with which the outputs begin, since a yaw is not in metres.
    space = len(runs[0][2].measured)
    lines = {
        k: np.linalg.norm(errors[:, :space], axis=1)
        for k, errors in tracking.items()
        if errors is not None
    }
    if not lines:
        return None
    text = draw.label("leader's tracking error", runs[0][2].length_unit)
    return _over_time([run for run in runs if run[0] in lines], lines, text)


def _count_equal(runs: _Runs, lines: dict[int, Array]) -> dict[int, int]:
    """Return the number of equal lines that each drawn line represents."""
    counts: dict[int, int] = {}
    for k, _, _ in runs:
        # To the bit, as of laws with the same leader, which does not react to its followers.
        same = [j for j in counts if np.array_equal(lines[j], lines[k])]
        counts[same[0] if same else k] = counts.get(same[0], 0) + 1 if same else 1
    return counts


def _over_time(runs: _Runs, lines: dict[int, Array], text: str) -> "Figure":
    """Return errors on a logarithmic axis, with gaps where they are 0."""
    counts = _count_equal(runs, lines)
    # The time axis of the longest run, since others may have ended early.
    longest = max((run for _, _, run in runs), key=lambda run: run.times[-1])
    figure, [[ax]] = draw.sheet(3.4)
    ax.set(xlim=(0.0, max(longest.times[-1], 1e-9)), xlabel="time (s)")
    curves = []
    for k, label, run in runs:
        if k not in counts:
            continue
        values = draw.above_zero(lines[k])
        keep = draw.thin(len(values))
        name = label if counts[k] == 1 else f"{label} and {counts[k] - 1} equal"
        name = draw.say_zero(name, values)
        draw.plot(ax, run.times[keep], values[keep], label=name, **_pen(k))
        curves.append(values)
    mark = settling_bound(runs[0][2].length_unit)
    ax.axhline(SETTLED, color="0.5", linewidth=0.8, linestyle=":", label=mark, zorder=1)
    ax.set_ylabel(text)
    draw.logarithmic(ax, *curves, np.array([SETTLED]))
    return draw.finish(figure)


def _approach(runs: _Runs) -> "Figure | None":
    """Return the path of the follower with the largest initial error, relative to its goal."""
    first = runs[0][2]
    axes = list(first.model.position_indices()[:2])
    if len(axes) < 2:
        return None
    # All methods have the same starts, so that the first gives the follower.
    follower = int(np.argmax(first.goal_distances([0])))
    names, units = first.model.state_names, first.model.state_units
    figure, ax = canvas([draw.label(f"{names[k]} error", units[k]) for k in axes])
    start, goal = first.errors[:1, follower][:, axes], np.zeros((1, 2))
    drawn, cut = [start, goal], False
    for k, label, run in runs:
        path, over = draw.drop_runaways(run.errors[:, follower][:, axes], start, goal)
        # A path that leaves would shrink the others to a dot.
        inside = np.abs(path).max(axis=1) <= 1.3 * np.abs(start).max()
        path, over = np.where(inside[:, None], path, np.nan), over or not inside.all()
        draw.plot(ax, path[draw.thin(len(path))], label=label, **_pen(k))
        drawn.append(path)
        cut |= over
    draw.plot(ax, start, label=f"start, F{follower}", **draw.dots("o", draw.LEADER, hollow=True))
    draw.plot(ax, goal, label="goal", **draw.dots("s", draw.LEADER))
    frame(ax, np.concatenate(drawn))
    return draw.finish(figure, cut)


def _pen(k: int) -> draw.Style:
    return draw.pen(k, draw.NAMED)
