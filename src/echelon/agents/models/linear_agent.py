"""Linear agents: single and double integrators, and any that its matrices give."""

import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import (
    ControlAffine,
    FlatChains,
    check_not_negative,
    check_positive,
    default,
)
from echelon.core.errors import ModelError, listing
from echelon.core.limits import excess_states
from echelon.core.types import Array, Input, InputMap, Output, PathLike, State

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


_NAMES = ("A", "B", "C", "D", "Ts")


def read_matrices(file: PathLike) -> dict[str, Array]:
    """Return A and B of a `.mat` file, and C, D, Ts where it has them; else `ModelError`."""
    content = _content(file)
    names = [name for name in content if not name.startswith("__")]
    missing = [name for name in ("A", "B") if name not in names]
    if missing:
        held = f"holds {listing(names)}" if names else "is empty"
        raise ModelError(
            f"`{file}` lacks {listing(missing)} and {held}; save the matrices by themselves, as in "
            "`save('plant.mat', 'A', 'B', 'C', 'D')`."
        )
    # MATLAB may have stored a matrix as a sparse one.
    held = {name: content[name] for name in _NAMES if name in names}
    return {k: np.asarray(m.toarray() if hasattr(m, "toarray") else m) for k, m in held.items()}


def _content(file: PathLike) -> Mapping[str, Any]:
    # Imported here: few models are in files, and SciPy's readers load slowly.
    from scipy.io import loadmat

    try:
        return loadmat(str(file), appendmat=False)
    except NotImplementedError:
        raise ModelError(
            f"`{file}` is a MATLAB file of version 7.3; save it with `save(..., '-v7')`."
        ) from None
    except OSError as error:
        raise ModelError(f"`{file}` cannot be read: {error.strerror or error}.") from None
    except Exception as error:  # SciPy raises whatever a damaged file causes
        raise ModelError(f"`{file}` is not a MATLAB file that can be read: {error}.") from None


_EXACT = 1e-9
"""Relative; what remains of a discrete-time model when it is sampled again."""


