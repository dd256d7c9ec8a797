"""Figures of the communication graph and of the closed-loop poles."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from echelon.agents.network.switching import Schedule
from echelon.core.digits import at_least
from echelon.core.types import Array
from echelon.experiments.results.recording import LoopPoles, Recording
from echelon.output.plots import style as draw
from echelon.output.plots.style import MOST, count_title, pen_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NUMBERED = 60
"""With more agents than this, their numbers would overlap."""
_STRETCHES = 6
"""Panels of a switching graph."""


def modes(run: Recording) -> "Figure | None":
    """Return the closed-loop poles; None where laws have no linearization."""
    return None if run.modes is None else poles(run.modes)


def poles(loop: LoopPoles) -> "Figure":
    """Return poles in the complex plane, coloured by the eigenvalue of the graph."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import NullLocator

    # The real part of complex eigenvalues, by which couplings are chosen.
    values = np.real(loop.eigenvalues)
    real, imaginary = np.real(loop.poles), np.imag(loop.poles)
    figure, ax = draw.canvas(["real part (1/s)", "imaginary part (rad/s)"])
    colour = np.repeat(values, real.shape[1])
    norm = LogNorm(values[0], values[-1] if values[-1] > values[0] else 1.01 * values[0])
    look = {"norm": norm, "cmap": "viridis", "edgecolors": "white", "zorder": 3}
    dots = ax.scatter(real.ravel(), imaginary.ravel(), 34, colour, **look)
    ax.axvline(0.0, color=draw.EDGE)
    slowest = float(real.max())
    mark: draw.Style = draw.LIMIT | {"color": draw.colour(1)}
    ax.axvline(slowest, **mark)
    _wide_axis(ax, real, imaginary)
    text = f"slowest: {at_least(slowest)} 1/s".replace("-", "\u2212")
    ax.set_title(text, color=draw.colour(1), loc="right")
    # A single eigenvalue needs no colour scale.
    if len(np.unique(values)) > 1:
        bar = figure.colorbar(dots, ax=ax, pad=0.02, aspect=30)
        bar.set_label("eigenvalue \u03bb of the graph")
        if len(values) <= 8:
            bar.set_ticks(values.tolist(), labels=[f"{value:.3g}" for value in values])
            bar.ax.yaxis.set_minor_locator(NullLocator())
    return draw.finish(figure)


