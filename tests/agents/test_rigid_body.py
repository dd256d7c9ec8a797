"""Rotations, Euler rates, inertia and motor mixing, against SciPy, calculus and linear programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from oracles import prioritized_thrusts, rotation, skew

from echelon.agents.models import PlanarQuadrotor, Quadrotor
from echelon.agents.models.rigid_body import (
    attitude_priority,
    body_rates,
    check_inertia,
    euler_rates,
    thrust_axis,
    tilt_towards,
)
from echelon.core import numerics
from echelon.core.errors import ModelError

turn = st.floats(-np.pi, np.pi)
pitch = st.floats(-1.4, 1.4)
angles = st.tuples(turn, pitch, turn).map(np.array)
rates = st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3).map(np.array)
moment = st.floats(1e-6, 1.0)


def in_float64(function, *arguments):
    """The value of a function of echelon at NumPy arguments, as NumPy."""
    with numerics.precision("float64"):
        return np.asarray(function(*[jnp.asarray(a) if np.ndim(a) else a for a in arguments]))


@given(angles)
def test_thrust_axis_is_the_third_column_of_the_rotation(zeta):
    assert in_float64(thrust_axis, zeta) == pytest.approx(rotation(zeta)[:, 2], abs=1e-14)


@given(angles, rates)
def test_euler_rates_turn_the_rotation_matrix_as_the_body_rate_does(zeta, omega):
    rate = in_float64(euler_rates, zeta, omega)
    h = 1e-6 / max(1.0, np.abs(rate).max())
    turned = (rotation(zeta + h * rate) - rotation(zeta - h * rate)) / (2.0 * h)
    size = max(1.0, np.abs(rate).max())
    assert turned == pytest.approx(rotation(zeta) @ skew(omega), abs=1e-8 * size)


@given(angles, rates)
def test_body_rates_undo_euler_rates(zeta, omega):
    with numerics.precision("float64"):
        back = body_rates(jnp.asarray(zeta), euler_rates(jnp.asarray(zeta), jnp.asarray(omega)))
        assert np.asarray(back) == pytest.approx(omega, rel=1e-12, abs=1e-12)


@given(rates.filter(lambda d: np.hypot(d[0], d[2]) > 1e-3), turn)
@example(np.array([0.0, 0.0, 9.81]), 0.0)
@example(np.array([0.0, 0.0, -2.0]), 1.0)
def test_tilt_towards_points_the_thrust_along_the_direction_and_keeps_the_yaw(direction, yaw):
    zeta = in_float64(lambda d: tilt_towards(d, jnp.asarray(yaw)), direction)
    assert zeta[2] == yaw
    unit = direction / np.linalg.norm(direction)
    assert rotation(zeta) @ [0.0, 0.0, 1.0] == pytest.approx(unit, abs=1e-12)


def test_tilt_towards_has_a_finite_slope_when_upright():
    def along(direction):
        return tilt_towards(direction, jnp.zeros(()))

    with numerics.precision("float64"):
        slope = np.asarray(jax.jacfwd(along)(jnp.array([0.0, 0.0, 2.0])))
    # A push b across a lift of 2 tilts by b / 2: forward pitches, to the left rolls left.
    assert slope == pytest.approx(np.array([[0, -0.5, 0], [0.5, 0, 0], [0, 0, 0]]), abs=1e-15)


@given(moment, moment, st.permutations(range(3)))
@example(1.0, 2.0, [0, 1, 2])
def test_a_flat_plate_is_a_rigid_body_whichever_way_it_lies(a, b, order):
    # A plate without thickness stands on the bound: its largest moment is the sum of the others.
    moments = (a, b, a + b)
    assert check_inertia(tuple(moments[k] for k in order)) is None


@given(moment, moment, st.floats(1.001, 10.0), st.integers(0, 2))
def test_an_inertia_beyond_the_triangle_inequality_is_refused_by_axis(a, b, factor, axis):
    inertia = [a, b]
    inertia.insert(axis, factor * (a + b))
    with pytest.raises(ModelError) as caught:
        check_inertia(tuple(inertia))
    name = "xyz"[axis]
    assert f"no rigid body has that: I{name}{name} = " in str(caught.value)
    with pytest.raises(ModelError):
        Quadrotor(inertia=tuple(inertia))
    assert Quadrotor(inertia=tuple(inertia), allow_unphysical=True).inertia == tuple(inertia)


# Rows are the motors at (x, y) = (+-l, +-l), front-left, rear-left, rear-right, front-right, as the
# vehicle is drawn; opposite motors spin alike.
PLACES = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
SPINS = np.array([1, -1, 1, -1])


def allocation(quadrotor):
    """(4, 4) matrix from motor thrusts to (thrust, torques): r x F, and the rotors' reaction."""
    places = quadrotor.arm * PLACES
    return np.stack([np.ones(4), places[:, 1], -places[:, 0], quadrotor.torque_per_thrust * SPINS])


