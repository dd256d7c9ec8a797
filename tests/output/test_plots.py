"""Figures of runs: they show the run's numbers with units and change no global state."""

import dataclasses
import functools

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from runs import simulate

import echelon as ech
from echelon import Formation, Graph, Outcome, lyapunov, summary, synthesize
from echelon.agents.models import Quadrotor, SingleIntegrator, UnicyclePoint, VanDerPol
from echelon.agents.references import Circle
from echelon.experiments.results.recording import recording_of
from echelon.laws import Consensus, Tracking, TrimInput
from echelon.output.plots.run_figures import figures, save_figures
from echelon.output.plots.style import COLOURS, thin
from echelon.synthesis.gains import FixedGain, Riccati

TREE = Graph.from_edges([(0, 1), (1, 2), (1, 3)])
POINT = FixedGain([1.0, 1.0, 0.1], coupling=2.0)
PLAIN = FixedGain("identity", coupling=2.0)

# Model, graph, method (of leader and followers alike), reference and spread.
RUNS = {
    "quadrotor": (Quadrotor.crazyflie(), TREE, Riccati(), Circle(), {"position": 0.5}),
    "unicycle": (UnicyclePoint(), TREE, POINT, Circle(), {"x": 0.5}),
    "van-der-pol": (VanDerPol(), TREE, Riccati(), None, {"position": 1.0, "velocity": 1.0}),
    "one-axis": (SingleIntegrator(dimension=1), TREE, PLAIN, Circle(), {"position": 1.0}),
    "swarm": (SingleIntegrator(), Graph.grid(4, 4), PLAIN, Circle(), {"position": 1.0}),
}


def close(model, graph, method, reference, spread):
    """A short run with one offset where the model has a position, and of synchronization else."""
    gain = synthesize(model, graph, method)
    leader = TrimInput() if reference is None else Tracking(reference, gain)
    offsets = {1: [1.0] * len(model.position)} if model.position else {}
    formation = Formation.from_offsets(model, graph, offsets)
    laws = {"leader": leader, "follower": Consensus(gain, "relay")}
    starts = {"initial": spread, "start_error": {model.state_names[0]: 0.2}}
    return simulate(model, graph, formation, **laws, **starts, horizon=0.5, dt=0.02)


@pytest.fixture(scope="module")
def runs():
    return functools.cache(lambda name: close(*RUNS[name]))


DRAWN = {}


def all_figures(result):
    """The figures of a run with V, made once."""
    if id(result) not in DRAWN:
        # The result is kept too: its id must not be given to another.
        DRAWN[id(result)] = (result, figures(result))
    return DRAWN[id(result)][1]


def drawn(result, name):
    """The axes of a figure and its labelled lines, each as an array of coordinates (T, k)."""
    figure = all_figures(result)[name]
    return figure.axes, labelled(figure)


def labelled(figure):
    lines = [line for ax in figure.axes for line in ax.get_lines()]
    named = [line for line in lines if not str(line.get_label()).startswith("_")]
    return {line.get_label(): np.column_stack(coordinates(line)) for line in named}


def coordinates(line):
    return line.get_data_3d() if hasattr(line, "get_data_3d") else line.get_data()


def cut(result, states, reference):
    frames = {"times": result.times[: len(states)], "inputs": result.inputs[: len(states)]}
    return dataclasses.replace(result, states=states, reference=reference, **frames)


def exploded(result, factor=1e300):
    """The same run, its agents growing to the edge of what a float can hold."""
    growth = np.geomspace(1.0, factor, len(result.times))[:, None, None]
    states = (result.states + 1e-3) * growth
    return dataclasses.replace(result, states=states, outcome=Outcome.DIVERGED)


