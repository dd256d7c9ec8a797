"""Collision avoidance with a proof: a filter of the rate of an agent's stopping point.

With roots rho_k of the inner loop, the points c_0 = p, c_k = c_(k-1) + c_(k-1)' / rho_k end in the
stopping point, and each of them moves straight towards the next one. So the hull of two agents'
differences changes by its last point alone, which the filter holds back (theory page, T10).
"""

import dataclasses
import math
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.model import ControlAffine, in_metres
from echelon.agents.network.near import Near
from echelon.core.errors import LawError, is_number, listing
from echelon.core.types import Array
from echelon.laws.nearest_point import nearest_point

AXES = ("x", "y", "z")
_SIZES = np.repeat([0.5, 5.0, 50.0], 16)
"""Of samples about the trim, at which outputs are compared with the position."""
_DOWNWASH = 3.0
"""Height over width of the ellipsoid about a model with a radius: rotors blow downward."""
_MOST_CORRECTIONS, _SOLVED = 60, 1e-9
"""Corrections of a rate by single rows, and the size (m/s) of one that ends them."""


@final
@dataclasses.dataclass(frozen=True)
class Safety:
    """Keeps upright ellipsoids about agents apart, under the law `stopping-point`.

    Distances are scaled: heights are divided by the ellipsoid's height over its width, so that two
    ellipsoids touch where the scaled distance is twice the horizontal radius.

    Args:
        radii: of the ellipsoid along x, y and z, m, the first two equal; by default the model's
            radius, and three times as much upward.
        gain: rate at which agents may use up their distance, 1/s; at most 1 over the step.
        swirl: how fast an agent that is held back turns aside, m/s; agents that meet head-on then
            pass each other on the right.
        margin: added to the distance that the filter keeps, m.
        reach: scaled distance up to which others are regarded, m.
        of_model: the radii where none are given; set by `prepared`.

    Raises:
        LawError: a number is out of its range.
    """

    radii: tuple[float, ...] | None = None
    gain: float = 4.0
    swirl: float = 0.5
    margin: float = 0.05
    reach: float = 3.0
    of_model: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        """Check every number."""
        if self.radii is not None:
            radii = tuple(np.atleast_1d(np.asarray(self.radii, object)).tolist())
            object.__setattr__(self, "radii", radii)
            if len(radii) != 3 or not all(map(_positive, radii)) or radii[0] != radii[1]:
                raise LawError(
                    f"`radii` of `safety` are {list(radii)}, and must be three positive numbers, "
                    "m, the first two equal."
                )
        for name, least in (("gain", 1e-9), ("reach", 1e-9), ("swirl", 0.0), ("margin", 0.0)):
            value = getattr(self, name)
            if not (value == 0.0 and least == 0.0 or _positive(value)):
                allowed = "positive" if least else "not negative"
                raise LawError(f"`{name}` of `safety` is {value}, and must be {allowed}.")

    @property
    def size(self) -> tuple[float, ...]:
        """The radii of the ellipsoid along x, y and z, m, as given or of the model."""
        size = self.radii or self.of_model
        assert size is not None, "`prepared` finds the radii"
        return size

    @property
    def touching(self) -> float:
        """The scaled distance at which two ellipsoids touch, m."""
        return 2.0 * self.size[0]

    @property
    def distance(self) -> float:
        """The scaled distance that hulls keep, m."""
        return self.touching + self.margin

    def prepared(self, model: ControlAffine) -> "Safety":
        """Return it with radii, checked for a model.

        Raises:
            LawError: the model has no position in x, y and z, or no radius, or its outputs with the
                names of the position are other values, as seen at samples, or are not in m.
        """
        name, odd = type(model).__name__, [x for x in model.position if x not in AXES]
        if not model.position or odd:
            what = f"the position {listing(model.position)}" if odd else "no `position`"
            raise LawError(f"`safety` needs a position in x, y or z, and `{name}` has {what}.")
        _check_position(model)
        if not in_metres(model):
            raise LawError(f"`safety` needs the position in m, and `{name}` has another unit.")
        if self.radii is not None:
            return self
        radius = model.radius
        if radius is None:
            raise LawError(f"`safety` needs `radii`, since `{name}` has no `radius`.")
        if not _positive(radius):
            raise LawError(f"`radius` of `{name}` is {radius}, and must be positive, m.")
        return dataclasses.replace(self, of_model=(radius, radius, _DOWNWASH * radius))

    def scales(self, model: ControlAffine) -> Array:
        """Return the factors (d,) of the position's coordinates in scaled distances."""
        return np.array([self.size[0] / self.size[AXES.index(x)] for x in model.position])

    def needed_reach(self, speeds: Float[Array, " d"], scales: Float[Array, " d"]) -> float:
        """Return the distance beyond which no row can act, for agents of some speeds, m/s."""
        return self.distance + 2.0 * math.hypot(*(scales * speeds).tolist()) / self.gain

    def filtered(
        self,
        rate: Float[jax.Array, " d"],
        near: Near,
        scales: Float[jax.Array, " d"],
        speeds: Float[jax.Array, " d"],
    ) -> tuple[Float[jax.Array, " d"], jax.Array]:
        """Return the rate nearest to a desired one that lets no hull come too near.

        Args:
            rate: of the stopping point relative to the leader's, m/s.
            near: the others.
            scales: as by `scales`.
            speeds: that the rate's entries may have.

        Returns:
            The rate (d,), and how many rows act on it.
        """
        corners = jnp.where(near.known[:, None, None], near.gaps, 0.0) * scales[None, None]
        nearest = nearest_point(corners)
        far = jnp.sqrt((nearest * nearest).sum(axis=1))
        normals = nearest / jnp.maximum(far, jnp.finfo(far.dtype).tiny)[:, None]
        # Of hulls that are too near already, the nearest points are driven apart.
        room = jnp.where(far >= self.distance, (normals * corners[:, -1]).sum(axis=1), far)
        low = -self.gain * jnp.where(near.leads, 1.0, 0.5) * (room - self.distance)
        used = near.known & (far <= self.reach)
        short = jnp.where(used, low - normals @ (rate * scales), 0.0)
        u = rate * scales + self._aside(normals, short)
        u = _shrunk(_projected(u, normals, low, used), normals, low, used) / scales
        # Less of it still meets all rows that 0 meets.
        u = u * (speeds / jnp.maximum(jnp.abs(u), speeds)).min()
        active = (short > 0.0).sum()
        return jnp.where(active > 0, u, rate), active.astype(rate.dtype)

    def _aside(
        self, normals: Float[jax.Array, "K d"], short: Float[jax.Array, " K"]
    ) -> Float[jax.Array, " d"] | float:
        """Return the velocity to the right of the agent that is most in the way."""
        if normals.shape[1] < 2:
            return 0.0
        worst = jnp.argmax(short)
        x, y, *rest = normals[worst]
        size = jnp.sqrt(x * x + y * y)
        right = jnp.stack([-y, x, *(0.0 * height for height in rest)])
        amount = self.swirl * jnp.clip(short[worst], 0.0, 1.0)
        return amount * right / jnp.where(size > 0.0, size, 1.0)


