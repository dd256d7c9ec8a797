"""Figures of a run over time: errors, V, inputs, states, distances."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.types import Array
from echelon.experiments.results.lyapunov import rises
from echelon.experiments.results.metrics import SETTLED
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw
from echelon.output.plots.agent_style import (
    REFERENCE,
    drawn,
    label,
    leaders_first,
    name_of,
    pen_of,
    reference_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINKS = 20_000  # links whose distances are computed, evenly spread over all
_PANELS = 12  # that fit on a page
_START = 3.0
"""Seconds at the start in which inputs change quickly."""
_DESIRED = {"color": "0.4", "linewidth": 0.9, "linestyle": (0, (1.0, 1.5)), "zorder": 1}
_SLOPE = {"color": draw.EDGE, "linewidth": 1.0, "linestyle": (0, (5.0, 2.0)), "zorder": 2.2}


def tracking(run: Recording) -> "Figure | None":
    """Return the tracking errors of the leaders' outputs, a panel for each unit."""
    if run.tracking is None:
        return None
    errors, names, units = run.tracking
    # Nobody can distinguish the lines of more leaders than have names.
    leaders = run.leaders if len(run.leaders) <= draw.NAMED else run.leaders[:1]
    # Metres and radians share no axis; a dictionary keeps their order.
    kinds = list(dict.fromkeys(units))
    figure, panels = _panels(run, len(kinds), 1.7)
    keep, cut = draw.thin(len(run.times), len(leaders)), False
    for place, leader in enumerate(leaders):
        look = draw.leader_pen(place, run.agents)
        for k, name in enumerate(names):
            error = errors[:, place, k, None]
            values, over = draw.drop_runaways(error[keep], error[:1])
            pen = {"color": draw.COLOURS[k % len(draw.COLOURS)], "linestyle": look["linestyle"]}
            text = name.replace("_", " ") + (f", leader {leader}" if len(run.leaders) > 1 else "")
            draw.plot(panels[kinds.index(units[k])], run.times[keep], values, label=text, **pen)
            cut |= over
    for ax, unit in zip(panels, kinds, strict=True):
        ax.set_ylabel(draw.label("tracking error", unit))
        ax.axhline(0.0, color="0.75", linewidth=0.6, zorder=1)
    return draw.finish(figure, cut)


# ---- convergence ------------------------------------------------------------------------------


def formation(run: Recording) -> "Figure":
    """Return each follower's distance from its goal on a logarithmic axis, with the guarantee.

    Of a large swarm it shows quantiles, the median and the worst follower.
    """
    followers, many = list(run.followers), run.agents > draw.NAMED
    keep = draw.thin(len(run.times), len(followers))
    errors, times = run.formation_errors[:, followers], run.times[keep]
    figure, (ax,) = _panels(run, 1, 3.2)
    if many:
        _bands(ax, times, draw.above_zero(errors[keep]))
        _worst(ax, run, times, errors, keep)
    for agent, line in zip(() if many else followers, draw.above_zero(errors[keep]).T):
        name = draw.say_zero(name_of(run, agent), line)
        draw.plot(ax, times, line, label=name, **pen_of(run, agent))
    _slope(ax, run, errors.max(axis=1, initial=0.0), 1.0)
    bound = run.error_bound()
    if bound is not None:
        look = {"color": draw.EDGE, "linewidth": 1.0, "linestyle": (0, (1.0, 1.5)), "zorder": 2.2}
        text = f"bound, by {run.promise['kind']} ({run.promise['theorem']})"
        draw.plot(ax, times, bound[keep], label=text, **look)
    if run.length_unit:
        ax.axhline(SETTLED, color="0.5", linewidth=0.8, linestyle=":", label="1 cm", zorder=1)
    ax.set_ylabel(draw.label("formation error", run.length_unit))
    marks = [SETTLED] if run.length_unit else []
    # The end of the bound may lie far below all errors, so only its start sets the axis.
    draw.logarithmic(ax, errors[keep], np.array(marks if bound is None else [*marks, bound[0]]))
    return draw.finish(figure)


def _bands(ax: "Axes", times: Array, values: Array, of: str = "follower") -> None:
    """Draw quantiles of values (T, N) and the median."""
    with np.errstate(invalid="ignore"):
        # At times at which all values are 0 there is nothing to draw, and no warning.
        some = np.isfinite(values).any(axis=1)
        ends = np.full((5, len(times)), np.nan)
        ends[:, some] = np.nanpercentile(values[some], [5, 25, 50, 75, 95], axis=1)
    look = {"color": draw.COLOURS[0], "linewidth": 0.0, "zorder": 1.5}
    ax.fill_between(times, ends[0], ends[4], alpha=0.18, label="5 to 95 %", **look)
    ax.fill_between(times, ends[1], ends[3], alpha=0.35, label="25 to 75 %", **look)
    draw.plot(ax, times, ends[2], label=f"median {of}", color=draw.COLOURS[0])


