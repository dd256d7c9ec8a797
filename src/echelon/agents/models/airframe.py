"""A rigid body in space that four motors move: what certificates of its motors need to know."""

from typing import NamedTuple


class Airframe(NamedTuple):
    """A rigid body under four motors, whose thrusts and torques are all that moves it.

    Attributes:
        mass: kg.
        inertia: principal moments, kg m^2.
        gravity: m/s^2.
        arm: of each motor along both horizontal body axes, m.
        torque_per_thrust: N m of yaw torque a newton.
        motor_thrust: the most of one motor, N; the least is none.
    """

    mass: float
    inertia: tuple[float, float, float]
    gravity: float
    arm: float
    torque_per_thrust: float
    motor_thrust: float
