"""Formations that change with time: each agent's offset is a function of time.

xi_i(t) = c + M(t, b_i(t)), where c is the first leader's offset, b_i the place of agent i relative
to it, which reshapes move along straight lines, and M the motions of the whole shape one after the
other.
"""

import abc
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import compiled_for_one_call
from echelon.core.errors import FormationError, listing
from echelon.core.numerics import derivatives, precision
from echelon.core.trace import error_summary
from echelon.core.types import Array, Scalar, State

ORDER = 5
"""Derivatives with respect to time that an offset has."""
BLEND = (462.0, -1980.0, 3465.0, -3080.0, 1386.0, -252.0)
"""Of u^6 .. u^11."""
_WATCHED, _SPAN, _POINTS = 60.0, 0.25, 10
"""s, for which a user's motion is looked at; of an interval; where derivatives are integrated."""
_JUMP = 1e-3
"""Of a derivative's size: what integrals leave of its change in an interval."""
_MOST_ASSIGNED, _MOST_PAIRS = 3000, 3000
"""Agents whose places are assigned, and whose paths are compared."""


class OffsetMotion(eqx.Module):
    """A motion of the whole shape: what becomes of a place over time, written with `jax.numpy`."""

    @abc.abstractmethod
    def __call__(self, place: Float[jax.Array, " d"], t: Scalar) -> Float[jax.Array, " d"]:
        """Return where a place (d,), m from the first leader's, is at a time t (s).

        It must have five derivatives with respect to t.
        """


@final
class Rotate(OffsetMotion):
    """The shape turns about the vertical axis through the first leader, at `rate` (rad/s)."""

    rate: float

    def __call__(self, place: Float[jax.Array, " d"], t: Scalar) -> Float[jax.Array, " d"]:
        """Return the place turned by rate t."""
        cos, sin = jnp.cos(self.rate * t), jnp.sin(self.rate * t)
        x, y = place[0], place[1]
        return place.at[:2].set(jnp.stack([cos * x - sin * y, sin * x + cos * y]))


@final
class Scale(OffsetMotion):
    """The shape is 1 + amplitude sin(rate t) times as large, with `rate` in rad/s."""

    amplitude: float
    rate: float

    def __call__(self, place: Float[jax.Array, " d"], t: Scalar) -> Float[jax.Array, " d"]:
        """Return the place times the factor."""
        return (1.0 + self.amplitude * jnp.sin(self.rate * t)) * place


@final
class Reshape(NamedTuple):
    """From `at` (s) on, over `over` (s), agents move to the places of another shape.

    Args:
        to: goal offsets (N, n), of which the position is used.
        at, over: s.
        nearest: whether places are assigned to followers so that the squares of their ways add up
            to as little as possible; the first agent's place else is the first one, and so on.
    """

    to: Array
    at: float
    over: float
    nearest: bool = False


