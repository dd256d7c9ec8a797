"""Plants, actuators and sensors that are not ideal, against closed forms and plain NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.world.actuator import Actuator
from echelon.agents.world.sensing import Sensing
from echelon.core.errors import EchelonError, SimulationError
from echelon.simulation.step.motion import PlantStep
from echelon.simulation.step.records import Steps

POINT = ech.models.DoubleIntegrator()
N = len(POINT.input_names)


def motion(world, dt, **more):
    settings = ech.Settings(horizon=1.0, dt=dt, **more)
    return PlantStep.of(POINT, world, settings, agents=1)


def pushed(world, dt, steps, command, **more):
    """The state of a point at rest after steps under one command."""
    with jax.enable_x64(True):
        moves, rest = motion(world, dt, **more), jnp.zeros((1, 2 * N))

        def step(now, k):
            x, own = now
            return moves.advance(own, x, jnp.asarray([command]), k, jnp.arange(1)), None

        run = jax.jit(lambda now: jax.lax.scan(step, now, jnp.arange(steps))[0])
        x, own = run((rest, jax.vmap(moves.begin)(rest)))
    return np.asarray(x[0]), own[1]


COMMAND = np.arange(1.0, N + 1.0)


def test_an_actuator_that_lags_follows_its_closed_form_to_the_order_of_runge_kutta():
    """Acceleration u (1 - e^(-t/T)): v = u (t - T (1 - e^(-t/T))), and its integral."""
    lag, t = 0.1, 0.5
    speed = t - lag * (1.0 - np.exp(-t / lag))
    place = 0.5 * t**2 - lag * speed
    world = ech.World(actuator=Actuator(lag=lag))
    x, own = pushed(world, 0.005, 100, COMMAND)
    np.testing.assert_allclose(x, [*(place * COMMAND), *(speed * COMMAND)], rtol=2e-8)
    np.testing.assert_allclose(own[0], COMMAND * (1.0 - np.exp(-t / lag)), rtol=1e-13)
    errors = [abs(pushed(world, t / n, n, COMMAND)[0][0] - place) for n in (5, 10, 20)]
    assert (np.log2(np.divide(errors[:-1], errors[1:])) > 3.8).all()


def test_levels_round_thrusts_and_a_least_thrust_is_given():
    drone = ech.models.Quadrotor()
    limits = drone.input_limits
    G, low, high = (np.asarray(part, float) for part in limits)
    with jax.enable_x64(True):
        motors = Actuator(levels=5, minimum=0.01).prepared(drone)
        u = np.linalg.solve(G, low + (high - low) * np.array([0.0, 0.3, 0.5, 0.9]))
        f = G @ np.asarray(motors.command(jnp.asarray(u)))
    expected = low + (high - low) * np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(f, np.maximum(expected, 0.01), atol=1e-12)


def test_late_states_are_those_of_some_steps_ago_and_noise_has_its_size():
    with jax.enable_x64(True):
        sensors = Sensing(delay=0.02, noise={"x": 0.5}, seed=3).prepared(POINT, 0.01, 9.0, 0)
        states = jnp.asarray(np.random.default_rng(0).normal(size=(9, 400, 2 * N)))

        def read(last, x, k):
            numbers, clock = jnp.arange(len(x)), Steps(jnp.asarray(k), 0.01)
            return jax.vmap(lambda *row: sensors.read(POINT, *row[:2], clock, row[2]))(
                last, x, numbers
            )

        begun = jax.vmap(lambda x: sensors.begin(POINT, x))(states[0])
        last, seen = begun, []
        for k in range(9):
            measured, last = read(last, states[k], k)
            seen.append(np.asarray(measured))
        again, _ = read(begun, states[0], 0)
    late = np.asarray(states)[[0, 0, *range(7)]]
    noise = np.array(seen) - late
    np.testing.assert_allclose(noise[:, :, 1:], 0.0, atol=1e-15)
    assert noise[:, :, 0].std() == pytest.approx(0.5, rel=0.03)
    np.testing.assert_array_equal(again, seen[0])


def test_agents_that_differ_move_each_as_its_own_plant():
    heavy = ech.models.PlanarQuadrotor(mass=0.04)
    base = ech.models.PlanarQuadrotor()
    settings = ech.Settings(horizon=0.1, dt=0.01)
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(3, 6)), rng.uniform(0.1, 0.3, size=(3, 2)) * [1.0, 1e-3]
    with jax.enable_x64(True):
        mixed = PlantStep.of(base, ech.World(plants={1: heavy}), settings, agents=3)
        numbers, first = jnp.arange(3), jnp.asarray(0)
        own = ((), ())
        got, _ = mixed.advance(own, jnp.asarray(x), jnp.asarray(u), first, numbers)
        for k, plant in enumerate((base, heavy, base)):
            alone = PlantStep.of(base, ech.World(plant), settings)
            moved, _ = alone.move(own, jnp.asarray(x[k]), jnp.asarray(u[k]), first, numbers[k])
            np.testing.assert_allclose(got[k], moved, rtol=1e-14)


def test_gusts_have_their_size_and_their_time_constant():
    gusts = ech.Disturbance(rms={"velocity": 0.7}, time=0.2, seed=1)
    with jax.enable_x64(True):
        wind = gusts.prepared(POINT, 0.01, 0)

        def step(last, k):
            now = jax.vmap(lambda g, i: wind.gusts(g, k, i))(last, jnp.arange(200))
            return now, now

        path = np.asarray(jax.lax.scan(step, jnp.zeros((200, 2 * N)), jnp.arange(400))[1])
    speed = path[:, :, N:]
    assert np.abs(path[:, :, :N]).max() == 0.0
    assert speed.std() == pytest.approx(0.7, rel=0.05)
    later = (speed[:-20] * speed[20:]).mean() / speed.var()
    assert later == pytest.approx(np.exp(-1.0), abs=0.05)


def test_air_drags_an_agent_along_and_substeps_are_shorter_steps_under_a_held_input():
    """v' = d (a - v): v = a (1 - e^(-d t))."""
    world = ech.World(disturbance=ech.Disturbance(air=(2.0, *[0.0] * (N - 1)), drag=0.5))
    x, _ = pushed(world, 0.01, 100, np.zeros(N))
    assert x[N] == pytest.approx(2.0 * (1.0 - np.exp(-0.5)), rel=1e-9)
    world = ech.World(actuator=Actuator(lag=0.05))
    coarse = pushed(world, 0.1, 4, COMMAND, substeps=5)[0]
    fine = pushed(world, 0.02, 20, COMMAND)[0]
    np.testing.assert_allclose(coarse, fine, rtol=1e-13)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (lambda: ech.World(actuator=Actuator(levels=8)), "`levels` .* has no motors"),
        (lambda: ech.World(actuator=Actuator(levels=1)), "`levels` .* is 1, .* from 2 on"),
        (lambda: ech.World(actuator=Actuator(lag=-1.0)), "`lag` .* -1.0"),
        (lambda: ech.World(sensing=Sensing(noise={"yaw": 1.0})), "`yaw` is no state or group"),
        (lambda: ech.World(sensing=Sensing(delay=-1.0)), "`delay` of the sensing is -1.0"),
        (lambda: ech.World(sensing=Sensing(delay=1e9)), "must be at most the horizon, 0.1 s"),
        (
            lambda: ech.World(plants={9: ech.models.SingleIntegrator(dimension=3)}),
            "plant for agent 9, and the agents are 0 to",
        ),
        (
            lambda: ech.World(disturbance=ech.Disturbance(air=(1.0,), drag=1.0)),
            "`drag` with an `air` of 1 number,",
        ),
        (lambda: ech.World(disturbance=ech.Disturbance(air=(1.0, 0.0))), "`air` .* without `drag`"),
        (lambda: ech.World(disturbance=ech.Disturbance(time=1.0)), "`time` .* without `rms`"),
        (lambda: ech.World(network=ech.Network(bursts={"share": 0.1})), "`bursts` is a `dict`"),
    ],
)
def test_a_world_that_cannot_be_is_refused_in_one_sentence(world, message):
    parts, settings = ech.build(ech.load_scenario("integrators"))
    with pytest.raises(EchelonError, match=message):
        parts = dataclasses.replace(parts, world=world())
        ech.simulate(parts, settings._replace(horizon=0.1, steady_window=0.1))


