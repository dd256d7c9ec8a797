"""The figures of a comparison: one line a method."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.metrics import SETTLED, formation_errors, output_errors
from echelon.experiments.studies.compare import Comparison, ComparisonRow
from echelon.output.plots import style as draw
from echelon.output.plots.figure_files import save
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def comparison_figures(comparison: Comparison) -> "dict[str, Figure]":
    """Return the figures of a comparison, by name.

    `formation_error` is the worst follower's distance from its goal, `tracking_error` the leader's
    from its reference, and `approach` one follower's way to its goal, all with one line a method.
    """
    flown = [(k, row) for k, row in enumerate(comparison.rows) if _frames(row)]
    if not flown:
        return {}
    with draw.style():
        made = {
            "formation_error": _formation_error(flown),
            "tracking_error": _tracking_error(flown),
            "approach": _approach(flown),
        }
    return {name: figure for name, figure in made.items() if figure is not None}


def save_comparison_figures(comparison: Comparison, folder: Path) -> None:
    """Write each figure of a comparison as PNG and PDF under `folder`/figures.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    save(comparison_figures(comparison), folder / "figures")


_Flown = list[tuple[int, ComparisonRow]]


def _frames(row: ComparisonRow) -> bool:
    return row.flight is not None and len(row.flight.result.times) > 1


def _result(row: ComparisonRow) -> Result:
    assert row.flight is not None
    return row.flight.result


def _formation_error(flown: _Flown) -> "Figure":
    lines = {k: formation_errors(_result(row)).max(axis=1) for k, row in flown}
    metric = _result(flown[0][1]).unit == "m"
    return _over_time(flown, lines, draw.label("worst formation error", "m" if metric else ""))


def _tracking_error(flown: _Flown) -> "Figure | None":
    found = {k: output_errors(_result(row)) for k, row in flown}
    # The outputs begin with the position, so that a yaw is not added to metres.
    space = len(_result(flown[0][1]).measured)
    lines = {
        k: np.linalg.norm(errors[:, :space], axis=1)
        for k, errors in found.items()
        if errors is not None
    }
    if not lines:
        return None
    metric = _result(flown[0][1]).unit == "m"
    text = draw.label("leader's tracking error", "m" if metric else "")
    return _over_time([(k, row) for k, row in flown if k in lines], lines, text)


def _count_alike(flown: _Flown, lines: dict[int, Array]) -> dict[int, int]:
    """Return how many lines each stands for: laws that share a leader draw one over the other."""
    stands: dict[int, int] = {}
    for k, _ in flown:
        # To the bit: laws that share a leader, who does not react to them, share its run.
        same = [j for j in stands if np.array_equal(lines[j], lines[k])]
        stands[same[0] if same else k] = stands.get(same[0], 0) + 1 if same else 1
    return stands


def _over_time(flown: _Flown, lines: dict[int, Array], text: str) -> "Figure":
    """Return errors on a logarithmic axis, with gaps where they are 0."""
    stands = _count_alike(flown, lines)
    # A run that ended early has fewer frames, and the axis is that of the others.
    longest = max((_result(row) for _, row in flown), key=lambda result: result.times[-1])
    figure, (ax,) = draw.panels(longest.times, longest.settings.horizon, 1, 3.4)
    shown = []
    for k, row in flown:
        if k not in stands:
            continue
        values = draw.above_zero(lines[k])
        keep = draw.thin(len(values))
        name = row.label if stands[k] == 1 else f"{row.label}, and {stands[k] - 1} alike"
        name = draw.say_zero(name, values)
        draw.plot(ax, _result(row).times[keep], values[keep], label=name, **_pen(k))
        shown.append(values)
    ax.axhline(SETTLED, color="0.5", linewidth=0.8, linestyle=":", label="1 cm", zorder=1)
    ax.set_ylabel(text)
    draw.logarithmic(ax, *shown, np.array([SETTLED]))
    return draw.finish(figure)


def _approach(flown: _Flown) -> "Figure | None":
    """Return how the follower that starts worst comes to its goal, seen from its leader."""
    first = _result(flown[0][1])
    axes = list(first.model.position_indices()[:2])
    if len(axes) < 2:
        return None
    # All methods begin from the same deviations, so that the first can choose.
    follower = int(np.argmax(formation_errors(first)[0]))
    names, units = first.model.state_names, first.model.state_units
    figure, ax = draw.canvas([draw.label(f"{names[k]} error", units[k]) for k in axes])
    start, goal = first.errors[:1, follower][:, axes], np.zeros((1, 2))
    drawn, cut = [start, goal], False
    for k, row in flown:
        path, over = draw.drop_runaways(_result(row).errors[:, follower][:, axes], start, goal)
        # One that leaves would shrink the others' ways to a dot.
        inside = np.abs(path).max(axis=1) <= 1.3 * np.abs(start).max()
        path, over = np.where(inside[:, None], path, np.nan), over or not inside.all()
        draw.plot(ax, path[draw.thin(len(path))], label=row.label, **_pen(k))
        drawn.append(path)
        cut |= over
    draw.plot(ax, start, label=f"start, F{follower}", **draw.dots("o", draw.LEADER, hollow=True))
    draw.plot(ax, goal, label="goal", **draw.dots("s", draw.LEADER))
    draw.frame(ax, np.concatenate(drawn))
    return draw.finish(figure, cut)


def _pen(k: int) -> dict[str, Any]:
    dash = "-" if k < len(draw.COLOURS) else (0, (3, 1.2))
    return {"color": draw.COLOURS[k % len(draw.COLOURS)], "linestyle": dash}
