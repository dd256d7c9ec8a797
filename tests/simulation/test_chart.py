"""States that leave the chart of a model's equations, and inputs that chatter between limits."""

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.core.errors import Outcome


def spinning(start, store_every=1):
    """A quadrotor that begins with a rate of pitch, and no law but the trim input."""
    model, graph = ech.models.Quadrotor(), ech.Graph.path(3)
    states = np.zeros((3, 12))
    states[2, [7, 10]] = start
    rest = ech.laws.TrimInput()
    parts = ech.Parts(
        model, graph, ech.Formation(np.zeros((3, 12))), ech.Laws(rest, rest), initial=states
    )
    return ech.simulate(parts, ech.Settings(1.0, 0.01, store_every=store_every))


@pytest.mark.parametrize("store_every", [1, 40])
@pytest.mark.parametrize(
    ("start", "first"),
    [((1.94, 0.0), 0.0), ((0.0, 2.0), np.ceil(50.0 * np.pi / 2.0) / 100.0), ((0.0, 1.575), 1.0)],
)
def test_an_agent_that_leaves_its_chart_is_named_with_the_time(start, first, store_every):
    # A constant rate q of pitch reaches 90 degrees at pi / (2 q), told to the step.
    run = spinning(start, store_every)
    assert run.outcome is Outcome.LEFT_CHART and run.outcome.exit_code == 1
    assert run.message.startswith(f"Follower 2 left the chart of its equations at t = {first:g} s")
    assert "`pitch` is not between -1.571 and 1.571 rad" in run.message
    assert len(run.times) == (101 if store_every == 1 else 4)
    assert run.message in " ".join(ech.report(run).split())
    assert ech.summary(run)["outcome"] == {"name": "left_chart", "message": run.message}


def test_a_run_whose_agents_all_leave_their_chart_has_left_it_and_others_complete():
    model, graph, rest = ech.models.Quadrotor(), ech.Graph.path(2), ech.laws.TrimInput()
    still, states = ech.Formation(np.zeros((2, 12))), np.zeros((2, 12))
    states[:, 7] = 1.94
    parts = ech.Parts(model, graph, still, ech.Laws(rest, rest), initial=states)
    assert ech.simulate(parts, ech.Settings(0.05, 0.01)).outcome is Outcome.LEFT_CHART
    assert spinning((0.5, 0.1)).outcome is Outcome.COMPLETED


class Cut(ech.models.Linear):
    """x' = u within |u| <= 1."""

    def limit(self, u):
        return jnp.clip(u, -1.0, 1.0)


@pytest.mark.parametrize(("strength", "alternations"), [(30.0, 99), (1.0, 0)])
def test_inputs_that_alternate_between_their_limits_are_counted(strength, alternations):
    # x+ = x - dt sign(x) from dt / 2 for ever, where |k x| > 1; a weak gain decays.
    model, graph = Cut([[0.0]], [[1.0]]), ech.Graph.path(2)
    gain = ech.synthesize(model, graph, ech.gains.FixedGain([[strength]], coupling=1.0))
    laws, starts = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain)), np.array([[0], [0.05]])
    parts = ech.Parts(model, graph, ech.Formation(np.zeros((2, 1))), laws, initial=starts)
    for every in (1, 7):
        run = ech.simulate(parts, ech.Settings(10.0, 0.1, store_every=every))
        assert run.chatter.tolist() == [0, alternations]
        assert ech.summary(run)["alternations"] == alternations
