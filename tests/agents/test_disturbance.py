"""Disturbances that laws do not know: wind, noise, and a plant that differs from the model."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from oracles import laplacian
from runs import simulate

from echelon import (
    Disturbance,
    Formation,
    Graph,
    build,
    dataset,
    load_scenario,
    lyapunov,
    report,
    scenario_from_mapping,
    summary,
    synthesize,
)
from echelon.agents import models
from echelon.agents.references import Hover
from echelon.agents.world.world import differences, vary_parameters
from echelon.core.errors import EchelonError, Outcome, ScenarioError
from echelon.core.numerics import precision
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.named_class import resolve
from echelon.laws import Consensus, Tracking, TrimInput
from echelon.synthesis.gains import FixedGain, Riccati

TREE = Graph.from_edges([(0, 1), (1, 2), (1, 3)])
CART = models.DoubleIntegrator(2)
STILL, ROW = Tracking(Hover((0, 0, 0))), {1: (1, 0), 2: (2, 0), 3: (3, 0)}
ALLOWED = "got `0`, allowed is a number"


def flown(model, graph, offsets, follower, leader=None, **more):
    """Agents under two laws, of which the leader's is the trim unless given."""
    formation, leader = Formation.from_offsets(model, graph, offsets), leader or TrimInput()
    return simulate(model, graph, formation, leader=leader, follower=follower, **more)


def drift(model=CART, agents=3, **options):
    """Agents that do nothing but what the wind does with them."""
    settings = {"horizon": 2.0, "dt": 0.01} | options
    return flown(model, Graph.path(agents), {}, TrimInput(), **settings)


def accelerations(run):
    """The wind of each step on carts, (steps, agents, 2)."""
    return np.diff(run.states[:, :, 2:], axis=0) / run.settings.dt


def test_a_constant_wind_alone_makes_a_parabola():
    run = drift(disturbance=Disturbance(constant={"vx": 0.5, "velocity": -0.25}))
    t = run.times[:, None]
    assert run.states[:, :, 0] == pytest.approx(np.tile(0.25 * t**2, 3), abs=1e-13)
    assert run.states[:, :, 1] == pytest.approx(np.tile(-0.125 * t**2, 3), abs=1e-13)
    assert run.states[:, :, 2] == pytest.approx(np.tile(0.5 * t, 3), abs=1e-13)
    assert not run.inputs.any()


@pytest.mark.parametrize("feedforward", ["none", "relay"])
def test_under_a_constant_wind_carts_settle_where_statics_says(feedforward):
    gain = synthesize(CART, TREE, Riccati())
    offsets, law = {1: (1, 0), 2: (1, 0.8), 3: (1, -0.8)}, Consensus(gain, feedforward=feedforward)
    wind = Disturbance(constant={"vx": 0.5, "vy": -0.2})
    run = {"disturbance": wind, "horizon": 60.0, "dt": 0.02, "store_every": 100}
    run = flown(CART, TREE, offsets, law, STILL, initial={"position": 1.0}, **run)
    # One axis of a double integrator with Q = R = I: P = [[sqrt 3, 1], [1, sqrt 3]], so u = -p - ..
    wind = np.array([0.5, -0.2])
    assert run.states[-1, 0, :2] == pytest.approx(wind, abs=1e-9)
    grounded = laplacian(4, TREE.edges)[1:, 1:]
    lag = np.linalg.solve(grounded, np.ones(3)) / gain.coupling
    # What the leader does against the wind is what its followers need.
    wanted = np.outer(lag, wind) if feedforward == "none" else np.zeros((3, 2))
    assert run.errors[-1, 1:, :2] == pytest.approx(wanted, abs=1e-9)


def test_linear_agents_settle_where_the_linear_system_says():
    rng = np.random.default_rng(2)
    A, B = rng.normal(size=(3, 3)) - 3.5 * np.eye(3), rng.normal(size=(3, 1))
    assert np.linalg.eigvals(A).real.max() < -0.3
    model, leak = models.Linear(A, B, names=("a", "b", "c")), 1.04
    gain = synthesize(model, TREE, FixedGain(coupling=0.7))
    world = {
        "plant": vary_parameters(model, {}, {"B": leak}),
        "disturbance": Disturbance(constant={"a": 0.3, "b": -0.1, "c": 0.5}),
    }
    run = {"initial": rng.normal(size=(4, 3)), "horizon": 80.0, "dt": 0.02, "store_every": 1000}
    run = flown(model, TREE, {}, Consensus(gain, "none"), **world, **run)
    L = laplacian(4, TREE.edges)
    L[0] = 0.0
    closed = np.kron(np.eye(4), A) - 0.7 * leak * np.kron(L, B @ B.T)
    wanted = np.linalg.solve(closed, -np.tile([0.3, -0.1, 0.5], 4)).reshape(4, 3)
    assert run.states[-1] == pytest.approx(wanted, abs=1e-9)


