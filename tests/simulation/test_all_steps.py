"""Numbers over all steps: the same whatever frames are stored, and what all frames give."""

import numpy as np
import pytest

import echelon as ech
from echelon.experiments.results.event_outcomes import event_outcomes
from echelon.simulation.step.meter import SETTLED

CART, K = ech.models.DoubleIntegrator(), 20
RING = ech.Graph([(0, 1), (1, 2), (2, 3), (3, 0), (1, 3)])
LAWS = ech.Laws(
    ech.laws.StoppingLeader(reference=ech.references.Circle(radius=2.0, rate=0.7)),
    ech.laws.StoppingPoint(coupling=4.0),
)
# No event at a multiple of 20 steps, so that a span never begins at a frame.
SETTINGS = ech.Settings(horizon=6.0, dt=0.02, seed=3)


def parts_of(events, network=None):
    places = {1: [1.0, 0.0], 2: [1.1, 0.1], 3: [0.0, 1.0]}
    formation = ech.Formation.from_offsets(CART, RING, places)
    world = ech.World(
        network=network, disturbance=ech.Disturbance(rms={"velocity": 0.3}, hold=0.1, seed=1)
    )
    return ech.Parts(CART, RING, formation, LAWS, {"position": 1.5}, world=world, events=events)


def pair(parts, engine="auto"):
    settings = SETTINGS._replace(engine=engine)
    return [ech.simulate(parts, settings._replace(store_every=k)) for k in (1, K)]


EXACT = ("steps", "limited", "unsettled", "inside", "chatter", "separation", "peaks", "late")
"""Counts and extremes, which no order of adding rounds."""
CUT = ech.network.Cut((1, 2), 1.5, 1.0)
CASES = {
    "native": ([CUT, ech.network.Cut((0, 3), 3.1)], None, "native"),
    "jax": ([CUT, ech.network.Cut((0, 3), 3.1)], None, "jax"),
    "lost": ([ech.network.Lose(3, 2.1), ech.network.Join(2, 2.9)], None, "jax"),
    "late": ([CUT], ech.Network(rate=25.0, delay=0.04, loss=0.2), "jax"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_no_number_of_a_run_depends_on_the_frames_that_are_stored(case):
    events, network, engine = CASES[case]
    every, some = pair(parts_of(events, network), engine)
    assert every.engine == some.engine == engine
    for name, total in every.sums._asdict().items():
        other = getattr(some.sums, name)
        if name in EXACT:
            assert np.array_equal(total, other, equal_nan=True), name
        elif name not in ("closest", "met"):  # not measured where all steps are frames
            # Added in other stretches: as many roundings as there are steps.
            np.testing.assert_allclose(total, other, rtol=300 * 2.0**-52, err_msg=name)
    assert every.closest is not None and some.closest is not None
    assert some.closest.frames is None
    assert some.closest.agents == every.closest.agents
    assert some.closest[0] == pytest.approx(every.closest[0], rel=1e-12)
    whole, thin = ech.summary(every), ech.summary(some)
    for key in ("largest_age_s", "mean_age_s", "saturation_fraction", "alternations"):
        assert whole[key] == thin[key], key
    for one, other in zip(event_outcomes(every), event_outcomes(some), strict=True):
        assert one.as_mapping() | {"leader": None} == other.as_mapping() | {"leader": None}


@pytest.mark.slow
@pytest.mark.parametrize("case", ["native", "lost"])
def test_the_recovery_after_an_event_is_that_of_all_steps(case):
    events, network, engine = CASES[case]
    every, some = pair(parts_of(events, network), engine)
    times, dt = every.times, SETTINGS.dt
    errors = every.formation_errors[:, [1, 2, 3]]
    outcomes = event_outcomes(some)
    ends = [*(outcome.at for outcome in outcomes[1:]), np.inf]
    for outcome, end in zip(outcomes, ends, strict=True):
        span = (times >= outcome.at - 0.5 * dt) & (times < end - 0.5 * dt)
        worst = errors[span].max(axis=1)
        assert outcome.peak == pytest.approx(worst.max(), rel=1e-12)
        assert outcome.until == pytest.approx(times[span][-1])
        above = np.flatnonzero(worst > SETTLED)
        if len(above) and above[-1] == len(worst) - 1:
            assert outcome.restored is None
        else:
            first = above[-1] + 1 if len(above) else 0
            assert outcome.restored == pytest.approx(times[span][first])
        assert "stored frames" not in outcome.sentence()


def test_what_follows_one_follower_after_an_event_has_a_closed_form():
    # x' = u with u = -c (x - 0) and the exact hold e+ = (1 - c dt) e: no link is needed but one.
    model, graph = ech.models.SingleIntegrator(1), ech.Graph([(0, 1), (0, 2), (1, 2)])
    gain = ech.synthesize(model, graph, ech.gains.FixedGain([[1.0]], coupling=1.0))
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain))
    formation = ech.Formation(np.zeros((3, 1)))
    event = [ech.network.Cut((1, 2), 0.35)]
    parts = ech.Parts(model, graph, formation, laws, np.array([[0.0], [0.5], [0.5]]), events=event)
    run = ech.simulate(parts, ech.Settings(10.0, 0.1, integrator="euler", store_every=30))
    [outcome] = event_outcomes(run)
    # Equal errors do not feel the link between them: e_k = 0.5 * 0.9^k, counted from step 4 on.
    assert outcome.peak == pytest.approx(0.5 * 0.9**4)
    first = int(np.ceil(np.log(0.01 / 0.5) / np.log(0.9)))
    assert outcome.restored == pytest.approx(0.1 * first)
    assert outcome.until == pytest.approx(10.0)
