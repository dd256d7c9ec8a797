"""What a varying g adds along the leader's path: a guarantee needs the leader's own inputs."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.core.words import Theorem
from echelon.guarantees.promises.coverage import coverage, covered

LINE = ech.Graph.path(4)


class Growing(ech.ControlAffine):
    """Two axes, each with a velocity input that acts more strongly the farther out it is."""

    state_names, input_names = ("x", "y"), ("vx", "vy")
    position = ("x", "y")

    def drift(self, x):
        return -0.1 * x

    def input_map(self, x):
        return jnp.diag(1.0 + 0.5 * x)

    def flat_state(self, *derivatives):
        return derivatives[0]


def parts_of(leader, **inputs):
    """Parts on half a unit of both axes and these inputs, behind a leader under a gain."""
    model = Growing()
    gain = ech.synthesize(model, LINE, ech.gains.RobustLQR({"x": 0.5, "y": 0.5, **inputs}))
    drive = ech.Laws(leader(gain), ech.laws.Consensus(gain, feedforward="relay"))
    return ech.Parts(model, LINE, ech.Formation(np.zeros((4, 2))), drive)


def promised(leader, **inputs):
    return ech.guarantee(parts_of(leader, **inputs), ech.Settings(4.0, 0.01))


def pushed(gain, push):
    """A leader that follows states of its own, under inputs of a size."""
    times = np.linspace(0.0, 4.0, 401)
    inputs = push * np.stack([np.sin(3.0 * times), np.cos(3.0 * times)], axis=1)
    states = [np.zeros(2)]
    for u in inputs[:-1]:
        x = states[-1]
        states.append(x + 0.01 * (-0.1 * x + (1.0 + 0.5 * x) * u))
    return ech.laws.Tracking(ech.references.StatePath(times, states, inputs), gain)


@pytest.mark.slow
@pytest.mark.parametrize("push", [0.9, 0.3])
def test_small_errors_are_guaranteed_only_with_inputs_that_the_hull_covers(push):
    bare = promised(lambda gain: pushed(gain, push))
    assert bare.region is None or bare.theorem is not Theorem.T2
    line = " ".join(x.text for x in bare.hypotheses.values())
    assert "the leader's own input reaches" in line and ("`vy`" in line or "`vx`" in line)
    covered = promised(lambda gain: pushed(gain, push), vx=0.5, vy=0.5)
    if push < 0.5:
        assert covered.theorem is Theorem.T2
        assert "vx in [-0.5, 0.5], vy in [-0.5, 0.5]" in covered.domain
    else:
        assert covered.region is None


def test_a_domain_says_which_inputs_stay_at_the_trim():
    found = promised(lambda _: ech.laws.TrimInput(), vx=0.5)
    assert found.theorem is Theorem.T2
    assert "vx in [-0.5, 0.5], vy at its trim" in found.domain
    assert "vy at its trim" in in_words(found)


@pytest.mark.parametrize(("agent", "entry", "said"), [(0, 0, "`x`"), (0, 3, "`vy`"), (1, 0, "")])
def test_states_and_inputs_of_the_leader_count_in_every_step_and_those_of_followers_do_not(
    agent, entry, said
):
    parts = parts_of(lambda gain: pushed(gain, 0.3), vx=0.5, vy=0.5)
    settings = ech.Settings(4.0, 0.01, store_every=200)
    result, promise = ech.simulate(parts, settings), ech.guarantee(parts, settings)
    assert promise.theorem is Theorem.T2 and covered(result, promise) is True
    # In some step between the three frames.
    highest = result.sums.highest.copy()
    highest[agent, entry] = 0.6
    seen = dataclasses.replace(result, sums=result.sums._replace(highest=highest))
    assert covered(seen, promise) is not bool(said)
    text = " ".join(coverage(seen, promise))
    assert (f"agent 0 left the domain in some step ({said})" in text) is bool(said)
