"""The pictures of `design`: the modes of a loop, and what is certified beside what is observed."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
    from matplotlib.figure import Figure

_MOST = 500
_LOST, _HELD = "#F0C9A8", "#CFE3F1"  # pale, so that the sets' outlines stand out on them
_CERTIFIED, _OBSERVED = draw.COLOURS[2], draw.COLOURS[0]


def save_design_figures(
    parts: Parts, settings: Settings, folder: Path, asked: str | None = None
) -> tuple[list[Path], Radii | None]:
    """Write `modes` and `certified_set` of a gain as PNG and PDF; return paths and both radii.

    A model of one state has no slice, a loop that does not decay has nothing to show in one, and
    more than 500 followers take too long to run: then the second figure and the radii are missing.

    Raises:
        GainError: the slice asked for is none of the model's.
        OSError: the folder or a file cannot be written.
    """
    loop = promise(parts, settings).loop
    made, radii = {}, None
    sliced = asked is not None or len(parts.model.state_names) > 1
    states = chosen_slice(parts.model, asked) if sliced else None
    with draw.style():
        made["modes"] = poles(LoopPoles(loop.poles, loop.eigenvalues))
        if states is not None and loop.every and len(parts.graph.followers) <= _MOST:
            made["certified_set"], radii = _certified_set(parts, settings, states)
    return save(made, folder), radii


# ---- sets -------------------------------------------------------------------------------------


def _certified_set(
    parts: Parts, settings: Settings, states: tuple[int, int]
) -> "tuple[Figure, Radii]":
    """Return starts of a slice by whether they converge, with the certified ellipse over them.

    A certified set much smaller than the observed one is shown again in a panel of its own.
    """
    from matplotlib.figure import Figure

    run, plane = trial(parts, settings), slice_of(parts, states)
    found = promise(run.parts, settings).certified
    certified, observed = None if found is None else found.radius, observed_radius(run, plane)
    named = (parts.model.state_names[states[0]], parts.model.state_names[states[1]])
    radii = Radii(named, certified, observed, plane.largest, run.horizon)
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
            text = draw.label(
                f"{parts.model.state_names[k]} off the goal", parts.model.state_units[k]
            )
            getattr(ax, f"set_{name}label")(text)
    if len(panels) > 1:
        axes[0].set_title("as far as it is observed", size=10)
        axes[1].set_title("as far as it is certified", size=10)
    _legend(figure, axes[0], radii, run)
    return figure, radii


def _starts(ax: Any, run: Trial, plane: StateSlice, half: Array) -> None:
    """Colour a grid of starts by whether they converge."""
    from matplotlib.colors import ListedColormap

    side = side_of(run.followers)
    x, y = grid(plane, half, side)
    starts = np.column_stack([part.ravel() for part in np.meshgrid(x, y)])
    held = converged(run, plane, starts).reshape(side, side)
    look = {"cmap": ListedColormap([_LOST, _HELD]), "vmin": 0.0, "vmax": 1.0, "rasterized": True}
    ax.pcolormesh(x, y, held.astype(float), shading="nearest", zorder=0, **look)
    ax.plot(0.0, 0.0, **draw.dots("+", draw.EDGE, 6.0))
    ax.grid(False)
    ax.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))


def _ellipses(ax: Any, plane: StateSlice, radii: Radii, half: Array) -> None:
    """Draw the certified and the observed set where they fit into the axes."""
    shown: list[Any] = [(radii.observed, _OBSERVED, (0, (5, 2)), "none")]
    if radii.certified and radii.certified < np.inf:
        shown.append((radii.certified, _CERTIFIED, "-", _CERTIFIED))
    for radius, colour, dash, fill in shown:
        if not radius or (plane.extents(radius) < 0.004 * half).any():
            continue
        points = plane.ellipse(radius, 400)
        points = np.vstack([points, points[:1]])
        ax.plot(*points.T, color=colour, linestyle=dash, linewidth=1.5, zorder=3)
        if fill != "none":
            ax.fill(*points.T, color=fill, alpha=0.25, linewidth=0.0, zorder=2)


def _legend(figure: "Figure", ax: Any, radii: Radii, run: Trial) -> None:
    """Name colours and lines above the panels."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    proved = "no set is certified"
    if radii.certified is not None:
        proved = "certified" + (" empty" if not radii.certified else f", r = {radii.certified:.3g}")
        proved = "certified everywhere" if radii.certified == np.inf else proved
    seen = f"all starts tried converge, r = {radii.observed:.3g}"
    lost = f"error not below {100.0 * run.decay:.2g} % after {run.horizon:.3g} s"
    ink = _CERTIFIED if radii.certified else "none"
    handles: list[Any] = [
        Line2D([], [], color=ink, linewidth=1.5, label=proved),
        Line2D([], [], color=_OBSERVED, linestyle=(0, (5, 2)), linewidth=1.5, label=seen),
        Patch(facecolor=_HELD, edgecolor="0.7", linewidth=0.5, label="converges, leader at rest"),
        Patch(facecolor=_LOST, edgecolor="0.7", linewidth=0.5, label=lost),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