def _worst(ax: "Axes", run: Recording, times: Array, errors: Array, keep: Array) -> None:
    """Draw the follower with the largest steady error, and the largest error at each time.

    A run that ended before its steady window is evaluated as a whole.
    """
    window = float(run.attributes.get("steady_window", 0.2 * run.horizon))
    steady = run.times >= run.horizon - window
    with np.errstate(over="ignore", invalid="ignore"):
        place = int(np.argmax((errors[steady if steady.any() else ...] ** 2).sum(axis=0)))
    name = f"worst: follower {run.followers[place]}"
    pen = {"color": draw.COLOURS[1], "zorder": 3}
    draw.plot(ax, times, draw.above_zero(errors[keep, place]), label=name, **pen)
    largest = draw.above_zero(errors[keep].max(axis=1))
    dash = {"linestyle": (0, (1.0, 1.2)), "linewidth": 0.9}
    draw.plot(ax, times, largest, label="largest at each time", **pen, **dash)


def _slope(ax: "Axes", run: Recording, values: Array, times: float) -> None:
    """Draw the guaranteed slope from the largest of values (T,) on."""
    rate, finite = run.rate, np.where(np.isfinite(values), values, 0.0)
    if rate is None or len(run.times) < 2 or finite.max() <= 0.0:
        return
    first = int(finite.argmax())
    t = np.array([run.times[first], run.times[-1]])
    # A line that ends at 0 has no place on a logarithmic axis.
    with np.errstate(under="ignore"):
        line = finite[first] * np.exp(-times * rate * (t - t[0]))
    if line[1] <= 0.0:
        t[1] = t[0] + 600.0 / (times * rate)
        line[1] = finite[first] * np.exp(-600.0)
    # Equal eigenvalues, as of a directed chain, give t^k e^(-rt): the slope holds in the end only.
    name = "guaranteed asymptotic slope" if _has_one_way_link(run) else "guaranteed slope"
    text = f"{name}: \u2212{times * rate:.3g} 1/s"
    draw.plot(ax, t, line, label=text, **_SLOPE)


def _has_one_way_link(run: Recording) -> bool:
    """Return whether a follower sends to another one and receives nothing from it."""
    inner = ~np.isin(run.edges, run.leaders).any(axis=1)
    return bool((run.heard[inner].sum(axis=1) == 1).any())


def lyapunov(run: Recording) -> "Figure | None":
    """Return V and its rate on logarithmic axes; None of a law without V."""
    if run.lyapunov is None or run.lyapunov_rate is None:
        return None
    keep = draw.thin(len(run.times))
    times, value, rate = run.times[keep], run.lyapunov[keep], run.lyapunov_rate[keep]
    value = draw.above_zero(value)
    # V is a square, and rates below the square of the floor are rounding of either sign.
    moves = np.abs(rate) > draw.FLOOR**2
    figure, panels = _panels(run, 2 if moves.any() else 1, 2.0)
    draw.plot(panels[0], times, value, label=draw.say_zero("V", value), color=draw.LEADER)
    _slope(panels[0], run, run.lyapunov, 2.0)
    panels[0].set_ylabel("V")
    draw.logarithmic(panels[0], value)
    for ax in panels[1:]:
        for name, speed, colour in zip(
            ("decreases", "increases"), (-rate, rate), draw.COLOURS, strict=False
        ):
            shown = np.where(moves & (speed > 0.0), speed, np.nan)
            if not np.isnan(shown).all():
                draw.plot(ax, times, shown, label=f"V {name}", color=colour, linewidth=0.8)
        ax.set_ylabel("|dV/dt| (1/s)")
        draw.logarithmic(ax, np.abs(rate[moves]))
        if _increases_between(run):
            text = f"at each frame; V increases in between, inputs held for dt = {run.dt:.3g} s"
            ax.set_title(text, size=draw.page().letters - 1.0, loc="right")
    return draw.finish(figure)


def _increases_between(run: Recording) -> bool:
    """Return whether V increases between two frames with a negative rate."""
    assert run.lyapunov is not None and run.lyapunov_rate is not None
    decreasing = run.lyapunov_rate < 0.0
    return bool(
        (rises(run.lyapunov[:-1], run.lyapunov[1:]) & decreasing[:-1] & decreasing[1:]).any()
    )


