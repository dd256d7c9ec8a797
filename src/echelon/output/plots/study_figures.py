"""Figures of studies: of a comparison, of a sweep, and of a design."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon.core.digits import at_most
from echelon.core.types import Array
from echelon.experiments.results.metrics import SETTLED, output_errors
from echelon.experiments.results.recording import LoopPoles
from echelon.experiments.results.run_numbers import RUN_NUMBERS, settling_bound
from echelon.experiments.results.table_two import (
    HORIZON,
    PRINTED,
    distance_errors,
    is_papers_experiment,
    table_two,
)
from echelon.experiments.studies.basin import (
    Radii,
    StateSlice,
    Trial,
    chosen_slice,
    converged,
    grid,
    observed_radius,
    side_of,
    slice_of,
    trial,
)
from echelon.experiments.studies.compare import PLANNED, PLANNED_LEADER, Comparison
from echelon.experiments.studies.observed_region import ObservedRegion
from echelon.experiments.studies.seed_comparison import SeedComparison, differences
from echelon.experiments.sweeps.plan import SEED, SUMMARIZED
from echelon.experiments.sweeps.sweep_dataset import share_bounds, succeeded
from echelon.guarantees.promises.promise import guarantee
from echelon.output.plots import style as draw
from echelon.output.plots.figure_files import save
from echelon.output.plots.network import poles
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.riccati import Riccati

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TICKS, _COUNTED = 9, 100
"""Most values named at an axis of a map, and most cells with their counts."""
_MOST = 500
_LOST, _CONVERGED = "#F0C9A8", "#CFE3F1"  # pale, under the outlines of the sets
_CERTIFIED, _OBSERVED = 2, 0


def comparison_figures(comparison: Comparison) -> "dict[str, Figure]":
    """Return the figures of a comparison, by name.

    `formation_error` is the worst follower's distance from its goal, `tracking_error` the leader's
    from its reference, and `approach` the path of one follower to its goal. `paper_fig_3b` is the
    paper's figure of that number, of its experiment.
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
            "paper_fig_3b": _paper_figure(comparison.scenario, runs),
        }
    return {name: figure for name, figure in drawings.items() if figure is not None}


def save_comparison_figures(comparison: Comparison | SeedComparison, folder: Path) -> None:
    """Write each figure of a comparison as PNG and PDF under `folder`/figures.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    if isinstance(comparison, SeedComparison):
        save(seed_figures(comparison), folder / "figures")
        return
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
        draw.plot(ax, run.times[keep], values[keep], label=name, **draw.pen(k, draw.NAMED))
        curves.append(values)
    mark = settling_bound(runs[0][2].length_unit)
    ax.axhline(SETTLED, label=mark, **draw.MARK)
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
    figure, ax = draw.canvas([draw.label(f"{names[k]} error", units[k]) for k in axes])
    start, goal = first.errors[:1, follower][:, axes], np.zeros((1, 2))
    drawn, cut = [start, goal], False
    for k, label, run in runs:
        path, over = draw.drop_runaways(run.errors[:, follower][:, axes], start, goal)
        # A path that leaves would shrink the others to a dot.
        inside = np.abs(path).max(axis=1) <= 1.3 * np.abs(start).max()
        path, over = np.where(inside[:, None], path, np.nan), over or not inside.all()
        draw.plot(ax, path[draw.thin(len(path))], label=label, **draw.pen(k, draw.NAMED))
        drawn.append(path)
        cut |= over
    draw.plot(ax, start, label=f"start, F{follower}", **draw.dots("o", draw.LEADER, hollow=True))
    draw.plot(ax, goal, label="goal", **draw.dots("s", draw.LEADER))
    draw.frame(ax, np.concatenate(drawn))
    return draw.finish(figure, cut)


_PAPERS_METHODS = ((PLANNED_LEADER, f"{Riccati.name}-relay"), (PLANNED,))
"""Our labels of the paper's two methods, of which the first that ran is drawn."""


