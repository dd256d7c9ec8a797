"""Bundled models against equations written a second time, and properties that all of them share."""

import importlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from model_family import FLAT_MODELS, MODELS
from oracles import newton_euler, quadrotor_input_map, rotation
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from echelon.agents import models
from echelon.agents.models.model_check import check_model
from echelon.agents.models.quadrotor_euler import ATTITUDE_PARAMETERS
from echelon.core import numerics
from echelon.core.errors import ModelError
from echelon.core.numerics import precision
from echelon.experiments.scenario import registry

rng = np.random.default_rng(7)

SPACE = ["crazyflie", "big"]

every_model = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
every_flat_model = pytest.mark.parametrize("model", FLAT_MODELS.values(), ids=FLAT_MODELS)


def numpy(function, *arguments):
    """The value of a function of echelon in float64, as NumPy."""
    with numerics.precision("float64"):
        return np.asarray(eqx.filter_jit(function)(*map(jnp.asarray, arguments)))


def state_and_input(model, seed=0):
    """A random state (angles within +-1 rad) and an input of the size that the model works with."""
    draw = np.random.default_rng(seed).uniform(-1.0, 1.0, len(model.state_names))
    size = np.array(model.trim[1]) + np.diag(model.input_scale)
    return draw, size * np.random.default_rng(seed + 1).uniform(-1.0, 1.0, len(size))


def planar(model, x, u):
    y, z, roll, vy, vz, rate = x
    push = u[0] / model.mass
    return [vy, vz, rate, -push * np.sin(roll), push * np.cos(roll) - 9.81, u[1] / model.inertia]


def printed(model, x, u):
    # Newton-Euler in free space, and then a push of T / m along all three axes alike.
    turning = newton_euler(x, np.array([0.0, *u[1:]]), model.mass, model.inertia, gravity=0.0)
    return turning + np.concatenate([np.zeros(3), np.full(3, u[0] / model.mass), np.zeros(6)])


def bicycle(model, x, u):
    _, _, heading, v, steering = x
    turn = v / model.wheelbase * np.sin(steering) / np.cos(steering)
    return [v * np.cos(heading), v * np.sin(heading), turn, u[0], u[1]]


def boat(model, x, u):
    # Fossen's M v' + C(v) v + D(v) v = tau, with C of the masses on the diagonal.
    turn = np.array([[np.cos(x[2]), -np.sin(x[2])], [np.sin(x[2]), np.cos(x[2])]])
    nu, tau = x[3:], np.array([u[0], 0.0, u[1]])
    M = np.diag([model.surge_mass, model.sway_mass, model.yaw_inertia])
    p, q = -M[1, 1] * nu[1], M[0, 0] * nu[0]
    C = np.array([[0.0, 0.0, p], [0.0, 0.0, q], [0.0, 0.0, 0.0]])  # without the Munk moment
    yaw = model.yaw_drag * (1.0 + model.yaw_growth * abs(nu[2]))
    D = np.diag([model.surge_drag, model.sway_drag, yaw])
    return [*turn @ nu[:2], nu[2], *np.linalg.solve(M, tau - (C + D) @ nu)]


def fixed_wing(model, x, u):
    # Newton's law for the point mass: weight, drag and thrust along, lift across the velocity.
    _, _, _, heading, climb, V, bank = x
    along = [np.cos(climb) * np.cos(heading), np.cos(climb) * np.sin(heading), np.sin(climb)]
    side = np.array([-np.sin(heading), np.cos(heading), 0.0])
    up = np.cross(along, side)
    drag = model.gravity / model.glide * V**2 / model.airspeed**2
    lift = u[1] * model.gravity * (np.cos(bank) * up + np.sin(bank) * side)
    push = (u[0] - drag) * np.array(along) + lift - [0.0, 0.0, model.gravity]
    rates = [push @ side / (V * np.cos(climb)), push @ up / V, push @ along]
    return [*V * np.array(along), *rates, u[2]]


