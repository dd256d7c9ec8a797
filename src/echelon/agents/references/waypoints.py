"""A smooth path through timed points."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from echelon.agents.references.path_file import read_columns
from echelon.agents.references.polynomial_path import PolynomialPath
from echelon.agents.references.reference import COORDINATES, numbers_of
from echelon.core.errors import ReferenceError
from echelon.core.types import Array, PathLike


class Waypoints(PolynomialPath):
    """The spline of degree 7 through `points` at `times`, at rest at both ends.

    Before the first and after the last time the path is constant. Its derivatives are continuous up
    to the sixth, so that a quadrotor can fly it (flatness needs four). The path starts and stops
    with zero velocity, acceleration and jerk.

    Args:
        times: K >= 2 increasing times, s.
        points: K points (x, y, z), m.
        yaw: of all points, or of each; rad. A turn is as large as the numbers say: from 3 to -3 the
            path turns by 6 rad.
        degrees: whether the yaw is in degrees.

    Raises:
        ReferenceError: the times do not increase, or points or yaw do not match them.
    """

    knots: Array
    coefficients: Array
    degrees: bool = eqx.field(static=True)

    # Six inside; at rest at both ends up to the third.
    joined = 3

    def __init__(
        self,
        times: Sequence[float] | Array,
        points: Sequence[Sequence[float]] | Array,
        yaw: float | Sequence[float] | Array = 0.0,
        degrees: bool = False,
    ) -> None:
        """Fit the spline."""
        t, p = _checked(times, points)
        self.degrees = degrees
        self.knots, self.coefficients = t, _fit(t, np.column_stack([p, _yaws(yaw, degrees, t)]))

    @classmethod
    def read(cls, file: PathLike, degrees: bool = False) -> "Waypoints":
        """Return the path through the points of a CSV file.

        Args:
            file: its first line names the columns `t`, `x`, `y`, `z` and `yaw`, in any order; s, m
                and rad. Without `yaw` it is 0.
            degrees: whether the yaw is in degrees.

        Raises:
            ReferenceError: the file cannot be read, or a line is wrong; the message names it.
        """
        values, _ = read_columns(file, ("t", *COORDINATES), optional=("yaw",))
        return cls(values[:, 0], values[:, 1:4], values[:, 4], degrees)

    def special_at(self, t: float) -> str:
        """Return that the path starts from rest, or comes to rest, within its outer points."""
        first, last = (float(x) for x in (self.knots[1], self.knots[-2]))
        if not (t < first or t > last):
            return ""
        what, span = ("starts from", first - self.knots[0])
        if t > last:
            what, span = "comes to", self.knots[-1] - last
        return (
            f"the spline rests at both ends, and {what} rest within the {span:.3g} s between its "
            f"{'last' if t > last else 'first'} two points"
        )

    def remarks(self) -> tuple[str, ...]:
        """Return what is probably wrong with the yaw: degrees that count as radians."""
        most = float(np.abs(self.coefficients[-1, :, 3]).max())
        if self.degrees or most <= 2.0 * math.pi:
            return ()
        return (
            f"the yaw of `Waypoints` reaches {most:.3g} rad, more than a turn; if it is in "
            "degrees, add `degrees: true`.",
        )


def _checked(
    times: Sequence[float] | Array, points: Sequence[Sequence[float]] | Array
) -> tuple[Array, Array]:
    """Return times (K,) and points (K, 3), after checking both."""
    t, p = numbers_of(times), numbers_of(points)
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        listed = times.tolist() if isinstance(times, np.ndarray) else times
        raise ReferenceError(
            f"`times` of `Waypoints` is {listed}, and must be at least 2 increasing times."
        )
    if p.shape != (len(t), 3) or not np.isfinite(p).all():
        # Rows of different lengths, or text, have no shape.
        got = f"is {points}" if p.shape == (1,) else f"has shape {p.shape}"
        raise ReferenceError(
            f"`points` of `Waypoints` {got}, and must be {len(t)} finite points (x, y, z)."
        )
    return t, p


def _yaws(yaw: float | Sequence[float] | Array, degrees: bool, times: Array) -> Float[Array, " K"]:
    """Return the yaw (rad) at each time."""
    values = numbers_of(yaw)
    if values.shape not in ((), times.shape) or not np.isfinite(values).all():
        raise ReferenceError(
            f"`yaw` of `Waypoints` is {yaw}, and must be a finite number, or {len(times)} of them, "
            "one for each time."
        )
    return np.broadcast_to(np.radians(values) if degrees else values, times.shape)


def _fit(times: Float[Array, " K"], points: Float[Array, "K 4"]) -> Float[Array, "8 K-1 4"]:
    """Return the coefficients of the pieces, highest power first."""
    # Imported here: splines load slowly, and only this reference needs them.
    from scipy.interpolate import make_interp_spline

    # A spline of degree 7 through K points has K + 6 coefficients: three conditions more at each
    # end.
    rest = [(order, np.zeros(4)) for order in (1, 2, 3)]
    spline = make_interp_spline(times, points, k=7, bc_type=(rest, rest))
    # Taylor's coefficients at each knot, which JAX evaluates without SciPy.
    powers = [spline.derivative(k)(times[:-1]) / math.factorial(k) for k in range(7, 0, -1)]
    coefficients = np.stack([*powers, points[:-1]])
    # Rounding would let a constant coordinate move.
    coefficients[:-1, :, (points == points[0]).all(axis=0)] = 0.0
    return coefficients
