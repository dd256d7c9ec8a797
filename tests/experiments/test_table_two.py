"""The paper's experiment by the paper's measures, and its first line of Algorithm 1."""

import numpy as np
import pytest
from oracles import spd
from runs import made_up

import echelon as ech
from echelon.experiments.results.table_two import (
    distance_errors,
    is_papers_experiment,
    missing,
    table_two,
)
from echelon.experiments.studies.compare import Comparison, ComparisonRow
from echelon.output.plots.study_figures import comparison_figures
from echelon.output.reports.comparison_report import comparison_mapping, comparison_report
from echelon.synthesis.gains.printed_lmi import printed_lmi, violation

MODEL, TREE = ech.models.Quadrotor(), ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)])
EDGES = ((1, 0), (2, 1), (3, 1))
PLACES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.8, 0.0], [1.0, -0.8, 0.0]])


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def by_numpy(states, reference, places):
    """Errors of leader, distances and vectors, from places alone."""
    x = states[:, :, :3]
    gaps = [np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in EDGES]
    wanted = [np.linalg.norm(places[i] - places[j]) for i, j in EDGES]
    off = x - places - x[:, :1] + places[0]
    return (
        rms(np.linalg.norm(x[:, 0] - reference[:, :3], axis=1)),
        [rms(gap - length) for gap, length in zip(gaps, wanted, strict=True)],
        [rms(np.linalg.norm(off[:, k], axis=1)) for k in (1, 2, 3)],
    )


@pytest.fixture(scope="module")
def drawn():
    """A run of 15 s in steps of one second, of random states."""
    rng = np.random.default_rng(0)
    offsets = np.pad(PLACES, ((0, 0), (0, 9)))
    states, reference = rng.normal(size=(16, 4, 12)), rng.normal(size=(16, 12))
    return made_up(states, MODEL, TREE, offsets, reference)


def check(found, expected):
    leader, distances, vectors = expected
    assert found.leader == pytest.approx(leader, rel=1e-12)
    assert found.distances == pytest.approx(distances, rel=1e-12)
    assert found.vectors == pytest.approx(vectors, rel=1e-12)


def test_the_errors_of_the_first_10_s_are_those_of_numpy_and_no_later_step_counts(drawn):
    found = table_two(drawn)
    check(found, by_numpy(drawn.states[:10], drawn.reference[:10], PLACES))
    assert (found.frames, found.every, found.measured) == (10, True, (0, 1, 1))
    later = drawn.states.copy()
    later[11:] += 5.0
    moved = made_up(later, MODEL, TREE, drawn.offsets, drawn.reference)
    assert table_two(moved) == found


def test_a_run_of_less_than_10_s_has_no_errors_to_compare(drawn):
    short = made_up(drawn.states[:10], MODEL, TREE, drawn.offsets, drawn.reference[:10])
    assert missing(short) == "the run ends at 9 s" and table_two(short) is None
    assert missing(drawn) == ""


def test_the_variants_of_the_paper_alone_are_beside_it():
    assert is_papers_experiment("paper-line", "Quadrotor", 4)
    for other in (("papers", "Quadrotor", 4), ("paper", "Unicycle", 4), ("paper", "Quadrotor", 5)):
        assert not is_papers_experiment(*other)


@pytest.fixture(scope="module")
def flown():
    """The paper's scenario behind both of its leaders, for its 10 s."""
    short = ["simulation.horizon=10", "report.steady_window=2"]
    return {
        law: ech.run(ech.load_scenario("paper", [*short, f"leader.law={law}"]))
        for law in ("tracking", "optimal-tracking")
    }


@pytest.mark.slow
def test_the_errors_at_the_paper_s_10_s_are_those_of_the_meter_and_of_numpy(flown):
    for run in flown.values():
        found, numbers = table_two(run), ech.metrics(run)
        assert found.every and found.frames == 2000
        check(found, by_numpy(run.states[:-1], run.reference[:-1], PLACES))
        distances = {edge.edge: edge.distance_rmse for edge in numbers.edges}
        assert found.distances == pytest.approx([*distances.values()], rel=1e-9)
        assert found.leader == pytest.approx(numbers.leader.rmse, rel=1e-9)
        assert found.vectors == pytest.approx([f.rmse for f in numbers.followers], rel=1e-9)
    found = table_two(flown["tracking"])
    assert found.leader == pytest.approx(0.387, abs=1e-3)
    assert found.distances == pytest.approx([0.245, 0.192, 0.121], abs=1e-3)
    assert found.vectors == pytest.approx([0.324, 0.282, 0.351], abs=1e-3)
    assert table_two(flown["optimal-tracking"]).leader == pytest.approx(0.237, abs=1e-3)