EQUATIONS = {
    models.Bicycle: bicycle,
    models.Boat: boat,
    models.FixedWing: fixed_wing,
    models.SingleIntegrator: lambda m, x, u: u,
    models.DoubleIntegrator: lambda m, x, u: [
        *x[m.dimension :],
        *(u[k] - m.drag * x[m.dimension + k] for k in range(m.dimension)),
    ],
    models.Linear: lambda m, x, u: m.A @ x + m.B @ u,
    models.VanDerPol: lambda m, x, u: [x[1], m.damping * (1 - x[0] * x[0]) * x[1] - x[0] + u[0]],
    models.Pendulum: lambda m, x, u: [x[1], u[0] - m.stiffness * np.sin(x[0]) - m.damping * x[1]],
    models.Unicycle: lambda m, x, u: [u[0] * np.cos(x[2]), u[0] * np.sin(x[2]), u[1]],
    models.UnicyclePoint: lambda m, x, u: [
        u[0] * np.cos(x[2]) - m.ahead * u[1] * np.sin(x[2]),
        u[0] * np.sin(x[2]) + m.ahead * u[1] * np.cos(x[2]),
        u[1],
    ],
    models.PlanarQuadrotor: planar,
    models.Quadrotor: lambda m, x, u: newton_euler(x, u, m.mass, m.inertia),
    models.PrintedQuadrotor: printed,
    models.QuadrotorEuler: lambda m, x, u: [
        *x[3:6],
        *((m.gravity + u[0]) * rotation(x[6:9])[:, 2] - [0.0, 0.0, m.gravity]),
        *x[9:12],
        *u[1:],
    ],
    models.QuadrotorThrust: lambda m, x, u: [
        *x[3:6],
        *((m.gravity + x[12]) * rotation(x[6:9])[:, 2] - [0.0, 0.0, m.gravity]),
        *x[9:12],
        *u[1:],
        u[0],
    ],
    models.CrazyflieAttitude: lambda m, x, u: [
        *x[3:6],
        *(m.thrust_gain * u[3] / m.mass * rotation(x[6:9])[:, 2] - [0.0, 0.0, m.gravity]),
        *x[9:12],
        *(m.command_gain * u[:2] - m.stiffness * x[6:8] - m.rate_damping * x[9:11]),
        m.yaw_damping * (u[2] - x[11]),
    ],
}


@every_model
@pytest.mark.parametrize("seed", range(3))
def test_drift_and_input_map_are_the_textbook_equations(model, seed):
    x, u = state_and_input(model, seed)
    wanted = np.array(EQUATIONS[type(model)](model, x, u))
    got = numpy(model.drift, x) + numpy(model.input_map, x) @ u
    assert got == pytest.approx(wanted, rel=1e-12, abs=1e-12)
    assert numpy(model.velocity, x, u) == pytest.approx(wanted, rel=1e-12, abs=1e-12)


def test_the_family_of_these_tests_is_the_whole_family():
    members = {getattr(models, name) for name in models.__all__}
    members -= {models.Limits, models.Heading, models.MassProperties, models.read_mass_properties}
    # Unlike agents are groups of members.
    members -= {models.UnlikeAgents}
    assert {type(model) for model in MODELS.values()} == members - {models.ControlAffine}
    registered = set()
    for entry in registry.MODELS.values():
        module, _, name = entry.target.partition(":")
        registered.add(getattr(importlib.import_module(module), name))
    assert registered == members - {models.ControlAffine}


positive = st.floats(0.05, 5.0)
entries = st.lists(st.floats(-1.0, 1.0), min_size=12, max_size=12).map(np.array)
inputs = st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=4).map(np.array)


@given(entries, inputs, positive, st.tuples(positive, positive, positive), st.floats(0.5, 20.0))
@settings(max_examples=40)
def test_quadrotor_is_newton_euler_for_any_parameters(x, u, mass, sides, gravity):
    # A box of any sides has an inertia that a rigid body can have.
    a, b, c = (side**2 for side in sides)
    inertia = (b + c, a + c, a + b)
    model = models.Quadrotor(mass=mass, inertia=inertia, gravity=gravity)
    got = numpy(model.velocity, x, u)
    assert got == pytest.approx(newton_euler(x, u, mass, inertia, gravity), rel=1e-10, abs=1e-10)
    columns = quadrotor_input_map(x, mass, inertia)
    assert numpy(model.input_map, x) == pytest.approx(columns, rel=1e-9, abs=1e-9)