def test_a_fault_of_the_world_is_one_sentence_with_its_place(here):
    faults = {
        "network={loss: 1.5}": "is a number of at most 1.",
        "actuator={levels: 1}": "--set actuator={levels: 1}: `levels`",
        "actuator={minimum: 5.0}": "below the largest thrust .* `Quadrotor`, 0.159",
        "sensing={estimator: constant-gain}": "constant-gain}: `estimator` .* states are exact",
        "sensing={noise: {foo: 1}}": "sensing.noise: `foo` is no state",
        "disturbance={air: [1, 0], drag: 0.1}": "drag: 0.1}: got `drag`",
        "plant={agents: {9: {scale: {}}}}": r"\}\}\}: plant.agents: got a plant for agent 9",
    }
    for override, words in faults.items():
        with pytest.raises(EchelonError, match=words) as caught:
            ech.build(ech.load_scenario("paper-global", [override]))
        assert len(str(caught.value).splitlines()) == 1


def test_what_has_no_time_for_a_lag_or_needs_exact_states_refuses_others():
    """A pilot reads the true states: a run would say what it does not simulate."""
    lag, drive = ech.World(actuator=Actuator(lag=0.1)), ech.optimal.RecedingHorizon()
    for changes, settled, words in (
        ({"world": lag}, {"integrator": "printed"}, "`printed`, which has no time"),
        ({"world": ech.World(network=ech.Network()), "drive": drive}, {}, "got `network`, but .*"),
        ({"world": ech.World(sensing=Sensing(delay=0.1)), "drive": drive}, {}, "got `sensing`, b"),
    ):
        parts, settings = ech.build(ech.load_scenario("integrators", ["simulation.horizon=1"]))
        with pytest.raises(SimulationError, match=words):
            ech.simulate(parts.replace(**changes), settings._replace(**settled))


def test_actuators_and_sensors_without_a_fault_are_the_ideal_ones():
    world = ech.World(actuator=Actuator(), sensing=Sensing(noise={"x": 0.0}))
    assert ech.World(actuator=Actuator(), sensing=Sensing()).ideal
    parts, settings = ech.build(ech.load_scenario("integrators", ["simulation.horizon=1"]))
    results = [
        ech.simulate(parts.replace(world=each), settings._replace(integrator="rk4"))
        for each in (ech.World(), world)
    ]
    np.testing.assert_array_equal(results[0].states, results[1].states)
