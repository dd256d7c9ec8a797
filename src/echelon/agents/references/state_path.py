"""A reference for any model: its states and inputs over time, as knots."""

from collections.abc import Sequence
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.references.path_file import noted, read_timed
from echelon.agents.references.reference import LeaderPath, numbers_of
from echelon.core.errors import LawError, ReferenceError, listing
from echelon.core.text_table import Column
from echelon.core.types import Array, Input, PathLike, Scalar, State

_Rows = Sequence[Sequence[float]]


@final
class StatePath(LeaderPath):
    """A path through states (K, n) with inputs (K, m) at times (K,), for any model.

    Between knots the input is linear and each state a cubic with slopes f + g u at the knots
    (Hermite, as in direct collocation). The path is therefore as feasible as its knots are;
    `echelon check` reports the distance of xdot from f + g u between them. Before the first and
    after the last time the path is constant.

    Args:
        times: K >= 2 increasing times, s.
        states: K states (n,), in the order of the model's `state_names` and in their units.
        inputs: K inputs (m,), likewise.

    Raises:
        ReferenceError: the times do not increase, or states or inputs do not match them.
    """

    times: Array
    states: Array
    inputs: Array
    notes: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, times: Sequence[float], states: _Rows, inputs: _Rows) -> None:
        self.notes = ()
        self.times = numbers_of(times)
        if self.times.ndim != 1 or len(self.times) < 2 or not (np.diff(self.times) > 0).all():
            raise ReferenceError(
                "`times` of `StatePath` must be at least 2 increasing finite times."
            )
        self.states, self.inputs = (
            _rows(name, rows, len(self.times))
            for name, rows in (("states", states), ("inputs", inputs))
        )

    @classmethod
    def read(
        cls,
        file: PathLike,
        model: ControlAffine,
        columns: Sequence[str] = (),
        begin: float | None = None,
    ) -> "StatePath":
        """Return the path in a table whose columns are `t`, the model's states and its inputs.

        Args:
            file: the table; its columns are in any order, and others are not read.
            model: states and inputs have its names, and its units where the file states none.
            columns: names of the columns, instead of the file's.
            begin: time of the first knot, s; by default the file's.

        Raises:
            ReferenceError: the file cannot be read, or a line is wrong; the message names it.
        """
        names = (*model.state_names, *model.input_names)
        units = (*model.state_units, *model.input_units)
        wanted = [Column(name, unit) for name, unit in zip(names, units, strict=True)]
        times, values, notes = read_timed(file, wanted, columns, begin)
        states, inputs = np.split(values, [len(model.state_names)], axis=1)
        path = cls(times, states, inputs)  # pyright: ignore[reportArgumentType]
        return noted(path, notes)

    def span(self) -> tuple[float, float]:
        """Return the times of the first and the last knot, s."""
        return float(self.times[0]), float(self.times[-1])

    def remarks(self) -> tuple[str, ...]:
        """Return the notes on its file."""
        return self.notes

    def follow(self, model: ControlAffine, t: Scalar) -> tuple[State, Input]:
        """Return the state (n,) and the input (m,) at time t."""
        knots, x, u = (
            jnp.asarray(part, t.dtype) for part in (self.times, self.states, self.inputs)
        )
        inside = jnp.clip(t, knots[0], knots[-1])
        # At the last knot there is no piece to the right, so the one to its left is used.
        k = jnp.clip(jnp.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
        span = knots[k + 1] - knots[k]
        s = (inside - knots[k]) / span
        # The model's difference, so that an angle may jump by a whole turn.
        step = model.difference(x[k + 1], x[k])
        first, last = (span * model.velocity(x[j], u[j]) for j in (k, k + 1))
        state = x[k] + s * (1.0 - s) ** 2 * first + s**2 * (3.0 - 2.0 * s) * step
        return state + s**2 * (s - 1.0) * last, (1.0 - s) * u[k] + s * u[k + 1]

    def check(self) -> None:
        """Do nothing: the constructor checked the knots."""

    def fit(self, model: ControlAffine) -> None:
        """Check that it has the model's states and inputs."""
        sizes = (("states", self.states), ("inputs", self.inputs))
        expected = (model.state_names, model.input_names)
        for (what, rows), names in zip(sizes, expected, strict=True):
            if rows.shape[1] != len(names):
                raise LawError(
                    f"`StatePath` has {rows.shape[1]} {what}, and `{type(model).__name__}` has "
                    f"{len(names)}: {listing(names)}."
                )


def _rows(name: str, rows: _Rows, count: int) -> Array:
    array = numbers_of(rows)
    if array.ndim != 2 or len(array) != count or not np.isfinite(array).all():
        raise ReferenceError(
            f"`{name}` of `StatePath` has shape {array.shape}, and must be {count} rows of finite "
            "numbers, one for each time."
        )
    return array
