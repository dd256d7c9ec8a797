"""Figures of a run over time: errors, V, states, distances, inputs; its start beside the whole."""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from echelon.core.digits import at_most
from echelon.core.types import Array
from echelon.experiments.results.lyapunov import rises
from echelon.experiments.results.metrics import SETTLED
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw
from echelon.output.plots.style import name_of, pen_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINKS = 20_000  # links whose distances are computed, evenly spread over all
_PANELS = 12  # that fit on a page
_DWARFS = 4.0
"""Times the range of nearly all inputs from which on the others are cut off."""

_SETTLES = 0.05
"""Share of their largest value that errors have where the start of a run ends."""
_SPANS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_USUAL = 3.0
"""Seconds of a start whose errors do not settle."""
_ULPS = 8.0
"""Units in the last place of the largest coordinate below which a difference is rounding."""

_RUNAWAY = 1e6
"""Times its size at the start from which on a coordinate has run away."""

Show: TypeAlias = "Callable[[Axes, Int[np.ndarray, ' F']], None]"
"""Draws some frames of a panel."""


def start_of(run: Recording) -> float:
    """Return the seconds at the start in which the errors settle, rounded up to a plain number."""
    worst = run.formation_errors.max(axis=1, initial=0.0)
    worst = np.where(np.isfinite(worst), worst, np.inf)
    late = np.flatnonzero(worst > _SETTLES * worst[0])
    if not late.size or late[-1] + 1 >= len(worst):
        return _USUAL
    settled = float(run.times[late[-1] + 1] - run.times[0])
    if settled <= 0.0:
        return _USUAL
    power = 10.0 ** np.floor(np.log10(settled))
    return float(next(span * power for span in _SPANS if span * power >= 0.999 * settled))


def over_time(
    run: Recording,
    shows: "Sequence[Show]",
    height: float,
    lines: int = 1,
    narrow_start: bool = False,
    alike: bool = True,
) -> "Figure":
    """Return a row of panels for each of what is shown: the start of the run, and the whole.

    The whole alone where the run is short, on a narrow page and in the caller's axes; the start
    alone on a narrow page with `narrow_start`.

    Args:
        run: of T frames.
        shows: draw some frames into a panel.
        height: of a row, inches.
        lines: that a panel has, of which each has fewer points the more there are.
        narrow_start: whether a narrow page has the start.
        alike: whether the start has the value axis of the whole.
    """
    first, narrow = np.flatnonzero(run.times <= start_of(run)), draw.page().narrow
    parts = [first, np.arange(len(run.times))]
    if run.times[-1] <= 2.0 * start_of(run) or len(first) < 3 or draw.target() is not None:
        parts = parts[1:]
    elif narrow:
        parts = parts[:1] if narrow_start else parts[1:]
    height *= draw.page().letters / 10.0 if narrow else 1.0
    size = float(np.clip(height * len(shows), 2.3 if narrow else 3.2, draw.HIGHEST))
    share = "row" if alike else False
    figure, axes = draw.sheet(size, len(shows), len(parts), sharex="col", sharey=share)
    for show, row in zip(shows, axes, strict=True):
        for part, ax in zip(parts, row, strict=True):
            show(ax, part[draw.thin(len(part), lines)])
            ax.set_ylabel(ax.get_ylabel() if ax is row[0] else "")
            mark_events(ax, run, row is axes[0] and ax is row[-1])
    for part, ax in zip(parts, axes[-1], strict=True):
        begin, last, whole = (float(run.times[k]) for k in (part[0], part[-1], -1))
        # A margin for a single frame, whose dot the axis would cut in half.
        ax.set_xlim((begin, last) if last > begin else (-0.02 * run.horizon, run.horizon))
        ax.set_xlabel("time (s)" if last == whole else f"time (s), of {whole:.4g} s")
    return figure


def mark_events(ax: "Axes", run: Recording, named: bool) -> None:
    """Draw a line at the time of each event, with what happened."""
    for event in run.events:
        ax.axvline(event["at"], **draw.LIMIT | {"zorder": 1})
        if named:
            where = {"transform": ax.get_xaxis_transform(), "rotation": 90, "va": "top"}
            look = {"ha": "right", "size": "x-small", "color": draw.EDGE, "clip_on": True}
            ax.text(event["at"], 0.98, f"{event['text']} ", **where, **look)


# ---- rounding ---------------------------------------------------------------------------------


