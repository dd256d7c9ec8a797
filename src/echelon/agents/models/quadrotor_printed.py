"""The quadrotor exactly as the paper prints it (literal), to show the consequences."""

import jax.numpy as jnp

from echelon.agents.models.model import ControlAffine, check_positive, diagonal
from echelon.agents.models.quadrotor import Quadrotor
from echelon.agents.models.rigid_body import check_moments, euler_rates, free_spin
from echelon.core.types import InputMap, Output, State


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
    radius = 0.07  # of the Crazyflie with its propellers

    def __check_init__(self) -> None:
        """Refuse a mass or inertia that is not positive.

        The printed inertia itself is kept on purpose.
        """
        check_positive(self, mass=self.mass)
        check_moments(self, self.inertia)

    @property
    def input_scale(self) -> tuple[tuple[float, ...], ...]:
        """S = diag(m, Ixx, Iyy, Izz)."""
        return diagonal(self.mass, *self.inertia)

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
