"""A linear agent given by its matrices."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import ModelError
from echelon.core.types import Array, InputMap, Output, State


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
        n = len(self.A)
        self.C = np.eye(n) if C is None else _matrix("C", C)
        self.names = tuple(names) or tuple(f"x{k + 1}" for k in range(n))
        if (
            self.A.shape != (n, n)
            or len(self.B) != n
            or self.C.shape[1] != n
            or len(self.names) != n
        ):
            raise ModelError(
                f"the shapes of `Linear` are A {self.A.shape}, B {self.B.shape}, C {self.C.shape} "
                f"with {len(self.names)} names, "
                "and must be A (n, n), B (n, m), C (q, n) with n names."
            )

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


def _matrix(name: str, value: Sequence[Sequence[float]] | Array) -> Array:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(
            f"`{name}` of `Linear` is {value}, and must be a list of rows of numbers."
        ) from None
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise ModelError(
            f"`{name}` of `Linear` must be a matrix of finite numbers, "
            f"and has shape {matrix.shape}."
        )
    return matrix
