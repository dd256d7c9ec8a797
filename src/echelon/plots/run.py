"""The figures of a run, ready for print."""

import bisect
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from echelon.core.types import Array
from echelon.engine.result import Result
from echelon.plots import style as draw
from echelon.results.metrics import SETTLED, formation_errors, output_errors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SNAPSHOTS = 6  # times at which the graph of a few agents is drawn
_EDGES = 5000  # A graph with more edges than this would be a black patch.
_PANELS = 12  # what fits above each other on a page


def figures(result: Result, lyapunov: Sequence[Array] | None = None) -> "dict[str, Figure]":
    """Return the figures that make sense for a run, by name.

    `leader_3d` is the leaders with their references: in space or in the plane where the model has a
    position, else in the phase plane or over time. `trajectories` are all agents, with the graph
    drawn at a few times. `tracking_error` is each output of the leader minus the reference's, and
    exists with a reference. `formation_error` is each follower's distance from its goal, with
    gaps where it is 0. `lyapunov` is V with its derivative, and exists where V is given.

    A run without a stored frame has no figures. Where agents run a million times farther off
    than their start and the reference reach, that is left out, and the figure says so.

    Args:
        result: the run.
        lyapunov: V (T,) and dV/dt (T,), such as `echelon.lyapunov(result)` returns.
    """
    if not len(result.times):
        return {}
    makers: dict[str, Callable[[], Figure | None]] = {
        "leader_3d": lambda: _leader(result),
        "trajectories": lambda: _trajectories(result),
        "tracking_error": lambda: _tracking_error(result),
        "formation_error": lambda: _formation_error(result),
        "lyapunov": lambda: None if lyapunov is None else _lyapunov(result, *lyapunov[:2]),
    }
    with draw.style():
        made = {name: make() for name, make in makers.items()}
    return {name: figure for name, figure in made.items() if figure is not None}


def save_figures(
    result: Result, folder: str | Path, lyapunov: Sequence[Array] | None = None
) -> list[Path]:
    """Write each figure of a run as PNG (150 dpi) and PDF under `folder`/figures; return the paths.

    Args:
        result: the run.
        folder: where `figures` is made, unless it is there.
        lyapunov: V (T,) and dV/dt (T,), or None to leave that figure out.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    return draw.save(figures(result, lyapunov), Path(folder) / "figures")


# ---- in space ---------------------------------------------------------------------------------


def _leader(result: Result) -> "Figure":
    """Return the leaders, each with its reference."""
    axes, leaders = _space(result), list(result.graph.leaders)
    if not axes:
        return _states_over_time(result, leaders)
    keep = draw.thin(len(result.times), 2 * len(leaders))
    paths = result.states[keep][:, leaders][..., axes].swapaxes(0, 1)
    wanted = [_reference(result, agent) for agent in leaders]
    known = [states[keep][:, axes] for states in wanted if states is not None]
    paths, cut = draw.drop_runaways(paths, paths[:, :1], *known)
    figure, ax = _canvas(result, axes)
    for name, path in zip(["reference", *[None] * len(known)], known):
        draw.plot(ax, path, label=name, **_REFERENCE)
    for agent, path in zip(leaders, paths, strict=True):
        draw.plot(ax, path, label=_name(result, agent, short=True), **_pen(result, agent))
    for path, named in zip(paths, [True, *[False] * len(leaders)]):
        for name, place, shape in (("start", path[:1], "o"), ("end", path[-1:], "s")):
            look = draw.dots(shape, draw.LEADER, hollow=name == "start")
            draw.plot(ax, place, label=name if named else None, **look)
    shown = np.concatenate([*paths, *known])
    draw.frame(ax, shown, alike=bool(result.model.position))
    return draw.finish(figure, cut)


def _trajectories(result: Result) -> "Figure":
    """Return the paths of all agents, with the graph drawn at a few times."""
    axes, agents = _space(result), range(result.graph.agents)
    if not axes:
        return _states_over_time(result, agents)
    paths, leader = result.states[:, :, axes], result.graph.leaders[0]
    wanted = _reference(result, leader)
    paths, cut = draw.drop_runaways(paths, paths[0], *([] if wanted is None else [wanted[:, axes]]))
    figure, ax = _canvas(result, axes)
    keep = draw.thin(len(paths), len(agents))
    for agent in _leaders_first(result, agents):
        look = _pen(result, agent)
        draw.plot(ax, paths[keep, agent], label=_name(result, agent, short=True), **look)
    _snapshots(ax, result, paths)
    draw.frame(ax, paths, alike=bool(result.model.position))
    return draw.finish(figure, cut)


def _snapshots(ax: Any, result: Result, paths: Array) -> None:
    """Draw the graph at a few times, agents hollow at the start and square at the end."""
    agents, last = result.graph.agents, len(paths) - 1
    # More snapshots of a swarm would hide each other.
    count = 2 if agents > 50 else _SNAPSHOTS
    frames = np.unique(np.linspace(0, last, count).round().astype(int))
    if len(result.graph.edges) <= _EDGES:
        _graph(ax, result, paths[frames], result.times[frames])
    size = 4.5 * draw.crowding(agents) ** 0.25
    for colour, group in _colours(result).items():
        places = paths[:, group]
        draw.plot(ax, _flatten(places[frames[1:-1]]), **draw.dots(".", colour, size))
        draw.plot(ax, places[0], **draw.dots("o", colour, size, hollow=True))
        draw.plot(ax, places[-1], **draw.dots("s", colour, size))
    # The legend explains the shapes once, in a colour that is nobody's.
    nowhere = np.full((1, paths.shape[2]), np.nan)
    for name, shape in (("start", "o"), ("end", "s")):
        look = draw.dots(shape, draw.EDGE, 4.5, hollow=name == "start")
        draw.plot(ax, nowhere, label=name, **look)


def _graph(ax: Any, result: Result, places: Array, times: Array) -> None:
    """Draw the graph's edges between places (S, N, k) at S times, the later the darker."""
    ends = places[:, result.graph.edges]
    # NaN lifts the pen, so that all edges of a time are one line and not thousands.
    gaps = np.full_like(ends[:, :, :1], np.nan)
    links = np.concatenate([ends, gaps], axis=2)
    text = "graph" if len(times) < 3 else f"graph, every {times[1] - times[0]:.3g} s"
    crowd = draw.crowding(result.graph.agents)
    look = {"linewidth": 0.9 * crowd**0.18, "rasterized": result.graph.agents > 100, "zorder": 3}
    for k, shade in enumerate(np.linspace(0.65, float(draw.EDGE), len(times))):
        name = text if k == len(times) - 1 else None
        draw.plot(ax, _flatten(links[k]), label=name, color=str(shade), **look)