@pytest.mark.parametrize("name", ["quadrotor", "van-der-pol", "swarm"])
def test_every_figure_is_there_and_its_axes_have_names(runs, name):
    result = runs(name)
    made = all_figures(result)
    expected = {"leader_3d", "trajectories", "formation", "inputs", "lyapunov"}
    expected |= {"tracking"} if result.reference is not None else set()
    assert set(made) == expected
    for title, figure in made.items():
        assert all(ax.get_ylabel() for ax in figure.axes)
        assert figure.axes[-1].get_xlabel()
        # Nothing is cut off at the edge of the paper.
        renderer = FigureCanvasAgg(figure).get_renderer()
        figure.draw(renderer)
        boxes = [part.get_tightbbox(renderer) for part in edges(figure)]
        for box in [box for box in boxes if box is not None]:
            assert box.x0 >= 0.0 and box.x1 <= figure.bbox.x1, title
            assert box.y0 >= 0.0 and box.y1 <= figure.bbox.y1, title


def edges(figure):
    """The axes with their labels, and the legends."""
    for ax in figure.axes:
        yield from ax._axis_map.values()
        yield from [ax.get_legend()] if ax.get_legend() else []
    yield from figure.legends


LABELS = {
    "quadrotor": ("x (m)", "y (m)", "z (m)"),
    "unicycle": ("x (m)", "y (m)"),
    "van-der-pol": ("position", "velocity"),
}


@pytest.mark.parametrize("name", LABELS)
def test_the_leader_is_drawn_with_its_reference_in_space_in_its_plane_or_phase_plane(runs, name):
    result, labels = runs(name), LABELS[name]
    (ax,), lines = drawn(result, "leader_3d")
    places = result.states[:, 0, : len(labels)]
    np.testing.assert_array_equal(lines["leader 0"], places)
    np.testing.assert_array_equal(lines["start"], places[:1])
    np.testing.assert_array_equal(lines["end"], places[-1:])
    names = [ax.get_xlabel(), ax.get_ylabel(), *([ax.get_zlabel()] if len(labels) > 2 else [])]
    assert tuple(names) == labels
    if result.reference is not None:
        reference = result.reference[:, : len(labels)]
        np.testing.assert_array_equal(lines["reference"], reference)
        # A leader with an offset has it beside its reference too.
        shift = np.eye(len(result.model.state_names))[0]
        parts = result.parts.replace(formation=Formation(result.formation.offsets + shift))
        moved = figures(dataclasses.replace(result, parts=parts), "leader_3d")["leader_3d"]
        there = reference + shift[: len(labels)]
        np.testing.assert_array_equal(labelled(moved)["reference"], there)


def test_a_leader_on_one_axis_is_drawn_over_time(runs):
    result = runs("one-axis")
    (ax,), lines = drawn(result, "leader_3d")
    expected = np.column_stack([result.times, result.states[:, 0, 0]])
    np.testing.assert_array_equal(lines["leader 0"], expected)
    np.testing.assert_array_equal(lines["reference"][:, 1], result.reference[:, 0])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time (s)", "x (m)")


def test_all_agents_are_drawn_apart_and_the_graph_six_times_from_the_first_frame_to_the_last(runs):
    result = runs("quadrotor")
    (ax,), lines = drawn(result, "trajectories")
    for agent, name in enumerate(["leader 0", "follower 1", "follower 2", "follower 3"]):
        np.testing.assert_array_equal(lines[name], result.states[:, agent, :3])
    assert [line.get_color() for line in ax.get_lines()[:4]] == ["black", *COLOURS[:3]]
    result = runs("quadrotor")
    (ax,), lines = drawn(result, "trajectories")
    last = result.states[-1][result.graph.edges, :3]
    (name,) = [name for name in lines if name.startswith("graph")]
    assert name == "graph, every 0.1 s"
    np.testing.assert_array_equal(lines[name].reshape(-1, 3, 3)[:, :2], last)
    edges = [line for line in ax.get_lines() if len(coordinates(line)[0]) == 9]
    assert len(edges) == 6
    first = np.column_stack(coordinates(edges[0])).reshape(-1, 3, 3)[:, :2]
    np.testing.assert_array_equal(first, result.states[0][result.graph.edges, :3])


