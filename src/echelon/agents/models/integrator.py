"""Single and double integrators in any dimension, the agents of most consensus literature."""

import numbers

import equinox as eqx
import jax
import jax.numpy as jnp

from echelon.agents.models.model import (
    ControlAffine,
    FlatChains,
    check_not_negative,
    default,
)
from echelon.core.errors import ModelError
from echelon.core.limits import excess_states
from echelon.core.types import Input, InputMap, Output, State

_PREFIXES = ("", "v", "a")
_UNITS = ("m", "m/s", "m/s^2")
"""Of a position and its first two derivatives."""


_ONE_AN_AXIS = default(
    lambda agent: FlatChains((agent.order,) * agent.dimension, (0,) * agent.dimension)
)
"""`flat_chains`: one chain an axis, with no integrator before an input."""


class Integrator(ControlAffine):
    """A chain of `order` integrators along each of `dimension` axes; abstract."""

    order: eqx.AbstractClassVar[int]
    # Static, since it sets shapes, which a compiled function cannot take as data.
    dimension: int = eqx.field(default=2, static=True)

    def __check_init__(self) -> None:
        """Refuse a dimension below one."""
        name, dimension = f"`dimension` of `{type(self).__name__}`", self.dimension
        # True is an integer to Python, and no dimension.
        integral = isinstance(dimension, numbers.Integral) and not isinstance(dimension, bool)
        if not integral or dimension < 1:
            raise ModelError(f"{name} is {dimension!r}, and must be a whole number of at least 1.")
        excess = excess_states(self.order * dimension)
        if excess is not None:
            raise ModelError(f"{name} is too large: {excess}.")

    def _names(self, derivative: int) -> tuple[str, ...]:
        """Return the names of a derivative along all axes: x, y, z, or x1, x2, ... beyond three."""
        count = self.dimension
        axes = ("x", "y", "z")[:count] if count <= 3 else [f"x{k + 1}" for k in range(count)]
        return tuple(_PREFIXES[derivative] + axis for axis in axes)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Axis names, then velocity names where a velocity is a state."""
        return sum(map(self._names, range(self.order)), start=())

    @property
    def input_names(self) -> tuple[str, ...]:
        """Velocity or acceleration names."""
        return self._names(self.order)

    @property
    def output_names(self) -> tuple[str, ...]:
        """The axes."""
        return self._names(0)

    @property
    def position(self) -> tuple[str, ...]:
        """The axes."""
        return self._names(0)

    @property
    def state_units(self) -> tuple[str, ...]:
        """Metres, then metres per second."""
        return tuple(unit for unit in _UNITS[: self.order] for _ in range(self.dimension))

    @property
    def input_units(self) -> tuple[str, ...]:
        """Metres per second, or per second squared."""
        return (_UNITS[self.order],) * self.dimension

    @property
    def state_groups(self) -> dict[str, tuple[str, ...]]:
        """`position`, and `velocity` where it is a state."""
        groups = ("position", "velocity")[: self.order]
        return {name: self._names(derivative) for derivative, name in enumerate(groups)}

    @property
    def flat_order(self) -> int:
        """As many derivatives as there are integrators."""
        return self.order

    @property
    def flat_outputs(self) -> tuple[str, ...]:
        """The axes, up to three."""
        # A reference has three coordinates of space.
        return self._names(0) if self.dimension <= 3 else ()

    def input_map(self, x: State) -> InputMap:
        """Return g = (0; I)."""
        # In the precision of x: else float32 runs are promoted wherever x64 is on.
        identity = jnp.eye(self.dimension, dtype=x.dtype)
        above = [jnp.zeros_like(identity) for _ in range(self.order - 1)]
        return jnp.concatenate([*above, identity])


class SingleIntegrator(Integrator):
    """xdot = u, with x a position in `dimension` axes (m) and u a velocity (m/s)."""

    order = 1
    flat_chains, flat_bounds = _ONE_AN_AXIS, ()

    def drift(self, x: State) -> State:
        """Return f = 0."""
        return jnp.zeros_like(x)

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return (position, velocity)."""
        return derivatives[0], derivatives[1]


class DoubleIntegrator(Integrator):
    """pdot = v, vdot = u - drag v, in `dimension` axes.

    Position p is in m, velocity v in m/s, input u in m/s^2 and `drag` in 1/s.
    """

    drag: float = 0.0

    order = 2
    flat_chains, flat_bounds = _ONE_AN_AXIS, ()

    def __check_init__(self) -> None:
        """Refuse a negative drag."""
        check_not_negative(self, drag=self.drag)

    def drift(self, x: State) -> State:
        """Return f = (v, -drag v)."""
        v = x[self.dimension :]
        return jnp.concatenate([v, -self.drag * v])

    def output(self, x: State) -> Output:
        """Return the position."""
        return x[: self.dimension]

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return (position, velocity) and the acceleration that holds against drag."""
        position, velocity, acceleration = derivatives
        # vdot = u - drag v, solved for u.
        return jnp.concatenate([position, velocity]), acceleration + self.drag * velocity