def _paper_figure(scenario: str, runs: _Runs) -> "Figure | None":
    """Return the errors of the followers' distances over the paper's 10 s, of its two methods."""
    first, by_label = runs[0][2], {label: run for _, label, run in runs}
    if not is_papers_experiment(scenario, type(first.model).__name__, first.graph.agents):
        return None
    found = {
        method: next((by_label[label] for label in labels if label in by_label), None)
        for method, labels in zip(PRINTED, _PAPERS_METHODS, strict=True)
    }
    if any(run is None or table_two(run) is None for run in found.values()):
        return None
    figure, [[ax]] = draw.sheet(3.4)
    ax.axhline(0.0, **draw.MARK)
    for (method, run), dash in zip(found.items(), ("-", (0, (3.0, 1.2))), strict=True):
        assert run is not None
        errors, keep = distance_errors(run), draw.thin(len(run.times))
        for k in range(errors.shape[1]):
            name = f"$e_{{F{k + 1}}}$ {method}"
            line = errors[keep, k]
            draw.plot(ax, run.times[keep], line, label=name, color=draw.colour(k), linestyle=dash)
    ax.set(xlim=(0.0, HORIZON), xlabel="time (s)")
    ax.set_ylabel(draw.label("distance, actual less desired", first.length_unit))
    return draw.finish(figure)


# ---- sweeps -----------------------------------------------------------------------------------


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
    return data.sizes[key] > 1 and np.issubdtype(data[key].dtype, np.number)


def _distributions(data: "xr.Dataset") -> "Figure":
    lines: dict[str, _Lines] = {}
    for name in SUMMARIZED:
        text = draw.label(RUN_NUMBERS[name].label, data[name].attrs.get("units", ""))
        lines[text] = {"": data[name].values.ravel()}
    return _shares(lines, data["outcome"].size, "runs")


_Lines = dict[str, Array]
"""Numbers of runs by the label of their line; those that are not finite exceed all others."""


def _shares(lines: dict[str, _Lines], total: int, of: str, signed: bool = False) -> "Figure":
    """Return on which share of `total` runs a number stays below each value, by its name."""
    figure, (axes,) = draw.sheet(2.8, 1, len(lines))
    for ax, (text, curves) in zip(axes, lines.items(), strict=True):
        ax.set_xlabel(text)
        ax.set_ylim(0.0, 1.02)
        for k, (label, numbers) in enumerate(curves.items()):
            values = np.sort(numbers)
            # A share of all runs: those without the number count as above any value.
            share = np.arange(1, len(values) + 1)[np.isfinite(values)] / total
            values = values[np.isfinite(values)]
            keep = draw.thin(len(values))
            look = draw.pen(k, draw.NAMED)
            ax.step(values[keep], share[keep], where="post", label=label, **look)
        finite = np.concatenate([*curves.values()])
        finite = finite[np.isfinite(finite)]
        if signed:
            ax.axvline(0.0, **draw.MARK)
        elif finite.size:
            _scale(ax, "x", finite)
    axes[0].set_ylabel(f"share of {of} below")
    return draw.finish(figure)


def _share(data: "xr.Dataset", keys: list[str]) -> "tuple[xr.DataArray, xr.DataArray]":
    """Return the numbers of settled runs and of all runs over some keys."""
    others = [dim for dim in data["outcome"].dims if dim not in keys]
    present = data["outcome"] != data["outcome"].attrs["flag_values"][0]
    return succeeded(data).sum(others), present.sum(others)


def _success(data: "xr.Dataset", keys: list[str]) -> "Figure":
    figure, (axes,) = draw.sheet(2.8, 1, len(keys[:3]))
    for ax, key in zip(axes, keys, strict=False):
        settled, runs = (part.sortby(key) for part in _share(data, [key]))
        values, rate = settled[key].values, settled.values / np.maximum(1, runs.values)
        low, high = share_bounds(settled.values, np.maximum(1, runs.values))
        bars = np.abs(np.stack([rate - low, high - rate]))
        ax.errorbar(values, rate, bars, color=draw.colour(0), **_dotted())
        _name_values(ax, "x", values)
        ax.set_xlabel(_label(data, key))
        ax.set_ylim(-0.03, 1.03)
    axes[0].set_ylabel("share of runs that settle")
    return draw.finish(figure)


def _region(data: "xr.Dataset", first: str, second: str) -> "Figure":
    settled, runs = (part.sortby([first, second]) for part in _share(data, [first, second]))
    rate = (settled / runs.clip(min=1)).transpose(second, first)
    figure, ((ax,),) = draw.sheet(2.8)
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
    second, first = map(str, settled.dims)
    for (row, column), count in np.ndenumerate(settled.values):
        total = int(runs.values[row, column])
        # The upper end of the colours is bright.
        colour = "black" if count > 0.6 * total else "white"
        place = float(settled[first].values[column]), float(settled[second].values[row])
        look: draw.Style = {"color": colour, "size": "x-small", "ha": "center", "va": "center"}
        ax.text(*place, f"{int(count)}/{total}", **look)