def test_the_wind_has_its_rms_and_neither_time_nor_agents_repeat_it():
    gusts = Disturbance(rms={"vx": 2.0, "vy": 0.5}, hold=0.25)
    run = drift(agents=40, horizon=10.0, dt=0.05, disturbance=gusts)
    wind = accelerations(run).reshape(40, 5, 40, 2)
    assert np.abs(wind - wind[:, :1]).max() <= 1e-9, "held over 5 steps of 0.05 s"
    draws = wind[:, 0] / [2.0, 0.5]
    # 1600 draws of each: the standard deviation is known to 1 / sqrt(3200) = 1.8 %.
    assert draws.std(axis=(0, 1)) == pytest.approx([1.0, 1.0], rel=0.07)
    assert scipy.stats.kstest(draws.ravel(), "norm").pvalue > 1e-3
    pairs = (draws[:-1], draws[1:]), (draws[:, :-1], draws[:, 1:]), (draws[..., 0], draws[..., 1])
    across = [np.corrcoef(one.ravel(), other.ravel())[0, 1] for one, other in pairs]
    assert np.abs(across).max() < 0.1


GUSTS = Disturbance(rms={"velocity": 1.0}, input_rms={"ax": 0.3}, hold=0.1)


@pytest.mark.study
def test_the_same_scenario_has_the_same_wind_whatever_is_asked_of_the_run():
    run, start = drift(disturbance=GUSTS), {"initial": {"position": 1.0}}
    assert np.array_equal(run.states, drift(disturbance=GUSTS).states)
    assert np.array_equal(run.states[::7], drift(disturbance=GUSTS, store_every=7).states[:29])
    assert np.array_equal(run.states, drift(disturbance=GUSTS, agents=9).states[:, :3])
    shorter = drift(disturbance=GUSTS, dt=0.005)
    assert np.abs(run.states - shorter.states[::2]).max() <= 1e-13
    single = drift(disturbance=GUSTS, precision="float32")
    assert np.abs(run.states - single.states).max() <= 1e-4
    graph = Graph.path(3)
    law = Consensus(synthesize(CART, graph, Riccati()), feedforward="relay")
    # With the input known, the rest of the acceleration is the wind.
    formed = flown(CART, graph, {}, law, **start, disturbance=GUSTS, horizon=2.0, dt=0.01)
    wind = accelerations(formed) - formed.inputs[:-1]
    assert wind == pytest.approx(accelerations(run), abs=1e-9)


@pytest.mark.parametrize(
    ("hold", "dt", "steps"), [(0.3, 0.1, 3), (0.7, 0.1, 7), (0.04, 0.1, 1), (0.26, 0.1, 3)]
)
def test_a_draw_lasts_the_nearest_number_of_steps(hold, dt, steps):
    with precision("float64"):
        wind = Disturbance(rms={"vx": 1.0}, hold=hold).prepared(models.DoubleIntegrator(1), dt, 0)
        drawn = [float(wind.on_state(jnp.asarray(k), jnp.asarray(0))[1]) for k in range(3 * steps)]
    # 0.3 / 0.1 is a little less than 3.
    assert len(set(drawn)) == 3
    assert drawn == [x for x in drawn[::steps] for _ in range(steps)]


def test_seeds_make_other_winds_and_the_disturbance_may_have_its_own():
    def states(own=None, **more):
        return drift(horizon=0.1, disturbance=dataclasses.replace(GUSTS, seed=own), **more).states

    once, long = states(), states(3 + 2**40)
    assert np.abs(states(seed=1) - once).max() > 1e-3
    assert np.array_equal(states(0, seed=5), once)
    # Seeds of more than 32 bits count in every precision.
    assert np.abs(states(3) - long).max() > 1e-3
    assert np.abs(states(3 + 2**40, precision="float32") - long).max() <= 1e-6


def test_one_wind_for_all_pushes_all_alike_and_noise_stays_each_agent_s_own():
    alike = drift(disturbance=Disturbance(rms={"velocity": 1.0}, common=True))
    assert np.array_equal(alike.states[:, 0], alike.states[:, 1])
    assert np.abs(alike.states[-1, 0]).max() > 0.01
    noisy = drift(disturbance=Disturbance(input_rms={"ax": 1.0}, common=True))
    assert np.abs(noisy.states[-1, 0, 2] - noisy.states[-1, 1, 2]) > 0.01