@every_model
def test_the_trim_is_an_equilibrium_within_the_limits(model):
    x, u = map(np.array, model.trim)
    speed = getattr(model, "airspeed", getattr(model, "speed", 0.0))
    # A vehicle at a speed moves straight on; all others rest.
    assert numpy(model.velocity, x, u) == pytest.approx(speed * np.eye(len(x))[0], abs=1e-12)
    assert numpy(model.limit, u).tobytes() == u.tobytes()
    assert min(*model.weights[0], *model.weights[1]) > 0.0
    assert [model.state_names[k] for k in model.position_indices()] == [*model.position]
    assert {model.state_units[k] for k in model.position_indices()} <= {"m"}


def pushed(limits, states=2):
    """A decaying agent with two limited inputs."""

    class Pushed(models.ControlAffine):
        state_names, input_names = ("x", "y")[:states], ("a", "b")
        input_limits = limits

        def drift(self, x):
            return -x

        def input_map(self, x):
            return jnp.ones((states, 2), x.dtype)

    return Pushed()


@pytest.mark.slow
@given(
    matrix=hnp.arrays(float, (2, 2), elements=st.floats(-2.0, 2.0)),
    wanted=hnp.arrays(float, (2,), elements=st.floats(-9.0, 9.0)),
)
def test_limits_alone_say_what_is_delivered(matrix, wanted):
    assume(np.linalg.cond(matrix) < 1e3 and np.abs(matrix).max() > 1e-300)
    model = pushed(models.Limits(tuple(map(tuple, matrix.tolist())), (-1.0, -2.0), (3.0, 0.5)))
    delivered, rows = numpy(model.limit, wanted), matrix @ wanted
    nearest = np.clip(rows, [-1.0, -2.0], [3.0, 0.5])
    np.testing.assert_allclose(matrix @ delivered, nearest, rtol=0, atol=1e-9)
    if (rows == nearest).all():
        assert delivered.tobytes() == wanted.tobytes()


@pytest.mark.parametrize("size", [1e-313, 1e-310])
def test_limits_that_floats_cannot_invert_are_refused(size):
    limits = models.Limits(((size, size), (size, 0.0)), (-1.0, -1.0), (1.0, 1.0))
    with pytest.raises(ModelError, match="does not define the input that is delivered"):
        check_model(pushed(limits, 1))


@every_model
def test_the_limits_for_solvers_are_those_of_the_actuators(model):
    limits = model.input_limits
    u0, size = np.array(model.trim[1]), np.array(model.input_scale)
    draws = np.stack(
        [u0 + size @ (4.0 ** rng.uniform(-2.0, 5.0) * rng.normal(size=len(u0))) for _ in range(300)]
    )
    limited = numpy(jax.vmap(model.limit), draws)
    kept = [a.tobytes() == u.tobytes() for a, u in zip(limited, draws, strict=True)]
    if limits is None:
        assert all(kept)
        return
    matrix, low, high = map(np.array, limits)
    within = [bool(((low <= matrix @ u) & (matrix @ u <= high)).all()) for u in draws]
    assert within == kept
    assert 30 < sum(within) < 270


@every_model
def test_normalized_inputs_are_deviations_from_the_trim(model):
    x, u = state_and_input(model)
    S, trim = np.array(model.input_scale), np.array(model.trim[1])
    v = np.linalg.solve(S, u - trim)
    assert numpy(model.physical, v) == pytest.approx(u, rel=1e-12, abs=1e-18)
    without = numpy(lambda v: model.physical(v, trim=False), v)
    assert without == pytest.approx(u - trim, rel=1e-12, abs=1e-18)
    assert numpy(model.normalized, u) == pytest.approx(v, rel=1e-12, abs=1e-12)
    about = numpy(model.normalized_drift, x) + numpy(model.normalized_input_map, x) @ v
    assert about == pytest.approx(numpy(model.velocity, x, u), rel=1e-12, abs=1e-11)


@every_model
def test_many_inputs_change_as_one_does_in_numpy_and_in_jax(model):
    v = np.random.default_rng(3).normal(size=(2, 5, len(model.input_names)))
    for change in (model.physical, model.normalized, lambda v: model.physical(v, trim=False)):
        one_by_one = [[numpy(change, row) for row in rows] for rows in v]
        assert isinstance(change(v), np.ndarray)
        assert change(v) == pytest.approx(np.array(one_by_one), rel=1e-14)
        assert numpy(change, v) == pytest.approx(change(v), rel=1e-14)
    assert model.physical(v[0].astype(np.float32)).dtype == np.float32