@final
class FormationMotion(eqx.Module):
    """How the offsets of N agents change with time.

    Attributes:
        places: (N, K + 1, d) relative to `center`, at first and after each of K reshapes, m.
        center: the first leader's offset (d,).
        begins, spans: of the reshapes (K,), s.
        motions: of the whole shape, applied one after the other.
        axes: the states that are the position.
        speeds: the state that is the derivative of each; -1 where none is.
    """

    places: Float[Array, "N K d"]
    center: Float[Array, " d"]
    begins: Float[Array, " K"]
    spans: Float[Array, " K"]
    motions: tuple[OffsetMotion, ...]
    axes: tuple[int, ...] = eqx.field(static=True)
    speeds: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        model: ControlAffine,
        leaders: Sequence[int],
        offsets: Float[Array, "N n"],
        changes: Sequence[OffsetMotion | Reshape],
    ) -> "FormationMotion":
        """Return the motion of a formation with offsets at first.

        Raises:
            FormationError: the model has no position, or a change does not fit it or the others.
        """
        axes = list(model.position_indices())
        if not axes:
            raise FormationError(
                f"`{type(model).__name__}` has no position, so its formation cannot move."
            )
        reshapes = sorted((c for c in changes if isinstance(c, Reshape)), key=lambda c: c.at)
        motions = tuple(c for c in changes if not isinstance(c, Reshape))
        _check_reshapes(reshapes, offsets.shape)
        for motion in motions:
            _check_motion(motion, model)
        places = [offsets[:, axes]]
        for change in reshapes:
            after = np.asarray(change.to, float)[:, axes]
            if change.nearest:
                after = after[nearest_places(leaders, places[-1], after)]
            places.append(after)
        center = places[0][leaders[0]]
        begins, spans = (
            np.array([getattr(c, name) for c in reshapes], float) for name in ("at", "over")
        )
        rows = np.stack(places, axis=1) - center
        return cls(rows, center, begins, spans, motions, tuple(axes), _speed_states(model))

    def place(self, row: Float[jax.Array, "K d"], t: Scalar) -> Float[jax.Array, " d"]:
        """Return the offset's position (d,) at a time (s) of an agent with a row of `places`."""
        row = jnp.asarray(row, t.dtype)
        place = row[0]
        if len(self.begins):
            begins, spans = (jnp.asarray(x, t.dtype) for x in (self.begins, self.spans))
            place = place + blend(jnp.clip((t - begins) / spans, 0.0, 1.0)) @ (row[1:] - row[:-1])
        for motion in self.motions:
            place = motion(place, t)
        return jnp.asarray(self.center, t.dtype) + place

    def derivatives(
        self, row: Float[jax.Array, "K d"], t: Scalar, order: int
    ) -> Float[jax.Array, "order d"]:
        """Return `place` and its first derivatives up to an order, (order + 1, d)."""
        return derivatives(lambda s: self.place(row, s), t, order)

    @property
    def shapes(self) -> Iterator[Float[Array, "N d"]]:
        """The places at first and after each reshape, without motions of the whole shape."""
        for k in range(self.places.shape[1]):
            yield self.center + self.places[:, k]

    @property
    def least_scale(self) -> float:
        """The smallest factor that `Scale` motions put to all places."""
        scales = (m.amplitude for m in self.motions if isinstance(m, Scale))
        return math.prod(1.0 - abs(a) for a in scales)

    @property
    def bundled(self) -> bool:
        """Whether all motions are the bundled ones."""
        return all(type(motion) in (Rotate, Scale) for motion in self.motions)

    def moves(self, agents: Sequence[int]) -> bool:
        """Tell whether offsets of some agents change; of a user's motion it is supposed."""
        rows = self.places[list(agents)]
        return not self.bundled or bool(rows.any() if self.motions else np.ptp(rows, 1).any())

    def meetings(self) -> Iterator[tuple[float, int, int, float]]:
        """Yield each reshape's begin (s) and nearest pair on straight ways, for few agents."""
        if not 2 <= len(self.places) <= _MOST_PAIRS:
            return
        i, j = np.triu_indices(len(self.places), 1)
        for k, begin in enumerate(self.begins):
            first, last = (self.places[i, m] - self.places[j, m] for m in (k, k + 1))
            way = last - first
            square = (way * way).sum(axis=1)
            share = -(first * way).sum(axis=1) / np.where(square > 0.0, square, 1.0)
            apart = np.linalg.norm(first + np.clip(share, 0.0, 1.0)[:, None] * way, axis=1)
            least = int(apart.argmin())
            distance = self.least_scale * float(apart[least])
            yield float(begin), int(i[least]), int(j[least]), distance


@final
class OwnOffset(NamedTuple):
    """The offset of one agent: its row of `places` in a motion, and its offset (n,) without it."""

    motion: FormationMotion
    base: State
    row: Float[jax.Array, "K d"]

    def derivatives(self, t: Scalar, order: int) -> Float[jax.Array, "order d"]:
        """Return the position and its derivatives up to an order at a time (s), (order + 1, d)."""
        return self.motion.derivatives(self.row, t, order)

    def state(self, t: Scalar) -> State:
        """Return the offset (n,) at a time (s): its position, and its velocity where states are."""
        place, speed = self.derivatives(t, 1)
        offset = self.base.at[np.array(self.motion.axes)].set(place)
        for k, index in enumerate(self.motion.speeds):
            offset = offset if index < 0 else offset.at[index].add(speed[k])
        return offset


def blend(u: jax.Array) -> jax.Array:
    """Return a polynomial that rises from 0 at 0 to 1 at 1, with five derivatives of 0 at both."""
    share = jnp.zeros_like(u)
    for factor in reversed(BLEND):
        share = share * u + factor
    return u**6 * share


def nearest_places(
    leaders: Sequence[int], before: Float[Array, "N d"], after: Float[Array, "N d"]
) -> Int[Array, " N"]:
    """Return whose place of `after` each agent takes; leaders keep their own.

    The squares of the ways add up to as little as possible.

    Raises:
        FormationError: there are too many agents.
    """
    if len(before) > _MOST_ASSIGNED:
        raise FormationError(
            f"places are assigned to at most {_MOST_ASSIGNED} agents, and got {len(before)}; leave "
            "out `assign: nearest`."
        )
    from scipy.optimize import linear_sum_assignment

    order = np.arange(len(before))
    others = np.setdiff1d(order, list(leaders))
    # In units of the largest place, whose rounding decides between ways that are equally long.
    size = max(np.abs(before).max(), np.abs(after).max(), np.finfo(float).tiny)
    ways = (before / size)[others][:, None] - (after / size)[others][None]
    order[others] = others[linear_sum_assignment((ways * ways).sum(axis=2))[1]]
    return order