def test_twice_the_rms_is_twice_the_wind_and_other_states_keep_theirs():
    one = drift(disturbance=Disturbance(rms={"vx": 1.0}))
    two = drift(disturbance=Disturbance(rms={"vx": 2.0, "vy": 1.0}))
    assert two.states[..., 2] == pytest.approx(2.0 * one.states[..., 2], abs=1e-13)
    assert not one.states[..., 3].any() and two.states[-1, :, 3].all()


def test_noise_enters_by_the_normalized_input_behind_the_limits():
    model = models.PlanarQuadrotor(motor_thrust=0.028 * 9.81 / 2)
    noise = Disturbance(input_rms={"thrust": 3.0}, hold=0.05)
    run = drift(model, agents=20, horizon=1.0, dt=0.05, disturbance=noise)
    push = np.diff(run.states[:, :, 4], axis=0) / 0.05
    # In normalized inputs it is an acceleration, and full motors do not keep it from adding to it.
    assert push.std() == pytest.approx(3.0, rel=0.15) and push.max() > 3.0
    assert np.abs(run.inputs - model.trim[1]).max() == 0.0 and not run.saturated.any()
    assert not run.states[..., 5].any(), "none on the torque"


@pytest.mark.study
def test_the_integrator_keeps_its_order_in_wind():
    wind = Disturbance(constant={"rate": 1.0}, rms={"rate": 3.0}, hold=0.2)
    run = {"initial": np.tile([1.0, 0.5], (3, 1)), "disturbance": wind, "store_every": 10**6}

    def end(dt):
        return drift(models.Pendulum(0.1), dt=dt, **run).states[-1]

    exact = end(0.00125)
    errors = [np.abs(end(dt) - exact).max() for dt in (0.04, 0.02, 0.01)]
    slope, _ = np.polyfit(np.log([0.04, 0.02, 0.01]), np.log(errors), 1)
    assert 3.8 <= slope <= 4.4


@pytest.mark.parametrize(
    "model", [models.Quadrotor(), models.Linear([[0.0, 1.0], [-1.0, -0.2]], [[0.0], [1.0]])]
)
def test_a_plant_like_the_model_changes_no_bit(model):
    law, start = Consensus(synthesize(model, TREE, Riccati()), "none"), model.state_names
    run = {"initial": dict.fromkeys(start, 0.3), "horizon": 1.0, "dt": 0.01}
    plain = flown(model, TREE, {}, law, **run)
    same = flown(model, TREE, {}, law, **run, plant=vary_parameters(model, {}, {}))
    assert plain.world.plant is None and same.world.plant is not model
    assert np.array_equal(plain.states, same.states)
    assert np.array_equal(plain.inputs, same.inputs)


def test_vehicles_heavier_than_their_model_sag_by_the_linear_solve():
    model = models.PlanarQuadrotor()
    gain = synthesize(model, TREE, Riccati())
    plant = vary_parameters(model, {}, {"mass": 1.05, "inertia": 1.05})
    run = {"initial": {"position": 0.3}, "horizon": 60.0, "dt": 0.005, "store_every": 400}
    run = flown(model, TREE, ROW, Consensus(gain, "none"), STILL, plant=plant, **run)
    # Thrust m (g + v) holds 1.05 m at v = 0.05 g. Height alone is a double integrator with the
    # default weights q = (1, 0.25) and r = 1/25, whose P has p12 = sqrt(q1 r): v = -p12 / r e.
    sag = -0.05 * 9.81 / np.sqrt(1.0 * 25.0)
    assert run.states[-1, 0] == pytest.approx([0, sag, 0, 0, 0, 0], abs=1e-9)
    lag = np.linalg.solve(laplacian(4, TREE.edges)[1:, 1:], np.ones(3)) / gain.coupling
    assert run.errors[-1, 1:, 1] == pytest.approx(sag * lag, abs=1e-9)
    assert run.inputs[-1, :, 0] == pytest.approx(1.05 * 0.028 * 9.81, rel=1e-9)


def test_actuators_are_the_plant_s_and_what_is_relayed_is_what_they_delivered():
    model, graph, start = models.PlanarQuadrotor(), Graph.path(2), np.zeros((2, 6))
    start[:, 1] = -8.0
    law = Consensus(synthesize(model, graph, Riccati()), feedforward="relay")
    weak = dataclasses.replace(model, motor_thrust=0.2)
    run = flown(model, graph, {}, law, STILL, initial=start, plant=weak, horizon=0.5, dt=0.005)
    assert run.inputs[..., 0].max() <= 0.4 + 1e-12 and run.saturated[0] > 0.1
    assert np.abs(run.states[:, 0] - run.states[:, 1]).max() <= 1e-12