def test_a_scale_that_depends_on_an_array_is_traced_with_it():
    class Weighed(models.ControlAffine):
        mass: np.ndarray
        state_names, input_names = ("speed",), ("push",)
        drift, input_map = models.SingleIntegrator.drift, models.SingleIntegrator.input_map

        @property
        def input_scale(self):
            return ((self.mass[0],),)

    change = eqx.filter_jit(lambda model, u: model.normalized(u))
    for mass in (2.0, 4.0):
        assert change(Weighed(np.array([mass])), jnp.array([8.0])) == 8.0 / mass


@every_model
@settings(max_examples=20)
@given(data=st.data())
def test_a_state_has_its_own_number_else_its_group_s_else_the_default(model, data):
    names = sorted({*model.state_names, *model.state_groups})
    named = data.draw(st.dictionaries(st.sampled_from(names), st.floats(-9, 9)))
    named = dict(data.draw(st.permutations(list(named.items()))))
    for name, value in zip(model.state_names, model.per_state(named, np.inf), strict=True):
        groups = [group for group, members in model.state_groups.items() if name in members]
        own = [named[name]] if name in named else [named[g] for g in groups if g in named]
        assert value in (own or [np.inf])
    with pytest.raises(ModelError, match="`nothing` is no state or group"):
        model.per_state({"nothing": 1.0})


@pytest.mark.parametrize(
    "model", [models.Unicycle(), models.UnicyclePoint()], ids=["axle", "point"]
)
@given(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0))
@settings(max_examples=30)
def test_headings_differ_by_the_shorter_way_round(model, a, b):
    x, y = np.array([1.0, 2.0, a]), np.array([0.5, -1.0, b])
    gap = numpy(model.difference, x, y)
    assert gap[:2] == pytest.approx([0.5, 3.0])
    assert abs(gap[2]) <= np.pi + 1e-12
    assert np.exp(1j * gap[2]) == pytest.approx(np.exp(1j * (a - b)), abs=1e-12)


class Smooth:
    """A random sum of sines in each coordinate, with derivatives of any order in closed form."""

    def __init__(self, coordinates, seed, drift=2.0):
        rng = np.random.default_rng(seed)
        self.amplitude = rng.uniform(0.1, 0.5, (3, coordinates))
        self.rate = rng.uniform(0.3, 1.2, (3, coordinates))
        self.phase = rng.uniform(-np.pi, np.pi, (3, coordinates))
        # A steady speed keeps vehicles that cannot stand moving.
        self.drift = drift * np.arange(1, coordinates + 1)

    def derivatives(self, t, order):
        rows = [
            jnp.sum(
                self.amplitude
                * self.rate**k
                * jnp.sin(self.rate * t + self.phase + k * np.pi / 2.0),
                axis=0,
            )
            for k in range(order + 1)
        ]
        rows[0], rows[1] = rows[0] + self.drift * t, rows[1] + self.drift
        return jnp.stack(rows)


@every_flat_model
@pytest.mark.parametrize("seed", range(4))
def test_the_flat_state_moves_as_its_flat_input_makes_it(model, seed):
    path = Smooth(len(model.flat_outputs), seed)

    def fly(t):
        return model.flat(path.derivatives(t, model.flat_order))

    with numerics.precision("float64"):
        (x, u), (rate, _) = jax.jvp(fly, (jnp.asarray(0.3),), (jnp.asarray(1.0),))
        assert np.asarray(rate) == pytest.approx(
            np.asarray(model.velocity(x, u)), rel=1e-10, abs=1e-10
        )


@every_flat_model
def test_the_flat_state_contains_the_path_and_its_speed(model):
    path = Smooth(len(model.flat_outputs), 5)
    with numerics.precision("float64"):
        rows = path.derivatives(jnp.asarray(0.3), model.flat_order)
        x = np.asarray(model.flat(rows)[0])
    ahead = getattr(model, "ahead", 0.0)
    for k, name in enumerate(model.flat_outputs):
        # The flat output of the point ahead of an axle is the axle.
        axle = ahead * {"x": np.cos, "y": np.sin}.get(name, np.sin)(x[2]) if ahead else 0.0
        assert x[model.state_names.index(name)] - axle == pytest.approx(float(rows[0, k]))
        if f"v{name}" in model.state_names:
            assert x[model.state_names.index(f"v{name}")] == pytest.approx(float(rows[1, k]))