# ---- inputs -----------------------------------------------------------------------------------


def inputs(run: Recording) -> "Figure | None":
    """Return the loads of actuators with their limits, at the start and over the whole run.

    Without limits it is each input in its unit.
    """
    loads = run.loads
    rows = _loads(loads) if loads is not None else _inputs(run)
    parts = [run.times <= _START] if draw.page().narrow else [run.times <= _START, run.times >= 0]
    parts = [part for part in parts if part.sum() > 1][: 1 if run.times[-1] <= 2 * _START else 2]
    parts = parts or [run.times >= 0.0]
    figure, axes = draw.grid(len(rows), len(parts), 1.5)
    for (name, values), line in zip(rows.items(), axes, strict=True):
        for part, ax in zip(parts, line, strict=True):
            _agents_over(ax, run, run.times[part], values[part])
            if loads is not None:
                _limits(ax, values[part])
            ax.set_xlim(run.times[part][0], max(run.times[part][-1], 1e-9))
        line[0].set_ylabel(name)
    for part, ax in zip(parts, axes[-1], strict=True):
        end, whole = run.times[part][-1], run.times[-1]
        ax.set_xlabel("time (s)" if end == whole else f"time (s), of {whole:.4g} s")
    return draw.finish(figure, once=True, corner=axes[0][-1])


def _loads(loads: Array) -> dict[str, Array]:
    """Return loads (T, N, k) in % of their limits: the only one, or the largest and smallest."""
    percent = 100.0 * loads
    if percent.shape[2] == 1:
        return {"input\n(% of limit)": percent[:, :, 0]}
    return {
        "largest\n(% of limit)": percent.max(axis=2),
        "smallest\n(% of limit)": percent.min(axis=2),
    }


def _inputs(run: Recording) -> dict[str, Array]:
    pairs = list(zip(run.input_names, run.input_units, strict=True))[:_PANELS]
    return {draw.label(*pair): run.inputs[:, :, k] for k, pair in enumerate(pairs)}


def _limits(ax: "Axes", values: Array) -> None:
    """Draw the limits 0 and 100 %, and shade the area beyond."""
    for value in (0.0, 100.0):
        look = {"color": draw.COLOURS[1], "linewidth": 0.9, "linestyle": (0, (4, 2)), "zorder": 2}
        ax.axhline(value, label="limit" if value else None, **look)
    low, high = min(-8.0, float(np.nanmin(values))), max(108.0, float(np.nanmax(values)))
    ax.axhspan(low, 0.0, color="0.92", zorder=0)
    ax.axhspan(100.0, high, color="0.92", zorder=0)
    ax.set_ylim(low, high)


def _agents_over(ax: "Axes", run: Recording, times: Array, values: Array) -> None:
    """Draw a number of each agent (T, N) as lines, or as quantiles of a large swarm."""
    if run.agents > draw.NAMED:
        keep = draw.thin(len(times), run.agents)
        _bands(ax, times[keep], values[keep][:, list(run.followers)])
        first = run.leaders[0]
        draw.plot(ax, times, values[:, first], label=f"leader {first}", **pen_of(run, first))
        return
    keep = draw.thin(len(times), run.agents)
    for agent in leaders_first(run, range(run.agents)):
        line, _ = draw.drop_runaways(values[keep, agent, None], values[:1, agent, None])
        draw.plot(ax, times[keep], line, label=name_of(run, agent), **pen_of(run, agent))


# ---- states and distances ---------------------------------------------------------------------


def states(run: Recording) -> "Figure":
    """Return the states over time, twelve at most."""
    return states_over_time(run, drawn(run))


def states_over_time(run: Recording, agents: Iterable[int]) -> "Figure":
    """Return a panel for each state, twelve at most, with a line for each agent."""
    agents = list(leaders_first(run, agents))
    keep, cut = draw.thin(len(run.times), len(agents)), False
    times, references = run.times[keep], [reference_of(run, agent) for agent in agents]
    # With followers in the figure references would hide their lines.
    guides = references if set(agents) <= {*run.leaders} else []
    count = min(len(run.state_names), _PANELS)
    # On a narrow page columns of panels would have room for labels only.
    columns = 1 if draw.page().narrow or count <= 4 else 2 if count <= 6 else 3
    figure, panels = draw.panels(run.times, run.horizon, count, 1.4, columns)
    for k, ax in enumerate(panels):
        paths = run.states[:, agents, k, None]
        anchors = [references[0][:, k, None]] if references[0] is not None else []
        values, over = draw.drop_runaways(paths, paths[0], *anchors)
        for name, guide in zip(["reference", *[None] * len(guides)], guides):
            if guide is not None:
                draw.plot(ax, times, guide[keep, k], label=name, **REFERENCE)
        for agent, line in zip(agents, values[keep].swapaxes(0, 1), strict=True):
            name = name_of(run, agent, short=True)
            draw.plot(ax, times, line, label=name, **pen_of(run, agent))
        ax.set_ylabel(label(run, k))
        cut |= over
    return draw.finish(figure, cut, once=True, corner=panels[columns - 1])


