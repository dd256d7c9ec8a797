"""Paths of polynomial pieces: through timed points, and as Crazyswarm2 and firmware fly them."""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.heading_symmetry import heading_of, rest_heading
from echelon.agents.models.model import ControlAffine
from echelon.agents.references.path_file import noted, read_points, yaw_notes
from echelon.agents.references.reference import COORDINATES, Reference, numbers_of
from echelon.agents.references.spline import ENDS, near, resampled, through
from echelon.core.compiled import cached_jit
from echelon.core.errors import ReferenceError, check_kind, check_name, is_number
from echelon.core.numerics import precision
from echelon.core.text_table import Column, read_table
from echelon.core.types import Array, PathLike, Scalar


class PolynomialPath(Reference):
    """Polynomials of degree 7 between times, constant before and after; abstract.

    Attributes:
        knots: (K,) increasing times, s.
        coefficients: (8, K - 1, 4) of (x, y, z, yaw) over the time since the knot, highest power
            first; metres and radians.
    """

    knots: eqx.AbstractVar[Float[Array, " K"]]
    coefficients: eqx.AbstractVar[Float[Array, "8 K-1 4"]]

    def __call__(self, t: Scalar) -> jax.Array:
        """Return the point at time t."""
        knots = jnp.asarray(self.knots, t.dtype)
        # Not by `clip`, whose derivative at its ends is one half.
        inside = jnp.where(t < knots[0], knots[0], jnp.where(t > knots[-1], knots[-1], t))
        # At the last knot there is no piece to the right, so the one to its left is used.
        piece = jnp.clip(jnp.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
        return _horner(jnp.asarray(self.coefficients, t.dtype)[:, piece], inside - knots[piece])

    def parts(self, horizon: float) -> Sequence[tuple[float, Callable[[Scalar], jax.Array]]]:
        """Return the polynomials between the knots, and constants before and after."""
        knots, powers = self.knots.tolist(), np.moveaxis(self.coefficients, 1, 0)
        last = _horner(self.coefficients[:, -1], knots[-1] - knots[-2])

        def polynomial(k: int) -> Callable[[Scalar], jax.Array]:
            return lambda t: _horner(jnp.asarray(powers[k], t.dtype), t - knots[k])

        def rest(place: Array) -> Callable[[Scalar], jax.Array]:
            return lambda t: jnp.asarray(place, t.dtype)

        every = [(knots[0], rest(powers[0, -1]))]
        every += [(knots[k + 1], polynomial(k)) for k in range(len(powers))]
        every += [(math.inf, rest(last))]
        count = sum(end < horizon for end, _ in every) + 1
        begun = [(min(end, horizon), path) for end, path in every[:count]]
        return [(end, path) for end, path in begun if end > 0.0]

    def span(self) -> tuple[float, float]:
        """Return the first and the last time, s."""
        return float(self.knots[0]), float(self.knots[-1])

    def turns(self, model: ControlAffine) -> bool:
        """Tell whether the yaw is constant and the trim's; a polynomial path has no enclosure."""
        yaw = self.coefficients[..., 3]
        moves = bool(yaw[:-1].any() or (yaw[-1] != rest_heading(model)).any())
        return heading_of(model).state != "yaw" or moves


def _horner(coefficients: Array | jax.Array, s: Scalar | float) -> Any:
    """Return the value (4,) of polynomials with coefficients (8, 4), highest power first."""
    value, *others = coefficients
    # In the time since the knot: powers of t would lose digits late in a run.
    for coefficient in others:
        value = value * s + coefficient
    return value


class Waypoints(PolynomialPath):
    """The spline of degree 7 through `points` at `times`, at rest or free at both ends.

    Before the first and after the last time the path is constant. Inside, its derivatives are
    continuous up to the sixth, so that a quadrotor can fly it (flatness needs four).

    Args:
        times: K >= 2 increasing times, s.
        points: K points (x, y, z), m.
        yaw: of all points, or of each; rad. A turn is as large as the numbers say: from 3 to -3 the
            path turns by 6 rad.
        degrees: whether the yaw is in degrees.
        ends: `rest` with zero velocity, acceleration and jerk at both ends; `free` for a path that
            moves there, as a recorded one (four points or more). Default `rest`, and `free` with
            `smooth`.
        smooth: largest distance (m, and rad of the yaw) of a smoother curve from the points; by
            default the curve passes through them.
        resample: step of points (s) that replace the given ones, on straight lines between them.

    Raises:
        ReferenceError: the times do not increase, points or yaw do not match them, or no smooth
            curve is within the distance.
    """

    knots: Array
    coefficients: Array
    ends: str = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        times: Sequence[float] | Array,
        points: Sequence[Sequence[float]] | Array,
        yaw: float | Sequence[float] | Array = 0.0,
        degrees: bool = False,
        ends: str | None = None,
        smooth: float | None = None,
        resample: float | None = None,
    ) -> None:
        t, p = _checked_points(times, points)
        ends = ("rest" if smooth is None else "free") if ends is None else ends
        check_name("`ends` of `Waypoints` is", ends, ENDS, ReferenceError)
        _check_positive(smooth=smooth, resample=resample)
        rows = np.column_stack([p, _yaws(yaw, degrees, t)])
        self.ends = ends
        self.notes = yaw_notes("`Waypoints`", rows[:, 3], degrees)
        t, rows = (t, rows) if resample is None else resampled(t, rows, resample)
        fit = through(t, rows, ends) if smooth is None else near(t, rows, ends, smooth)
        self.knots, self.coefficients = fit

    @property
    def joined(self) -> int:  # pyright: ignore
        """Three derivatives are continuous where it comes to rest; none where it stops moving."""
        return 3 if self.ends == "rest" else 0

    @classmethod
    def read(
        cls,
        file: PathLike,
        degrees: bool = False,
        columns: Sequence[str] = (),
        begin: float | None = None,
        ends: str | None = None,
        smooth: float | None = None,
        resample: float | None = None,
        model: ControlAffine | None = None,
    ) -> "Waypoints":
        """Return the path through the points of a table, or of a GPX file.

        Args:
            file: its columns are `t`, `x`, `y` and where given `z` and `yaw`, or `lat`, `lon` and
                `alt`, which become metres east, north and up of the first point. They have the unit
                in their header, else s, m and rad; others are not read.
            degrees: whether a yaw without a unit is in degrees.
            columns: names of the columns, instead of the file's.
            begin: time of the first point, s; by default the file's, and 0 for Unix time stamps.
            ends: as of the class, likewise the next two.
            smooth: m.
            resample: s.
            model: that a missing `z` is remarked for.

        Raises:
            ReferenceError: the file cannot be read, or a line is wrong; the message names it.
        """
        spatial = model is not None and "z" in model.flat_outputs
        times, values, notes = read_points(file, degrees, columns, begin, spatial)
        return noted(cls(times, values[:, :3], values[:, 3], False, ends, smooth, resample), notes)

    def variants(self) -> Iterator[tuple[str, str, "Waypoints"]]:
        """Yield what forces motion, and the same points without it: free ends, a smooth curve."""
        last = _horner(self.coefficients[:, -1], self.knots[-1] - self.knots[-2])
        points = np.concatenate([self.coefficients[-1], last[None]])
        rest = ("rests at both ends", "ends: free", None)
        each = [("passes through each point", f"smooth: {size:g}", size) for size in _TRIED]
        for why, key, smooth in ([rest] if self.ends == "rest" else []) + each:
            with contextlib.suppress(ReferenceError):
                path = Waypoints(self.knots, points[:, :3], points[:, 3], False, "free", smooth)
                yield why, key, path

    def remarks(self) -> tuple[str, ...]:
        """Return what is probably wrong: notes on its file, or degrees that count as radians."""
        return self.notes


