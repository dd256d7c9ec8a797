"""The interface of an agent: a control-affine system xdot = f(x) + g(x) u, y = h(x)."""

import abc
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, NamedTuple, TypeAlias, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from echelon.core.errors import ModelError, did_you_mean, is_number, listing
from echelon.core.trace import call_once_traced
from echelon.core.types import Array, Declared, Input, InputMap, Output, Scalar, State


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


class Heading(NamedTuple):
    """How a model turns: its heading grows by the angle, and vectors in the plane turn by it.

    Attributes:
        state: name of the state that is the heading, rad.
        vectors: pairs of states that turn, such as ("x", "y"): from the first to the second.
        inputs: pairs of normalized inputs that turn; none where inputs act along the body's axes.
    """

    state: str
    vectors: tuple[tuple[str, str], ...] = ()
    inputs: tuple[tuple[str, str], ...] = ()


class Turn(NamedTuple):
    """A rotation of pairs of entries of a vector (k,), exp(angle G).

    Attributes:
        partners: (k,) the entry with which each entry is mixed.
        signs: (k,) its sign in the mixture; 0 where an entry does not turn.
    """

    partners: Array
    signs: Array

    @classmethod
    def of(cls, names: tuple[str, ...], pairs: tuple[tuple[str, str], ...]) -> "Turn":
        """Return the rotation of pairs of named entries."""
        partners, signs = np.arange(len(names)), np.zeros(len(names))
        for first, second in pairs:
            i, j = names.index(first), names.index(second)
            partners[[i, j]], signs[[i, j]] = (j, i), (-1.0, 1.0)
        return cls(partners, signs)

    def __call__(self, values: Float[jax.Array, " k"], angle: Scalar) -> Float[jax.Array, " k"]:
        """Return values (k,) turned by an angle (rad); entries that do not turn keep their bits."""
        if not self.signs.any():
            return values
        signs = jnp.asarray(self.signs, values.dtype)
        cosines = jnp.where(self.signs != 0.0, jnp.cos(angle), jnp.ones_like(values))
        return cosines * values + jnp.sin(angle) * (signs * values[self.partners])

    @property
    def slope(self) -> Array:
        """G (k, k)."""
        slope = np.zeros((len(self.signs), len(self.signs)))
        slope[np.arange(len(self.signs)), self.partners] = self.signs
        return slope


# `ControlAffine` is the agent of the paper's Definition 1. A user's model needs two methods and two
# tuples of names; everything else has a default, which a class attribute, a property or a method of
# the same name replaces.

Pair: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
Rows: TypeAlias = tuple[tuple[float, ...], ...]
_T = TypeVar("_T")
_Inputs = TypeVar("_Inputs", jax.Array, np.ndarray)


class _Default(Generic[_T]):
    """A class attribute computed from the instance, until a subclass replaces it in any way."""

    def __init__(self, make: Callable[[Any], _T]) -> None:
        self.make = make

    # Without `__set__` it gives way to a field of the instance, as a property would not.
    def __get__(self, instance: object, owner: type) -> "_T | _Default[_T]":
        return self if instance is None else self.make(instance)


def default(make: Callable[[Any], _T]) -> _T:
    """Return a default that depends on the instance; an attribute or a property may replace it."""
    return cast(_T, _Default(make))


def _repeat(value: float, names: tuple[str, ...]) -> tuple[float, ...]:
    return (value,) * len(names)


def diagonal(*entries: float) -> Rows:
    """Return a diagonal matrix as nested tuples, the form of `input_scale`."""
    return tuple(
        tuple(e if i == j else 0.0 for j in range(len(entries))) for i, e in enumerate(entries)
    )


class Limits(NamedTuple):
    """The inputs that actuators can deliver: low <= G u <= high, row by row.

    Attributes:
        matrix: G, (k, m).
        low, high: (k,), infinite where there is no bound.
    """

    matrix: Rows
    low: tuple[float, ...]
    high: tuple[float, ...]


class FlatChains(NamedTuple):
    """The lengths of a model's chains of integrators.

    Attributes:
        degrees: for each flat output, the first derivative that the inputs reach.
        integrators: for each input, how many integrators are put before it.
    """

    degrees: tuple[int, ...]
    integrators: tuple[int, ...]