def _label(data: "xr.Dataset", key: str) -> str:
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
    if _is_geometric(values):
        getattr(ax, f"set_{which}scale")("log")


def _name_values(ax: "Axes", which: str, values: Array) -> None:
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


# ---- comparisons over seeds --------------------------------------------------------------------


def seed_figures(comparison: SeedComparison) -> "dict[str, Figure]":
    """Return the figures of a comparison over seeds, by name.

    `quantiles` shows on which share of the seeds each method stays below a number, `differences`
    on which share the number of a method minus that of another does: left of 0 the first is better.
    """
    rows, total = comparison.compared, len(comparison.seeds)
    names = [name for name in SUMMARIZED if name in comparison.names]
    pairs = [*itertools.combinations(rows, 2)][: len(draw.COLOURS)]
    single, double = dict[str, _Lines](), dict[str, _Lines]()
    for name in names:
        text, unit = RUN_NUMBERS[name].label, comparison.unit(name)
        single[draw.label(text, unit)] = {row.label: row.ranked(name) for row in rows}
        double[draw.label(f"{text}, difference", unit)] = {
            f"{a.label} minus {b.label}": differences(name, a, b) for a, b in pairs
        }
    with draw.style():
        figures = {"quantiles": _shares(single, total, "seeds")} if names else {}
        if names and pairs:
            figures["differences"] = _shares(double, total, "seeds", signed=True)
    return figures


# ---- designs ----------------------------------------------------------------------------------


def save_design_figures(
    parts: Parts,
    settings: Settings,
    folder: Path,
    axes: str | None = None,
    region: ObservedRegion | None = None,
) -> tuple[list[Path], Radii | None]:
    """Write `modes` and `certified_set` of a gain as PNG and PDF; return paths and both radii.

    The second figure and the radii are missing for a model of one state, for a loop that does not
    decay, and for more than 500 followers. An observed region is drawn beside the certified set,
    or, where that figure is missing, as `observed_region`.

    Raises:
        GainError: `axes` names no two states of the model.
        OSError: the folder or a file cannot be written.
    """
    loop = guarantee(parts, settings).loop
    figures, radii = {}, None
    sliced = axes is not None or len(parts.model.state_names) > 1
    states = chosen_slice(parts.model, axes) if sliced else None
    with draw.style():
        figures["modes"] = poles(LoopPoles(loop.poles, loop.eigenvalues))
        if states is not None and loop.every and len(parts.graph.followers) <= _MOST:
            figures["certified_set"], radii = _certified_set(parts, settings, states, region)
        elif region is not None:
            figures["observed_region"], ((ax,),) = draw.sheet(3.0)
            _failing(ax, region, None)
            figures["observed_region"] = draw.finish(figures["observed_region"])
    return save(figures, folder), radii


def _certified_set(
    parts: Parts, settings: Settings, states: tuple[int, int], seen: ObservedRegion | None
) -> "tuple[Figure, Radii]":
    """A certified set much smaller than the observed one has a second panel."""
    run, plane = trial(parts, settings), slice_of(parts, states)
    region = guarantee(run.parts, settings).certified
    certified, observed = None if region is None else region.radius, observed_radius(run, plane)
    names = (parts.model.state_names[states[0]], parts.model.state_names[states[1]])
    radii = Radii(names, certified, observed, plane.largest, run.horizon)
    wide = np.minimum(plane.limits, plane.extents(1.8 * max(observed, 1e-2 * plane.largest)))
    panels = [wide]
    if certified and certified < np.inf and (plane.extents(certified) < 0.3 * wide).all():
        panels.append(plane.extents(1.5 * certified))
    figure, (axes,) = draw.sheet(4.0, 1, len(panels) + (seen is not None))
    for ax, half in zip(axes, panels, strict=False):
        _starts(ax, run, plane, half)
        _ellipses(ax, plane, radii, half)
        for name, k in zip("xy", states, strict=True):
            text = draw.label(f"{parts.model.state_names[k]} error", parts.model.state_units[k])
            getattr(ax, f"set_{name}label")(text)
    if len(panels) > 1:
        axes[0].set_title("observed")
        axes[1].set_title("certified")
    if seen is not None:
        _failing(axes[-1], seen, certified_scale(parts, certified or 0.0, seen))
    _legend(figure, axes[0], radii, run)
    return figure, radii