def _check_reshapes(reshapes: Sequence[Reshape], shape: tuple[int, ...]) -> None:
    for change in reshapes:
        for name, value, fine in (
            ("at", change.at, change.at >= 0.0),
            ("over", change.over, change.over > 0.0),
        ):
            if not (math.isfinite(value) and fine):
                allowed = "positive" if name == "over" else "not negative"
                raise FormationError(
                    f"`{name}` of a reshape is {value}, and must be a finite time, {allowed}."
                )
        if np.shape(change.to) != shape or not np.isfinite(change.to).all():
            raise FormationError(
                f"a reshape leads to offsets of shape {np.shape(change.to)}, and must lead to "
                f"finite ones of shape {shape}."
            )
    for one, other in zip(reshapes, reshapes[1:], strict=False):
        if other.at < one.at + one.over:
            raise FormationError(
                f"the reshape at {other.at:g} s begins before that at {one.at:g} s ends, at "
                f"{one.at + one.over:g} s."
            )


def _check_motion(motion: object, model: ControlAffine) -> None:
    name, axes = f"`{type(motion).__name__}`", model.position
    if not isinstance(motion, OffsetMotion):
        raise FormationError(
            f"a motion of a formation is {name}, and must be `Rotate`, `Scale`, `Reshape` or an "
            "`OffsetMotion` of your own."
        )
    if isinstance(motion, Rotate | Scale):
        numbers = {k: v for k, v in vars(motion).items() if not math.isfinite(v)}
        if numbers:
            key, value = next(iter(numbers.items()))
            raise FormationError(f"`{key}` of {name} is {value}, and must be a finite number.")
    if isinstance(motion, Rotate) and (len(axes) < 2 or "z" in axes[:2]):
        raise FormationError(
            f"{name} turns the shape about the vertical axis, and the position of "
            f"`{type(model).__name__}` is {listing(axes)}."
        )
    if isinstance(motion, Scale) and not abs(motion.amplitude) < 1.0:
        raise FormationError(
            f"`amplitude` of {name} is {motion.amplitude}, and must be between -1 and 1."
        )
    if not isinstance(motion, Rotate | Scale):
        _check_smooth(motion, len(axes))


def _check_smooth(motion: OffsetMotion, d: int) -> None:
    """Check that a user's motion has five derivatives at a place, by their integrals."""
    what = f"the motion `{type(motion).__name__}`"
    advice = "write it with `jax.numpy`, and give it five derivatives with respect to time"
    ends = np.arange(0.0, _WATCHED + _SPAN / 2, _SPAN)
    nodes, weights = np.polynomial.legendre.leggauss(_POINTS)
    times = (ends[:-1, None] + 0.5 * _SPAN * (nodes + 1.0)).ravel()
    try:
        with precision("float64"):
            at_ends, between = (
                np.asarray(_derivatives_at(motion, jnp.asarray(x), d)) for x in (ends, times)
            )
    except Exception as error:  # the user's code may raise anything
        raise FormationError(
            f"{what} cannot be differentiated ({error_summary(error)}); {advice}."
        ) from error
    if at_ends.shape[1:] != (ORDER + 1, d):
        raise FormationError(f"{what} must return {d} numbers, a place.")
    if not (np.isfinite(at_ends).all() and np.isfinite(between).all()):
        raise FormationError(f"{what} or a derivative of it is not finite; {advice}.")
    between = between.reshape(-1, _POINTS, *at_ends.shape[1:])
    integrals = 0.5 * _SPAN * np.einsum("p,epkd->ekd", weights, between)[:, 1:]
    gap = np.abs(np.diff(at_ends, axis=0)[:, :-1] - integrals)
    size = np.abs(at_ends[:, :-1]).max(axis=(0, 2)) + np.abs(integrals).max(axis=(0, 2))
    jumps = np.flatnonzero((gap > _JUMP * (size[:, None] + 1e-9)).any(axis=(0, 2)))
    if len(jumps):
        order = int(jumps[0])
        where = float(ends[int(gap[:, order].max(axis=1).argmax())])
        name = "it" if order == 0 else f"its derivative of order {order}"
        raise FormationError(
            f"{what} has no five derivatives: {name} jumps near {where:g} s; {advice}."
        )


@compiled_for_one_call
def _derivatives_at(motion: OffsetMotion, times: jax.Array, d: int) -> jax.Array:
    place = jnp.arange(1.0, d + 1.0)
    return jax.vmap(lambda t: derivatives(lambda s: motion(place, s), t, ORDER))(times)


def _speed_states(model: ControlAffine) -> tuple[int, ...]:
    """Return the state that is the rate of each coordinate of the position; -1 where none is."""
    draw, n = np.random.default_rng(0), len(model.state_names)
    near = np.asarray(model.trim[0], float) + draw.uniform(-0.3, 0.3, (3, n))
    with precision("float64"):
        rates = np.stack([np.asarray(model.drift(jnp.asarray(x))) for x in near])
        maps = np.stack([np.asarray(model.input_map(jnp.asarray(x))) for x in near])
    same = np.all(np.abs(rates[:, :, None] - near[:, None]) <= 1e-12, axis=0)
    speeds = list[int]()
    for axis in model.position_indices():
        states = [] if maps[:, axis].any() else np.flatnonzero(same[axis])
        speeds.append(int(states[0]) if len(states) == 1 else -1)
    return tuple(speeds)
