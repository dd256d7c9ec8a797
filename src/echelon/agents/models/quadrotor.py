"""The 12-state quadrotor of the paper's example, and exactly as the paper prints it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.body_file import read_principal
from echelon.agents.models.model import (
    Airframe,
    ControlAffine,
    FlatCoordinates,
    Limits,
    Rows,
    check_positive,
    diagonal,
)
from echelon.agents.models.rigid_body import (
    THRUST_TWICE,
    UPRIGHT,
    RigidVehicle,
    attitude_along,
    attitude_priority,
    body_axes,
    body_rates,
    check_inertia,
    check_moments,
    euler_rates,
    fits,
    free_spin,
    outer_radius,
    thrust_axis,
)
from echelon.core.errors import ModelError, check_name
from echelon.core.types import Input, InputMap, Output, PathLike, State

_IDENTIFIED = (16.571710e-6, 16.655602e-6, 29.261652e-6)
"""Inertia of a Crazyflie of 28 g, kg m^2 (Foerster 2015), the only one that is published."""


def _crazyflie(mass: float, motor_thrust: float, torque_per_thrust: float) -> dict[str, Any]:
    numbers = {"motor_thrust": motor_thrust, "torque_per_thrust": torque_per_thrust}
    return {"mass": mass, "inertia": _IDENTIFIED, **numbers}


# The motor thrust is the one that the firmware reaches at any charge of the battery. A full battery
# gives more: 0.16 N by Foerster, whose numbers the paper takes.
PARAMETERS: dict[str, dict[str, Any]] = {
    "crazyflie": _crazyflie(0.028, 0.15975, 0.005964552),
    "crazyflie-2.1+": _crazyflie(0.029, 0.12, 0.006993),
    "crazyflie-legacy": _crazyflie(0.029, 0.12, 0.00735),
    "crazyflie-thrust-kit": _crazyflie(0.0325, 0.18, 0.00516),
    "paper": {"mass": 0.028, "inertia": (6.4893e-6, 16.4562e-6, 29.5435e-6)},
}
"""Named parameter sets. `crazyflie` is the Crazyflie 2.1 that Foerster (2015) identified, with the
calibration of its firmware at that time; `paper` is the paper's Table I as printed. The others are
defaults of the firmware from 2025 on (Bitcraze, platform cf2) for the propellers of the 2.1+, the
older ones and the thrust upgrade kit; their inertia is Foerster's."""