class Linear(ControlAffine):
    """xdot = A x + B u, y = C x.

    Args:
        A: (n, n).
        B: (n, m).
        C: (q, n), the identity when left out.
        names: n state names; x1, x2, ... when left out.

    Raises:
        ModelError: the matrices do not fit together or hold a non-finite number.
    """

    A: Array
    B: Array
    C: Array
    # Text is no data to JAX, so it belongs to the structure of the module.
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        A: Sequence[Sequence[float]] | Array,
        B: Sequence[Sequence[float]] | Array,
        C: Sequence[Sequence[float]] | Array | None = None,
        names: Sequence[str] = (),
    ) -> None:
        # NumPy's float64: a JAX array made outside of an x64 context would already be rounded.
        self.A, self.B = _matrix("A", A), _matrix("B", B)
        n, m = len(self.A), self.B.shape[1]
        self.C = np.eye(n) if C is None else _matrix("C", C)
        self.names = tuple(names) or tuple(f"x{k + 1}" for k in range(n))
        if (
            self.A.shape != (n, n)
            or n * m == 0
            or len(self.B) != n
            or self.C.shape[1] != n
            or len(self.names) != n
        ):
            raise ModelError(
                f"the shapes of `Linear` are A {self.A.shape}, B {self.B.shape}, C {self.C.shape} "
                f"with {len(self.names)} names, "
                "and must be A (n, n), B (n, m), C (q, n) with n names, n and m from 1 on."
            )

    @classmethod
    def discrete(
        cls,
        A: Sequence[Sequence[float]] | Array,
        B: Sequence[Sequence[float]] | Array,
        step: float,
        C: Sequence[Sequence[float]] | Array | None = None,
        names: Sequence[str] = (),
    ) -> "Linear":
        """Return the system in continuous time that x+ = A x + B u samples, as MATLAB's `d2c`.

        With inputs held over `step` its states at the samples are those of the given system; it is
        the slowest such system. A run with `dt` equal to `step` repeats them up to the error of the
        integrator, which `substeps` reduce.

        Args:
            A: (n, n).
            B: (n, m).
            step: the sampling time, s.
            C: (q, n), the identity when left out.
            names: n state names.

        Raises:
            ModelError: there is no such system, since A has an eigenvalue that is zero or negative;
                or as for `Linear`.
        """
        sampled = cls(A, B, C, names)
        check_positive(sampled, step=step)
        return cls(*_continuous(sampled.A, sampled.B, float(step)), C, names)

    @classmethod
    def from_control(cls, system: Any, names: Sequence[str] = ()) -> "Linear":
        """Return the model of a `StateSpace` of python-control or SciPy.

        One in discrete time, with a step `dt` (s), is converted as by `discrete`.

        Args:
            system: what has the matrices A, B, C, D and, in discrete time, `dt`.
            names: n state names; x1, x2, ... when left out.

        Raises:
            ModelError: it is no state space, D is not zero, or its step is not specified.
        """
        if not all(hasattr(system, name) for name in "ABCD"):
            raise ModelError(
                f"`system` is a `{type(system).__name__}`, and must be a `StateSpace` with A, B, C "
                "and D; convert a transfer function first, as by `control.ss`."
            )
        # python-control says True for a step that is not specified, and 0 or None for no steps.
        step = getattr(system, "dt", None)
        found = {name: np.asarray(getattr(system, name)) for name in "ABCD"}
        found["Ts"] = np.asarray(-1.0 if step is True else step or 0.0)
        return cls._of("the state space", found, names)

    @classmethod
    def read(cls, file: PathLike, names: Sequence[str] = ()) -> "Linear":
        """Return the model in a MATLAB file: A and B, and where given C, D and the step Ts.

        With a positive Ts (s) it is a discrete-time model, see `discrete`.

        Raises:
            ModelError: the file cannot be read, lacks A or B, D is not zero, or Ts is no step.
        """
        return cls._of(f"`{file}`", read_matrices(file), names)

    @classmethod
    def _of(cls, what: str, found: Mapping[str, Array], names: Sequence[str]) -> "Linear":
        """Return the model of matrices by name, in steps where `Ts` is not zero."""
        if found.get("D", np.zeros(1)).any():
            raise ModelError(
                f"`D` of {what} is not zero, and the output of an agent depends on its state "
                "only; leave `D` out, or add the input's filter to the states."
            )
        matrices, C, Ts = (found["A"], found["B"]), found.get("C"), found.get("Ts", np.zeros(1))
        if not Ts.any():
            return cls(*matrices, C, names)
        # MATLAB has -1 for a discrete-time model whose step is not specified.
        if Ts.size != 1 or not Ts.item() > 0.0:
            raise ModelError(
                f"`Ts` of {what} is {' '.join(map(str, Ts.ravel()[:3]))}, and must be one step "
                "in s, or 0 of a model in continuous time."
            )
        return cls.discrete(*matrices, Ts.item(), C, names)

    @property
    def state_names(self) -> tuple[str, ...]:
        """The given names."""
        return self.names

    @property
    def input_names(self) -> tuple[str, ...]:
        """u1, u2, ..."""
        return tuple(f"u{k + 1}" for k in range(self.B.shape[1]))

    @property
    def output_names(self) -> tuple[str, ...]:
        """y1, y2, ..."""
        return tuple(f"y{k + 1}" for k in range(len(self.C)))

    def drift(self, x: State) -> State:
        """Return A x."""
        return jnp.asarray(self.A, x.dtype) @ x

    def input_map(self, x: State) -> InputMap:
        """Return B."""
        return jnp.asarray(self.B, x.dtype)

    def output(self, x: State) -> Output:
        """Return C x."""
        return jnp.asarray(self.C, x.dtype) @ x


def _continuous(A: Array, B: Array, step: float) -> tuple[Array, Array]:
    """Return the continuous-time (A, B) of which these are samples, inputs held a step (s)."""
    from scipy.linalg import expm, logm

    eigenvalues = np.linalg.eigvals(A)
    for value in eigenvalues[(np.real(eigenvalues) <= 0.0) & (np.imag(eigenvalues) == 0.0)][:1]:
        raise ModelError(
            f"the discrete-time model has no equivalent in continuous time, since A has the "
            f"eigenvalue {np.real(value):.3g}, and must have none that is zero or negative."
        )
    n, m = B.shape
    rate = np.real(np.asarray(logm(A))) / step
    # B is the integral of exp(A s) over the step, times the continuous one.
    flow = expm(step * np.block([[rate, np.eye(n)], [np.zeros((n, 2 * n))]]))
    entry = np.linalg.solve(flow[:n, n:], B)
    both = np.block([[rate, entry], [np.zeros((m, n + m))]])
    error = np.abs(expm(step * both)[:n] - np.hstack([A, B])).max()
    if not error <= _EXACT * max(1.0, np.abs(A).max(), np.abs(B).max()):
        raise ModelError(
            "the discrete-time model has no equivalent in continuous time: the logarithm of A is "
            f"only known to {error:.2g}."
        )
    return rate, entry


def _matrix(name: str, value: Sequence[Sequence[float]] | Array) -> Array:
    try:
        # Not `array`, which drops imaginary parts.
        matrix = np.asarray(value).astype(np.float64, casting="same_kind")
    except (TypeError, ValueError):
        got = " ".join(str(value).split())[:60]
        raise ModelError(
            f"`{name}` of `Linear` is {got}, and must be a list of rows of real numbers."
        ) from None
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise ModelError(
            f"`{name}` of `Linear` must be a matrix of finite numbers, and "
            + ("has NaN or infinite ones." if matrix.ndim == 2 else f"has shape {matrix.shape}.")
        )
    return matrix
