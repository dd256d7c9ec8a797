"""Single and double integrators in any dimension, the agents of most consensus literature."""

import numbers

import equinox as eqx
import jax
import jax.numpy as jnp

from echelon.agents.models.model import ControlAffine, FlatChains, check_not_negative
from echelon.core.errors import ModelError
from echelon.core.limits import excess_states
from echelon.core.types import Input, InputMap, Output, State

_AXES = ("x", "y", "z")


def _axes(dimension: int) -> tuple[str, ...]:
    """Return x, y, z, or x1, x2, ... beyond three dimensions."""
    return _AXES[:dimension] if dimension <= 3 else tuple(f"x{k + 1}" for k in range(dimension))


def _check_dimension(model: ControlAffine, dimension: int) -> None:
    # True is an integer to Python, and no dimension.
    if isinstance(dimension, bool) or not isinstance(dimension, numbers.Integral) or dimension < 1:
        raise ModelError(
            f"`dimension` of `{type(model).__name__}` is {dimension}, "
            "and must be a whole number of at least 1."
        )
    excess = excess_states(model.flat_order * dimension)
    if excess is not None:
        raise ModelError(f"`dimension` of `{type(model).__name__}` is too large: {excess}.")


class SingleIntegrator(ControlAffine):
    """xdot = u, with x a position in `dimension` axes (m) and u a velocity (m/s)."""

    # Static, since it sets shapes, which a compiled function cannot take as data.
    dimension: int = eqx.field(default=2, static=True)

    flat_order = 1
    flat_bounds = ()

    def __check_init__(self) -> None:
        """Refuse a dimension below one."""
        _check_dimension(self, self.dimension)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Axis names."""
        return _axes(self.dimension)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Velocity names."""
        return tuple(f"v{name}" for name in _axes(self.dimension))

    @property
    def state_units(self) -> tuple[str, ...]:
        """Metres."""
        return ("m",) * self.dimension

    @property
    def input_units(self) -> tuple[str, ...]:
        """Metres per second."""
        return ("m/s",) * self.dimension

    @property
    def state_groups(self) -> dict[str, tuple[str, ...]]:
        """All states are `position`."""
        return {"position": self.state_names}

    @property
    def position(self) -> tuple[str, ...]:
        """All axes."""
        return self.state_names

    @property
    def flat_chains(self) -> FlatChains:
        """One chain of one integrator an axis."""
        return FlatChains((1,) * self.dimension, (0,) * self.dimension)

    @property
    def flat_outputs(self) -> tuple[str, ...]:
        """The axes, up to three."""
        # A reference has three coordinates of space.
        return self.state_names if self.dimension <= 3 else ()

    def drift(self, x: State) -> State:
        """Return f = 0."""
        return jnp.zeros_like(x)

    def input_map(self, x: State) -> InputMap:
        """Return g = I."""
        # In the precision of x: else float32 runs are promoted wherever x64 is on.
        return jnp.eye(self.dimension, dtype=x.dtype)

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return (position, velocity)."""
        return derivatives[0], derivatives[1]


class DoubleIntegrator(ControlAffine):
    """pdot = v, vdot = u - drag v, in `dimension` axes.

    Position p is in m, velocity v in m/s, input u in m/s^2 and `drag` in 1/s.
    """

    dimension: int = eqx.field(default=2, static=True)
    drag: float = 0.0

    flat_order = 2
    flat_bounds = ()

    def __check_init__(self) -> None:
        """Refuse a dimension below one or a negative drag."""
        _check_dimension(self, self.dimension)
        check_not_negative(self, drag=self.drag)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Axis names, then velocity names."""
        axes = _axes(self.dimension)
        return axes + tuple(f"v{name}" for name in axes)

    @property
    def input_names(self) -> tuple[str, ...]:
        """Acceleration names."""
        return tuple(f"a{name}" for name in _axes(self.dimension))

    @property
    def state_units(self) -> tuple[str, ...]:
        """Metres, then metres per second."""
        return ("m",) * self.dimension + ("m/s",) * self.dimension

    @property
    def input_units(self) -> tuple[str, ...]:
        """Metres per second squared."""
        return ("m/s^2",) * self.dimension

    @property
    def state_groups(self) -> dict[str, tuple[str, ...]]:
        """`position` and `velocity`."""
        names = self.state_names
        return {"position": names[: self.dimension], "velocity": names[self.dimension :]}

    @property
    def output_names(self) -> tuple[str, ...]:
        """The axes."""
        return _axes(self.dimension)

    @property
    def position(self) -> tuple[str, ...]:
        """The axes."""
        return _axes(self.dimension)

    @property
    def flat_chains(self) -> FlatChains:
        """One chain of two integrators an axis."""
        return FlatChains((2,) * self.dimension, (0,) * self.dimension)

    @property
    def flat_outputs(self) -> tuple[str, ...]:
        """The axes, up to three."""
        return _axes(self.dimension) if self.dimension <= 3 else ()

    def drift(self, x: State) -> State:
        """Return f = (v, -drag v)."""
        v = x[self.dimension :]
        return jnp.concatenate([v, -self.drag * v])

    def input_map(self, x: State) -> InputMap:
        """Return g = (0; I)."""
        identity = jnp.eye(self.dimension, dtype=x.dtype)
        return jnp.concatenate([jnp.zeros_like(identity), identity])

    def output(self, x: State) -> Output:
        """Return the position."""
        return x[: self.dimension]

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return (position, velocity) and the acceleration that holds against drag."""
        position, velocity, acceleration = derivatives
        # vdot = u - drag v, solved for u.
        return jnp.concatenate([position, velocity]), acceleration + self.drag * velocity
