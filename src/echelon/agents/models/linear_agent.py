"""A linear agent given by its matrices."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.matlab_file import read_matrices
from echelon.agents.models.model import ControlAffine, check_positive
from echelon.core.errors import ModelError
from echelon.core.types import Array, InputMap, Output, PathLike, State

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
        """Check and keep the matrices as float64."""
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
    def read(cls, file: PathLike, names: Sequence[str] = ()) -> "Linear":
        """Return the model in a MATLAB file: A and B, and where given C, D and the step Ts.

        With a positive Ts (s) it is a discrete-time model, see `discrete`.

        Raises:
            ModelError: the file cannot be read, lacks A or B, D is not zero, or Ts is no step.
        """
        found = read_matrices(file)
        if found.get("D", np.zeros(1)).any():
            raise ModelError(
                f"`D` of `{file}` is not zero, and the output of an agent depends on its state "
                "only; leave `D` out, or add the input's filter to the states."
            )
        matrices, C, Ts = (found["A"], found["B"]), found.get("C"), found.get("Ts", np.zeros(1))
        if not Ts.any():
            return cls(*matrices, C, names)
        # MATLAB has -1 for a discrete-time model whose step is not specified.
        if Ts.size != 1 or not Ts.item() > 0.0:
            raise ModelError(
                f"`Ts` of `{file}` is {' '.join(map(str, Ts.ravel()[:3]))}, and must be one step "
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
    """Return the continuous-time (A, B) that (A, B) sample with inputs held over a step (s).

    Raises:
        ModelError: there is none.
    """
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
