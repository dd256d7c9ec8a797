"""What is guaranteed where offsets change with time (T5), and what is not."""

import copy
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from in_words import in_words

import echelon as ech
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate, Scale
from echelon.core.statement import Hypothesis
from echelon.experiments.scenario.build import Experiment
from echelon.experiments.studies.check import check
from echelon.experiments.studies.recomputation import compare_claims
from echelon.guarantees.promises.promise import guarantee
from echelon.guarantees.stopping.moving_offsets import offset_sizes
from echelon.guarantees.verifier.verify import verify

AGENT = ech.models.Quadrotor.crazyflie()
GRAPH = ech.Graph.from_edges([[0, 1], [1, 2]])
SETTINGS = ech.Settings(horizon=6.0, dt=0.005)
PLACES = {1: (1.0, 0.0, 0.0), 2: (0.0, 1.0, 0.2)}


OTHER = ech.Formation.from_offsets(AGENT, GRAPH, {1: (-0.6, 0, 0.1), 2: (0, 0.5, 0)}).offsets
CHANGES, TURN = [Rotate(0.5), Scale(0.3, 0.7), Reshape(OTHER, 1.0, 3.0)], [Rotate(0.5)]


class Wave(OffsetMotion):
    """Heights that rise and fall."""

    def __call__(self, place, t):
        return place.at[-1].add(0.2 * jnp.sin(t))


CENTRE = ech.references.Circle(center=(0, 0, 1), radius=1.0, rate=0.5)


def parts(changes, model=AGENT, follower=None, **initial):
    places = {k: x[: len(model.position)] for k, x in PLACES.items()}
    formation = ech.Formation.from_offsets(model, GRAPH, places)
    formation = formation.moving(model, GRAPH, changes) if changes else formation
    leader = ech.laws.StoppingLeader(reference=CENTRE)
    drive = ech.Laws(leader, follower or ech.laws.StoppingPoint())
    return ech.Parts(model, GRAPH, formation, drive, initial=initial)


@pytest.mark.slow
def test_bounds_of_offsets_hold_at_all_times_and_are_not_far_above():
    motion = parts(CHANGES).formation.motion
    bounds = np.array(offset_sizes(motion), float)
    times = jnp.linspace(0.0, 40.0, 8001)
    with jax.enable_x64(True):
        one = jax.vmap(lambda row, t: motion.derivatives(row, t, 5), (0, None))
        values = np.asarray(jax.jit(jax.vmap(one, (None, 0)))(jnp.asarray(motion.places), times))
    across = np.linalg.norm(values[..., :2], axis=-1).max(axis=(0, 1))
    upward = np.abs(values[..., 2]).max(axis=(0, 1))
    for seen, bound in ((across, bounds[:, 0]), (upward, bounds[:, 2])):
        assert (seen <= bound).all() and (bound <= 4.0 * seen).all()
    with pytest.raises(ech.EchelonError, match="may be beyond 1e\\+300.$"):
        offset_sizes(parts([Rotate(1e200)]).formation.motion)


@pytest.mark.slow
def test_a_motion_is_guaranteed_with_what_it_asks_of_the_chart():
    still, moving = (guarantee(parts(x), SETTINGS) for x in ([], CHANGES))
    assert moving.claimed and moving.rate == still.rate
    assert "offsets may change as they do" in in_words(moving)
    assert "offsets" in moving.anywhere() and "offsets" not in still.anywhere()
    # Offsets that rise and fall use up a part of the thrust.
    size = float(offset_sizes(parts(CHANGES).formation.motion)[2][2])
    assert still.tube.left - moving.tube.left == pytest.approx(size, rel=1e-9)
    assert "that of the own offset and the leader's" in in_words(moving)