def distances(run: Recording) -> "Figure | None":
    """Return the distances of linked agents and their desired values, and the smallest distance.

    None of agents without a position.
    """
    if not run.position:
        return None
    places, columns = run.states[:, :, list(run.position)], list(run.position)
    links = slice(None, None, -(-len(run.edges) // _LINKS) or 1)
    i, j = run.edges[links].T
    keep = draw.thin(len(run.times), max(1, len(i)))
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.linalg.norm(places[keep][:, i] - places[keep][:, j], axis=2)
        desired = np.linalg.norm(run.offsets[i][:, columns] - run.offsets[j][:, columns], axis=1)
    apart[~np.stack([run.linked(t)[links] for t in run.times[keep]])] = np.nan
    figure, (linked, nearest) = _panels(run, 2, 1.9)
    linked.set_ylabel(draw.label("linked agents", "m"))
    _edges(linked, run, run.times[keep], apart, desired)
    few = draw.thin(len(run.times), run.agents)
    least = run.least_distances(few)
    assert least is not None
    draw.plot(nearest, run.times[few], least, color=draw.LEADER, label="any two")
    nearest.set_ylabel(draw.label("smallest distance", "m"))
    nearest.set_ylim(bottom=0.0)
    return draw.finish(figure)


def ages(run: Recording) -> "Figure | None":
    """Return the age of the oldest message of each follower; None in the ideal network."""
    if run.messages is None:
        return None
    followers = list(run.followers)
    keep = draw.thin(len(run.times), len(followers))
    times, values = run.times[keep], run.messages.agents[keep][:, followers]
    figure, (ax,) = _panels(run, 1, 2.6)
    if run.agents > draw.NAMED:
        _bands(ax, times, values)
    for agent, line in zip(followers if run.agents <= draw.NAMED else (), values.T, strict=False):
        draw.plot(ax, times, line, label=name_of(run, agent), **pen_of(run, agent))
    look = {"color": "0.5", "linewidth": 0.8, "linestyle": ":", "zorder": 1}
    ax.axhline(run.messages.forget, label="not used beyond", **look)
    ax.set_ylabel(draw.label("age of the oldest message", "s"))
    ax.set_ylim(bottom=0.0)
    return draw.finish(figure)


def avoidance(run: Recording) -> "Figure | None":
    """Return how near agents came that keep apart, and how many held each other back, over time."""
    numbers = run.avoidance
    if numbers is None:
        return None
    figure, (near, held) = _panels(run, 2, 1.9)
    draw.plot(near, numbers.times, numbers.distance, color=draw.LEADER, label="any two agents")
    look = {"color": "0.5", "linewidth": 0.8, "zorder": 1}
    near.axhline(numbers.kept, label="kept by hulls", linestyle=":", **look)
    near.axhline(numbers.touching, label="touching", linestyle="-", **look)
    near.set_ylabel(draw.label("smallest scaled distance", "m"))
    near.set_ylim(bottom=0.0)
    held.step(numbers.times, numbers.active, where="post", color=draw.LEADER)
    held.set_ylabel("active rows")
    held.set_ylim(bottom=0.0)
    return draw.finish(figure)


def _edges(ax: "Axes", run: Recording, times: Array, apart: Array, desired: Array) -> None:
    """Draw the distance of each edge, or quantiles of the errors of many."""
    if len(run.edges) > draw.NAMED:
        errors = np.abs(apart - desired)
        _bands(ax, times, draw.above_zero(errors), "link")
        ax.set_ylabel("distance error (m)")
        draw.logarithmic(ax, errors)
        return
    for place, (i, j) in enumerate(run.edges):
        look = draw.pen(place, len(run.edges))
        line, _ = draw.drop_runaways(apart[:, place, None], apart[:1, place, None])
        draw.plot(ax, times, line, label=f"{i} to {j}", **look)
        ax.axhline(desired[place], **_DESIRED | {"color": look["color"]})
    # In the legend it has no colour of a link.
    ax.plot([], [], label="desired", **_DESIRED)


def _panels(run: Recording, rows: int, height: float) -> "tuple[Figure, list[Axes]]":
    return draw.panels(run.times, run.horizon, rows, height)