def _wide_axis(ax: "Axes", real: Array, imaginary: Array) -> None:
    """Choose scales that show slow and fast poles, with a margin right of the imaginary axis."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    sizes, heights = np.abs(real), np.abs(imaginary)
    least, most = max(float(sizes.min()), 1e-6 * float(sizes.max())), float(sizes.max())
    right = max(0.0, float(real.max()))
    if most > 30.0 * least:
        ax.set_xscale("symlog", linthresh=least, linscale=0.6)
        minus = FuncFormatter(lambda x, _: f"{x:g}".replace("-", "\u2212"))
        ax.xaxis.set_major_formatter(minus)
        powers = 10.0 ** np.arange(np.floor(np.log10(least)), np.ceil(np.log10(most)) + 1.0)
        # Closer to 0 their labels would overlap.
        powers = powers[powers > 0.5 * least]
        ax.xaxis.set_major_locator(FixedLocator([*-powers[::-1], 0.0]))
        # Minor ticks show that the axis is not linear.
        between = np.outer(powers, np.arange(2.0, 10.0)).ravel()
        ax.xaxis.set_minor_locator(FixedLocator([*-between[between < 1.6 * most]]))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.set_xlim(-1.6 * most, 2.0 * right + 0.3 * least)
    else:
        ax.set_xlim(-1.08 * most, 1.1 * right + 0.08 * most)
    oscillating = heights[heights > 1e-9 * most]
    if oscillating.size and heights.max() > 30.0 * np.median(oscillating):
        ax.set_yscale("symlog", linthresh=float(np.median(oscillating)))
    if not oscillating.size:
        ax.set_ylim(-1.0, 1.0)


# ---- the graph --------------------------------------------------------------------------------


def network(run: Recording) -> "Figure":
    """Return the communication graph, with agents at their places in the formation or on a circle.

    An arrow points to the receiver; a line without an arrow is bidirectional, a dotted line is
    inactive. A switching graph has a panel for each of its first six graphs. Of a huge swarm the
    figure shows the agents closest to the leaders.
    """
    whole, run = run, _near_leaders(run)
    places, units = _places(run)
    stretches = _stretches(run)
    columns = min(len(stretches), 2 if draw.page().narrow else 3)
    rows = -(-len(stretches) // columns)
    width = draw.page().width
    # A single panel on a wide page is flatter.
    available = 0.85 * width / columns * (0.75 if columns == 1 and not draw.page().narrow else 1.0)
    size = np.ptp(places, axis=0)
    least = _dot(run, columns) / 144.0 * max(size[0] / available, size[1] / (0.8 * available))
    lines = curves_of(places, run.edges, least)
    size = np.ptp(np.concatenate([places, *lines]), axis=0)
    tall = float(np.clip(size[1] / max(size[0], 1e-9), 0.3, 0.8))
    figure, lattice = draw.sheet(rows * (0.75 + available * tall), rows, columns)
    panels = [ax for line in lattice for ax in line]
    for ax, (title, weights) in zip(panels, stretches, strict=False):
        _agents_and_links(ax, run, places, lines, weights, columns)
        _finish_network(ax, np.concatenate([places, *lines]), units)
        parts = [title, count_title(whole, run.agents)]
        ax.set_title(", ".join(filter(None, parts)))
    for ax in panels[len(stretches) :]:
        ax.axis("off")
    return draw.finish(figure)


def _near_leaders(run: Recording) -> Recording:
    """Return a recording of the agents with the fewest links to a leader."""
    if run.agents <= MOST:
        return run
    from scipy import sparse

    (i, j), ones = run.edges.T, np.ones(len(run.edges), np.int8)
    adjacency = sparse.csr_array(sparse.coo_array((ones, (i, j)), (run.agents, run.agents)))
    far = sparse.csgraph.dijkstra(
        adjacency, directed=False, indices=run.leaders, unweighted=True, min_only=True
    )
    agents = np.sort(np.argsort(far, kind="stable")[:MOST])
    links = np.isin(run.edges, agents).all(axis=1)
    schedule = run.schedule and Schedule(
        run.schedule.starts, run.schedule.weights[:, links], run.schedule.period
    )
    return dataclasses.replace(
        run,
        **{name: getattr(run, name)[:, agents] for name in ("states", "inputs")},
        **{name: getattr(run, name)[agents] for name in ("offsets", "saturated")},
        leaders=tuple(np.flatnonzero(np.isin(agents, run.leaders)).tolist()),
        # Leaders are the first to be kept, so that each agent has its own.
        nearest=np.searchsorted(agents, run.nearest[agents]),
        edges=np.searchsorted(agents, run.edges[links]),
        weights=run.weights[links],
        heard=run.heard[links],
        schedule=schedule,
    )


def _stretches(run: Recording) -> list[tuple[str, Array]]:
    if run.schedule is None:
        return [("", run.weights)]
    spans = list(run.schedule.spans())[:_STRETCHES]
    if len(run.schedule.starts) > _STRETCHES:
        spans[-1] += f", of {len(run.schedule.starts)} intervals"
    return list(zip(spans, run.schedule.weights, strict=False))


def _dot(run: Recording, columns: int) -> float:
    """Return the size of an agent's dot, in points."""
    return 12.0 * draw.crowding(run.agents) ** 0.3 / columns**0.4


def _agents_and_links(
    ax: "Axes", run: Recording, places: Array, lines: list[Array], weights: Array, columns: int
) -> None:
    small = _dot(run, columns) / 12.0
    _links(ax, run, places, lines, weights, small)
    looks = [(a in run.leaders, pen_of(run, a)["color"]) for a in range(run.agents)]
    for look in dict.fromkeys(looks):
        alike = np.array([other == look for other in looks])
        draw.plot(ax, places[alike], **draw.dots("s" if look[0] else "o", look[1], 12.0 * small))
    for agent in range(run.agents if run.agents <= _NUMBERED else 0):
        text = {"color": "white", "size": 7.0 * small**0.5, "zorder": 5}
        ax.annotate(str(agent), tuple(places[agent]), ha="center", va="center", **text)


def _places(run: Recording) -> tuple[Array, tuple[str, ...]]:
    """Return the places of agents (N, 2), and the labels of the axes if these are offsets."""
    offsets = run.offsets[:, list(run.position)]
    spread = np.ptp(offsets, axis=0) if run.position else np.zeros(0)
    axes = np.argsort(-spread, kind="stable")[:2]
    apart = len(np.unique(offsets.round(9), axis=0)) == run.agents
    if len(axes) == 2 and spread[axes[1]] > 1e-9 and apart:
        axes = np.sort(axes)
        names = [run.state_names[run.position[k]] for k in axes]
        return offsets[:, axes], tuple(f"{name} offset (m)" for name in names)
    turn = 2.0 * np.pi * np.arange(run.agents) / run.agents
    return np.column_stack([np.sin(turn), np.cos(turn)]), ()


_BENDS = tuple(side * height for height in (0.16, 0.24, 0.1, 0.34) for side in (1.0, -1.0))
"""Sideways bends of a link, relative to its length, best first."""
_ALONG = np.linspace(0.0, 1.0, 25)[:, None]


