"""Figures of a run over time: errors, V, states, distances."""

import functools
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from echelon.core.digits import at_most
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
from echelon.output.plots.over_time import (
    above,
    bands,
    error_rounding,
    over_time,
    potential_rounding,
    shade_rounding,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINKS = 20_000  # links whose distances are computed, evenly spread over all
_PANELS = 12  # that fit on a page
_DESIRED = {"color": "0.4", "linewidth": 0.9, "linestyle": (0, (1.0, 1.5)), "zorder": 1}
_SLOPE = {"color": draw.EDGE, "linewidth": 1.0, "linestyle": (0, (5.0, 2.0)), "zorder": 2.2}


def tracking(run: Recording) -> "Figure | None":
    """Return the tracking errors of the leaders' outputs, a panel for each unit."""
    if run.tracking is None:
        return None
    errors, names, units = run.tracking
    # Nobody can distinguish the lines of more leaders than have names.
    leaders = run.leaders if len(run.leaders) <= draw.NAMED else run.leaders[:1]
    errors = run.while_present(errors[:, : len(leaders)], leaders)
    cut = [False]

    def show(ax: "Axes", frames: Array, unit: str) -> None:
        outputs = [k for k in range(len(names)) if units[k] == unit]
        for place, leader in enumerate(leaders):
            for k in outputs:
                error = errors[:, place, k, None]
                values, over = draw.drop_runaways(error[frames], error[:1])
                text = names[k].replace("_", " ")
                text += f", leader {leader}" if len(run.leaders) > 1 else ""
                pen = draw.pen(k + place * len(names), draw.NAMED)
                draw.plot(ax, run.times[frames], values, label=text, **pen)
                cut[0] |= over
        ax.set_ylabel(draw.label("tracking error", unit))
        ax.axhline(0.0, color="0.75", linewidth=0.6, zorder=1)

    # Metres and radians share no axis; a dictionary keeps their order.
    shows = [functools.partial(show, unit=unit) for unit in dict.fromkeys(units)]
    figure, axes = over_time(run, shows, 1.7, len(leaders))
    return draw.finish(figure, cut[0], [row[-1] for row in axes])


# ---- convergence ------------------------------------------------------------------------------


def formation(run: Recording) -> "Figure":
    """Return each follower's distance from its goal on a logarithmic axis, with the guarantee.

    Of a large swarm it shows quantiles, the median and the worst follower.
    """
    followers, many = list(run.followers), run.agents > draw.NAMED
    errors, floor, bound = (
        run.formation_errors[:, followers],
        error_rounding(run),
        run.error_bound(),
    )
    marks = [SETTLED] if run.length_unit else []
    # The end of the bound may lie far below all errors, so only its start sets the axis.
    marks = np.array(marks if bound is None else [*marks, bound[0]])

    def show(ax: "Axes", frames: Array) -> None:
        times, values = run.times[frames], above(errors[frames], floor)
        if many:
            bands(ax, times, errors[frames], floor=floor)
            _worst(ax, run, times, errors, frames, floor)
        for agent, line in zip(() if many else followers, values.T):
            zero = draw.above_zero(errors[frames, followers.index(agent)])
            name = draw.say_zero(name_of(run, agent), zero)
            draw.plot(ax, times, line, label=name, **pen_of(run, agent))
        _slope(ax, run, errors.max(axis=1, initial=0.0), 1.0)
        if bound is not None:
            text = f"bound, by {run.promise['kind']} ({run.promise['theorem']})"
            look = _SLOPE | {"linestyle": (0, (1.0, 1.5))}
            draw.plot(ax, times, bound[frames], label=text, **look)
        if run.length_unit:
            ax.axhline(SETTLED, color="0.5", linewidth=0.8, linestyle=":", label="1 cm", zorder=1)
        ax.set_ylabel(draw.label("formation error", run.length_unit))
        draw.logarithmic(ax, errors[frames], marks)
        shade_rounding(ax, floor, errors[frames])

    figure, ((*_, last),) = over_time(run, [show], 3.2, len(followers), alike=False)
    return draw.finish(figure, legends=[last])


def _worst(
    ax: "Axes", run: Recording, times: Array, errors: Array, keep: Array, floor: float
) -> None:
    """Draw the follower with the largest steady error, and the largest error at each time.

    A run that ended before its steady window is evaluated as a whole.
    """
    window = float(run.attributes.get("steady_window", 0.2 * run.horizon))
    steady = run.times >= run.horizon - window
    with np.errstate(over="ignore", invalid="ignore"):
        place = int(np.argmax((errors[steady if steady.any() else ...] ** 2).sum(axis=0)))
    name = f"worst: follower {run.followers[place]}"
    pen = {"color": draw.COLOURS[1], "zorder": 3}
    draw.plot(ax, times, above(errors[keep, place], floor), label=name, **pen)
    largest = above(errors[keep].max(axis=1), floor)
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
    text = f"{name}: \u2212{at_most(times * rate)} 1/s"
    draw.plot(ax, t, line, label=text, **_SLOPE)


def _has_one_way_link(run: Recording) -> bool:
    """Return whether a follower sends to another one and receives nothing from it."""
    inner = ~np.isin(run.edges, run.leaders).any(axis=1)
    return bool((run.heard[inner].sum(axis=1) == 1).any())


def lyapunov(run: Recording) -> "Figure | None":
    """Return V and its rate, by V at the start, on logarithmic axes; None of a law without V."""
    if run.lyapunov is None or run.lyapunov_rate is None:
        return None
    # By its first value V has no unit, which in itself depends on P.
    first = float(run.lyapunov[0]) if run.lyapunov[0] > 0.0 else 1.0
    value, rate, floor = run.lyapunov / first, run.lyapunov_rate / first, potential_rounding(run)
    # V is a square, and rates below the square of the floor are rounding of either sign.
    moves = (np.abs(run.lyapunov_rate) > draw.FLOOR**2) & (run.lyapunov >= floor)

    def show_value(ax: "Axes", frames: Array) -> None:
        shown = above(value[frames], floor / first)
        name = draw.say_zero("V", draw.above_zero(value[frames]))
        draw.plot(ax, run.times[frames], shown, label=name, color=draw.LEADER)
        _slope(ax, run, value, 2.0)
        ax.set_ylabel("V / V(0)")
        draw.logarithmic(ax, value[frames])
        shade_rounding(ax, floor / first, value[frames])

    def show_rate(ax: "Axes", frames: Array) -> None:
        for k, (name, speed) in enumerate((("dV/dt < 0", -rate), ("dV/dt > 0", rate))):
            shown = np.where(moves & (speed > 0.0), speed, np.nan)[frames]
            if not np.isnan(shown).all():
                draw.plot(ax, run.times[frames], shown, label=name, **draw.pen(k, 2))
        ax.set_ylabel("|dV/dt| / V(0) (1/s)")
        draw.logarithmic(ax, np.abs(rate[frames][moves[frames]]))

    shows = [show_value, show_rate] if moves.any() else [show_value]
    figure, axes = over_time(run, shows, 2.0, alike=False)
    if _increases_between(run) and len(axes) > 1:
        text = f"at each frame; V increases in between, inputs held for dt = {run.dt:.3g} s"
        axes[1][-1].set_title(text, size=draw.page().letters - 1.0, loc="right")
    return draw.finish(figure, legends=[row[-1] for row in axes])


def _increases_between(run: Recording) -> bool:
    """Return whether V increases between two frames with a negative rate."""
    assert run.lyapunov is not None and run.lyapunov_rate is not None
    decreasing = run.lyapunov_rate < 0.0
    return bool(
        (rises(run.lyapunov[:-1], run.lyapunov[1:]) & decreasing[:-1] & decreasing[1:]).any()
    )


# ---- states and distances ---------------------------------------------------------------------


def states(run: Recording) -> "Figure":
    """Return the states over time, twelve at most."""
    return states_over_time(run, drawn(run))


def states_over_time(run: Recording, agents: Iterable[int]) -> "Figure":
    """Return a panel for each state, twelve at most, with a line for each agent."""
    agents = list(leaders_first(run, agents))
    references = [reference_of(run, agent) for agent in agents]
    # With followers in the figure references would hide their lines.
    guides = references if set(agents) <= {*run.leaders} else []
    shown = run.while_present(run.states[:, agents], agents)
    cut = [False]

    def show(ax: "Axes", frames: Array, k: int) -> None:
        paths = shown[:, :, k, None]
        anchors = [references[0][:, k, None]] if references[0] is not None else []
        values, over = draw.drop_runaways(paths, paths[0], *anchors)
        for name, guide in zip(["reference", *[None] * len(guides)], guides):
            if guide is not None:
                draw.plot(ax, run.times[frames], guide[frames, k], label=name, **REFERENCE)
        for agent, line in zip(agents, values[frames].swapaxes(0, 1), strict=True):
            name = name_of(run, agent, short=True)
            draw.plot(ax, run.times[frames], line, label=name, **pen_of(run, agent))
        ax.set_ylabel(label(run, k))
        cut[0] |= over

    shows = [functools.partial(show, k=k) for k in range(min(len(run.state_names), _PANELS))]
    figure, axes = over_time(run, shows, 1.4, len(agents))
    return draw.finish(figure, cut[0], [axes[0][-1]], once=True)


def distances(run: Recording) -> "Figure | None":
    """Return the distances of linked agents and their desired values, and the smallest distance.

    The closest pair is marked, and the distance at which agents of their size touch. None of agents
    without a position.
    """
    if not run.position:
        return None
    places, columns = run.states[:, :, list(run.position)], list(run.position)
    links = slice(None, None, -(-len(run.edges) // _LINKS) or 1)
    i, j = run.edges[links].T
    with np.errstate(over="ignore", invalid="ignore"):
        offsets = run.offsets_in()[..., columns]
        desired = np.linalg.norm(offsets[..., i, :] - offsets[..., j, :], axis=-1)

    def show_links(ax: "Axes", frames: Array) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            apart = np.linalg.norm(places[frames][:, i] - places[frames][:, j], axis=2)
        apart[~np.stack([run.linked(t)[links] for t in run.times[frames]])] = np.nan
        ax.set_ylabel(draw.label("linked agents", "m"))
        _edges(ax, run, run.times[frames], apart, desired)

    def show_nearest(ax: "Axes", frames: Array) -> None:
        few = frames[draw.thin(len(frames), run.agents)]
        least = run.least_distances(few)
        assert least is not None
        draw.plot(ax, run.times[few], least, color=draw.LEADER, label="any two")
        _mark_closest(ax, run)
        ax.set_ylabel(draw.label("smallest distance", "m"))
        ax.set_ylim(bottom=0.0)

    figure, axes = over_time(run, [show_links, show_nearest], 1.9, max(1, len(i)))
    return draw.finish(figure, legends=[row[-1] for row in axes])


def _mark_closest(ax: "Axes", run: Recording) -> None:
    """Mark the closest pair, and twice the radius of an agent."""
    closest = run.closest_pair()
    if closest is not None:
        text = "{}: {} and {}".format(f"{closest.distance:.3g} m", *closest.agents)
        where = np.array([closest.time]), np.array([closest.distance])
        draw.plot(ax, *where, label=text, **draw.dots("o", draw.COLOURS[1], 4.0))
    if run.radius is not None:
        look = {"color": draw.EDGE, "linewidth": 0.9, "linestyle": (0, (6, 2))}
        ax.axhline(2.0 * run.radius, label="agents touch", **look)


def ages(run: Recording) -> "Figure | None":
    """Return the age of the oldest message of each follower; None in the ideal network."""
    messages, followers = run.messages, list(run.followers)
    if messages is None:
        return None

    def show(ax: "Axes", frames: Array) -> None:
        times, values = run.times[frames], messages.agents[frames][:, followers]
        if run.agents > draw.NAMED:
            bands(ax, times, values)
        few = followers if run.agents <= draw.NAMED else ()
        for agent, line in zip(few, values.T, strict=False):
            draw.plot(ax, times, line, label=name_of(run, agent), **pen_of(run, agent))
        look = {"color": "0.5", "linewidth": 0.8, "linestyle": ":", "zorder": 1}
        ax.axhline(messages.forget, label="not used beyond", **look)
        ax.set_ylabel(draw.label("age of the oldest message", "s"))
        ax.set_ylim(0.0, 1.05 * top)

    known = np.nan_to_num(messages.agents[:, followers])
    # Of the whole run: the panels of its start and of all of it have one axis.
    top = max(messages.forget, float(known.max(initial=0.0)))
    figure, ((*_, last),) = over_time(run, [show], 2.6, len(followers))
    return draw.finish(figure, legends=[last])


def avoidance(run: Recording) -> "Figure | None":
    """Return how near agents came that keep apart, and how many held each other back, over time."""
    numbers = run.avoidance
    if numbers is None or not len(numbers.times):
        return None

    def slices(frames: Array) -> tuple[Array, Array]:
        within = numbers.times <= run.times[frames[-1]]
        return within, numbers.times[within]

    def show_near(ax: "Axes", frames: Array) -> None:
        within, times = slices(frames)
        draw.plot(
            ax, times, numbers.distance[within], color=draw.LEADER, label="smallest of any two"
        )
        look = {"color": "0.5", "linewidth": 0.8, "zorder": 1}
        ax.axhline(numbers.ellipsoid.limit, label="kept by hulls", linestyle=":", **look)
        ax.axhline(numbers.ellipsoid.touching, label="touching", linestyle="-", **look)
        ax.set_ylabel(draw.label("scaled distance", "m"))
        ax.set_ylim(bottom=0.0)

    def show_held(ax: "Axes", frames: Array) -> None:
        within, times = slices(frames)
        ax.step(times, numbers.active[within], where="post", color=draw.LEADER)
        ax.set_ylabel("active rows")
        ax.set_ylim(bottom=0.0)

    figure, axes = over_time(run, [show_near, show_held], 1.9)
    return draw.finish(figure, legends=[row[-1] for row in axes])


def _edges(ax: "Axes", run: Recording, times: Array, apart: Array, desired: Array) -> None:
    """Draw the distance of each edge, or quantiles of the errors of many."""
    if len(run.edges) > draw.NAMED:
        errors = np.abs(apart - desired)
        floor = error_rounding(run)
        bands(ax, times, errors, "link", floor)
        ax.set_ylabel("distance error (m)")
        draw.logarithmic(ax, errors)
        shade_rounding(ax, floor, errors)
        return
    for place, (i, j) in enumerate(run.edges):
        look = draw.pen(place, len(run.edges))
        line, _ = draw.drop_runaways(apart[:, place, None], apart[:1, place, None])
        draw.plot(ax, times, line, label=f"{i} to {j}", **look)
        ax.axhline(desired[place], **_DESIRED | {"color": look["color"]})
    # In the legend it has no colour of a link.
    ax.plot([], [], label="desired", **_DESIRED)