class FlatBound(NamedTuple):
    """A border of the flat coordinates: a derivative of flat outputs stays above a value.

    For one output it is the derivative itself, for several the length of the vector of derivatives.

    Attributes:
        outputs: names of the flat outputs.
        derivative: order of the derivative.
        above: lower limit of the derivative.
        within: the bounds of the state that follow, in words.
    """

    outputs: tuple[str, ...]
    derivative: int
    above: float
    within: str


class FlatCoordinates(NamedTuple):
    """A state in flat coordinates.

    Attributes:
        values: (r, m), the flat outputs and their derivatives below those that the inputs reach,
            else zero.
        invert: commanded highest derivatives (m,) -> the normalized inputs (m,) of the integrators.
    """

    values: jax.Array
    invert: Callable[[jax.Array], Input]


class ControlAffine(Declared):
    """One agent, xdot = f(x) + g(x) u with output y = h(x).

    Shapes are those of one agent: x (n,), u (m,), f (n,), g (n, m), h (q,). The methods must be
    pure and, in x, differentiable by JAX.
    """

    state_names: ClassVar[tuple[str, ...]] = ()
    """Names of the n states; required of every model."""

    input_names: ClassVar[tuple[str, ...]] = ()
    """Names of the m inputs; required of every model."""

    output_names: ClassVar[tuple[str, ...]] = default(lambda self: self.state_names)
    """Names of the entries of h(x); replace them together with `output`."""

    state_units: ClassVar[tuple[str, ...]] = default(lambda self: ("",) * len(self.state_names))
    """SI units of the states, as text; empty where unknown."""

    input_units: ClassVar[tuple[str, ...]] = default(lambda self: ("",) * len(self.input_names))
    """SI units of the inputs, as text; empty where unknown."""

    state_groups: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Named groups of states, such as `position` or `attitude`, for spreads and start errors."""

    position: ClassVar[tuple[str, ...]] = ()
    """Names of the position coordinates, in metres; none for an agent without a position."""

    radius: ClassVar[float | None] = None
    """Radius (m) of the sphere around its position that holds the agent; None if it has no size.

    Two agents closer than twice the radius touch. The simulation lets them pass through each other,
    and a run reports it."""

    trim: ClassVar[Pair] = default(
        lambda self: (_repeat(0.0, self.state_names), _repeat(0.0, self.input_names))
    )
    """Equilibrium (x*, u*) about which gains are computed; the origin unless replaced."""

    input_scale: ClassVar[Rows] = default(lambda self: diagonal(*_repeat(1.0, self.input_names)))
    """Matrix S (m, m) of the normalized input v in u = u* + S v; the identity unless replaced."""

    weights: ClassVar[Pair] = default(
        lambda self: (_repeat(1.0, self.state_names), _repeat(1.0, self.input_names))
    )
    """Diagonals of the default Riccati weights (Q, R), R on normalized inputs; all ones."""

    damping: ClassVar[Rows | None] = None
    """Feedback K (m, n) of an inner loop v = -K (x - x*) that does not use symmetric states.

    Of another shape it is a parameter of a model of yours, which has no such loop."""

    symmetry_weights: ClassVar[tuple[float, ...] | None] = None
    """Weights of the symmetric states in the P that goes with `damping`, one each."""

    symmetry_inputs: ClassVar[tuple[float, ...] | None] = None
    """Weights R of the normalized inputs in the law around `damping`, one each; ones if None."""

    input_limits: ClassVar[Limits | None] = None
    """The inputs that actuators deliver, low <= G u <= high; None without limits.

    Where G is square and invertible, `limit` clips row by row unless it is replaced; for any other
    G a model must replace it.
    """

    heading: ClassVar[Heading | None] = None
    """How states and inputs turn with the heading, if the dynamics are the same in every heading.

    The gains of such a model turn with the heading that the leader follows. None for other models.
    """

    chart: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Open bounds of states outside which the equations do not hold, such as a pitch of 90 deg."""

    flat_outputs: ClassVar[tuple[str, ...]] = ()
    """The coordinates of a reference, of (x, y, z, yaw), that the model can follow."""

    flat_order: ClassVar[int] = 0
    """Number of time derivatives of the reference that `flat` needs."""

    flat_chains: ClassVar[FlatChains | None] = None
    """The chains of integrators that feedback makes of the agent; computed at samples if None."""

    flat_bounds: ClassVar[tuple[FlatBound, ...] | None] = None
    """Borders of the flat coordinates of `flat_chains`, as the model states them; an empty tuple
    states that there are none, None states nothing."""

    airframe: ClassVar[Airframe | None] = None
    """The rigid body that four motors move by `thrust` and three torques; None for other agents."""

    @abc.abstractmethod
    def drift(self, x: State) -> State:
        """Return f(x)."""

    @abc.abstractmethod
    def input_map(self, x: State) -> InputMap:
        """Return g(x)."""

    def output(self, x: State) -> Output:
        """Return h(x); the whole state unless replaced."""
        return x

    def flat(self, derivatives: jax.Array) -> tuple[State, Input]:
        """Return the state and input (x, u) that produce a flat output.

        Args:
            derivatives: (flat_order + 1, len(flat_outputs)), the output and its time derivatives.

        Raises:
            ModelError: the model does not define it.
        """
        raise ModelError(
            f"model `{type(self).__name__}` cannot track a reference, since it defines no `flat`; "
            "use the law `passive` for its leader, or add `flat_outputs`, `flat_order` and `flat`."
        )

    def to_flat(self, x: State, e: jax.Array) -> FlatCoordinates | None:
        """Return the flat coordinates of a state, e being the integrator states of `flat_chains`.

        Where it returns None they are computed by automatic differentiation.
        """
        return None

    def initial_integrators(self, x: State, ahead: jax.Array) -> jax.Array | None:
        """Return the initial states of the integrators before inputs; None leaves them open.

        `ahead` (r, m) are the flat outputs, with derivatives, of the path that the agent follows.
        """
        return None

    def difference(self, x: State, y: State) -> State:
        """Return x - y; replaced where a coordinate is an angle."""
        return x - y

    def own_state(self, x: State) -> State:
        """Return a state after a step with what the agent has; the whole unless replaced."""
        return x

    def limit(self, u: Input) -> Input:
        """Return the input that the actuators deliver for a requested u.

        Each row of G u is clipped to its limits unless replaced. An input within the limits must be
        returned unchanged, to the bit: saturation is counted as any change.
        """
        if self.input_limits is None:
            return u
        G, low, high = (jnp.asarray(part, u.dtype) for part in self.input_limits)
        rows = G @ u
        clipped = jnp.clip(rows, low, high)
        inverse = _inverse(self.input_limits.matrix, G)
        # Multiplying by G and its inverse rounds, which would count as saturation.
        return jnp.where(jnp.all(rows == clipped), u, inverse @ clipped)

    def velocity(self, x: State, u: Input) -> State:
        """Return f(x) + g(x) u."""
        return call_once_traced(self.drift, x) + call_once_traced(self.input_map, x) @ u

    def normalized_drift(self, x: State) -> State:
        """Return f(x) + g(x) u*, the drift about the trim."""
        return self.velocity(x, jnp.asarray(self.trim[1], x.dtype))

    def normalized_input_map(self, x: State) -> InputMap:
        """Return g(x) S, the input map of the normalized input."""
        return call_once_traced(self.input_map, x) @ jnp.asarray(self.input_scale, x.dtype)

    def physical(self, v: _Inputs, trim: bool = True) -> _Inputs:
        """Return u = u* + S v of normalized inputs (..., m), NumPy's or JAX's, in their precision.

        Without the trim it is S v, the change of the input.
        """
        xp = v.__array_namespace__()
        # One input a row: (S v)' = v'S'.
        u = v @ xp.asarray(self.input_scale, v.dtype).T
        return u + _trim_input(self, u) if trim else u

    def normalized(self, u: _Inputs) -> _Inputs:
        """Return v = S^-1 (u - u*) of physical inputs (..., m), NumPy's or JAX's."""
        xp = u.__array_namespace__()
        # A constant wherever S is one, so that neither a step nor a solver's expression inverts it.
        # By NumPy, since compiling an inverse takes longer than the rest of a trace.
        if any(isinstance(entry, Tracer) for entry in jax.tree.leaves(self.input_scale)):
            inverse = xp.linalg.inv(xp.asarray(self.input_scale, u.dtype))
        else:
            inverse = xp.asarray(np.linalg.inv(np.asarray(self.input_scale, u.dtype)))
        return (u - _trim_input(self, u)) @ inverse.T

    def position_indices(self) -> tuple[int, ...]:
        """Return the indices of `position` in the state."""
        return tuple(self.state_names.index(name) for name in self.position)

    def states_called(self, name: str) -> tuple[int, ...]:
        """Return the indices of a state or of a group of states.

        Raises:
            ModelError: the model has neither a state nor a group of that name.
        """
        if name in self.state_groups:
            return tuple(self.state_names.index(member) for member in self.state_groups[name])
        if name in self.state_names:
            return (self.state_names.index(name),)
        allowed = [*self.state_groups, *self.state_names]
        raise ModelError(
            f"`{name}` is no state or group of `{type(self).__name__}`, "
            f"which has {listing(allowed)}{did_you_mean(name, allowed)}."
        )

    def per_state(self, named: Mapping[str, float], otherwise: float = 0.0) -> np.ndarray:
        """Return a number for each state, (n,), from numbers by state or group of states.

        The number of a state overrides that of its group. States without one get `otherwise`.

        Raises:
            ModelError: a name is neither a state nor a group.
        """
        values = np.full(len(self.state_names), float(otherwise))
        # Groups come first, whatever the order of the mapping, and states override them.
        for name in sorted(named, key=lambda name: name in self.state_names):
            values[list(self.states_called(name))] = named[name]
        return values