def rounding_of(run: Recording) -> Float[np.ndarray, " n"]:
    """Return what rounding leaves of differences between agents, for each state."""
    single = run.attributes.get("precision") == "float32"
    eps = np.finfo(np.float32 if single else np.float64).eps
    sizes, begin = np.abs(run.states), np.abs(run.offsets).max(axis=0)
    begin = np.maximum(begin, sizes[0].max(axis=0))
    # Of a run that diverged what it was before.
    within = np.where(sizes <= _RUNAWAY * np.maximum(begin, 1.0), sizes, 0.0)
    return _ULPS * eps * np.maximum(within.max(axis=(0, 1)), begin)


def error_rounding(run: Recording) -> float:
    """Return the formation error that is rounding."""
    return float(np.linalg.norm(rounding_of(run)[list(run.measured)]))


def potential_rounding(run: Recording) -> float:
    """Return the V that is rounding; 0 if no P is stored.

    V is 1/2 sum_ij L_ij delta_i'P delta_j, and no eigenvalue of L is above twice the largest sum of
    an agent's weights.
    """
    if run.metric is None:
        return 0.0
    size = rounding_of(run)
    degrees = np.zeros(run.agents)
    for end in (0, 1):
        np.add.at(degrees, run.edges[:, end], run.weights)
    return float(len(run.followers) * degrees.max() * (size @ np.abs(run.metric) @ size))


def shade_rounding(ax: "Axes", floor: float, *values: Array) -> bool:
    """Shade what is rounding at the lower end of a logarithmic axis, if values lie there."""
    finite = np.concatenate([np.ravel(value) for value in values])
    below = finite[np.isfinite(finite) & (finite > 0.0)] < floor
    if not below.any():
        return False
    low, high = np.log10(floor), np.log10(ax.get_ylim()[1])
    ax.set_ylim(bottom=10.0 ** (low - 0.06 * (high - low)))
    ax.axhspan(ax.get_ylim()[0], floor, color="0.88", zorder=0.5, label="rounding")
    return True


def above(values: Array, floor: float) -> Array:
    """Return values with NaN where they are rounding, which is shaded instead."""
    return np.where(values >= floor, draw.above_zero(values), np.nan)


def bands(
    ax: "Axes", times: Array, values: Array, of: str = "follower", floor: float | None = None
) -> None:
    """Draw quantiles of values (T, N) and the median, cut off where they are rounding."""
    with np.errstate(invalid="ignore"):
        # At times at which all values are 0 there is nothing to draw, and no warning.
        some = np.isfinite(values).any(axis=1)
        ends = np.full((5, len(times)), np.nan)
        ends[:, some] = np.nanpercentile(values[some], [5, 25, 50, 75, 95], axis=1)
    if floor is not None:
        # Of all values: without those below it the quantiles of the others would be higher.
        ends[:2], ends[2:] = np.maximum(ends[:2], floor), above(ends[2:], floor)
    look = {"color": draw.colour(0), "linewidth": 0.0, "zorder": 1.5}
    ax.fill_between(times, ends[0], ends[4], alpha=0.18, label="5 to 95 %", **look)
    ax.fill_between(times, ends[1], ends[3], alpha=0.35, label="25 to 75 %", **look)
    draw.plot(ax, times, ends[2], label=f"median {of}", color=draw.colour(0))


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
        ax.axhline(0.0, **draw.MARK)

    # Metres and radians share no axis; a dictionary keeps their order.
    shows = [functools.partial(show, unit=unit) for unit in dict.fromkeys(units)]
    return draw.finish(over_time(run, shows, 1.7, len(leaders)), cut[0])


# ---- convergence ------------------------------------------------------------------------------


def formation(run: Recording) -> "Figure":
    """Return each follower's distance from its goal on a logarithmic axis, with the guarantee.

    Of a large swarm it shows quantiles, the median and the worst follower.
    """
    followers, many = list(run.followers), run.agents > draw.NAMED
    errors = run.formation_errors[:, followers]
    floor = error_rounding(run)
    bound = run.error_bound()
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
            text = f"bound, by {run.guarantee['kind']} ({run.guarantee['theorem']})"
            draw.plot(ax, times, bound[frames], label=text, color=draw.EDGE, linestyle="-.")
        if run.length_unit:
            ax.axhline(SETTLED, label="1 cm", **draw.MARK)
        ax.set_ylabel(draw.label("formation error", run.length_unit))
        draw.logarithmic(ax, errors[frames], marks)
        shade_rounding(ax, floor, errors[frames])

    return draw.finish(over_time(run, [show], 3.2, len(followers), alike=False))