def test_metres_are_alike_in_all_directions(runs):
    for name in ("leader_3d", "trajectories"):
        (plane,), _ = drawn(runs("unicycle"), name)
        assert plane.get_aspect() == 1.0
        (space,), _ = drawn(runs("quadrotor"), name)
        sizes = [np.ptp(limits()) for limits in (space.get_xlim, space.get_ylim, space.get_zlim)]
        scale = space._box_aspect / np.array(sizes)
        np.testing.assert_allclose(scale, scale[0])


def test_the_tracking_error_is_the_output_minus_the_reference(runs):
    result = runs("quadrotor")
    panels, lines = drawn(result, "tracking")
    off = result.states[:, 0] - result.reference
    for name, k in (("x", 0), ("y", 1), ("z", 2), ("yaw", 8)):
        np.testing.assert_allclose(lines[name][:, 1], off[:, k], rtol=0.0, atol=1e-15)
        np.testing.assert_array_equal(lines[name][:, 0], result.times)
    assert [ax.get_ylabel() for ax in panels] == ["tracking error (m)", "tracking error (rad)"]


@pytest.mark.parametrize("name", ["quadrotor", "van-der-pol"])
def test_the_formation_error_is_the_distance_from_the_goal(runs, name):
    result, metres = runs(name), name == "quadrotor"
    (ax,), lines = drawn(result, "formation")
    for agent in result.graph.followers:
        goal = result.states[:, 0] + result.formation.offsets[agent]
        off = (result.states[:, agent] - goal)[:, list(result.measured)]
        error = np.sqrt((off**2).sum(axis=1))
        np.testing.assert_allclose(lines[f"follower {agent}"][:, 1], error, rtol=1e-12)
    assert ax.get_yscale() == "log" and ("1 cm" in lines) is metres
    assert ax.get_ylabel() == ("formation error (m)" if metres else "formation error")
    if metres:
        assert set(lines["1 cm"][:, 1]) == {0.01}
        assert ax.get_ylim()[0] <= 0.01 <= ax.get_ylim()[1]