def curves_of(places: Array, edges: Array, least: float) -> list[Array]:
    """Return the line (K, 2) of each edge: straight, or bent around other agents.

    A line keeps a distance of `least` from all other places (N, 2): a straight one if possible,
    then the first bend that does, or else the bend with the largest distance. With more agents than
    have numbers all lines are straight.
    """
    straight = list(places[edges])
    if len(places) > _NUMBERED:
        return straight
    return [
        line if _gap(places, edge, line) > least else _bend(places, edge, least)
        for edge, line in zip(edges, straight, strict=True)
    ]


def _bend(places: Array, edge: Array, least: float) -> Array:
    # Links of adjacent agents bend to different sides.
    kinks = [bend * (-1.0) ** int(edge.min()) for bend in _BENDS]
    lines = [_arc(places[edge[0]], places[edge[1]], bend) for bend in kinks]
    gaps = [_gap(places, edge, line) for line in lines]
    clear = [line for line, gap in zip(lines, gaps, strict=True) if gap > least]
    return clear[0] if clear else lines[int(np.argmax(gaps))]


def _arc(first: Array, second: Array, bend: float) -> Array:
    """Return a parabola (K, 2) between two places; `bend` is its height relative to the length."""
    way = second - first
    aside = 4.0 * bend * _ALONG * (1.0 - _ALONG)
    return first + _ALONG * way + aside * np.array([-way[1], way[0]])


def _gap(places: Array, edge: Array, line: Array) -> float:
    """Return the distance of a line (K, 2) from all places (N, 2) but the ends of its edge."""
    others = np.delete(places, edge, axis=0)[:, None]
    if not len(others):
        return np.inf
    begin, way = line[:-1], np.diff(line, axis=0)
    share = ((others - begin) * way).sum(axis=2) / np.maximum((way**2).sum(axis=1), 1e-300)
    nearest = begin + np.clip(share, 0.0, 1.0)[:, :, None] * way
    return float(np.linalg.norm(others - nearest, axis=2).min())


def _links(
    ax: "Axes", run: Recording, places: Array, curves: list[Array], weights: Array, small: float
) -> None:
    from matplotlib.collections import LineCollection, PolyCollection

    wide = np.clip(1.6 * np.sqrt(weights / run.weights.max()), 0.3, 1.6) * small
    wide *= draw.scale("lines.linewidth")
    present, inactive = weights > 0.0, ~run.heard.any(axis=1)
    for mask, dash in ((present & ~inactive, "-"), (present & inactive, (0, (1.0, 2.0)))):
        lines = [curves[k] for k in np.flatnonzero(mask)]
        look = {"linewidths": wide[mask], "colors": "0.55", "linestyles": [dash], "zorder": 1}
        ax.add_collection(LineCollection(lines, **look))
    one = run.heard.sum(axis=1) == 1
    arrows, pens = run.arrows[present[one]], wide[one & present]
    ways = [curves[k] for k in np.flatnonzero(one & present)]
    if run.agents > _NUMBERED:
        tall = 0.4 * float(np.sqrt(np.ptp(places, axis=0).prod() / run.agents))
        heads = PolyCollection(_heads(places[arrows], tall), facecolors="0.35", zorder=2)
        ax.add_collection(heads)
        return
    for (first, second), line, way in zip(arrows, pens, ways, strict=True):
        arrow = {"arrowstyle": "-|>", "color": "0.35", "linewidth": line, "shrinkB": 8.0 * small}
        arrow["connectionstyle"] = f"arc3,rad={_bulge(places[first], places[second], way)}"
        ax.annotate("", tuple(places[second]), tuple(places[first]), arrowprops=arrow, zorder=2)


def _bulge(first: Array, second: Array, line: Array) -> float:
    """Return the `rad` of matplotlib's arc3 for a bent line: its handle's offset by its length."""
    way, aside = second - first, line.mean(axis=0) - 0.5 * (first + second)
    whole = float(way @ way)
    if len(line) == 2 or whole <= 0.0:
        return 0.0
    # Samples of 4 s (1 - s) have this mean, and the handle is twice as far off as the middle.
    mean = float((4.0 * _ALONG * (1.0 - _ALONG)).mean())
    return 2.0 * float(aside @ [way[1], -way[0]]) / (mean * whole)


def _heads(ends: Array, tall: float) -> list[Array]:
    """Return triangles between ends (K, 2, 2), closer to the second."""
    way = ends[:, 1] - ends[:, 0]
    whole = np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]
    aside = np.stack([-way[:, 1], way[:, 0]], axis=1) / whole
    tall_each = np.minimum(tall, 0.3 * whole)
    tip = ends[:, 0] + 0.7 * way
    back, out = tip - tall_each * way / whole, 0.4 * tall_each * aside
    return list(np.stack([tip, back + out, back - out], axis=1))


def _finish_network(ax: "Axes", places: Array, units: tuple[str, ...]) -> None:
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.08 * float((high - low).max()) or 1.0
    low, high = low - margin, high + margin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal")
    if units:
        ax.set(xlabel=units[0], ylabel=units[1])
    else:
        ax.axis("off")
