"""The observed region of attraction: against regions known in closed form, and exact bounds."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import echelon as ech
from echelon.experiments.studies import basin
from echelon.experiments.studies.observed_region import (
    ObservedRegion,
    ScaleTrial,
    failure_bound,
    observed_region,
    start_widths,
)
from echelon.experiments.sweeps.sweep_dataset import succeeded
from echelon.output.plots.study_figures import certified_scale, save_design_figures
from echelon.output.reports.region_report import region_report, region_sentences


class Saturated(ech.models.Linear):
    """x' = x + u within |u| <= 1: no input returns it from |x| >= 1."""

    def limit(self, u):
        return jnp.clip(u, -1.0, 1.0)


class Own(ech.laws.Law):
    """A law of a user's own."""

    def update(self, model, view, memory):
        return -3.0 * view.disagreement, memory


def unstable(law=None, initial=None):
    model, graph = Saturated([[1.0]], [[1.0]]), ech.Graph.path(2)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain([[3.0]], coupling=1.0))
    law = ech.laws.Consensus(gain) if law is None else law
    laws, still = ech.Laws(ech.laws.TrimInput(), law), ech.Formation(np.zeros((2, 1)))
    initial = {"x1": 0.5} if initial is None else initial
    return ech.Parts(model, graph, still, laws, initial=initial)


SETTINGS = ech.Settings(25.0, 0.05, steady_window=1.0)


def draws(seeds):
    return np.array([np.random.default_rng(k).uniform(-1.0, 1.0, (2, 1))[1, 0] for k in seeds])


def test_the_region_of_a_saturated_unstable_agent_is_found_to_the_start():
    # Behind |x| = 1 the agent leaves whatever its input is; within, all starts come back.
    region = observed_region(unstable(), SETTINGS, scales=(4.0, 1.9, 2.1), seeds=100)
    assert [trial.scale for trial in region.trials] == [1.9, 2.1, 4.0]
    for trial in region.trials:
        outside = int((np.abs(0.5 * trial.scale * draws(range(100))) >= 1.0).sum())
        assert trial.failed == outside, trial
        assert (trial.failed == 0) == (trial.scale < 2.0)
    assert region.reached is not None and region.reached.scale == 1.9
    assert region.spreads == {"x1": 0.5} and region.drawn and region.within == 24.0


def test_a_law_of_a_users_own_is_observed_too():
    seeds = 8
    region = observed_region(unstable(Own()), SETTINGS, scales=(1.0, 8.0), seeds=seeds)
    outside = int((np.abs(4.0 * draws(range(seeds))) >= 1.0).sum())
    assert [trial.failed for trial in region.trials] == [0, outside]


def test_spreads_are_taken_from_given_starts_and_without_any_the_region_is_refused():
    for given in ({1: [0.4]}, np.array([[0.0], [-0.4]])):
        widths, drawn = start_widths(unstable(initial=given))
        assert widths.tolist() == [0.4] and not drawn
    widths, _ = start_widths(unstable(initial={"x1": 0.7, 1: [0.4]}))
    assert widths.tolist() == [0.7]
    for nothing in ({}, {"x1": 0.0}, {1: [0.0]}):
        with pytest.raises(ech.EchelonError, match="a region needs starts that are off the goals"):
            observed_region(unstable(initial=nothing), SETTINGS, seeds=1)


def test_angles_a_turn_apart_are_no_spread():
    model, graph = ech.models.Unicycle(), ech.Graph.path(2)
    rest = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    starts = np.zeros((2, len(model.state_names)))
    starts[1, model.state_names.index("heading")] = 2.0 * np.pi + 0.1
    parts = ech.Parts(model, graph, ech.Formation(0.0 * starts), rest, initial=starts)
    assert start_widths(parts)[0].max() == pytest.approx(0.1)