@pytest.mark.slow
def test_agents_stay_within_the_tube_of_a_moving_formation():
    roots = (2.0, 2.5, 3.0)
    gentle = ech.laws.StoppingPoint(roots=roots, speed=(0.7, 0.7, 0.5, 1.0))
    drive = ech.Laws(ech.laws.StoppingLeader(reference=CENTRE, roots=roots), gentle)
    one = parts([Rotate(0.3), Scale(0.2, 0.4)], position=0.5, attitude=0.1).replace(drive=drive)
    value, still = guarantee(one, SETTINGS), guarantee(parts([]).replace(drive=drive), SETTINGS)
    load = value.tube.motor_load
    assert load is not None and load.alone is None and still.tube.motor_load.alone is not None
    result = ech.simulate(one, SETTINGS)
    thrust = result.inputs @ np.asarray(AGENT.input_limits.matrix).T
    assert load.least <= thrust.min() and thrust.max() <= load.largest
    # With the arrival that is promised, of the moving goals.
    errors = result.formation_errors[result.times >= value.tube.arrival]
    assert len(errors) and errors.max() < 0.01


@pytest.mark.slow
def test_no_bound_of_a_user_s_motion_leaves_agents_with_borders_unguaranteed():
    value = guarantee(parts([Wave()]), SETTINGS)
    assert not value.promised
    assert "no bound of the motion `Wave` is known" in in_words(value)
    carts = guarantee(parts([Wave()], ech.models.DoubleIntegrator(3)), SETTINGS)
    assert carts.promised


def test_a_law_of_states_is_not_guaranteed():
    model = ech.models.DoubleIntegrator(3)
    gain = ech.synthesize(model, GRAPH, ech.gains.Riccati())
    drive = ech.Laws(ech.laws.Tracking(CENTRE), ech.laws.Consensus(gain))
    still, moving = (parts(x, model).replace(drive=drive) for x in ([], [Rotate(0.5)]))
    assert guarantee(still, SETTINGS).promised
    value = guarantee(moving, SETTINGS)
    assert not value.promised and value.hypotheses[Hypothesis.SYMMETRY].fails
    assert "offsets change with time" in in_words(value)


@pytest.mark.slow
def test_safety_keeps_the_tube_of_the_speed_and_promises_no_convergence():
    apart = ech.laws.StoppingPoint(safety=ech.Safety(radii=(0.1, 0.1, 0.3)))
    still, moving = (guarantee(parts(x, follower=apart), SETTINGS) for x in ([], [Rotate(0.5)]))
    assert moving.tube.left == still.tube.left and moving.rate is None
    assert "not guaranteed while offsets change" in in_words(moving)
    assert "decay at" not in in_words(moving)


FORGERIES = {
    "smaller bounds": lambda claim: claim["sizes"][2].__setitem__(0, 0.5 * claim["sizes"][2][0]),
    "slower rotation": lambda claim: claim["motions"][0].update(rate=0.1),
    "larger scale": lambda claim: claim["motions"][1].update(amplitude=0.9),
    "quicker reshape": lambda claim: claim.update(over=[1.0]),
    "another shape": lambda claim: claim.update(sizes=[row[:2] for row in claim["sizes"]]),
}


def test_claims_of_offsets_are_checked_by_code_of_its_own(tmp_path):
    document = json.loads(
        json.dumps({"guarantee": guarantee(parts(CHANGES), SETTINGS).as_mapping()})
    )
    file = tmp_path / "summary.json"
    file.write_text(json.dumps(document))
    assert verify(file).verdict == "incomplete", verify(file).sentence
    for name, forge in FORGERIES.items():
        forged = copy.deepcopy(document)
        forge(forged["guarantee"]["anywhere"]["offsets"])
        file.write_text(json.dumps(forged))
        assert verify(file).verdict == "refused", name


@pytest.mark.slow
def test_a_moving_run_is_not_accepted_under_the_promise_of_constant_offsets():
    stored = json.loads(json.dumps([check(parts(x), SETTINGS).as_mapping() for x in ([], TURN)]))
    moving = Experiment(parts(TURN), SETTINGS)
    still, own = ({x.verdict for x in compare_claims(x, moving, "moves")} for x in stored)
    assert "refused" in still and own == {"recomputed"}
