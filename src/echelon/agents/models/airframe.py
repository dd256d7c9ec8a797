"""The rigid body of a quadrotor and its motors, as proofs about motor thrusts need it."""

from typing import NamedTuple


class Airframe(NamedTuple):
    """A rigid body under four motors, whose thrusts and torques are all that moves it.

    Attributes:
        mass: kg.
        inertia: principal moments, kg m^2.
        gravity: m/s^2.
        arm: of each motor along both horizontal body axes, m.
        torque_per_thrust: yaw torque per thrust, N m / N.
        motor_thrust: largest thrust of one motor, N; the smallest is 0.
    """

    mass: float
    inertia: tuple[float, float, float]
    gravity: float
    arm: float
    torque_per_thrust: float
    motor_thrust: float