def _worst(
    ax: "Axes", run: Recording, times: Array, errors: Array, keep: Array, floor: float
) -> None:
    """A run that ended before its steady window is evaluated as a whole."""
    window = float(run.attributes.get("steady_window", 0.2 * run.horizon))
    steady = run.times >= run.horizon - window
    with np.errstate(over="ignore", invalid="ignore"):
        place = int(np.argmax((errors[steady if steady.any() else ...] ** 2).sum(axis=0)))
    name = f"worst: follower {run.followers[place]}"
    pen = {"color": draw.colour(1), "zorder": 3}
    draw.plot(ax, times, above(errors[keep, place], floor), label=name, **pen)
    largest = above(errors[keep].max(axis=1), floor)
    draw.plot(ax, times, largest, label="largest at each time", linestyle=":", **pen)


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
    inner = ~np.isin(run.edges, run.leaders).any(axis=1)
    name = "asymptotic slope" if (run.heard[inner].sum(axis=1) == 1).any() else "slope"
    text = f"guaranteed {name}: \u2212{at_most(times * rate)} 1/s"
    draw.plot(ax, t, line, label=text, **draw.LIMIT)


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
    figure, falls = over_time(run, shows, 2.0, alike=False), run.lyapunov_rate < 0.0
    between = rises(run.lyapunov[:-1], run.lyapunov[1:]) & falls[:-1] & falls[1:]
    if between.any() and moves.any():
        text = f"at each frame; V increases in between, inputs held for dt = {run.dt:.3g} s"
        figure.axes[-1].set_title(text, loc="right")
    return draw.finish(figure)


# ---- states and distances ---------------------------------------------------------------------


def states(run: Recording) -> "Figure":
    """Return the states over time, twelve at most."""
    return states_over_time(run, draw.drawn(run))


def states_over_time(run: Recording, agents: Iterable[int]) -> "Figure":
    """Return a panel for each state, twelve at most, with a line for each agent."""
    agents = list(draw.leaders_first(run, agents))
    references = [draw.reference_of(run, agent) for agent in agents]
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
                draw.plot(ax, run.times[frames], guide[frames, k], label=name, **draw.REFERENCE)
        for agent, line in zip(agents, values[frames].swapaxes(0, 1), strict=True):
            name = name_of(run, agent, short=True)
            draw.plot(ax, run.times[frames], line, label=name, **pen_of(run, agent))
        ax.set_ylabel(draw.label(run.state_names[k], run.state_units[k]))
        cut[0] |= over

    shows = [functools.partial(show, k=k) for k in range(min(len(run.state_names), _PANELS))]
    return draw.finish(over_time(run, shows, 1.4, len(agents)), cut[0])


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
        desired = np.broadcast_to(desired, (len(run.times), len(i)))

    def show_links(ax: "Axes", frames: Array) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            apart = np.linalg.norm(places[frames][:, i] - places[frames][:, j], axis=2)
        apart[~np.stack([run.linked(t)[links] for t in run.times[frames]])] = np.nan
        ax.set_ylabel(draw.label("linked agents", "m"))
        _edges(ax, run, run.times[frames], apart, desired[frames])

    def show_nearest(ax: "Axes", frames: Array) -> None:
        few = frames[draw.thin(len(frames), run.agents)]
        least = run.least_distances(few)
        assert least is not None
        draw.plot(ax, run.times[few], least, color=draw.LEADER, label="any two")
        closest = run.closest_pair()
        if closest is not None:
            text = "{}: {} and {}".format(f"{closest.distance:.3g} m", *closest.agents)
            where = np.array([closest.time]), np.array([closest.distance])
            draw.plot(ax, *where, label=text, **draw.dots("o", draw.colour(1), 4.0))
        if run.radius is not None:
            ax.axhline(2.0 * run.radius, label="agents touch", **draw.LIMIT)
        ax.set_ylabel(draw.label("smallest distance", "m"))
        ax.set_ylim(bottom=0.0)

    return draw.finish(over_time(run, [show_links, show_nearest], 1.9, max(1, len(i))))


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
        ax.axhline(messages.forget, label="not used beyond", **draw.MARK)
        ax.set_ylabel(draw.label("age of the oldest message", "s"))
        ax.set_ylim(0.0, 1.05 * top)

    known = np.nan_to_num(messages.agents[:, followers])
    # Of the whole run: the panels of its start and of all of it have one axis.
    top = max(messages.forget, float(known.max(initial=0.0)))
    return draw.finish(over_time(run, [show], 2.6, len(followers)))


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
        least = numbers.distance[within]
        draw.plot(ax, times, least, color=draw.LEADER, label="smallest of any two")
        ax.axhline(numbers.ellipsoid.limit, label="kept by hulls", **draw.MARK)
        ax.axhline(numbers.ellipsoid.touching, label="touching", **draw.LIMIT)
        ax.set_ylabel(draw.label("scaled distance", "m"))
        ax.set_ylim(bottom=0.0)

    def show_held(ax: "Axes", frames: Array) -> None:
        within, times = slices(frames)
        ax.step(times, numbers.active[within], where="post", color=draw.LEADER)
        ax.set_ylabel("active rows")
        ax.set_ylim(bottom=0.0)

    return draw.finish(over_time(run, [show_near, show_held], 1.9))


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
        draw.plot(ax, times, desired[:, place], **draw.MARK | {"color": look["color"]})
    # In the legend it has no colour of a link.
    ax.plot([], [], label="desired", **draw.MARK)


