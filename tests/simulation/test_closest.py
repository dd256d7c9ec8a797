"""The smallest distance over all steps, whatever frames are stored."""

import numpy as np
import pytest

import echelon as ech
from echelon.simulation.engine.batch import Batch
from echelon.simulation.step import distances

SWAP = {
    "name": "swap",
    "model": {"name": "quadrotor", "parameters": "crazyflie"},
    "graph": {"edges": [[0, 1], [0, 2]]},
    "formation": {"offsets": {1: [-1.5, 1.0, 0], 2: [1.5, 1.02, 0]}},
    "reference": {"name": "hover", "position": [0, 0, 1]},
    "initial": {
        "states": {1: [1.52, 1.0, 1, *[0] * 9], 2: [-1.5, 1.02, 1, *[0] * 9]},
    },
    "simulation": {"horizon": 2.0, "dt": 0.005},
}


def built(given=SWAP, **changes):
    parts, settings = ech.build(ech.scenario_from_mapping(given))
    return parts, settings._replace(**changes)


def all_pairs(result):
    """The smallest distance of all frames, its step and agents, pair by pair."""
    places = result.states[:, :, list(result.position)]
    i, j = np.triu_indices(places.shape[1], 1)
    apart = np.linalg.norm(places[:, i] - places[:, j], axis=2)
    frame, pair = np.unravel_index(apart.argmin(), apart.shape)
    return apart.min(), result.times[frame], (i[pair], j[pair])


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("engine", ["jax", "native"])
def test_the_smallest_distance_does_not_depend_on_the_stored_frames(engine, precision):
    parts, settings = built(engine=engine, precision=precision)
    distance, time, agents = all_pairs(ech.simulate(parts, settings))
    assert distance == pytest.approx(0.0214, abs=1e-4) and time == pytest.approx(0.89)
    for every in (7, 40, 400):
        run = ech.simulate(parts, settings._replace(store_every=every))
        found = ech.metrics(run).closest
        rounding = 1e-9 if precision == "float64" else 1e-4
        assert found.distance == pytest.approx(distance, rel=rounding)
        assert found.agents == agents and found.time == pytest.approx(time)
        assert found.frames is None and run.closest_pair().distance > 3.0 * distance
        text = " ".join(ech.report(run).split())
        assert "Warning: agents 1 and 2 came within 0.0214 m at 0.89 s; agents of" in text
        summary = ech.summary(run)
        assert summary["minimum_distance"] == found.distance
        assert summary["minimum_distance_frames"] is None


def many(agents):
    return {
        "name": "many",
        "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
        "graph": {"name": "star", "agents": agents},
        "formation": {"name": "circle", "spacing": 1.0},
        "reference": {"name": "circle", "radius": 3.0, "rate": 0.3},
        "initial": {"spread": {"position": 3.0}},
        "simulation": {"horizon": 5.0, "dt": 0.01, "store_every": 50},
    }


@pytest.mark.parametrize("engine", ["jax", "native"])
def test_of_up_to_32_agents_all_steps_count_and_of_more_the_report_says_frames(engine):
    parts, settings = built(many(distances.PAIRED), engine=engine)
    every = ech.simulate(parts, settings._replace(store_every=1))
    found = ech.simulate(parts, settings).closest
    assert found.distance == pytest.approx(all_pairs(every)[0], rel=1e-9)
    assert found.frames is None
    parts, settings = built(many(distances.PAIRED + 1), engine=engine)
    run = ech.simulate(parts, settings)
    assert run.closest == run.closest_pair()._replace(frames=11)
    assert " s in the 11 stored frames" in " ".join(ech.report(run).split())
    assert ech.summary(run)["minimum_distance_frames"] == 11


@pytest.mark.slow
def test_runs_of_a_batch_have_the_distances_of_each_alone_and_absent_agents_are_near_to_nobody():
    runs = [built(many(5), seed=seed) for seed in range(9)]
    found = [result.closest for result in Batch(1).fly(runs)]
    alone = [ech.simulate(parts, settings._replace(store_every=1)) for parts, settings in runs]
    expected = [all_pairs(result)[0] for result in alone]
    np.testing.assert_allclose([pair.distance for pair in found], expected, rtol=1e-9)
    assert all(pair.frames is None for pair in found)
    given = many(4) | {"events": [{"at": 1.0, "lose": 2}]}
    parts, settings = built(given)
    every = ech.simulate(parts, settings._replace(store_every=1))
    assert ech.simulate(parts, settings).closest.distance == pytest.approx(
        every.closest_pair().distance, rel=1e-9
    )


@pytest.mark.parametrize("engine", ["jax", "native"])
def test_a_torque_of_rounding_size_that_changes_its_sign_is_no_jump_between_limits(engine):
    # Motors reach 0 N and never their upper limit.
    offsets = [[0.83, -1.74, 0.73], [0.4, 1.4, -1.88], [-0.88, -0.54, 1.15], [-1.29, 0.81, 1.56]]
    given = {
        "name": "torque",
        "model": {"name": "quadrotor", "parameters": "crazyflie"},
        "seed": 191,
        "graph": {"edges": [[0, 1, 1.53], [1, 2, 0.74], [0, 3, 1.06], [2, 4, 1.45]]},
        "follower": {"feedforward": "none", "frame": "world"},
        "reference": {"name": "circle", "center": [0, 0, 1.0], "radius": 1.0, "rate": 0.5},
        "formation": {"offsets": dict(enumerate(offsets, 1))},
        "initial": {"spread": {"position": 0.5}},
        "disturbance": {"rms": {"velocity": 0.5}, "hold": 0.03},
        "simulation": {"horizon": 0.16, "dt": 0.005, "integrator": "euler"},
    }
    parts, settings = built(given, engine=engine)
    result = ech.simulate(parts, settings)
    motors = result.inputs[:, 4] @ np.asarray(parts.model.input_limits.matrix).T
    assert motors.min() < 1e-12 and motors.max() < 0.9 * parts.model.motor_thrust
    assert ech.summary(result)["alternations"] == 0


@pytest.mark.parametrize("engine", ["jax", "native"])
def test_a_continued_run_has_the_same_smallest_distance(engine):
    given = many(4) | {"simulation": {"horizon": 3000.0, "dt": 0.01, "store_every": 5000}}
    parts, settings = built(given, engine=engine)
    stretches, whole = [], ech.simulate(parts, settings)

    def stop(run):
        raise KeyboardInterrupt

    part = ech.simulate(parts, settings, progress=stop, keep=stretches.append)
    assert 0 < part.sums.steps[0] < whole.sums.steps[0]
    again = ech.simulate(parts, settings, before=stretches)
    np.testing.assert_array_equal(again.sums.closest, whole.sums.closest)
    np.testing.assert_array_equal(again.sums.met, whole.sums.met)