_TRIED = (0.01, 0.05)
"""Tolerances (m) of the smoother curves that are tried."""


def _checked_points(
    times: Sequence[float] | Array, points: Sequence[Sequence[float]] | Array
) -> tuple[Array, Array]:
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


def _check_positive(**options: float | None) -> None:
    for name, number in options.items():
        if number is not None and not (is_number(number) and 0.0 < number < math.inf):
            raise ReferenceError(
                f"`{name}` of `Waypoints` is {number}, and must be a positive number."
            )


def _yaws(yaw: float | Sequence[float] | Array, degrees: bool, times: Array) -> Float[Array, " K"]:
    values = numbers_of(yaw)
    if values.shape not in ((), times.shape) or not np.isfinite(values).all():
        raise ReferenceError(
            f"`yaw` of `Waypoints` is {yaw}, and must be a finite number, or {len(times)} of them, "
            "one for each time."
        )
    return np.broadcast_to(np.radians(values) if degrees else values, times.shape)


_COLUMNS = ("duration", *(f"{name}^{k}" for name in COORDINATES for k in range(8)))
_ORDERS = 4
"""The value and three derivatives at both ends determine a polynomial of degree 7."""
_SAME = 1e-3
"""Largest jump, in m or rad and their derivatives, that counts as rounding of a file's digits."""
_CLOSE, _MANY = 1e-4, 4096
"""Largest distance of written pieces from their path, m or rad, and their largest number."""
_LONG = 4.0
"""Duration of the first pieces that are tried, s; then there are more."""
_BLOCK = 512
_BETWEEN = np.linspace(0.0, 1.0, 9)[1:-1]