def test_a_law_made_for_another_class_of_the_same_states_flies_it():
    printed = models.PrintedQuadrotor()
    run = drift(printed, plant=models.Quadrotor(), horizon=1.0)
    # The printed model has no gravity, so its trim is no thrust: the real one falls.
    assert run.states[-1, :, 2] == pytest.approx(-0.5 * 9.81, rel=1e-9)
    assert differences(printed, models.Quadrotor()) == "`Quadrotor` for `PrintedQuadrotor`"


BUNDLED = {
    name: resolve(entry)
    for name, entry in registry.MODELS.items()
    if name not in ("linear", "quadrotor-printed")
} | {
    "linear": lambda: models.Linear(-np.eye(2), np.eye(2)),
    "quadrotor-printed": models.PrintedQuadrotor,
}


@pytest.mark.parametrize("name", BUNDLED)
def test_every_number_of_every_bundled_model_can_be_scaled(name):
    model = BUNDLED[name]()
    for field in dataclasses.fields(model):
        value = getattr(model, field.name)
        if isinstance(value, bool | int | str) or field.name == "names":
            continue
        plant = vary_parameters(model, {}, {field.name: 1.05})
        assert np.asarray(getattr(plant, field.name)) == pytest.approx(1.05 * np.asarray(value))
        assert type(plant) is type(model) and plant.state_names == model.state_names
        assert differences(model, plant).startswith(f"`{field.name}` ") == bool(np.any(value))
        back = vary_parameters(plant, {field.name: value}, {})
        assert differences(model, back).endswith("which equals the model")


@pytest.mark.parametrize(
    "disturbance",
    [
        Disturbance({"vy": 0.5}, {"velocity": 1.0}, {"torque": 3.0}, hold=0.05),
        Disturbance(air=(1.0, 0.0), drag=20.0),
    ],
    ids=["wind", "air"],
)
def test_the_rate_of_v_is_its_derivative_in_wind_and_with_another_plant(disturbance):
    model = models.PlanarQuadrotor()
    world = {
        "plant": vary_parameters(model, {}, {"mass": 1.2, "inertia": 0.9}),
        "disturbance": disturbance,
    }
    law = Consensus(synthesize(model, TREE, Riccati()), "none")
    run = {"initial": {"position": 0.5}, "horizon": 0.5, "dt": 0.0005}
    run = flown(model, TREE, ROW, law, STILL, **world, **run)
    v = lyapunov(run)
    # Inputs are held, so V is smooth within a step and its difference is the rate half a step on.
    ahead = np.diff(v.value) / 0.0005
    assert ahead == pytest.approx(v.rate[:-1], abs=2e-2 * np.abs(v.rate).max())
    still = run.parts.replace(world=dataclasses.replace(run.world, disturbance=None))
    calm = lyapunov(dataclasses.replace(run, parts=still))
    assert np.abs(calm.rate - v.rate).max() > 0.1 * np.abs(v.rate).max()


def imperfect(**more):
    return scenario_from_mapping(
        {
            "name": "imperfect",
            "model": {"name": "planar-quadrotor"},
            "graph": {"name": "path", "agents": 3},
            "formation": {"name": "line"},
            "initial": {"spread": {"position": 0.5}},
            "simulation": {"horizon": 1.0, "dt": 0.01, "store_every": 10},
            "plant": {"scale": {"mass": 1.05}},
            "disturbance": {"constant": {"vy": 0.5}, "rms": {"velocity": 1}, "hold": 0.2},
            **more,
        }
    )


@pytest.mark.slow
def test_a_scenario_says_plant_and_disturbance_and_every_report_repeats_them():
    from echelon.experiments.scenario.build import run

    result = run(imperfect())
    assert result.outcome is Outcome.COMPLETED
    assert result.world.plant.mass == pytest.approx(0.0294) and result.model.mass == 0.028
    assert result.world.disturbance == Disturbance({"vy": 0.5}, {"velocity": 1.0}, hold=0.2)
    plant = "`mass` 0.0294 for 0.028"
    wind = "constant `vy` 0.5; rms `velocity` 1; drawn every 0.2 s"
    text = " ".join(report(result).split())
    assert f"Plant: {plant}; laws and gains use the model's values." in text
    assert f"Disturbance: {wind}; unknown to the laws." in text
    told = json.loads(json.dumps(summary(result)))
    assert (told["plant"], told["disturbance"]) == (plant, wind)
    attributes = dataset(result).attrs
    assert (attributes["plant"], attributes["disturbance"]) == (plant, wind)
    perfect = run(imperfect(plant=None, disturbance=None))
    assert "Plant" not in report(perfect) and "Disturbance" not in report(perfect)
    assert summary(perfect)["plant"] is None and "plant" not in dataset(perfect).attrs


