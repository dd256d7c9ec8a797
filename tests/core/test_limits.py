"""Inputs too large for the memory are refused before allocation; errors name what would fit."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import echelon as ech
from echelon.core import limits
from echelon.core.errors import ModelError, Outcome
from echelon.core.limits import MOST_AGENTS, MOST_STEPS, horizon_fault
from echelon.experiments.scenario import build as scenario_build
from echelon.simulation.engine.batch import Batch
from echelon.simulation.engine.prepare import check_memory

HUGE = 10**23
KINDS = ech.Graph.ring, ech.Graph.star, ech.Graph.complete


def settings(**changes):
    return ech.Settings(**{"horizon": 1.0, "dt": 0.1} | changes)


def test_what_does_not_fit_is_refused_before_it_is_made():
    cases = [
        (lambda: ech.Graph.path(HUGE), "1e+23 agents are asked for, and 1000000 fit"),
        *((partial(kind, HUGE), "1e+23 agents") for kind in KINDS),
        (lambda: ech.Graph.grid(10**17, 10**11), "1e+28 agents"),
        (lambda: ech.Graph.geometric(HUGE, 0.1), "1e+23 agents"),
        (lambda: ech.Graph([(0, 1), (1, 999_999_999)]), "1000000000 agents are asked for"),
        (lambda: ech.Graph([(0, 1)], agents=HUGE), "1e+23 agents"),
        (lambda: ech.Graph.complete(100_000), "4999950000 edges are asked for, and 10000000 fit"),
        (lambda: ech.Graph.geometric(MOST_AGENTS, 5.0), "5e+11 edges"),
        (lambda: ech.models.SingleIntegrator(HUGE), "1e+23 states of an agent are asked for"),
        (lambda: ech.models.DoubleIntegrator(2000), "4000 states of an agent are asked for"),
        (lambda: settings(horizon=2.5e9, dt=1e-3).check(), "has 2.5e+12 steps of 0.001 s, and"),
        (lambda: settings(horizon=1e308, dt=1e-308).check(), "has 1e+616 steps"),
        (lambda: settings(dt=1e-308).check(), "has 1e+308 steps"),
        (lambda: settings(store_every=HUGE).check(), "`store_every` is 1000000"),
        (lambda: settings(seed=HUGE).check(), "`seed` is 1000000"),
    ]
    for window in (-1.0, 0.0, 1.1, np.nan, np.inf):
        wrong = partial(settings, steady_window=window)
        cases.append((lambda wrong=wrong: wrong().check(), f"`steady_window` is {window}"))
    settings(steady_window=1.0).check()
    # More columns than agents are one row.
    agent, graph = ech.models.DoubleIntegrator(2), ech.Graph.path(5)
    rows = [ech.Formation.grid(agent, graph, columns=count).offsets for count in (5, HUGE)]
    np.testing.assert_array_equal(*rows)
    for make, said in cases:
        with pytest.raises(ech.EchelonError) as refused:
            make()
        text = str(refused.value)
        assert said in text and text.count("\n") == 0 and text.endswith(".")


def test_a_run_that_stores_too_much_is_told_what_would_fit(monkeypatch):
    agent, graph = ech.models.DoubleIntegrator(2), ech.Graph.path(4)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    parts = ech.Parts(agent, graph, ech.Formation.from_offsets(agent, graph, {}), drive)
    assert limits.memory() > 2**28
    monkeypatch.setattr(limits, "memory", lambda: 2**30)
    long = settings(horizon=1e7)
    with pytest.raises(ech.EchelonError, match="needs? .* GiB of memory, and 0.5 GiB fit") as no:
        ech.simulate(parts, long)
    every = int(str(no.value).partition("a `store_every` of ")[2].partition(",")[0])
    check_memory(parts.model, 4, long._replace(store_every=every))
    with pytest.raises(ech.EchelonError):
        check_memory(parts.model, 4, long._replace(store_every=every // 2))
    # And so would a shorter run.
    times = float(str(no.value).partition("or a horizon ")[2].partition(" ")[0])
    check_memory(parts.model, 4, long._replace(horizon=round(1e7 / times * 0.99)))


class Nameless(ech.models.SingleIntegrator):
    @property
    def state_names(self):
        return None


def test_a_model_is_checked_before_its_states_are_counted_and_ends_no_other_run():
    agent, graph = ech.models.SingleIntegrator(2), ech.Graph.path(3)
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    right = ech.Parts(agent, graph, ech.Formation.from_offsets(agent, graph, {}), drive)
    models = "car", None, ech.models.SingleIntegrator, Nameless(2)
    wrong = [right.replace(model=model) for model in models]
    for parts in wrong:
        with pytest.raises(ModelError):
            ech.simulate(parts, settings())
    *refused, last = Batch(1).fly([(parts, settings()) for parts in (*wrong, right)])
    assert [type(each) for each in refused] == [ModelError] * 4
    assert isinstance(last, ech.Result) and last.outcome is Outcome.COMPLETED


def test_a_run_without_room_is_refused_before_a_gain_is_made(monkeypatch):
    """A gain may take long where agents are many."""

    def make(*_):
        raise AssertionError("a gain is made")

    monkeypatch.setattr(limits, "memory", lambda: 2**20)
    monkeypatch.setattr(scenario_build, "synthesize", make)
    scenario = ech.load_scenario("paper")
    with pytest.raises(ech.EchelonError, match="GiB of memory, and .* GiB fit"):
        scenario_build.build(scenario, to_run=True)
    with pytest.raises(AssertionError):
        scenario_build.build(scenario)


@given(st.integers(1, MOST_STEPS), st.floats(1e-6, 1e3))
def test_a_whole_number_of_steps_is_a_horizon(steps, dt):
    assert horizon_fault(steps * dt, dt) is None
    assert round(steps * dt / dt) == steps


@given(st.integers(1, 10**6), st.floats(0.001, 0.999), st.floats(1e-6, 1e3))
def test_a_part_of_a_step_is_told_with_the_horizons_beside_it(steps, part, dt):
    said = horizon_fault((steps + part) * dt, dt)
    below, above = said.partition("such as ")[2].removesuffix(" s").split(" or ")
    assert [float(below), float(above)] == pytest.approx([steps * dt, (steps + 1) * dt], rel=1e-11)