STILL = [*SPACE, "planar", "planar crazyflie", "euler", "thrust", "attitude"]


@pytest.mark.parametrize("name", STILL)
def test_standing_still_is_flown_by_the_trim(name):
    model = MODELS[name]
    rows = np.zeros((model.flat_order + 1, len(model.flat_outputs)))
    rows[0] = 1.0 + np.arange(len(model.flat_outputs))
    with numerics.precision("float64"):
        x, u = map(np.asarray, model.flat(jnp.asarray(rows)))
    wanted = np.zeros(len(x))
    wanted[[model.state_names.index(name) for name in model.flat_outputs]] = rows[0]
    assert x == pytest.approx(wanted, abs=1e-15)
    assert u == pytest.approx(np.array(model.trim[1]), abs=1e-15)


def attitude_by_rotations(path, gravity, t):
    """ZYX angles, rates and accelerations on a path by SciPy and central differences of 1 ms."""

    def angles(t):
        rows = np.asarray(path.derivatives(t, 2))
        z = rows[2, :3] + np.array([0.0, 0.0, gravity])
        z /= np.linalg.norm(z)
        # The body x axis has no part to the left of the heading.
        x = np.cross([-np.sin(rows[0, 3]), np.cos(rows[0, 3]), 0.0], z)
        x /= np.linalg.norm(x)
        yaw, pitch, roll = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], 1)).as_euler("ZYX")
        return np.array([roll, pitch, yaw])

    h, around = 1e-3, [angles(t + k * 1e-3) for k in range(-2, 3)]
    rate = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12.0 * h) @ around
    bend = np.array([-1.0, 16.0, -30.0, 16.0, -1.0]) / (12.0 * h**2) @ around
    return around[2], rate, bend


@pytest.mark.parametrize("seed", range(3))
def test_under_computed_torque_quadrotors_fly_what_rotations_and_differences_say(seed):
    euler, thrust, t = MODELS["euler"], models.QuadrotorThrust(gravity=3.7), 0.4
    # A yaw that keeps below half a turn, where a rotation has one name.
    path = Smooth(4, seed, drift=0.3)
    with precision("float64"):
        lift = [
            np.linalg.norm(np.asarray(path.derivatives(t + d, 2))[2, :3] + [0.0, 0.0, 3.7])
            for d in (-1e-5, 0.0, 1e-5)
        ]
        zeta, rate, bend = attitude_by_rotations(path, 3.7, t)
        rows = path.derivatives(t, 4)
        (x, u), (y, v) = (map(np.asarray, model.flat(rows)) for model in (euler, thrust))
    assert x[6:9] == pytest.approx(zeta, abs=1e-12) and x[9:12] == pytest.approx(rate, abs=1e-8)
    assert u[1:] == pytest.approx(bend, abs=1e-6) and u[0] == pytest.approx(lift[1] - 3.7, abs=1e-9)
    assert (y[:12] == x).all() and y[12] == u[0] and (v[1:] == u[1:]).all()
    assert v[0] == pytest.approx((lift[2] - lift[0]) / 2e-5, abs=1e-6)


def test_commands_fly_what_their_equations_ask_of_angles_and_thrust():
    model, t = models.CrazyflieAttitude(), 0.4
    path = Smooth(4, 2, drift=0.3)
    with precision("float64"):
        rows = path.derivatives(t, 4)
        zeta, rate, bend = attitude_by_rotations(path, model.gravity, t)
        x, u = map(np.asarray, model.flat(rows))
    back = model.stiffness * zeta + model.rate_damping * rate
    assert x[6:9] == pytest.approx(zeta, abs=1e-12) and x[9:12] == pytest.approx(rate, abs=1e-8)
    assert u[:2] == pytest.approx((bend + back)[:2] / model.command_gain, abs=1e-8)
    assert u[2] == pytest.approx(rate[2] + bend[2] / model.yaw_damping, abs=1e-7)
    lift = np.linalg.norm(np.asarray(rows)[2, :3] + [0.0, 0.0, model.gravity])
    assert u[3] == pytest.approx(model.mass * lift / model.thrust_gain, rel=1e-12)