class Polynomials(PolynomialPath):
    """Polynomial pieces of degree 7, one after the other from time 0; then the path is constant.

    Files have few digits, with which pieces do not quite meet: where value or one of the first
    three derivatives jump by at most 1e-3 (m or rad, s), both sides get their mean, and at the end
    derivatives below it become 0.

    Args:
        durations: (P,) of the pieces, s.
        coefficients: (P, 4, 8) of x, y, z, yaw over the time since the beginning of the piece, the
            constant first; m and rad.

    Raises:
        ReferenceError: a number is not finite, a duration not positive, or the place or the yaw
            jumps between two pieces.
    """

    knots: Array
    coefficients: Array
    # How many derivatives are continuous is a property of the pieces.
    joined: int = eqx.field(static=True, default=0)  # pyright: ignore

    def __init__(
        self,
        durations: Sequence[float] | Array,
        coefficients: Sequence[Sequence[Sequence[float]]] | Array,
    ) -> None:
        spans, powers = _checked(durations, coefficients)
        for piece, fault in _faults(spans, powers):
            raise ReferenceError(f"piece {piece} of `Polynomials` {fault}.")
        ends, self.joined = _joined(_ends(spans, powers))
        self.knots = np.concatenate([[0.0], np.cumsum(spans)])
        self.coefficients = np.moveaxis(_between(spans, ends), 2, 0)[::-1]

    @classmethod
    def read(cls, file: PathLike, columns: Sequence[str] = ()) -> "Polynomials":
        """Return the path in a CSV file of Crazyswarm2.

        Args:
            file: its columns are `duration`, `x^0` to `x^7`, and likewise for `y`, `z` and `yaw`.
            columns: names of the columns, instead of the file's.

        Raises:
            ReferenceError: the file cannot be read, or a line is wrong; the message names it.
        """
        table = read_table(file, "path", ReferenceError).named(columns)
        values, lines, *_ = table.columns([Column(name) for name in _COLUMNS])
        spans, powers = values[:, 0], values[:, 1:].reshape(len(values), len(COORDINATES), 8)
        for piece, fault in _faults(spans, powers):
            raise ReferenceError(f"the piece of the path at `{file}:{lines[piece]}` {fault}.")
        return cls(spans, powers)

    @classmethod
    def of(cls, path: Reference, horizon: float) -> "Polynomials":
        """Return pieces that follow a path to 0.1 mm and 1e-4 rad.

        Paths of polynomials, such as `Waypoints`, are returned whole and exactly; of any other the
        pieces have equal durations, and the same value and three derivatives where they meet.

        Args:
            path: the path.
            horizon: its length, s.

        Raises:
            ReferenceError: the path is too long or not smooth enough for 4096 pieces.
        """
        check_kind("path", path, Reference, ReferenceError)
        if isinstance(path, PolynomialPath):
            return _of_polynomials(path)
        count = math.ceil(horizon / _LONG)
        while count <= _MANY:
            times = np.linspace(0.0, horizon, count + 1)
            rows = _sampled(path, times)
            spans = np.diff(times)
            powers = _between(spans, np.stack([rows[:-1], rows[1:]], axis=1))
            if _distance(path, times[:-1], spans, powers) <= _CLOSE:
                return cls(spans, powers)
            count += 1 + count // 4
        raise ReferenceError(
            f"{_MANY} pieces do not follow `{type(path).__name__}` to {_CLOSE:g} m for "
            f"{horizon:g} s; make it shorter or smoother."
        )

    def moved(self, offset: Sequence[float]) -> "Polynomials":
        """Return the same path an offset (x, y, z, yaw) away, m and rad."""
        return eqx.tree_at(
            lambda path: path.coefficients,
            self,
            self.coefficients + np.eye(8)[-1][:, None, None] * np.asarray(offset),
        )

    def text(self) -> str:
        """Return the CSV file that Crazyswarm2 reads; every number as read back exactly."""
        powers = np.moveaxis(self.coefficients[::-1], 0, 2)
        rows = np.column_stack([np.diff(self.knots), powers.reshape(len(powers), -1)])
        lines = [",".join(map(repr, row)) for row in rows.tolist()]
        return "\n".join([",".join(_COLUMNS), *lines, ""])


def _checked(durations: object, coefficients: object) -> tuple[Array, Array]:
    spans, powers = numbers_of(durations), numbers_of(coefficients)
    count = len(spans) if spans.ndim == 1 else 0
    if not count or powers.shape != (count, len(COORDINATES), 8) or not np.isfinite(powers).all():
        raise ReferenceError(
            f"`coefficients` of `Polynomials` has shape {powers.shape}, and must be finite numbers "
            f"of shape ({count or 'P'}, 4, 8) for {count or 'P'} durations."
        )
    return spans, powers


