"""Figures of paths: in space, from above, in a phase plane."""

from typing import TYPE_CHECKING

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw
from echelon.output.plots.over_time import states_over_time
from echelon.output.plots.style import name_of, pen_of, reference_of

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
        return states_over_time(run, leaders)
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
    return _paths(run, axes) if axes else states_over_time(run, draw.drawn(run))


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
