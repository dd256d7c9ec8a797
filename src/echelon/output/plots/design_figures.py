"""Figures of `echelon design`: closed-loop poles, and certified and observed regions."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon.core.digits import at_most
from echelon.core.types import Array
from echelon.experiments.results.recording import LoopPoles
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
from echelon.guarantees.promises.promise import promise
from echelon.output.plots import style as draw
from echelon.output.plots.figure_files import save
from echelon.output.plots.network import poles
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST = 500
_LOST, _CONVERGED = "#F0C9A8", "#CFE3F1"  # pale, under the outlines of the sets
_CERTIFIED, _OBSERVED = draw.COLOURS[2], draw.COLOURS[0]


def save_design_figures(
    parts: Parts, settings: Settings, folder: Path, axes: str | None = None
) -> tuple[list[Path], Radii | None]:
    """Write `modes` and `certified_set` of a gain as PNG and PDF; return paths and both radii.

    The second figure and the radii are missing for a model of one state, for a loop that does not
    decay, and for more than 500 followers.

    Raises:
        GainError: `axes` names no two states of the model.
        OSError: the folder or a file cannot be written.
    """
    loop = promise(parts, settings).loop
    figures, radii = {}, None
    sliced = axes is not None or len(parts.model.state_names) > 1
    states = chosen_slice(parts.model, axes) if sliced else None
    with draw.style():
        figures["modes"] = poles(LoopPoles(loop.poles, loop.eigenvalues))
        if states is not None and loop.every and len(parts.graph.followers) <= _MOST:
            figures["certified_set"], radii = _certified_set(parts, settings, states)
    return save(figures, folder), radii


# ---- sets -------------------------------------------------------------------------------------


def _certified_set(
    parts: Parts, settings: Settings, states: tuple[int, int]
) -> "tuple[Figure, Radii]":
    """Return the starts in a slice that converge, with the certified ellipse over them.

    A certified set much smaller than the observed one has a second panel.
    """
    from matplotlib.figure import Figure

    run, plane = trial(parts, settings), slice_of(parts, states)
    region = promise(run.parts, settings).certified
    certified, observed = None if region is None else region.radius, observed_radius(run, plane)
    names = (parts.model.state_names[states[0]], parts.model.state_names[states[1]])
    radii = Radii(names, certified, observed, plane.largest, run.horizon)
    wide = np.minimum(plane.limits, plane.extents(1.8 * max(observed, 1e-2 * plane.largest)))
    panels = [wide]
    if certified and certified < np.inf and (plane.extents(certified) < 0.3 * wide).all():
        panels.append(plane.extents(1.5 * certified))
    figure = Figure((7.0, 4.0), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, half in zip(axes, panels, strict=True):
        _starts(ax, run, plane, half)
        _ellipses(ax, plane, radii, half)
        for name, k in zip("xy", states, strict=True):
            text = draw.label(f"{parts.model.state_names[k]} error", parts.model.state_units[k])
            getattr(ax, f"set_{name}label")(text)
    if len(panels) > 1:
        axes[0].set_title("observed", size=10)
        axes[1].set_title("certified", size=10)
    _legend(figure, axes[0], radii, run)
    return figure, radii


def _starts(ax: "Axes", run: Trial, plane: StateSlice, half: Array) -> None:
    """Colour a grid of starts by whether they converge."""
    from matplotlib.colors import ListedColormap

    side = side_of(run.followers)
    x, y = grid(plane, half, side)
    starts = np.column_stack([part.ravel() for part in np.meshgrid(x, y)])
    inside = converged(run, plane, starts).reshape(side, side)
    colours = ListedColormap([_LOST, _CONVERGED])
    look = {"cmap": colours, "vmin": 0.0, "vmax": 1.0, "rasterized": True, "zorder": 0}
    ax.pcolormesh(x, y, inside.astype(float), shading="nearest", **look)
    ax.plot(0.0, 0.0, **draw.dots("+", draw.EDGE, 6.0))
    ax.grid(False)
    ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))


def _ellipses(ax: "Axes", plane: StateSlice, radii: Radii, half: Array) -> None:
    """Draw the certified and the observed set, if they fit into the axes."""
    ellipses: list[Any] = [(radii.observed, _OBSERVED, (0, (5, 2)), "none")]
    if radii.certified and radii.certified < np.inf:
        ellipses.append((radii.certified, _CERTIFIED, "-", _CERTIFIED))
    for radius, colour, dash, fill in ellipses:
        if not radius or (plane.extents(radius) < 0.004 * half).any():
            continue
        points = plane.ellipse(radius, 400)
        points = np.vstack([points, points[:1]])
        ax.plot(*points.T, color=colour, linestyle=dash, linewidth=1.5, zorder=3)
        if fill != "none":
            ax.fill(*points.T, color=fill, alpha=0.25, linewidth=0.0, zorder=2)


def _legend(figure: "Figure", ax: "Axes", radii: Radii, run: Trial) -> None:
    """Draw the legend above the panels."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    certified = "no certified set"
    if radii.certified is not None:
        certified = f"certified, r = {at_most(radii.certified)}"
        certified = certified if radii.certified else "certified: empty"
        certified = "certified everywhere" if radii.certified == np.inf else certified
    observed = f"observed: all tested starts converge, r = {at_most(radii.observed)}"
    lost = f"error not below {100.0 * run.decay:.2g} % after {run.horizon:.3g} s"
    ink = _CERTIFIED if radii.certified else "none"
    border: dict[str, Any] = {"edgecolor": "0.7", "linewidth": 0.5}
    handles: list[Any] = [
        Line2D([], [], color=ink, linewidth=1.5, label=certified),
        Line2D([], [], color=_OBSERVED, linestyle=(0, (5, 2)), linewidth=1.5, label=observed),
        Patch(facecolor=_CONVERGED, label="converges, leader at rest", **border),
        Patch(facecolor=_LOST, label=lost, **border),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