def certified_scale(parts: Parts, radius: float, region: ObservedRegion) -> float:
    """Return a scale up to which all starts of a region are in sum_i delta_i'P delta_i <= r^2."""
    gain, names = parts.drive.gain, parts.model.state_names
    assert gain is not None
    widths = np.array([region.spreads.get(name, 0.0) for name in names])
    # |d'P d| <= w'|P| w for all |d| <= w, entry by entry.
    largest = len(parts.graph.followers) * float(widths @ np.abs(gain.P) @ widths)
    return radius / np.sqrt(largest)


def _dotted() -> draw.Style:
    """Return the look of shares with their bars."""
    return {"fmt": "o:", "markersize": 3.0 * draw.scale("lines.markersize"), "capsize": 2}


def _failing(ax: "Axes", region: ObservedRegion, certified: float | None) -> None:
    """Draw the share of random starts that fail over the scale, and its bound at 95 %."""
    scales, runs = [x.scale for x in region.trials], [x.runs for x in region.trials]
    share = np.array([x.failed for x in region.trials]) / runs
    above = np.array([x.bound for x in region.trials]) - share
    bars = np.stack([np.zeros(len(share)), above])
    look: draw.Style = {"color": draw.colour(_OBSERVED), **_dotted()}
    label = f"of {runs[0]} starts, bound 95 %"
    ax.errorbar(scales, share, bars, label=label, **look)
    if certified and certified < np.inf:
        ax.axvline(certified, color=draw.colour(_CERTIFIED), label="certified (leader at rest)")
    _name_values(ax, "x", np.array(scales))
    ax.set(xlabel="scale of the starts' spreads", ylabel="share of runs that fail")
    ax.set_ylim(-0.03, 1.03)
    ax.legend(loc="best")


def _starts(ax: "Axes", run: Trial, plane: StateSlice, half: Array) -> None:
    from matplotlib.colors import ListedColormap

    side = side_of(run.followers)
    x, y = grid(plane, half, side)
    starts = np.column_stack([part.ravel() for part in np.meshgrid(x, y)])
    inside = converged(run, plane, starts).reshape(side, side)
    colours = ListedColormap([_LOST, _CONVERGED])
    look = {"cmap": colours, "vmin": 0.0, "vmax": 1.0, "rasterized": True, "zorder": 0}
    ax.pcolormesh(x, y, inside.astype(float), shading="nearest", **look)
    draw.plot(ax, np.zeros((1, 2)), **draw.dots("+", draw.EDGE, 6.0))
    ax.grid(False)
    ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))


def _ellipses(ax: "Axes", plane: StateSlice, radii: Radii, half: Array) -> None:
    """Draw the certified and the observed set, if they fit into the axes."""
    ellipses: list[Any] = [(radii.observed, draw.colour(_OBSERVED), (0, (5, 2)), "none")]
    if radii.certified and radii.certified < np.inf:
        ink = draw.colour(_CERTIFIED)
        ellipses.append((radii.certified, ink, "-", ink))
    for radius, colour, dash, fill in ellipses:
        if not radius or (plane.extents(radius) < 0.004 * half).any():
            continue
        points = plane.ellipse(radius, 400)
        points = np.vstack([points, points[:1]])
        ax.plot(*points.T, color=colour, linestyle=dash, zorder=3)
        if fill != "none":
            ax.fill(*points.T, color=fill, alpha=0.25, linewidth=0.0, zorder=2)


def _legend(figure: "Figure", ax: "Axes", radii: Radii, run: Trial) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    certified = "no certified set"
    if radii.certified is not None:
        certified = f"certified, r = {at_most(radii.certified)}"
        certified = certified if radii.certified else "certified: empty"
        certified = "certified everywhere" if radii.certified == np.inf else certified
    observed = f"observed: all tested starts converge, r = {at_most(radii.observed)}"
    lost = f"error not below {100.0 * run.decay:.2g} % after {run.horizon:.3g} s"
    ink = draw.colour(_CERTIFIED) if radii.certified else "none"
    border: dict[str, Any] = {"edgecolor": "0.7"}
    handles: list[Any] = [
        Line2D([], [], color=ink, label=certified),
        Line2D([], [], color=draw.colour(_OBSERVED), linestyle=(0, (5, 2)), label=observed),
        Patch(facecolor=_CONVERGED, label="converges, leader at rest", **border),
        Patch(facecolor=_LOST, label=lost, **border),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