def _trim_input(model: ControlAffine, u: _Inputs) -> _Inputs:
    xp = u.__array_namespace__()
    return xp.broadcast_to(xp.asarray(model.trim[1], u.dtype), u.shape)


def wrap_angles(difference: State, *angles: int) -> State:
    """Return a difference of states with the angles (rad) at these indices within half a turn."""
    # Agents that differ by a whole turn agree. Without a turn to subtract no bit changes.
    indices = np.array(angles)
    turns = jnp.round(difference[indices] / (2.0 * jnp.pi))
    return difference.at[indices].add(-2.0 * jnp.pi * turns)


def check_positive(owner: object, **values: float) -> None:
    """Raise `ModelError` unless each named parameter is a finite positive number."""
    # The comparisons are false for NaN, which is rejected too.
    for name, value in values.items():
        if not (is_number(value) and 0.0 < value < float("inf")):
            raise ModelError(
                f"`{name}` of `{type(owner).__name__}` is {value}, "
                "and must be a positive finite number."
            )


def check_not_negative(owner: object, **values: float) -> None:
    """Raise `ModelError` unless each named parameter is a finite number of at least zero."""
    for name, value in values.items():
        if not (is_number(value) and 0.0 <= value < float("inf")):
            raise ModelError(
                f"`{name}` of `{type(owner).__name__}` is {value}, and must be finite "
                "and not negative."
            )


def _inverse(rows: Rows, G: jax.Array) -> jax.Array:
    """Return the inverse of a matrix, which is computed once unless its numbers are traced."""
    if any(isinstance(x, Tracer) for row in rows for x in row):
        return jnp.linalg.inv(G)
    return jnp.asarray(np.linalg.inv(np.asarray(rows)), G.dtype)


def in_metres(model: ControlAffine) -> bool:
    """Tell whether no coordinate of the position has another unit than m."""
    units = dict(zip(model.state_names, model.state_units, strict=True))
    return all(units[name] in ("", "m") for name in model.position)


def position_unit(model: ControlAffine) -> str:
    """Return the unit of distances: m where none is declared; empty without one for all axes."""
    if in_metres(model):
        return "m" if model.position else ""
    units = {model.state_units[k] for k in model.position_indices()}
    return units.pop() if len(units) == 1 else ""