def _flatten(points: Array) -> Array:
    return points.reshape(-1, points.shape[-1])


def _colours(result: Result) -> dict[str, list[int]]:
    """Return the agents of each colour."""
    groups: dict[str, list[int]] = {}
    for agent in range(result.graph.agents):
        groups.setdefault(_pen(result, agent)["color"], []).append(agent)
    return groups


def _reference(result: Result, leader: int) -> Array | None:
    """Return the states (T, n) that a leader should have, or None where it follows nothing."""
    return None if result.reference is None else result.reference + result.formation.offsets[leader]


def _space(result: Result) -> list[int]:
    """Return the states that span the picture: the position's, or both of two; else none."""
    position = list(result.model.position_indices()[:3])
    if len(position) > 1:
        return position
    return [0, 1] if len(result.model.state_names) == 2 else []


def _canvas(result: Result, axes: Sequence[int]) -> "tuple[Figure, Any]":
    return draw.canvas([_label(result, k) for k in axes])


# ---- over time --------------------------------------------------------------------------------


def _states_over_time(result: Result, agents: Iterable[int]) -> "Figure":
    """Return a panel for each state, twelve at most, with a line for each of the agents."""
    agents = list(_leaders_first(result, agents))
    keep, cut = draw.thin(len(result.times), len(agents)), False
    times, wanted = result.times[keep], [_reference(result, agent) for agent in agents]
    # Behind followers too it would hide their lines.
    guides = wanted if set(agents) <= {*result.graph.leaders} else []
    figure, panels = _panels(result, min(len(result.model.state_names), _PANELS), 1.4)
    for k, ax in enumerate(panels):
        paths = result.states[:, agents, k, None]
        known = [wanted[0][:, k, None]] if wanted[0] is not None else []
        values, over = draw.drop_runaways(paths, paths[0], *known)
        for name, guide in zip(["reference", *[None] * len(guides)], guides):
            if guide is not None:
                draw.plot(ax, times, guide[keep, k], label=name, **_REFERENCE)
        for agent, line in zip(agents, values[keep].swapaxes(0, 1), strict=True):
            draw.plot(
                ax, times, line, label=_name(result, agent, short=True), **_pen(result, agent)
            )
        ax.set_ylabel(_label(result, k))
        cut |= over
    return draw.finish(figure, cut, once=True)