def motors(quadrotor, u):
    return np.linalg.solve(allocation(quadrotor), u)


QUAD = Quadrotor()
TOP = QUAD.motor_thrust
share = st.floats(-2.0, 2.0)
four = st.lists(st.floats(-2.0, 3.0), min_size=4, max_size=4).map(np.array)
inside = st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4).map(np.array)


@given(st.floats(-1.0, 2.0), share, share, share)
@example(0.5, 0.0, 0.0, 0.0)
@example(0.5, 1.5, -1.5, 1.0)
@example(0.5, 0.5, 0.5, 2.0)
@settings(max_examples=60)
def test_mixing_solves_the_linear_programs_of_its_priorities(collective, roll, nod, yaw):
    tilt, turning = roll * PLACES[:, 1] - nod * PLACES[:, 0], yaw * SPINS.astype(float)
    got = in_float64(
        lambda t, y: attitude_priority(jnp.asarray(collective), t, y, 1.0), tilt, turning
    )
    wanted = prioritized_thrusts(collective, tilt, turning, 1.0)
    # The shares carry the slack of the linear programs, times thrusts of up to 6.
    assert got == pytest.approx(wanted, abs=1e-6)


@given(four)
def test_motors_deliver_what_they_can_and_deliver_it_again_to_the_bit(wanted):
    once = in_float64(QUAD.limit, allocation(QUAD) @ (TOP * wanted))
    got = motors(QUAD, once) / TOP
    assert got.min() >= -1e-12 and got.max() <= 1.0 + 1e-12
    assert in_float64(QUAD.limit, once).tobytes() == once.tobytes()


@given(inside)
@example(np.array([0.0, 0.0, 0.0, 0.0]))
@example(np.array([0.5, 0.5, 0.5, 0.5]))
def test_inputs_that_motors_can_deliver_come_back_to_the_bit(wanted):
    # Well inside, where rounding in the way to the motors and back decides nothing.
    u = allocation(QUAD) @ (TOP * (0.001 + 0.998 * wanted))
    assert in_float64(QUAD.limit, u).tobytes() == u.tobytes()


@given(four)
def test_torques_are_kept_whenever_they_fit_and_roll_and_pitch_before_yaw(wanted):
    u = allocation(QUAD) @ (TOP * wanted)
    got = in_float64(QUAD.limit, u)
    tilt = motors(QUAD, [0.0, u[1], u[2], 0.0])
    torque = motors(QUAD, [0.0, *u[1:]])
    tolerance = 1e-12 * QUAD.arm * TOP
    if np.ptp(torque) <= TOP:
        assert got[1:] == pytest.approx(u[1:], abs=tolerance)
        # The collective gives way only as far as the motors make it.
        low, high = -torque.min(), TOP - torque.max()
        assert got[0] / 4 == pytest.approx(np.clip(u[0] / 4, low, high), abs=1e-12)
    if np.ptp(tilt) <= TOP:
        assert got[1:3] == pytest.approx(u[1:3], abs=tolerance)
        # The yaw torque is a difference of thrusts: the rounding of a thrust, times its lever.
        rounding = 8.0 * np.finfo(float).eps * QUAD.torque_per_thrust * TOP
        assert 0.0 <= got[3] * np.sign(u[3]) <= abs(u[3]) * (1.0 + 1e-12) + rounding
    else:
        # Both shrink by the same share: the axis of the tilt stays, and yaw has no room left.
        assert got[1] * u[2] == pytest.approx(got[2] * u[1], abs=tolerance * QUAD.arm * TOP)
        assert np.ptp(motors(QUAD, [0.0, got[1], got[2], 0.0])) == pytest.approx(TOP)


@given(st.floats(-1.0, 3.0), st.floats(-2.0, 2.0))
def test_the_planar_quadrotor_keeps_its_torque_before_its_thrust(total, difference):
    planar = PlanarQuadrotor()
    arm, most = planar.arm, planar.motor_thrust
    u = np.array([total * most, difference * arm * most])
    thrust, torque = once = in_float64(planar.limit, u)
    assert torque == pytest.approx(np.clip(u[1], -arm * most, arm * most), abs=1e-15)
    used = abs(torque) / arm
    assert thrust == pytest.approx(np.clip(u[0], used, 2 * most - used), abs=1e-12)
    # What two rotors deliver they deliver again to the bit.
    assert in_float64(planar.limit, once).tobytes() == once.tobytes()