def _with_rate(
    curve: Callable[[jax.Array], jax.Array], s: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return jax.jvp(curve, (s,), (jnp.ones_like(s),))


# Motors at (+-l, +-l): front-left, rear-left, rear-right, front-right as signs of (x, y); the spin
# of each gives the sign of its yaw torque.
_FRONT = (1.0, -1.0, -1.0, 1.0)
_LEFT = (1.0, 1.0, -1.0, -1.0)
_SPIN = (1.0, -1.0, 1.0, -1.0)


class Quadrotor(RigidVehicle):
    """Quadrotor in space by the Newton-Euler equations, ZYX Euler angles.

    pdot = v, vdot = -g e3 + R(zeta) e3 T / m,
    zetadot = W(zeta) omega, J omegadot = tau - omega x J omega
    (paper, equation of the example).

    States: position (m), velocity (m/s), attitude (rad), body rate (rad/s). Inputs: thrust T (N)
    and body torques tau (N m). The normalized input is (T/m - g, J^-1 tau).

    Raises:
        ModelError: a parameter is not positive, or no rigid body has the inertia (unless
            `allow_unphysical`).
    """

    mass: float = 0.028
    inertia: tuple[float, float, float] = (16.571710e-6, 16.655602e-6, 29.261652e-6)
    gravity: float = 9.81
    # The motors are 0.046 m from the hub, over sqrt 2 along each body axis; 0.639 N in all, a
    # quarter each.
    arm: float = 0.0325
    motor_thrust: float = 0.15975
    torque_per_thrust: float = 0.005964552
    allow_unphysical: bool = eqx.field(default=False, static=True)

    state_names = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r")
    input_names = ("thrust", "torque_x", "torque_y", "torque_z")
    input_units = ("N", "N m", "N m", "N m")
    flat_chains, flat_bounds = THRUST_TWICE, UPRIGHT
    state_groups = {
        "position": ("x", "y", "z"),
        "velocity": ("vx", "vy", "vz"),
        "attitude": ("roll", "pitch", "yaw"),
        "rate": ("p", "q", "r"),
    }
    # By simulation: weights of 1 make a rate of 0.008 1/s, and with 700 a line of 10 is lost.
    symmetry_weights = (500.0, 500.0, 100.0)
    # A tilt turns the thrust into the direction that weighs 500: with a weight of 1 for it the
    # fastest mode goes from 143 1/s at hover to 706 1/s at 30 degrees.
    symmetry_inputs = (4.0, 1.0, 1.0, 1.0)

    @classmethod
    def named(cls, name: str, **changes: Any) -> "Quadrotor":
        """Return the quadrotor of a named parameter set, one of `PARAMETERS`.

        `changes` replace fields of the set.

        Raises:
            ModelError: there is no such set.
        """
        check_name("the parameters of `Quadrotor` are", name, PARAMETERS, ModelError)
        return cls(**{**PARAMETERS[name], **changes})

    @classmethod
    def read(
        cls,
        file: PathLike,
        arm: float = arm,
        motor_thrust: float = motor_thrust,
        torque_per_thrust: float = torque_per_thrust,
        gravity: float = gravity,
    ) -> "Quadrotor":
        """Return the quadrotor with the mass and the inertia of a URDF or MJCF file.

        Its axes are those of the root link; the motors are taken as symmetric about its centre of
        mass. Neither format states motors, so other numbers are arguments, with the defaults of
        the class.

        Raises:
            ModelError: the file cannot be read, or its axes are not principal within 1 %.
        """
        mass, inertia = read_principal(file, cls.__name__)
        return cls(
            mass=mass,
            inertia=inertia,
            gravity=gravity,
            arm=arm,
            motor_thrust=motor_thrust,
            torque_per_thrust=torque_per_thrust,
        )

    @classmethod
    def crazyflie(cls) -> "Quadrotor":
        """Return the Crazyflie 2.1 with the parameters identified by Foerster (2015)."""
        return cls.named("crazyflie")

    def __check_init__(self) -> None:
        """Reject parameters that no vehicle can have."""
        names = ("mass", "arm", "motor_thrust", "torque_per_thrust")
        check_positive(self, **{name: getattr(self, name) for name in names})
        check_moments(self, self.inertia)
        if not self.allow_unphysical:
            check_inertia(self.inertia)

    @property
    def radius(self) -> float:
        """The propellers' outer edge, 0.07 m of a Crazyflie, whose motors are at 0.046 m."""
        return outer_radius(self.arm)

    @property
    def trim(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Hover at the origin: thrust m g, no torque."""
        return (0.0,) * 12, (self.mass * self.gravity, 0.0, 0.0, 0.0)

    @property
    def damping(self) -> Rows:
        """Damp velocity (1.6 1/s by tilting, 2 1/s upward), tilt and yaw, but not position."""
        # A tilt accelerates by g times itself, so 1.6/g rad per m/s damp at 1.6 1/s. Poles of the
        # attitude: s^2 + 16 s + 60 = (s + 6) (s + 10); of the yaw: (s + 2)^2.
        tilt, stiff, damp = 1.6 / self.gravity, 60.0, 16.0
        K = np.zeros((4, 12))
        K[0, 5] = 2.0
        K[1, [4, 6, 9]] = -stiff * tilt, stiff, damp
        K[2, [3, 7, 10]] = stiff * tilt, stiff, damp
        K[3, [8, 11]] = 4.0, 4.0
        return tuple(tuple(float(entry) for entry in row) for row in K)

    @property
    def input_scale(self) -> tuple[tuple[float, ...], ...]:
        """S = diag(m, Ixx, Iyy, Izz)."""
        return diagonal(self.mass, *self.inertia)

    @property
    def input_limits(self) -> Limits:
        """Each motor delivers between 0 and `motor_thrust`."""
        # Thrust and torques mix the motors by orthogonal patterns of signs, with squares that sum
        # to 4: the inverse is the transpose over 4.
        rows = tuple(
            (
                0.25,
                left / (4.0 * self.arm),
                -front / (4.0 * self.arm),
                spin / (4.0 * self.torque_per_thrust),
            )
            for left, front, spin in zip(_LEFT, _FRONT, _SPIN, strict=True)
        )
        return Limits(rows, (0.0,) * 4, (self.motor_thrust,) * 4)

    @property
    def airframe(self) -> Airframe:
        """The rigid body under the motors."""
        numbers = self.gravity, self.arm, self.torque_per_thrust, self.motor_thrust
        return Airframe(self.mass, self.inertia, *numbers)

    def drift(self, x: State) -> State:
        """Return f(x): free fall, attitude kinematics and gyroscopic coupling."""
        fall = jnp.array([0.0, 0.0, -self.gravity], x.dtype)
        turning = euler_rates(x[6:9], x[9:12])
        return jnp.concatenate([x[3:6], fall, turning, free_spin(self.inertia, x[9:12])])

    def input_map(self, x: State) -> InputMap:
        """Return g(x): thrust along the body z axis, torques on the body rates."""
        nothing = jnp.zeros((3, 4), x.dtype)
        lift = jnp.pad(thrust_axis(x[6:9])[:, None] / self.mass, ((0, 0), (0, 3)))
        spin = jnp.pad(jnp.diag(1.0 / jnp.asarray(self.inertia, x.dtype)), ((0, 0), (1, 0)))
        return jnp.concatenate([nothing, lift, nothing, spin])

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input that fly a path (x, y, z, yaw) with derivatives, (5, 4)."""
        position, velocity, acceleration = derivatives[:3, :3]
        up = jnp.array([0.0, 0.0, self.gravity], derivatives.dtype)
        attitude = attitude_along(derivatives, self.gravity)

        def rate(s: jax.Array) -> State:
            return body_rates(*_with_rate(attitude, s))

        now = jnp.zeros((), derivatives.dtype)
        omega, omega_dot = _with_rate(rate, now)
        # J omegadot = tau - omega x J omega, solved for tau.
        torque = jnp.asarray(self.inertia, omega.dtype) * (
            omega_dot - free_spin(self.inertia, omega)
        )
        thrust = self.mass * jnp.linalg.norm(acceleration + up)
        return (
            jnp.concatenate([position, velocity, attitude(now), omega]),
            jnp.concatenate([thrust[None], torque]),
        )

    def to_flat(self, x: State, e: jax.Array) -> FlatCoordinates:
        """Return position and yaw with derivatives; e is the thrust over mass minus g, its rate."""
        # With a = T/m, p^(2) = a R e3 - g e3, and R' = R [omega]x makes p^(3) = R (a q, -a p, a')
        # and p^(4) = R (2 a' q + a q' + a p r, -2 a' p - a p' + a q r, a'' - a (p^2 + q^2)).
        (p, q, r), a, rate = x[9:12], self.gravity + e[0], e[1]
        axes, turning = body_axes(x[6:9]), euler_rates(x[6:9], x[9:12])
        fall = jnp.array([0.0, 0.0, -self.gravity], x.dtype)
        jerk = axes @ jnp.stack([a * q, -a * p, rate])
        path = jnp.stack([x[:3], x[3:6], axes[:, 2] * a + fall, jerk])
        heading = jnp.pad(jnp.stack([x[8], turning[2]]), (0, 2))

        def invert(tops: jax.Array) -> Input:
            snap = tops[:3] @ axes
            (sr, sp), (cr, cp) = jnp.sin(x[6:8]), jnp.cos(x[6:8])
            # One quotient for all, since divisions take longest here.
            both = 1.0 / (a * cr)
            p_dot = q * r - (2.0 * rate * p + snap[1]) * (cr * both)
            q_dot = (snap[0] - 2.0 * rate * q) * (cr * both) - p * r
            # yaw' is (sin(roll) q + cos(roll) r) / cos(pitch), and tops[3] its rate.
            drift = turning[0] * (cr * q - sr * r) + sr * q_dot + sp * turning[1] * turning[2]
            spin = jnp.stack([p_dot, q_dot, (cp * tops[3] - drift) * (a * both)])
            spin = spin - free_spin(self.inertia, x[9:12])
            return jnp.concatenate([(snap[2] + a * (p**2 + q**2))[None], spin])

        return FlatCoordinates(jnp.concatenate([path, heading[:, None]], axis=1), invert)

    def limit(self, u: Input) -> Input:
        """Return what four motors within [0, motor_thrust] deliver.

        Where they cannot deliver u, first the collective is reduced, then yaw, then roll and pitch.
        """
        left, front, spin = (jnp.asarray(sign, u.dtype) for sign in (_LEFT, _FRONT, _SPIN))
        # The same mixer as in `input_limits`, its part for yaw apart.
        tilt = (u[1] * left - u[2] * front) / (4.0 * self.arm)
        yaw = u[3] * spin / (4.0 * self.torque_per_thrust)
        commanded = u[0] / 4.0 + tilt + yaw
        f = attitude_priority(u[0] / 4.0, tilt, yaw, self.motor_thrust)
        torque = [
            self.arm * (left @ f),
            -self.arm * (front @ f),
            self.torque_per_thrust * (spin @ f),
        ]
        delivered = jnp.stack([jnp.sum(f), *torque])
        # u itself where it fits: rounding of the mixing would count as saturation.
        return jnp.where(fits(commanded, self.motor_thrust), u, delivered)


class PrintedQuadrotor(ControlAffine):
    """The quadrotor as printed in the paper (literal).

    pdot = v, vdot = (T, T, T) / m,
    zetadot = W(zeta) omega, J omegadot = tau - omega x J omega.

    Gravity and the rotation of the thrust into the world frame are missing, as printed; the thrust
    pushes along (1, 1, 1). Its drift is nilpotent at the origin, so no P > 0 satisfies the paper's
    Assumption 5. States and inputs are those of `Quadrotor`; the normalized input is
    (T/m, J^-1 tau).
    """

    mass: float = 0.028
    # Table I, which no rigid body has: Ixx + Iyy < Izz.
    inertia: tuple[float, float, float] = (6.4893e-6, 16.4562e-6, 29.5435e-6)

    state_names, state_units = Quadrotor.state_names, Quadrotor.state_units
    input_names, input_units = Quadrotor.input_names, Quadrotor.input_units
    output_names, position = Quadrotor.output_names, Quadrotor.position
    state_groups, chart = Quadrotor.state_groups, Quadrotor.chart
    input_scale = Quadrotor.input_scale  # pyright: ignore - a property
    radius = 0.07  # of the Crazyflie with its propellers

    def __check_init__(self) -> None:
        # The printed inertia itself is kept on purpose.
        check_positive(self, mass=self.mass)
        check_moments(self, self.inertia)

    def drift(self, x: State) -> State:
        """Return f(x), without gravity as printed."""
        turning = euler_rates(x[6:9], x[9:12])
        still = jnp.zeros(3, x.dtype)
        return jnp.concatenate([x[3:6], still, turning, free_spin(self.inertia, x[9:12])])

    def input_map(self, x: State) -> InputMap:
        """Return g, constant: the thrust enters all three accelerations alike, as printed."""
        nothing = jnp.zeros((3, 4), x.dtype)
        push = jnp.pad(jnp.full((3, 1), 1.0 / self.mass, x.dtype), ((0, 0), (0, 3)))
        spin = jnp.pad(jnp.diag(1.0 / jnp.asarray(self.inertia, x.dtype)), ((0, 0), (1, 0)))
        return jnp.concatenate([nothing, push, nothing, spin])

    def output(self, x: State) -> Output:
        """Return position and yaw."""
        return jnp.concatenate([x[:3], x[8:9]])