def _tracking_error(result: Result) -> "Figure | None":
    """Return the leaders' outputs minus their references', a panel for each unit."""
    if result.reference is None:
        return None
    leaders, model = result.graph.leaders, result.model
    # More leaders than have names would be lines that nobody can tell apart.
    shown = leaders if len(leaders) <= draw.NAMED else leaders[:1]
    units = dict(zip(model.state_names, model.state_units, strict=True))
    # Metres and radians share no axis; a dictionary keeps their order.
    kinds = list(dict.fromkeys(units.get(name, "") for name in model.output_names))
    figure, panels = _panels(result, len(kinds), 1.7)
    keep, cut = draw.thin(len(result.times), len(shown)), False
    for place, leader in enumerate(shown):
        errors, look = output_errors(result, leader), draw.leader_pen(place, result.graph.agents)
        assert errors is not None  # as there is a reference
        for k, name in enumerate(model.output_names):
            values, over = draw.drop_runaways(errors[keep, k, None], errors[:1, k, None])
            own = {"color": draw.COLOURS[k % len(draw.COLOURS)], "linestyle": look["linestyle"]}
            label = name.replace("_", " ") + (f", leader {leader}" if len(leaders) > 1 else "")
            ax = panels[kinds.index(units.get(name, ""))]
            draw.plot(ax, result.times[keep], values, label=label, **own)
            cut |= over
    for ax, unit in zip(panels, kinds, strict=True):
        ax.set_ylabel(draw.label("tracking error", unit))
        ax.axhline(0.0, color="0.75", linewidth=0.6, zorder=1)
    return draw.finish(figure, cut)


def _formation_error(result: Result) -> "Figure":
    """Return each follower's distance from its goal, on a logarithmic axis."""
    followers, many = list(result.graph.followers), result.graph.agents > draw.NAMED
    errors = formation_errors(result)[:, followers]
    keep = draw.thin(len(errors), len(followers))
    times, errors, metric = result.times[keep], errors[keep], result.unit == "m"
    figure, (ax,) = _panels(result, 1, 3.2)
    for agent, line in zip(followers, draw.above_zero(errors).T, strict=True):
        name = draw.say_zero(_name(result, agent, short=True), line)
        draw.plot(ax, times, line, label=name, **_pen(result, agent))
    # Of a swarm no line can be followed; the worst and the median can.
    if many:
        for name, of, dash in (("worst", np.max, "-"), ("median", np.median, "--")):
            look = {"color": draw.LEADER, "linestyle": dash}
            draw.plot(
                ax, times, draw.above_zero(of(errors, axis=1)), label=f"{name} follower", **look
            )
    if metric:
        ax.axhline(SETTLED, color="0.5", linewidth=0.8, linestyle=":", label="1 cm", zorder=1)
    ax.set_ylabel(draw.label("formation error", "m" if metric else ""))
    draw.logarithmic(ax, errors, np.array([SETTLED] if metric else []))
    return draw.finish(figure)


def _lyapunov(result: Result, value: Array, rate: Array) -> "Figure":
    """Return V, and how fast it falls or rises, on logarithmic axes."""
    keep = draw.thin(len(value))
    times, value, rate = result.times[keep], draw.above_zero(value[keep]), rate[keep]
    # V is a square, and what is smaller than that of a floor is its rounding, of both signs.
    moves = np.abs(rate) > draw.FLOOR**2
    figure, panels = _panels(result, 2 if moves.any() else 1, 2.0)
    draw.plot(panels[0], times, value, label=draw.say_zero("V", value), color=draw.LEADER)
    panels[0].set_ylabel("V")
    draw.logarithmic(panels[0], value)
    for ax in panels[1:]:
        for name, speed, colour in zip(
            ("falls", "rises"), (-rate, rate), draw.COLOURS, strict=False
        ):
            shown = np.where(moves & (speed > 0.0), speed, np.nan)
            if not np.isnan(shown).all():
                draw.plot(ax, times, shown, label=f"V {name}", color=colour, linewidth=0.8)
        ax.set_ylabel("|dV/dt| (1/s)")
        draw.logarithmic(ax, np.abs(rate[moves]))
    return draw.finish(figure)


def _panels(result: Result, rows: int, height: float) -> "tuple[Figure, list[Any]]":
    return draw.panels(result.times, result.settings.horizon, rows, height)


# ---- agents -----------------------------------------------------------------------------------

# Broad and pale under a thin leader, it shows where the two coincide.
_REFERENCE = {"color": draw.REFERENCE, "linestyle": (0, (1.6, 0.9)), "linewidth": 3.0, "zorder": 2}


def _name(result: Result, agent: int, short: bool = False) -> str | None:
    """Return an agent's name; where `short`, None for the many of a swarm but its first leader."""
    leaders, few = result.graph.leaders, result.graph.agents <= draw.NAMED
    if agent in leaders:
        if not short or few or len(leaders) <= draw.NAMED:
            return f"leader {agent}"
        return f"{len(leaders)} leaders" if agent == leaders[0] else None
    return f"follower {agent}" if few or not short else None


def _pen(result: Result, agent: int) -> dict[str, Any]:
    leads = agent in result.graph.leaders
    place = bisect.bisect_left(result.graph.leaders if leads else result.graph.followers, agent)
    return (draw.leader_pen if leads else draw.pen)(place, result.graph.agents)


def _leaders_first(result: Result, agents: Iterable[int]) -> list[int]:
    # First drawn are first in the legend; `zorder` and not this decides who is on top.
    return sorted(agents, key=lambda agent: agent not in result.graph.leaders)


def _label(result: Result, k: int) -> str:
    return draw.label(result.model.state_names[k], result.model.state_units[k])
