"""Figures drawn from recordings: limits, guarantees, distances, and sizes for a page."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from recordings import GUARANTEE, as_file, flown, swinging, tracked, with_errors

from echelon.agents.network.switching import Schedule
from echelon.core.errors import OutputError
from echelon.experiments.results.metrics import Avoidance, Ellipsoid
from echelon.experiments.results.recording import MessageAges
from echelon.output.plots.network import curves_of
from echelon.output.plots.over_time import start_of
from echelon.output.plots.run_figures import NAMES, figures
from echelon.output.plots.style import ONE_COLUMN, TWO_COLUMNS, leader_pen, pen

CERTIFIED = GUARANTEE | {"theorem": "T1", "kind": "proof", "covers_start": True}
FEW = ("trajectories", "formation", "inputs")


@pytest.fixture(scope="module")
def run():
    own = flown(seconds=4.0)
    rate = np.gradient(own.lyapunov, own.times)
    shape = len(own.times), len(own.edges), 2
    late = MessageAges(
        np.full(own.states.shape[:2], 0.02), np.ones(shape), np.ones(shape, int), 0.5
    )
    times = own.times[::8]
    apart = Avoidance(times, 0.3 + times, 1.0 * (np.sin(times) > 0.0), Ellipsoid(0.125, 0.375, 0.3))
    more = {"tracking": tracked(own), "lyapunov_rate": rate, "messages": late, "avoidance": apart}
    return dataclasses.replace(own, **more)


@pytest.fixture(scope="module")
def flock():
    return flown(60, 2.0, rate=20.0, leaders=tuple(range(0, 60, 20)))


def lines_of(figure, place=0):
    return {line.get_label(): line.get_xydata() for line in figure.axes[place].get_lines()}


def test_inputs_stand_in_percent_of_their_limits_which_are_drawn(run):
    figure = figures(run, ["inputs"])["inputs"]
    lines = lines_of(figure)
    np.testing.assert_allclose(lines["follower 2"][:, 1], 100.0 * run.inputs[:, 2].max(axis=1))
    assert set(lines["limit"][:, 1]) == {100.0}
    low, high = figure.axes[0].get_ylim()
    assert low < 0.0 and high > 100.0
    assert figure.axes[0].get_xlim() == (0.0, 4.0)
    free = figures(dataclasses.replace(run, bounds=None), ["inputs"])["inputs"]
    assert [ax.get_ylabel() for ax in free.axes] == ["u0 (N)", "u1 (N)", "u2 (N)", "u3 (N)"]


def test_the_slope_that_is_promised_is_drawn_from_the_largest_error_on(run):
    worst = run.formation_errors.max(axis=1)
    for name, rate in (("formation", -0.5), ("lyapunov", -1.0)):
        label = f"guaranteed slope: \u2212{-rate:g} 1/s"
        (t0, first), (t1, last) = lines_of(figures(run, [name])[name])[label]
        assert name == "lyapunov" or (first == worst.max() and t0 == run.times[worst.argmax()])
        assert np.log(last / first) == pytest.approx(rate * (t1 - t0))
    none = dataclasses.replace(run, guarantee=GUARANTEE | {"verdict": "none", "claim": None})
    for name, figure in figures(none, ["formation", "lyapunov"]).items():
        assert not [k for k in lines_of(figure) if "guaranteed" in k], name


def test_a_bound_is_drawn_where_a_theorem_gives_one_and_it_bounds_what_shrinks_so(run):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(12, 12))
    P = root @ root.T + np.eye(12)
    # Errors that shrink as promised in the metric of P, and not a bit faster.
    shrink = np.exp(-0.5 * run.times)[:, None, None]
    errors = shrink * rng.normal(size=(1, 4, 12))
    errors[:, 0] = 0.0
    proved = dataclasses.replace(with_errors(run, errors), metric=P, guarantee=CERTIFIED)
    bound = proved.error_bound()
    assert (bound[:, None] >= proved.formation_errors).all()
    drawn = lines_of(figures(proved, ["formation"])["formation"])["bound, by proof (T1)"]
    np.testing.assert_array_equal(drawn[:, 1], bound)
    # Attained by an error along the direction in which the metric sees a position least.
    worst = np.zeros((1, 4, 12))
    block = np.linalg.inv(P)
    direction = np.linalg.eigh(block[:3, :3])[1][:, -1]
    worst[0, 1] = block[:, :3] @ direction
    tight = with_errors(proved, shrink * worst)
    np.testing.assert_allclose(tight.error_bound(), tight.formation_errors[:, 1], rtol=1e-9)
    proved = dataclasses.replace(
        run, metric=1e4 * np.diag([1.0] + [1e-4] * 11), guarantee=CERTIFIED
    )
    bound = proved.error_bound()
    (ax,) = figures(proved, ["formation"])["formation"].axes
    assert bound[0] > 10.0 * run.formation_errors.max()
    assert ax.get_ylim()[1] >= bound[0]


@pytest.mark.parametrize(
    "spoiled",
    [
        {"saturated": np.array([0.0, 0.1, 0.0, 0.0])},
        {"metric": None},
        {"guarantee": CERTIFIED | {"theorem": "T2"}},
        {"guarantee": CERTIFIED | {"covers_start": None}},
        {"guarantee": CERTIFIED | {"claim": None}},
        {"guarantee": CERTIFIED | {"ignores": ["wind or noise acts on the agents"]}},
    ],
)
def test_no_bound_is_drawn_that_is_not_promised_of_the_run(run, spoiled):
    proved = dataclasses.replace(run, metric=np.eye(12), guarantee=CERTIFIED)
    assert proved.error_bound() is not None
    assert dataclasses.replace(proved, **spoiled).error_bound() is None


def test_distances_are_those_of_linked_agents_with_those_desired(
    run,
):
    figure = figures(run, ["distances"])["distances"]
    lines = lines_of(figure)
    i, j = run.edges[1]
    apart = np.linalg.norm(run.states[:, i, :3] - run.states[:, j, :3], axis=1)
    np.testing.assert_allclose(lines[f"{i} to {j}"][:, 1], apart)
    places = run.states[:, :, :3]
    away = np.linalg.norm(places[:, :, None] - places[:, None], axis=3) + 1e9 * np.eye(4)
    least = lines_of(figure, 1)["any two"][:, 1]
    np.testing.assert_allclose(least, away.min(axis=(1, 2)))
    moving = run.offsets * (1.0 + run.times[:, None, None])
    figure = figures(dataclasses.replace(run, moving=moving), "distances")["distances"]
    i, j = run.edges[0]
    desired = np.linalg.norm(moving[:, i, :3] - moving[:, j, :3], axis=1)
    assert any(np.array_equal(line.get_ydata(), desired) for line in figure.axes[0].lines)


def test_settings_that_the_user_has_changed_apply_to_lines_and_legends(run):
    with matplotlib.rc_context({"lines.linewidth": 3.0, "legend.fontsize": 14.0}):
        own = figures(run, "formation")["formation"]
    plain = figures(run, "formation")["formation"]
    for figure, width, size in ((own, 3.0, 14.0), (plain, 1.1, 8.33)):
        assert {line.get_linewidth() for line in figure.axes[0].lines} == {width}
        assert figure.legends[0].get_texts()[0].get_fontsize() == pytest.approx(size)
        assert figure.axes[0].xaxis.label.get_fontname() == "STIXGeneral"


OWN = {
    "lines.linewidth": 2.2,
    "lines.markersize": 10.0,
    "legend.fontsize": 14.0,
    "legend.labelcolor": "red",
    "font.family": "DejaVu Sans",
    "font.size": 12.0,
    "axes.labelsize": "large",
    "axes.spines.right": False,
    "axes.facecolor": "0.8",
    "axes.prop_cycle": matplotlib.cycler(color=["#123456", "#abcdef"], linestyle=["-", "--"]),
    "axes.grid.axis": "y",
    "grid.color": "green",
    "xtick.labelsize": 6.0,
    "ytick.labelsize": 7.0,
}


def test_figures_follow_the_settings_of_the_user(run):
    names = ["formation", "trajectories", "network", "distances"]
    with matplotlib.rc_context(OWN):
        own = figures(run, names)
    plain = figures(run, names)
    ax, legend = own["formation"].axes[0], own["formation"].legends[0]
    followers = [line for line in ax.lines if line.get_label().startswith("follower")]
    looks = [(line.get_color(), line.get_linestyle()) for line in followers]
    assert looks == [("#123456", "-"), ("#abcdef", "--"), ("#123456", "-")]
    assert {text.get_fontsize() for text in legend.get_texts()} == {14.0}
    assert {to_rgb(text.get_color()) for text in legend.get_texts()} == {(1.0, 0.0, 0.0)}
    assert ax.yaxis.label.get_fontname() == "DejaVu Sans"
    assert ax.yaxis.label.get_fontsize() == pytest.approx(1.2 * 12.0)
    assert to_rgb(ax.get_facecolor()) == (0.8, 0.8, 0.8)
    assert ax.get_yticklabels()[0].get_fontsize() == 7.0
    assert own["formation"].axes[-1].get_xticklabels()[0].get_fontsize() == 6.0
    assert ax.get_ygridlines()[0].get_color() == "green"
    assert not ax.get_xgridlines()[0].get_visible() and ax.get_ygridlines()[0].get_visible()
    # What echelon draws broader than a line, or larger than a marker, keeps its proportion.
    for name in names:
        for one, other in zip(own[name].axes, plain[name].axes, strict=True):
            for of in (Line2D.get_linewidth, Line2D.get_markersize):
                sizes = [sorted({of(line) for line in axes.lines}) for axes in (one, other)]
                assert sizes[0] == pytest.approx(2.0 * np.array(sizes[1]))
    wide = [figure["network"].axes[0].collections[0].get_linewidths() for figure in (own, plain)]
    assert wide[0] == pytest.approx(2.0 * np.array(wide[1]))


def test_the_network_has_every_edge_and_an_arrow_from_who_leads(run):
    (ax,) = figures(run, ["network"])["network"].axes
    (drawn,) = [part for part in ax.collections if len(part.get_segments()) == len(run.edges)]
    places = run.offsets[:, :2]
    np.testing.assert_allclose(np.stack(drawn.get_segments()), places[run.edges])
    arrows = [text for text in ax.texts if getattr(text, "arrow_patch", None) is not None]
    assert len(arrows) == sum(0 in edge for edge in run.edges.tolist())
    assert {text.get_text() for text in ax.texts} - {""} == {"0", "1", "2", "3"}


def test_a_graph_that_switches_has_the_links_of_each_time(run):
    weights = np.array([[1.0, 1.0, 0.0], [0.0, 2.0, 1.0]])
    schedule = Schedule(np.array([0.0, 2.5]), weights, None)
    switched = dataclasses.replace(run, schedule=schedule, weights=weights.max(axis=0))
    made = figures(switched, ["network", "distances", "trajectories"])
    for ax, row in zip(made["network"].axes, weights, strict=True):
        drawn = [line for part in ax.collections for line in part.get_segments()]
        np.testing.assert_allclose(np.stack(drawn), run.offsets[run.edges[row > 0.0]][:, :, :2])
    titles = [ax.get_title() for ax in made["network"].axes]
    assert titles == ["from 0 to 2.5 s", "from 2.5 s on"]
    for place, (i, j) in enumerate(run.edges):
        shown = lines_of(made["distances"])[f"{i} to {j}"]
        there = weights[(run.times >= 2.5).astype(int), place] > 0.0
        np.testing.assert_array_equal(np.isfinite(shown[:, 1]), there)
    # Of the six times of the graph three are before the switch.
    grey = [line for line in made["trajectories"].axes[0].lines if line.get_zorder() == 3]
    counts = [np.isfinite(np.array(line.get_data_3d())).all(axis=0).sum() for line in grey]
    assert counts == [4] * 6
    np.testing.assert_allclose(np.array(grey[5].get_data_3d()).T[3], run.states[-1, 0, :3])


def test_the_worst_and_the_median_of_a_flock_count_the_steady_window_and_those_at_rounding(flock):
    errors = np.zeros_like(flock.errors)
    # Two thirds of the followers are at rounding from half of the run on.
    errors[:, list(flock.followers), 0] = 1.0
    exact = list(flock.followers)[::3] + list(flock.followers)[1::3]
    errors[np.ix_(flock.times >= 1.0, exact, [0])] = 1e-18
    lines = lines_of(figures(with_errors(flock, errors), ["formation"])["formation"])
    median = lines["median follower"][:, 1]
    assert (median[flock.times < 1.0] == 1.0).all() and np.isnan(median[flock.times >= 1.0]).all()
    errors = np.zeros_like(flock.errors)
    errors[:, 7, 0] = np.where(flock.times < 0.8 * flock.horizon - 1e-9, 9.0, 0.1)
    errors[:, 9, 0] = 1.0
    told = lines_of(figures(with_errors(flock, errors), ["formation"])["formation"])
    assert "worst: follower 9" in told
    # Ended before that window, it is the worst of all that there is.
    early = dataclasses.replace(with_errors(flock, errors), horizon=9.0)
    assert "worst: follower 7" in lines_of(figures(early, ["formation"])["formation"])


@pytest.mark.parametrize(
    ("page", "width", "what"), [(ONE_COLUMN, 3.5, NAMES), (TWO_COLUMNS, 7.16, FEW)]
)
def test_figures_fit_the_columns_of_a_page_with_letters_of_8_points(run, flock, page, width, what):
    for own, names in ((run, what), (flock, FEW)):
        made = figures(own, names, page)
        assert tuple(made) == names
        for name, figure in made.items():
            assert all(ax.get_ylabel() or name in ("inputs", "network") for ax in figure.axes)
            assert figure.get_figwidth() == width and figure.get_figheight() <= 9.0, name
            assert all(ax.yaxis.label.get_size() == 8.0 for ax in figure.axes)
            renderer = FigureCanvasAgg(figure).get_renderer()
            figure.draw(renderer)
            for ax in figure.axes:
                parts = [*ax._axis_map.values(), *filter(None, [ax.get_legend()])]
                for box in filter(None, (part.get_tightbbox(renderer) for part in parts)):
                    assert box.x0 >= -1 and box.x1 <= figure.bbox.x1 + 1, (name, own.agents)


def test_the_last_time_stands_on_the_paper_whatever_style_draws_it(flock):
    longer = dataclasses.replace(flock, times=7.5 * flock.times, horizon=15.0)
    figure = figures(longer, ["formation"], ONE_COLUMN)["formation"]
    renderer = FigureCanvasAgg(figure).get_renderer()
    assert figure.axes[0].xaxis.get_tightbbox(renderer).x1 <= figure.bbox.x1


def test_a_link_that_would_hide_behind_an_agent_is_bent_around_it():
    places = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [1.5, 0.4]])
    edges = np.array([[0, 1], [0, 2], [1, 3], [3, 0], [0, 4]])
    lines = curves_of(places, edges, 0.15)
    assert [len(line) == 2 for line in lines] == [True, False, False, False, True]
    for edge, line in zip(edges, lines, strict=True):
        np.testing.assert_allclose(line[[0, -1]], places[edge])
        share = np.linspace(0.0, 1.0, len(line))
        fine = np.stack([np.interp(np.arange(0, 1, 1e-3), share, c) for c in line.T], axis=1)
        for other in np.delete(places, edge, axis=0):
            assert np.linalg.norm(fine - other, axis=1).min() > 0.15


def test_the_arrow_of_a_bent_link_lies_on_it(run):
    offsets = np.zeros_like(run.offsets)
    offsets[:, :2] = [[0, 0], [1, 0], [2, 0], [1, 1]]
    edges = np.array([[2, 0], [0, 1], [1, 3]])
    straight = dataclasses.replace(run, offsets=offsets, edges=edges, heard=~np.isin(edges, [0]))
    figure = figures(straight, ["network"])["network"]
    (ax,) = figure.axes
    FigureCanvasAgg(figure).draw()
    (drawn,) = [part for part in ax.collections if len(part.get_segments()) == 3]
    begin, *_, end = ways = ax.transData.transform(drawn.get_segments()[0])[::-1]
    arrow = next(filter(None, (getattr(text, "arrow_patch", None) for text in ax.texts)))
    handle = arrow.get_connectionstyle().connect(begin, end).vertices[1]
    # Of a parabola with this handle the middle.
    middle = 0.25 * (begin + 2.0 * handle + end)
    np.testing.assert_allclose(middle, ways[len(ways) // 2], atol=1.0)
    assert np.linalg.norm(middle - 0.5 * (begin + end)) > 20.0


def test_links_past_the_palette_are_dashed_and_lines_that_have_names_differ_in_grey_too(run):
    edges = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3], [3, 1]])
    more = dataclasses.replace(
        run, edges=edges, weights=np.ones(7), heard=np.ones((7, 2), bool), schedule=None
    )
    ax = figures(more, ["distances"])["distances"].axes[0]
    named = {line.get_label(): line for line in ax.lines}
    looks = {
        (named[f"{i} to {j}"].get_color(), named[f"{i} to {j}"].get_linestyle()) for i, j in edges
    }
    assert len(looks) == 7
    assert named["desired"].get_color() not in {colour for colour, _ in looks}
    looks = [pen(place, 10) for place in range(10)] + [leader_pen(0, 10)]
    shades = [np.dot(to_rgb(look["color"]), (0.299, 0.587, 0.114)) for look in looks]
    for i, one in enumerate(looks):
        for j, other in enumerate(looks[:i]):
            apart = abs(shades[i] - shades[j]) > 0.06
            assert apart or one["linestyle"] != other["linestyle"], (i, j)


def test_axes_of_derivatives_say_when_v_rises_between_frames_that_fall(run):
    rising = dataclasses.replace(
        run, lyapunov=np.exp(run.times), lyapunov_rate=-np.ones(len(run.times))
    )
    below = figures(rising, ["lyapunov"])["lyapunov"].axes[1]
    assert "V increases in between" in below.get_title(loc="right")
    assert not figures(run, ["lyapunov"])["lyapunov"].axes[1].get_title(loc="right")


def test_plot_draws_png_pdf_and_svg_from_the_file_and_loses_no_other(echelon, here):
    (here / "run.nc").write_bytes(as_file(swinging(("x", "y", "z"), (0, 1, 2), n=3)))
    code, told, _ = echelon("plot", "run.nc", "--what", "formation,network,ages", "--dpi", "60")
    assert code == 0
    assert told == (
        "- Written to figures: formation, network, each as PNG, PDF, SVG.\n"
        "- The run has no data for `ages`.\n"
    )
    made = sorted(path.name for path in (here / "figures").iterdir())
    assert made == sorted(
        f"{n}.{k}" for n in ("formation", "network") for k in ("png", "pdf", "svg")
    )
    assert b"<text" in (here / "figures" / "formation.svg").read_bytes()
    assert echelon("plot", "run.nc", "--what", "network", "--out", "other", "--dpi", "60")[0] == 0
    code, _, fault = echelon("plot", "run.nc", "--what", "network", "--out", "other")
    assert code == 2 and "exists; choose another folder, or `--force`" in fault
    code, _, fault = echelon("plot", "run.nc", "--dpi", "9")
    assert code == 2 and fault == "echelon: `--dpi` is 9, and must be from 30 to 1200.\n"
    code, _, fault = echelon("plot", "run.nc", "--what", "netwrk")
    assert code == 2 and "(did you mean `network`?)" in fault


@pytest.mark.parametrize("name", ["formation", "modes", "network", "trajectories"])
def test_a_figure_of_one_axes_is_drawn_into_those_of_the_caller(run, name):
    own = Figure((9.0, 3.0))
    left, right = own.subplots(1, 2)
    shown = run if name != "trajectories" else swinging(("x", "y"), (0, 1), n=2)
    assert figures(shown, name, ax=left) == {name: own}
    assert tuple(own.get_size_inches()) == (9.0, 3.0) and not right.has_data()
    theirs = figures(shown, [name])[name].axes[0]
    assert left.has_data() and left.get_xlabel() == theirs.get_xlabel()
    for mine, line in zip(left.get_lines(), theirs.get_lines(), strict=True):
        np.testing.assert_array_equal(mine.get_xydata(), line.get_xydata())


@pytest.mark.parametrize(
    ("what", "ax", "sentence"),
    [
        ("inputs", Figure().add_subplot(), "has several axes"),
        ("leader_3d", Figure().add_subplot(), "in space"),
        (("states", "modes"), Figure().add_subplot(), "2 names"),
        ("formation", 3, "^`ax` is a `int`, and must be axes of matplotlib\\.$"),
        ("formaton", None, "the figure is `formaton`, allowed are .* .did you mean `formation`"),
    ],
)
def test_a_figure_that_is_none_and_axes_that_do_not_fit_are_refused(run, what, ax, sentence):
    with pytest.raises(OutputError, match=sentence):
        figures(run, what, ax=ax)


@pytest.fixture(scope="module")
def long():
    """A minute, of which the errors settle within the first four seconds."""
    own = flown(seconds=60.0, rate=10.0)
    return dataclasses.replace(own, tracking=tracked(own), lyapunov_rate=-own.lyapunov)


OVER_TIME = ("tracking", "formation", "inputs", "states", "distances", "lyapunov")


@pytest.mark.slow
def test_figures_over_time_have_their_start_enlarged_unless_they_settle_late(run, long):
    for name, figure in figures(long, OVER_TIME).items():
        times = [ax.get_xlim() for ax in figure.axes]
        assert set(times) == {(0.0, 4.0), (0.0, 60.0)}, name
        assert times[::2] == [(0.0, 4.0)] * (len(times) // 2), name
        labels = {ax.get_xlabel() for ax in figure.axes} - {""}
        assert labels == {"time (s), of 60 s", "time (s)"}, name
        # The start has its own points: as many as frames of it are stored.
        (line, *_) = (line for line in figure.axes[0].lines if len(line.get_xdata()) > 2)
        assert len(line.get_xdata()) == 41, name
    assert len(figures(run, ["formation"])["formation"].axes) == 1
    slow = with_errors(long, np.ones_like(long.states))
    assert start_of(slow) == 3.0
    assert len(figures(long, ["formation"], ONE_COLUMN)["formation"].axes) == 1


def test_rounding_is_shaded_and_no_line_of_data(long):
    shrink = np.exp(-2.0 * long.times)[:, None, None]
    errors = np.zeros_like(long.states)
    errors[:, 1:, :3] = shrink
    states = errors + np.array([4.0] * 3 + [0.0] * 9)
    noisy = dataclasses.replace(long, states=states, offsets=np.zeros_like(long.offsets))
    ax = figures(noisy, ["formation"])["formation"].axes[-1]
    (shade,) = [patch for patch in ax.patches if patch.get_label() == "rounding"]
    floor = shade.get_y() + shade.get_height()
    assert floor == pytest.approx(8 * np.finfo(float).eps * 5.0 * 3**0.5)
    assert ax.get_ylim()[0] == pytest.approx(shade.get_y()) and ax.get_ylim()[0] > floor / 20.0
    for line in ax.lines:
        if line.get_label().startswith("follower"):
            values = line.get_ydata()
            assert np.nanmin(values) >= floor and np.isnan(values).sum() > 300
    clean = figures(long, ["tracking", "distances"])
    assert not any(ax.patches for figure in clean.values() for ax in figure.axes)


@pytest.mark.parametrize("bounds", [True, False])
def test_few_inputs_that_dwarf_the_rest_are_cut_off_and_the_figure_says_so(long, bounds):
    inputs = long.inputs.copy()
    inputs[1, 2] = 300.0
    spiked = dataclasses.replace(long, inputs=inputs, bounds=long.bounds if bounds else None)
    axes = figures(spiked, ["inputs"])["inputs"].axes
    assert axes[1].get_ylim()[1] < (150.0 if bounds else 1.0)
    title = axes[1].get_title(loc="right")
    assert title.startswith("clipped: values from ") and title.endswith(
        "3e+04" if bounds else "300"
    )
    plain = figures(long, ["inputs"])["inputs"]
    assert not any(ax.get_title(loc="right") for ax in plain.axes)


def test_the_closest_pair_is_marked_beside_the_size_of_agents(long):
    sized = dataclasses.replace(long, radius=0.07)
    lines = lines_of(figures(sized, ["distances"])["distances"], 3)
    closest = sized.closest_pair()
    text = "{:.3g} m: {} and {}".format(closest.distance, *closest.agents)
    assert lines[text].tolist() == [[closest.time, closest.distance]]
    assert set(lines["agents touch"][:, 1]) == {0.14}
    assert "agents touch" not in lines_of(figures(long, ["distances"])["distances"], 3)


def test_an_event_is_a_line_in_every_panel_with_its_words_in_one(long):
    happened = dataclasses.replace(long, events=({"at": 5.0, "text": "agent 0 is lost"},))
    figure = figures(happened, ["distances"])["distances"]
    assert len(figure.axes) == 4
    for ax in figure.axes:
        assert any(list(line.get_xdata()) == [5.0, 5.0] for line in ax.get_lines())
    words = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert words == ["agent 0 is lost "]


def test_a_swarm_has_its_followers_in_the_legend_of_every_figure(flock):
    made = figures(flock, ("states", "trajectories", "formation", "inputs"))
    for name, figure in made.items():
        legends = [ax.get_legend() for ax in figure.axes] + figure.legends
        texts = [text.get_text() for each in filter(None, legends) for text in each.get_texts()]
        assert {"57 followers", "5 to 95 %"} & {*texts}, name


def test_a_lost_leader_has_no_values_after_its_loss(long):
    lost = dataclasses.replace(
        long,
        schedule=Schedule(
            np.array([0.0, 5.0]),
            np.ones((2, len(long.edges))),
            None,
            np.array([[True] * 4, [False, True, True, True]]),
        ),
    )
    for name in ("tracking", "states"):
        for ax in figures(lost, [name])[name].axes:
            line = ax.get_lines()[0]
            times, values = line.get_xdata(), line.get_ydata()
            assert np.array_equal(np.isfinite(values), times < 5.0)


BACKEND = """
import os, sys
os.environ["MPLBACKEND"] = sys.argv[1]
import echelon
assert "matplotlib" not in sys.modules
from recordings import flown
figure = echelon.figures(flown(seconds=0.1), "trajectories")["trajectories"]
figure.savefig(sys.argv[2])
import matplotlib
assert os.environ["MPLBACKEND"] == sys.argv[1] and "matplotlib.pyplot" not in sys.modules
print(matplotlib.get_backend(auto_select=False))
"""


def test_figures_are_drawn_whatever_backend_the_environment_names(tmp_path):
    """Jupyter names its own one to child processes; a user's choice remains."""
    file, backend = tmp_path / "figure.png", "module://nothing.installed"
    command = [sys.executable, "-c", BACKEND, backend, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == backend
    assert file.read_bytes().startswith(b"\x89PNG")