def test_errors_of_zero_leave_gaps_and_stretch_no_axis(runs):
    result = runs("unicycle")
    goals = np.broadcast_to(result.formation.offsets, result.states.shape)
    still = dataclasses.replace(result, states=goals)
    figure = figures(still, "formation")["formation"]
    (ax,), lines = figure.axes, labelled(figure)
    for agent in result.graph.followers:
        assert np.isnan(lines[f"follower {agent} (always 0)"][:, 1]).all()
    assert ax.get_ylim()[0] >= 1e-3
    # At their goals from the middle on: the line ends there, and the axis at what it shows.
    half = result.states.copy()
    half[len(half) // 2 :] = goals[len(half) // 2 :]
    figure = figures(dataclasses.replace(result, states=half), "formation")["formation"]
    (ax,), lines = figure.axes, labelled(figure)
    for agent in result.graph.followers:
        shown = lines[f"follower {agent}"][:, 1]
        assert np.isnan(shown[len(half) // 2 :]).all() and (shown[: len(half) // 2] > 0).all()
    assert ax.get_ylim()[0] >= 1e-6


def test_v_and_its_derivative_are_drawn_as_given(runs):
    result = runs("quadrotor")
    v = lyapunov(result)
    (above, below), lines = drawn(result, "lyapunov")
    first = v.value[0]
    np.testing.assert_allclose(lines["V"], np.column_stack([result.times, v.value / first]))
    falls, rises = (lines.get(name) for name in ("dV/dt < 0", "dV/dt > 0"))
    np.testing.assert_allclose(falls[:, 1], np.where(v.rate < 0.0, -v.rate / first, np.nan))
    assert (rises is None) == (v.rate <= 0.0).all()
    assert [ax.get_yscale() for ax in (above, below)] == ["log", "log"]
    assert [above.get_ylabel(), below.get_ylabel()] == ["V / V(0)", "|dV/dt| / V(0) (1/s)"]


def with_v(result, value, rate):
    """The recording of a run with another V."""
    return dataclasses.replace(recording_of(result), lyapunov=value, lyapunov_rate=rate)


def test_a_rising_v_is_told_apart_and_without_v_there_is_no_figure(runs):
    result = runs("van-der-pol")
    count = len(result.times)
    rate = np.linspace(-1.0, 2.0, count)
    lines = labelled(figures(with_v(result, np.ones(count), rate), "lyapunov")["lyapunov"])
    np.testing.assert_array_equal(lines["dV/dt < 0"][:, 1], np.where(rate < 0.0, -rate, np.nan))
    np.testing.assert_array_equal(lines["dV/dt > 0"][:, 1], np.where(rate > 0.0, rate, np.nan))
    result = runs("van-der-pol")
    assert not figures(with_v(result, None, None), "lyapunov")
    still = np.zeros(len(result.times))
    assert len(figures(with_v(result, still, still), "lyapunov")["lyapunov"].axes) == 1


def test_many_followers_have_no_names_and_their_worst_has(runs):
    result = runs("swarm")
    made = all_figures(result)
    paths = [np.column_stack(coordinates(x)) for x in made["trajectories"].axes[0].lines[:16]]
    np.testing.assert_array_equal(np.stack(paths, axis=1), result.states)
    told = [text.get_text() for text in made["trajectories"].legends[0].get_texts()]
    assert told == ["leader 0", "15 followers", "graph, every 0.1 s", "start", "end"]
    lines = labelled(made["formation"])
    worst = next(name for name in lines if name.startswith("worst: follower "))
    told = {worst, "median follower", "largest at each time", "1 cm"}
    assert {name for name in lines if not name.startswith("guaranteed slope")} == told
    off = (result.states - result.formation.offsets)[:, :, :2]
    errors = np.linalg.norm(off[:, 1:] - off[:, :1], axis=2)
    for name, expected in (
        ("largest at each time", errors.max(axis=1)),
        (worst, errors[:, int(worst.split()[-1]) - 1]),
        ("median follower", np.median(errors, axis=1)),
    ):
        np.testing.assert_allclose(lines[name][:, 1], expected, rtol=1e-12)


@pytest.mark.parametrize("name", ["quadrotor", "van-der-pol", "one-axis"])
def test_a_run_that_grew_out_of_all_bounds_is_drawn_within_its_start(runs, name):
    huge = with_v(exploded(runs(name)), np.full(26, 1e300), np.full(26, np.inf))
    figure = figures(huge)["trajectories"]
    FigureCanvasAgg(figure).draw()
    for ax in figure.axes:
        if ax.get_xlabel() == "time (s)":
            continue
        assert np.abs([ax.get_xlim(), ax.get_ylim()]).max() < 1e3
    assert "not drawn" in figure.get_suptitle()


def test_what_is_within_reach_is_drawn_and_nothing_else_changes(runs):
    result = runs("quadrotor")
    states = result.states.copy()
    states[15:, 2, 0] = 1e200
    figure = figures(dataclasses.replace(result, states=states), "trajectories")["trajectories"]
    (ax,), lines = figure.axes, labelled(figure)
    np.testing.assert_array_equal(lines["follower 2"][:15], result.states[:15, 2, :3])
    assert np.isnan(lines["follower 2"][15:]).all()
    np.testing.assert_array_equal(lines["follower 1"], result.states[:, 1, :3])
    assert ax.figure.get_suptitle()
    assert not all_figures(result)["trajectories"].get_suptitle()


@pytest.mark.parametrize("name", ["quadrotor", "van-der-pol", "one-axis"])
def test_a_run_of_one_frame_is_drawn_as_dots(runs, name):
    whole = runs(name)
    result = cut(whole, whole.states[:1], None if whole.reference is None else whole.reference[:1])
    made = figures(result)
    assert {"trajectories", "formation", "inputs"} < set(made)
    figure = made["leader_3d"]
    lines = [line for ax in figure.axes for line in ax.get_lines()]
    assert all(line.get_marker() not in ("None", "", " ", None) for line in lines)


def test_a_leader_at_rest_has_no_path_and_a_run_of_no_frame_no_figures(runs, tmp_path):
    moving = runs("quadrotor")
    still = np.broadcast_to(moving.states[:1], moving.states.shape)
    for states, reference in ((still, None), (still, still[:, 0]), (still + 1e-9, None)):
        assert not figures(cut(moving, states, reference), "leader_3d")
    assert figures(cut(moving, still, moving.reference), "leader_3d")
    run = runs("quadrotor")
    empty = cut(run, run.states[:0], None)
    assert figures(empty) == {}
    assert save_figures(empty, tmp_path) == []


def test_long_runs_are_thinned_and_keep_their_ends():
    assert thin(2000).tolist() == list(range(2000))
    assert len(thin(100_001)) == 2000
    assert thin(100_001)[[0, -1]].tolist() == [0, 100_000]
    assert np.ptp(np.diff(thin(100_001))) <= 1
    assert len(thin(100_001, lines=1000)) == 200
    assert thin(1).tolist() == [0]


@pytest.mark.slow
def test_each_figure_is_written_as_the_same_png_and_pdf_and_settings_are_left_alone(runs, tmp_path):
    # To look the back end up would itself choose one; a copy does not.
    before, errors = dict(matplotlib.rcParams.copy()), np.geterr()
    paths = save_figures(runs("quadrotor"), tmp_path)
    assert dict(matplotlib.rcParams.copy()) == before and np.geterr() == errors
    names = ["leader_3d", "trajectories", "tracking", "formation", "inputs", "lyapunov"]
    expected = [
        tmp_path / "figures" / f"{name}.{kind}" for name in names for kind in ("png", "pdf")
    ]
    assert paths == expected
    assert sorted((tmp_path / "figures").iterdir()) == sorted(expected)
    for png, pdf in zip(paths[::2], paths[1::2], strict=True):
        assert png.read_bytes().startswith(b"\x89PNG")
        assert int.from_bytes(png.read_bytes()[16:20]) == 1050  # 7 inches of 150 dots
        assert pdf.read_bytes().startswith(b"%PDF")
    first, again = (
        save_figures(runs("unicycle"), tmp_path / name, ("formation", "trajectories"))
        for name in ("first", "again")
    )
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]


@pytest.fixture(scope="module")
def multitude():
    """A line of 6,001 agents that a leader in its middle makes go somewhere."""
    model, agents = ech.models.SingleIntegrator(dimension=2), 6001
    edges = np.stack([np.arange(agents - 1), np.arange(1, agents)], axis=1)
    graph = ech.Graph.from_edges(edges, leaders=(3000,), agents=agents)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Agreement())
    places = np.arange(agents)
    formation = ech.Formation(np.stack([places - 3000.0, places % 7.0], axis=1))
    parts = ech.Parts(model, graph, formation, drive, initial={"position": 0.3})
    return ech.simulate(parts, ech.Settings(horizon=0.02, dt=0.01, steady_window=0.01))


@pytest.mark.slow
def test_a_multitude_is_drawn_by_some_and_the_graph_about_its_leader(multitude):
    made = figures(multitude, ("trajectories", "network", "states"))
    [ax] = made["trajectories"].axes
    assert ax.get_title() == "1,501 of 6,001 agents"
    starts = multitude.states[0]
    drawn = [line.get_xydata()[0] for line in ax.lines[:1501]]
    assert np.isin(np.array(drawn), starts).all() and np.isin(starts[3000], drawn[0]).all()
    [ax] = made["network"].axes
    assert ax.get_title() == "2,000 of 6,001 agents"
    across = np.concatenate([line.get_xydata()[:, 0] for line in ax.lines])
    wanted = np.sort(multitude.formation.offsets[2000:4001, 0])
    assert len(across) == 2000 and np.isin(across, wanted).all()
    assert max(len(ax.lines) for ax in made["states"].axes) < 2010


def test_the_summary_of_a_multitude_names_the_best_the_median_and_the_worst(multitude):
    told, every = summary(multitude), ech.metrics(multitude)
    errors = np.sort([each.steady_rmse for each in every.followers])
    assert [row["steady_rmse"] for row in told["followers"]] == errors[[0, 3000, -1]].tolist()
    off = np.sort([each.distance_rmse for each in every.edges])
    assert [row["distance_rmse"] for row in told["edges"]] == off[[0, 3000, -1]].tolist()