@pytest.mark.parametrize(("failed", "runs"), [(0, 200), (1, 200), (13, 40), (39, 40)])
def test_a_bound_is_exact(failed, runs):
    # At the bound, so few failures or fewer have a probability of 5 %.
    bound = failure_bound(failed, runs)
    assert scipy.stats.binom.cdf(failed, runs, bound) == pytest.approx(0.05, rel=1e-9)
    assert failure_bound(0, 200) == pytest.approx(1.0 - 0.05 ** (1.0 / 200.0))
    assert failure_bound(runs, runs) == 1.0


def region_of(*failed, runs=200):
    trials = [ScaleTrial(2.0**k, runs, {"late": n} if n else {}) for k, n in enumerate(failed)]
    return ObservedRegion({"x": 1.0}, {"x": "m"}, True, 8.0, "m", True, tuple(trials))


def test_the_region_ends_before_the_first_failure():
    assert region_of(0, 0, 1, 0).reached == ScaleTrial(2.0, 200, {})
    assert region_of(1, 0).reached is None
    assert region_of(0, 0, 0).reached == ScaleTrial(4.0, 200, {})


def test_the_chosen_bound_holds_in_95_percent_of_experiments():
    # Also where the probability passes the bound between two scales, and draws are independent.
    rng, probabilities = np.random.default_rng(1), (0.001, 0.014, 0.016, 0.016, 0.016, 0.016)
    false = 0
    for _ in range(4000):
        region = region_of(*(int(rng.binomial(200, p)) for p in probabilities))
        best = region.reached
        false += best is not None and probabilities[int(np.log2(best.scale))] > best.bound
    # Of 4000 at 5 %: 200, with a standard deviation of 14.
    assert false <= 200 + 4 * 14


@pytest.mark.slow
def test_a_success_is_that_of_a_sweep():
    changes = ["simulation.horizon=9", "initial.spread={position: 0.3}"]
    scenario = ech.load_scenario("integrators", changes)
    parts, settings = ech.build(scenario)
    region = observed_region(parts, settings, scales=(1.0,), seeds=24)
    data = ech.sweep(scenario, {"seed": range(24)})
    latest = settings.horizon - settings.window
    arrived = succeeded(data) & (data["worst_settling_time"] <= latest)
    assert 0 < int(arrived.sum()) < 24
    assert region.trials[0].failed == 24 - int(arrived.sum())


def test_a_report_of_a_region_is_short_and_states_the_bound_first():
    for region in (region_of(0, 0, 3), region_of(200), region_of(0)._replace(limits=False)):
        text = region_report(region)
        assert all(len(line) <= 80 for line in text.splitlines())
        assert all(len(sentence.split()) <= 25 for sentence in region_sentences(region))
    first = next(region_sentences(region_of(0, 0, 3)))
    assert first.startswith("Starts at up to 2 times the spreads: 0 of 200 failed")
    assert first.endswith("below 1.5 % at 95 %.")
    mapping = region_of(0, 3).as_mapping()
    assert mapping["reached"] == 1.0 and mapping["trials"][1]["failed"] == 3


def test_starts_up_to_the_certified_scale_are_in_the_certified_set():
    parts = unstable()
    P, region = float(parts.drive.gain.P[0, 0]), region_of(0)._replace(spreads={"x1": 0.5})
    # One follower, one state: P (s w)^2 = r^2.
    assert certified_scale(parts, 0.3, region) == pytest.approx(0.3 / (0.5 * np.sqrt(P)))


def test_the_centre_of_a_grid_is_the_goal():
    plane = basin.StateSlice((0, 1), np.eye(2), np.ones(2))
    for side in (11, 21, 41):
        for axis in basin.grid(plane, np.array([9.7, 1.37]), side):
            assert axis[side // 2] == 0.0 and axis[0] == -axis[-1]


def test_a_region_is_drawn_where_nothing_is_certified(tmp_path):
    # One state has no slice, so that the region has a figure of its own.
    files, radii = save_design_figures(unstable(), SETTINGS, tmp_path, region=region_of(0, 5))
    assert radii is None and "observed_region.png" in {file.name for file in files}