def _faults(spans: Array, powers: Array) -> Iterator[tuple[int, str]]:
    """Yield the pieces that last no time or begin away from the end of the one before."""
    for k in np.flatnonzero(~((spans > 0.0) & np.isfinite(spans))):
        yield int(k), f"lasts {spans[k]:g} s, and must last a positive time"
    ends = _ends(spans, powers)
    jumps = np.abs(ends[:-1, 1, 0] - ends[1:, 0, 0])
    for k in np.flatnonzero((jumps > _SAME).any(axis=1)):
        where = f"{np.linalg.norm(jumps[k, :3]):.3g} m and {jumps[k, 3]:.3g} rad"
        yield int(k) + 1, f"begins {where} from the end of the one before, and must begin there"


def _falling(s: float) -> Float[Array, "4 8"]:
    """Return the derivatives of order 0 to 3 of the powers 0 to 7 at s."""
    powers = np.arange(8)
    factors = [[math.perm(p, order) for p in powers] for order in range(_ORDERS)]
    exponents = np.maximum(powers - np.arange(_ORDERS)[:, None], 0)
    return np.array(factors) * float(s) ** exponents


def _ends(spans: Float[Array, " P"], powers: Float[Array, "P 4 8"]) -> Float[Array, "P 2 4 4"]:
    """Return the derivatives [order, coordinate] of pieces at their beginning and end."""
    at = np.array([[_falling(0.0), _falling(span)] for span in spans])
    return np.einsum("peok,pck->peoc", at, powers)


def _joined(ends: Float[Array, "P 2 4 4"]) -> tuple[Float[Array, "P 2 4 4"], int]:
    """Return the derivatives of pieces that meet, and how many of them are continuous."""
    left, right = ends[:, 1], np.roll(ends[:, 0], -1, axis=0)
    right[-1] = 0.0
    right[-1, 0] = left[-1, 0]
    near = np.abs(left - right) <= _SAME
    middle = 0.5 * (left + right)
    middle[-1] = right[-1]
    ends = ends.copy()
    ends[:, 1] = np.where(near, middle, left)
    ends[1:, 0] = np.where(near, middle, right)[:-1]
    return ends, int(near.all(axis=(0, 2)).cumprod().sum()) - 1


def _between(spans: Float[Array, " P"], ends: Float[Array, "P 2 4 4"]) -> Float[Array, "P 4 8"]:
    """Return the pieces with these derivatives [order, coordinate] at beginning and end."""
    # Over a duration of 1, since powers of others would cost digits.
    scale = spans[:, None] ** np.arange(8)
    conditions = np.concatenate([_falling(0.0), _falling(1.0)])
    rows = (ends * scale[:, None, :_ORDERS, None]).reshape(len(spans), 2 * _ORDERS, -1)
    return np.swapaxes(np.linalg.solve(conditions, rows), 1, 2) / scale[:, None]


def _of_polynomials(path: PolynomialPath) -> Polynomials:
    knots, powers = path.knots, np.moveaxis(path.coefficients[::-1], 0, 2)
    ahead = knots[1:] > 0.0
    begin = np.maximum(knots[:-1], 0.0) - knots[:-1]
    low, high = (
        np.stack([_falling(s) for s in at]) for at in (begin[ahead], np.diff(knots)[ahead])
    )
    ends = np.stack([np.einsum("pok,pck->poc", at, powers[ahead]) for at in (low, high)], axis=1)
    spans = (np.diff(knots) - begin)[ahead]
    pieces = _between(spans, ends)
    if knots[0] > 0.0:
        waiting = np.zeros((1, *pieces.shape[1:]))
        waiting[..., 0] = pieces[0, :, 0]
        pieces, spans = np.concatenate([waiting, pieces]), np.concatenate([knots[:1], spans])
    return Polynomials(spans, pieces)


def _sampled(path: Reference, times: Float[Array, " T"]) -> Float[Array, "T 4 4"]:
    """Return value and three derivatives [order, coordinate] of a path."""
    # In blocks of one size, since each other one would be compiled anew.
    padded = np.pad(times, (0, -len(times) % _BLOCK), mode="edge").reshape(-1, _BLOCK)
    with precision("float64"):
        rows = [np.asarray(_derivatives(path, block)) for block in padded]
    return np.concatenate(rows)[: len(times)]


@cached_jit
def _derivatives(path: Reference, times: jax.Array) -> jax.Array:
    return jax.vmap(lambda t: path.derivatives(t, _ORDERS - 1, COORDINATES))(times)


def _distance(path: Reference, begins: Array, spans: Array, powers: Float[Array, "P 4 8"]) -> float:
    """Return the largest distance of pieces from their path, at points between their ends."""
    times = begins[:, None] + spans[:, None] * _BETWEEN
    exact = _sampled(path, times.ravel())[:, 0]
    since = (spans[:, None] * _BETWEEN)[..., None] ** np.arange(8)
    pieces = np.einsum("psk,pck->psc", since, powers)
    return float(np.abs(pieces.reshape(exact.shape) - exact).max())