def test_normalized_inputs_move_the_point_of_a_unicycle_alike_in_every_heading():
    model = models.UnicyclePoint(ahead=0.3)
    for heading in (0.0, 1.0, 2.5):
        g = numpy(model.normalized_input_map, np.array([1.0, 2.0, heading]))
        assert (g @ g.T)[:2, :2] == pytest.approx(np.eye(2), abs=1e-15)


def test_the_crazyflie_carries_the_identified_numbers():
    model = models.Quadrotor.named("crazyflie")
    assert model == models.Quadrotor.crazyflie() == models.Quadrotor()
    assert model.mass == 0.028
    assert model.inertia == (16.571710e-6, 16.655602e-6, 29.261652e-6)
    assert np.hypot(model.arm, model.arm) == pytest.approx(0.046, abs=5e-5)
    assert 4 * model.motor_thrust == pytest.approx(0.639, abs=1e-12)
    assert model.torque_per_thrust == 0.005964552


@pytest.mark.parametrize(
    ("name", "grams", "newtons", "metres"),
    [
        ("crazyflie-2.1+", 29.0, 0.12, 0.006993),
        ("crazyflie-legacy", 29.0, 0.12, 0.00735),
        ("crazyflie-thrust-kit", 32.5, 0.18, 0.00516),
    ],
)
def test_the_crazyflies_of_today_carry_the_firmware_s_numbers(name, grams, newtons, metres):
    model = models.Quadrotor.named(name)
    assert (model.mass, model.motor_thrust) == (grams / 1000, newtons)
    assert model.torque_per_thrust == metres
    assert model.inertia == models.Quadrotor.crazyflie().inertia
    with numerics.precision("float64"):
        assert check_model(model) == ()  # hovering is within reach
        # Full yaw: the collective gives way, so two motors give all and two give nothing.
        most = np.asarray(model.limit(jnp.asarray([model.mass * 9.81, 0.0, 0.0, 1.0])))[3]
    assert most == pytest.approx(2.0 * metres * newtons)


def test_a_named_quadrotor_takes_changes():
    model = models.Quadrotor.named("paper", allow_unphysical=True, mass=0.03)
    assert model.mass == 0.03
    assert model.inertia == (6.4893e-6, 16.4562e-6, 29.5435e-6)


def test_the_firmware_s_gains_are_those_of_its_set():
    """Mellinger's attitude controller by hand: gains of 65535ths, an error of twice the angle."""
    model = models.CrazyflieAttitude.named("firmware")
    motor = 0.12 / 65535
    tilt = 2 * 0.0325 * motor / 16.613656e-6  # rad/s^2 a unit; half of it goes to each motor
    slower = 1 + 200 * tilt  # its feedback of the angular acceleration
    assert model.stiffness == pytest.approx(2 * 70000 * tilt / slower, rel=1e-3)
    assert model.rate_damping == pytest.approx(20000 * tilt / slower, rel=1e-3)
    assert model.yaw_damping == pytest.approx(12000 * 4 * 0.006993 * motor / 29.261652e-6, rel=1e-3)
    assert model.command_gain == model.stiffness and model.motor_thrust == 0.12


@pytest.mark.parametrize("name", ATTITUDE_PARAMETERS)
def test_a_held_command_ends_in_a_steady_tilt_and_turn(name):
    model = models.CrazyflieAttitude.named(name)
    u = np.array([0.1, -0.05, 0.4, model.trim[1][3]])
    with numerics.precision("float64"):
        flow = jax.jit(lambda x: model.velocity(x, jnp.asarray(u)))
        end = solve_ivp(lambda t, x: np.asarray(flow(x)), (0.0, 2.0), np.zeros(12), rtol=1e-9).y
        assert check_model(model) == ()
    assert end[6:8, -1] == pytest.approx(model.command_gain / model.stiffness * u[:2], rel=1e-4)
    assert end[11, -1] == pytest.approx(0.4, rel=1e-4)


def test_a_property_that_fails_is_named_with_what_it_raises():
    class Weak(models.SingleIntegrator):
        most: float = 1.0

        @property
        def input_limits(self):
            return models.Limits(np.eye(1), (-self.most,), (self.most,))

    with pytest.raises(ModelError, match="`input_limits` of `Weak` fails with TypeError"):
        check_model(Weak(dimension=1, most="fast"))