# ---- inputs -----------------------------------------------------------------------------------


def inputs(run: Recording) -> "Figure | None":
    """Return the loads of actuators with their limits, at the start and over the whole run.

    Without limits it is each input in its unit. An axis is clipped where few values dwarf the rest,
    and its title says so.
    """
    loads, pairs = run.loads, zip(run.input_names, run.input_units, strict=True)
    rows = {draw.label(*pair): run.inputs[:, :, k] for k, pair in enumerate(pairs)}
    rows = dict([*rows.items()][:_PANELS])
    if loads is not None:
        ends = {"largest": 100.0 * loads.max(axis=2), "smallest": 100.0 * loads.min(axis=2)}
        ends = ends if loads.shape[2] > 1 else {"input": 100.0 * loads[:, :, 0]}
        rows = {f"{name}\n(% of limit)": values for name, values in ends.items()}

    def show(ax: "Axes", frames: Array, name: str, values: Array) -> None:
        _agents_over(ax, run, run.times[frames], values[frames])
        if loads is not None:
            _limits(ax, values)
        _clip(ax, values, loads is not None)
        ax.set_ylabel(name)

    shows = [functools.partial(show, name=name, values=values) for name, values in rows.items()]
    figure = over_time(run, shows, 1.5, run.agents, narrow_start=True)
    for ax in figure.axes:
        place: Any = ax.get_subplotspec()
        if place is not None and not place.is_last_col():
            ax.set_title("", loc="right")
    return draw.finish(figure)


def _clip(ax: "Axes", values: Array, limited: bool) -> None:
    """Clip an axis to what 98 % of the values need, where the others are beyond four times that."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return
    (low, high), (least, most) = np.percentile(finite, [1.0, 99.0]), (finite.min(), finite.max())
    if limited:
        low, high = min(low, 0.0), max(high, 100.0)
    size = max(float(high - low), 1e-12)
    if most - least <= _DWARFS * size:
        return
    ax.set_ylim(low - 0.15 * size, high + 0.15 * size)
    ax.set_title(f"clipped: values from {least:.3g} to {most:.3g}", loc="right")


def _limits(ax: "Axes", values: Array) -> None:
    for value in (0.0, 100.0):
        ax.axhline(value, label="limit" if value else None, **draw.LIMIT)
    low, high = min(-8.0, float(np.nanmin(values))), max(108.0, float(np.nanmax(values)))
    ax.axhspan(low, 0.0, color="0.92", zorder=0)
    ax.axhspan(100.0, high, color="0.92", zorder=0)
    ax.set_ylim(low, high)


def _agents_over(ax: "Axes", run: Recording, times: Array, values: Array) -> None:
    if run.agents > draw.NAMED:
        bands(ax, times, values[:, list(run.followers)])
        first = run.leaders[0]
        draw.plot(ax, times, values[:, first], label=f"leader {first}", **pen_of(run, first))
        return
    for agent in draw.leaders_first(run, range(run.agents)):
        line, _ = draw.drop_runaways(values[:, agent, None], values[:1, agent, None])
        draw.plot(ax, times, line, label=name_of(run, agent), **pen_of(run, agent))
