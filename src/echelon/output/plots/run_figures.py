"""The figures of a run, ready for screen and print; those of paths are drawn here."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.errors import OutputError
from echelon.core.types import Array
from echelon.experiments.results.recording import Recording, recording_of
from echelon.output.plots import network, over_time
from echelon.output.plots import style as draw
from echelon.output.plots.figure_files import NAMES, check_names, save
from echelon.output.plots.style import name_of, pen_of, reference_of
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SNAPSHOTS = 6  # times at which a small graph is drawn
_DENSE = 60  # edges; of a larger graph so many snapshots would hide each other
_EDGES = 5000  # a graph with more edges would be a black patch

_STILL = 1e-6
"""Part of its largest coordinate within which a leader is at rest."""


def leader(run: Recording) -> "Figure | None":
    """Return the leaders, each with its reference; None if all are at rest."""
    axes, leaders = _space(run), list(run.leaders)
    if not axes:
        return over_time.states_over_time(run, leaders)
    keep = draw.thin(len(run.times), 2 * len(leaders))
    paths = run.states[keep][:, leaders][..., axes].swapaxes(0, 1)
    states = [reference_of(run, agent) for agent in leaders]
    references = [row[keep][:, axes] for row in states if row is not None]
    paths, cut = draw.drop_runaways(paths, paths[:, :1], *references)
    lines = [*paths, *references]
    moves = any(np.ptp(line, axis=0).max() > _STILL * np.abs(line).max() for line in lines)
    if len(keep) > 1 and not moves:
        return None
    figure, ax = draw.canvas([draw.label(run.state_names[k], run.state_units[k]) for k in axes])
    for name, path in zip(["reference", *[None] * len(references)], references):
        draw.plot(ax, path, label=name, **draw.REFERENCE)
    for agent, path in zip(leaders, paths, strict=True):
        draw.plot(ax, path, label=name_of(run, agent, short=True), **pen_of(run, agent))
    for path, first in zip(paths, [True, *[False] * len(leaders)]):
        for name, place, shape in (("start", path[:1], "o"), ("end", path[-1:], "s")):
            look = draw.dots(shape, draw.LEADER, hollow=name == "start")
            draw.plot(ax, place, label=name if first else None, **look)
    draw.frame(ax, np.concatenate([*paths, *references]), alike=len(run.position) > 1)
    return draw.finish(figure, cut)


def trajectories(run: Recording) -> "Figure":
    """Return the paths of all agents, with the graph drawn at a few times."""
    axes = _space(run)
    return _paths(run, axes) if axes else over_time.states_over_time(run, draw.drawn(run))


def top_view(run: Recording) -> "Figure | None":
    """Return the paths from above; None if `trajectories` shows that."""
    axes = _space(run)
    return _paths(run, axes[:2]) if len(axes) > 2 else None


def _paths(run: Recording, axes: list[int]) -> "Figure":
    agents, reference = draw.drawn(run), reference_of(run, run.leaders[0])
    paths = run.states[:, agents][:, :, axes]
    anchors = [] if reference is None else [reference[:, axes]]
    paths, cut = draw.drop_runaways(paths, paths[0], *anchors)
    figure, ax = draw.canvas([draw.label(run.state_names[k], run.state_units[k]) for k in axes])
    keep = draw.thin(len(paths), len(agents))
    for agent, path in zip(agents, paths[keep].swapaxes(0, 1), strict=True):
        look = pen_of(run, agent)
        draw.plot(ax, path, label=name_of(run, agent, short=True), **look)
    _snapshots(ax, run, agents, paths)
    draw.frame(ax, paths, alike=bool(run.position))
    ax.set_title(draw.count_title(run, len(agents)))
    return draw.finish(figure, cut)


def _snapshots(ax: "Axes", run: Recording, agents: list[int], paths: Array) -> None:
    """Draw the graph at a few times, agents hollow at the start and square at the end."""
    crowd, last = len(agents), len(paths) - 1
    # More snapshots of a large swarm would hide each other.
    count = 2 if crowd > 50 or len(run.edges) > _DENSE else _SNAPSHOTS
    frames = np.unique(np.linspace(0, last, count).round().astype(int))
    if len(run.edges) <= _EDGES and crowd == run.agents:
        _graph(ax, run, paths[frames][:, np.argsort(agents)], run.times[frames])
    size = 4.5 * draw.crowding(crowd) ** 0.25
    groups: dict[str, list[int]] = {}
    for place, agent in enumerate(agents):
        groups.setdefault(pen_of(run, agent)["color"], []).append(place)
    for colour, group in groups.items():
        places = paths[:, group]
        between = places[frames[1:-1]].reshape(-1, places.shape[-1])
        draw.plot(ax, between, **draw.dots(".", colour, size))
        draw.plot(ax, places[0], **draw.dots("o", colour, size, hollow=True))
        draw.plot(ax, places[-1], **draw.dots("s", colour, size))
    # The legend explains the markers once, in a colour of no agent.
    nowhere = np.full((1, paths.shape[2]), np.nan)
    for name, shape in (("start", "o"), ("end", "s")):
        look = draw.dots(shape, draw.EDGE, 4.5, hollow=name == "start")
        draw.plot(ax, nowhere, label=name, **look)


def _graph(ax: "Axes", run: Recording, places: Array, times: Array) -> None:
    """Draw the graph's edges between places (S, N, k) at S times, the later the darker."""
    ends = places[:, run.edges]
    # NaN interrupts a line, so that all edges of a time are one line instead of thousands.
    gaps = np.full_like(ends[:, :, :1], np.nan)
    links = np.concatenate([ends, gaps], axis=2)
    links[~np.stack([run.linked(t) for t in times])] = np.nan
    text = "graph" if len(times) < 3 else f"graph, every {times[1] - times[0]:.3g} s"
    look = {"rasterized": run.agents > 100, "alpha": min(1.0, (_DENSE / len(run.edges)) ** 0.5)}
    for k, shade in enumerate(np.linspace(0.65, float(draw.EDGE), len(times))):
        name = text if k == len(times) - 1 else None
        draw.plot(
            ax,
            links[k].reshape(-1, links.shape[-1]),
            label=name,
            color=str(shade),
            zorder=3,
            **look,
        )