class _Ascent(NamedTuple):
    """Corrections so far, the vector, the pull of each row, and the size of the last one."""

    steps: jax.Array
    u: Float[jax.Array, " d"]
    pull: Float[jax.Array, " K"]
    last: jax.Array


def _projected(
    u: Float[jax.Array, " d"],
    normals: Float[jax.Array, "K d"],
    low: Float[jax.Array, " K"],
    used: Bool[jax.Array, " K"],
) -> Float[jax.Array, " d"]:
    """Return the vector with normals u >= low that is nearest, to rounding or nearly.

    Hildreth's dual ascent: the row that is off most is corrected, again and again.
    """

    def corrected(now: _Ascent) -> _Ascent:
        change = jnp.where(used, jnp.maximum(-now.pull, low - normals @ now.u), 0.0)
        worst = jnp.argmax(jnp.abs(change))
        by = change[worst]
        pull = now.pull.at[worst].add(by)
        return _Ascent(now.steps + 1, now.u + by * normals[worst], pull, jnp.abs(by))

    def off(now: _Ascent) -> jax.Array:
        return (now.steps < _MOST_CORRECTIONS) & (now.last > _SOLVED)

    start = _Ascent(jnp.zeros((), jnp.int32), u, 0.0 * low, jnp.full((), jnp.inf, u.dtype))
    return jax.lax.while_loop(off, corrected, start).u


def _shrunk(
    u: Float[jax.Array, " d"],
    normals: Float[jax.Array, "K d"],
    low: Float[jax.Array, " K"],
    used: Bool[jax.Array, " K"],
) -> Float[jax.Array, " d"]:
    """Return the largest part of a vector that meets all rows which 0 meets."""
    along = normals @ u
    over = used & (low <= 0.0) & (along < low)
    return u * jnp.where(over, low / jnp.where(over, along, -1.0), 1.0).min(initial=1.0)


def hull_points(
    values: Float[jax.Array, "r d"], roots: tuple[float, ...]
) -> Float[jax.Array, "r d"]:
    """Return c_0 .. c_(r-1) of a position with its derivatives, for roots (r - 1 of them)."""
    rows = np.zeros((len(values),) * 2)
    for k in range(len(values)):
        whole = np.atleast_1d(np.poly(-np.array(roots[:k])))[::-1]
        rows[k, : k + 1] = whole / whole[0]
    return jnp.asarray(rows, values.dtype) @ values


def _check_position(model: ControlAffine) -> None:
    """Check that outputs with the names of the position are the position, near the trim and far."""
    names = [name for name in model.position if name in model.output_names]
    both = model.output_names, model.state_names
    outputs, states = (np.array([each.index(x) for x in names], int) for each in both)
    draw = np.random.default_rng(0)
    away = _SIZES[:, None] * draw.uniform(-1.0, 1.0, (len(_SIZES), len(model.state_names)))
    x = jnp.asarray(np.asarray(model.trim[0], float) + away)
    off = np.abs(np.asarray(jax.vmap(model.output)(x)[:, outputs] - x[:, states]))
    wrong = np.flatnonzero(~(off.max(axis=0) <= _SOLVED))
    if len(wrong):
        raise LawError(
            f"`safety` needs the position of `{type(model).__name__}` among its flat outputs, and "
            f"its output `{names[wrong[0]]}` is not the state of that name."
        )


def _positive(value: object) -> bool:
    return is_number(value) and 0.0 < float(value) < math.inf