@pytest.mark.slow
def test_fewer_stored_frames_say_that_they_are_not_all_steps(flown):
    few = ["simulation.horizon=10", "simulation.store_every=10"]
    run = ech.run(ech.load_scenario("paper", few))
    found = table_two(run)
    assert (found.frames, found.every) == (200, False)
    assert "over 200 stored frames" in " ".join(ech.report(run).split())
    # The first frame weighs as much as ten steps, and the start is the largest error.
    assert found.leader > table_two(flown["tracking"]).leader


@pytest.mark.slow
def test_the_paper_s_leader_in_a_comparison_is_the_one_of_the_scenario(flown):
    short = ech.load_scenario("paper", ["simulation.horizon=10", "report.steady_window=2"])
    found = ech.compare(short, only=("optimal-leader",))
    [row] = found.rows
    np.testing.assert_allclose(
        row.flight.result.states, flown["optimal-tracking"].states, rtol=1e-7, atol=1e-7
    )
    told = comparison_mapping(found)["beside_printed"]["optimal-leader"]
    assert told["leader_rmse"] == table_two(row.flight.result).leader
    assert "optimal-leader" in comparison_report(found)
    # Both methods of the figure are needed; here one run stands for both.
    pair = (row, ComparisonRow("optimization", row.flight))
    figure = comparison_figures(Comparison("paper", pair, 10.0, 2.0, ()))["paper_fig_3b"]
    drawn = [line for line in figure.axes[0].lines if str(line.get_label()).startswith("$e_")]
    assert len(drawn) == 6 and "paper_fig_3b" not in comparison_figures(found)
    errors = distance_errors(row.flight.result)
    for k, line in enumerate(drawn):
        assert line.get_ydata()[0] == errors[0, k % 3] and line.get_ydata()[-1] == errors[-1, k % 3]


def test_without_a_reference_nobody_plans_a_leader():
    still = ["reference=null", "leader.law=passive", "simulation.horizon=0.02"]
    scenario = ech.load_scenario("planar-quadrotor", [*still, "report.steady_window=0.01"])
    [row] = ech.compare(scenario, only=("optimal-leader",)).rows
    assert row.flight is None and "there is none" in row.reason


# ---- solve (LMI) ----


@pytest.mark.parametrize("seed", range(5))
def test_the_printed_lmi_is_refused_with_a_vector_that_violates_it(seed):
    rng = np.random.default_rng(seed)
    goals, drifts = rng.normal(size=(2, 3, 2))
    P = spd(rng, 2)
    found = violation(printed_lmi(P, goals, drifts))
    # The same form, block by block from the paper's definition.
    values, vectors = np.linalg.eigh(np.linalg.inv(P))
    root = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    a, b = found.vector.reshape(2, 3, 2)
    D = goals[None] - goals[:, None]
    F = drifts[:, None] - drifts[None]
    square = np.einsum("ia,ija,kjb,kb->", b, F, D, b)
    value = 2.0 * np.einsum("ia,ab,ib->", a, root, b) - square
    assert value == pytest.approx(found.value, rel=1e-9) and value > 0.0
    assert np.linalg.norm(found.vector) == pytest.approx(1.0)


def test_no_scenario_gets_a_gain_from_the_printed_lmi():
    with pytest.raises(ech.EchelonError) as refused:
        ech.build(ech.load_scenario("paper", ["follower.gain={method: printed-lmi}"]))
    text = str(refused.value)
    # At P = I and goals that differ in position alone K is [[0, I], [I, 0]].
    largest = np.linalg.eigvalsh(np.kron([[0.0, 1.0], [1.0, 0.0]], np.eye(12)))[-1]
    assert (
        f"has no solution: at every P > 0 its largest eigenvalue is above 0, and {largest:g} at"
        in text
    )