def _space(run: Recording) -> list[int]:
    """Return the states on the axes: the position's, or both of two; else none."""
    position = list(run.position[:3])
    if len(position) > 1:
        return position
    return [0, 1] if len(run.state_names) == 2 else []


_MAKERS: "dict[str, Callable[[Recording], Figure | None]]" = dict(
    zip(
        NAMES,
        (
            *(leader, trajectories, top_view),
            *(over_time.tracking, over_time.formation, over_time.inputs),
            *(over_time.states, over_time.distances, over_time.lyapunov),
            *(network.modes, network.network, over_time.ages, over_time.avoidance),
        ),
        strict=True,
    )
)
DEFAULT = (
    *("leader_3d", "trajectories", "tracking", "formation", "inputs", "lyapunov"),
    *("ages", "avoidance"),
)
"""Figures that a run writes into its folder."""


def figures(
    run: Result | Recording,
    what: str | Sequence[str] = DEFAULT,
    page: draw.FigureSize = draw.SCREEN,
    ax: "Axes | None" = None,
) -> "dict[str, Figure]":
    """Return figures of a run, by name; those that do not apply to it are missing.

    - `leader_3d`: the leaders with their references, in space, in the plane, or over time
    - `trajectories`: all agents, with the graph at a few times; `top_view`: the same from above
    - `tracking`: each output of the leaders minus its reference
    - `formation`: each follower's distance from its goal, with the guaranteed slope and bound
    - `inputs`: actuator loads with their limits
    - `states`: all states over time
    - `distances`: those of linked agents, and the smallest of any two
    - `lyapunov`: V with its derivative
    - `modes`: the closed-loop poles
    - `network`: the communication graph
    - `ages`: of the oldest message of each follower, over a network
    - `avoidance`: how near agents came that keep apart, and how many held each other back

    A run without a stored frame has no figures. Parts of a diverging run a million times beyond its
    start and reference are not drawn, and the figure says so.

    Args:
        run: a result, or a recording of one.
        what: the name of a figure, or names.
        page: size of the figures, such as `echelon.output.plots.style.ONE_COLUMN`.
        ax: axes of matplotlib into which the one named figure is drawn, such as `formation`,
            `modes`, or the paths of agents in the plane; the figure returned is then theirs.

    Raises:
        OutputError: a name is unknown; or `ax` is given, and `what` are several figures or one that
            has several axes or is in space.
    """
    names = check_names(what)
    if ax is not None and len(names) != 1:
        raise OutputError(f"`ax` takes one figure, and `what` has {len(names)} names.")
    if ax is not None and not hasattr(ax, "figure"):
        raise OutputError(f"`ax` is a `{type(ax).__name__}`, and must be axes of matplotlib.")
    data = recording_of(run)
    if not len(data.times):
        return {}
    with draw.style(page, ax):
        drawings = {name: make(data) for name, make in _MAKERS.items() if name in names}
    return {name: figure for name, figure in drawings.items() if figure is not None}


def save_figures(
    run: Result | Recording, folder: str | Path, what: str | Sequence[str] = DEFAULT
) -> list[Path]:
    """Write figures of a run as PNG (150 dpi) and PDF under `folder`/figures; return the paths.

    Args:
        run: a result, or a recording of one.
        folder: that gets a folder `figures`.
        what: the name of a figure, or names, as `figures` has them.

    Raises:
        OSError: the folder or a file cannot be written.
        OutputError: a name is unknown.
    """
    return save(figures(run, what), Path(folder) / "figures")