def test_a_plant_s_parameter_may_be_given_or_scaled():
    given = build(imperfect(plant={"parameters": {"mass": 0.03}, "scale": {"inertia": 2}}))
    plant = given.parts.world.plant
    assert (plant.mass, plant.inertia) == (0.03, pytest.approx(2 * 16.571710e-6))
    named = load_scenario("paper", ["plant={scale: {inertia: 2.0}}"])
    doubled = build(named).parts.world.plant
    assert np.asarray(doubled.inertia) == pytest.approx(
        2.0 * np.asarray(models.Quadrotor().inertia)
    )


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        (
            {"plant": {"scale": {"mas": 2}}},
            "plant: `mas` is no parameter of `PlanarQuadrotor`; it has `mass`, `inertia`, "
            "`gravity`, `arm`, `motor_thrust` (did you mean `mass`?).",
        ),
        (
            {"plant": {"scale": {"mass": 2}, "parameters": {"mass": 2}}},
            "plant: `mass` of the plant has a value and a factor; give one of them.",
        ),
        (
            {"plant": {"parameters": {"mass": -1}}},
            "plant: `mass` of `PlanarQuadrotor` is -1, and must be a positive finite number.",
        ),
        (
            {"disturbance": {"rms": {"velocty": 1}}},
            "disturbance.rms: `velocty` is no state or group of `PlanarQuadrotor`, which has "
            "`position`, `velocity`, `attitude`, `rate`, `y`, `z`, `roll`, `vy`, `vz`, "
            "`roll_rate` (did you mean `velocity`?).",
        ),
        (
            {"disturbance": {"input_rms": {"trust": 1}}},
            "disturbance.input_rms: `trust` is no input of `PlanarQuadrotor`, which has `thrust`, "
            "`torque` (did you mean `thrust`?).",
        ),
        ({"plant": {"scale": {"mass": 0}}}, f"plant.scale.mass: {ALLOWED} above 0."),
        (
            {"disturbance": {"rms": {"vy": -1}}},
            "disturbance.rms.vy: got `-1`, allowed is a number of at least 0.",
        ),
        ({"disturbance": {"hold": 0}}, f"disturbance.hold: {ALLOWED} above 0."),
    ],
)
def test_faults_of_plant_and_disturbance_are_told_with_their_place(section, sentence):
    with pytest.raises(ScenarioError) as caught:
        build(imperfect(**section))
    assert str(caught.value) == f"mapping: {sentence}"


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("rms", {"vx": -1.0}, "-1.0 for `vx`, and must be finite and not negative."),
        ("constant", {"vx": np.nan}, "nan for `vx`, and must be finite."),
        ("hold", 0.0, "0.0, and must be a positive finite number of seconds."),
        ("seed", -1, "-1, and must be a whole number from 0 on."),
    ],
)
def test_bad_disturbances_are_refused_in_a_sentence(key, value, told):
    with pytest.raises(EchelonError) as caught:
        Disturbance(**{key: value})
    assert str(caught.value) == f"`{key}` of the disturbance is {told}"


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: drift(plant=models.DoubleIntegrator(1)),
            "`state_names` of the plant `DoubleIntegrator` are `x`, `vx`, and must be those of "
            "the model `DoubleIntegrator`, `x`, `y`, `vx`, `vy`.",
        ),
        (
            lambda: drift(plant=3),
            "the model is 3, and must be an instance of a `ControlAffine` class.",
        ),
        (
            lambda: drift(disturbance={"rms": 1.0}),
            "`disturbance` is a `dict`, and must be a `Disturbance`.",
        ),
        (
            lambda: vary_parameters(models.Linear(np.eye(2), np.eye(2)), {}, {"names": 2.0}),
            "`names` of `Linear` is ('x1', 'x2'), and only numbers can be scaled by a factor.",
        ),
    ],
)
def test_worlds_that_do_not_fit_are_refused_in_a_sentence(make, sentence):
    with pytest.raises(EchelonError) as caught:
        make()
    assert str(caught.value) == sentence


def test_a_plant_that_jax_made_is_warned_of_as_a_model_is():
    rounded = dataclasses.replace(CART, drag=np.float32(0.1))
    run = drift(plant=rounded, horizon=0.1)
    assert any("float32" in text for text in run.warnings)
