"""Agents that are the same in every heading: their motion turns as their state does.

With T the turn of a state by an angle and D its slope, f(T x) = D f(x) and g(T x) E = D g(x), where
E turns the inputs. So what a law does about one heading it can do about all, in axes that turn.
"""

import itertools
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.compiled import cached_jit
from echelon.core.errors import ModelError, did_you_mean, listing
from echelon.core.memoize import memoize
from echelon.core.numerics import precision
from echelon.core.types import Array, Scalar, State

if TYPE_CHECKING:
    from echelon.agents.models.model import ControlAffine

_SAMPLES = 16
_GAP = 1e-9
"""Relative, of f and g; an inertia makes some entries tens of thousands."""


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
    """A turn of vectors (k,) in the plane, by the slope G of its matrix exp(angle G) at no angle.

    Attributes:
        partners: (k,) which entry each is mixed with.
        signs: (k,) of what it is mixed with; 0 where it does not turn.
    """

    partners: Array
    signs: Array

    @classmethod
    def of(cls, names: tuple[str, ...], pairs: tuple[tuple[str, str], ...]) -> "Turn":
        """Return the turn of named entries by pairs."""
        partners, signs = np.arange(len(names)), np.zeros(len(names))
        for first, second in pairs:
            i, j = names.index(first), names.index(second)
            partners[[i, j]], signs[[i, j]] = (j, i), (-1.0, 1.0)
        return cls(partners, signs)

    def __call__(self, values: jax.Array, angle: Scalar) -> jax.Array:
        """Return values (k,) turned by an angle (rad); by none they stay, to the bit."""
        if not self.signs.any():
            return values
        signs = jnp.asarray(self.signs, values.dtype)
        scale = jnp.where(self.signs != 0.0, jnp.cos(angle), jnp.ones_like(values))
        return scale * values + jnp.sin(angle) * (signs * values[self.partners])

    @property
    def slope(self) -> Array:
        """G (k, k)."""
        slope = np.zeros((len(self.signs), len(self.signs)))
        slope[np.arange(len(self.signs)), self.partners] = self.signs
        return slope


def state_turn(model: "ControlAffine") -> Turn:
    """Return how differences of a model's states turn, D; not at all where it states no heading."""
    return Turn.of(model.state_names, model.heading.vectors if model.heading else ())


def input_turn(model: "ControlAffine") -> Turn:
    """Return how a model's normalized inputs turn, E."""
    return Turn.of(model.input_names, model.heading.inputs if model.heading else ())


def heading_of(model: "ControlAffine") -> Heading:
    """Return the heading that a model states, of one that does."""
    assert model.heading is not None
    return model.heading


def heading_index(model: "ControlAffine") -> int:
    """Return the place of the heading in the state of a model that states one."""
    return model.state_names.index(heading_of(model).state)


def rest_heading(model: "ControlAffine") -> float:
    """Return the heading of the trim, rad, in which gains are made."""
    return float(np.asarray(model.trim[0], float)[heading_index(model)])


def turned(model: "ControlAffine", x: State, angle: Scalar) -> State:
    """Return T x, the state (n,) of an agent turned about the origin by an angle (rad)."""
    return state_turn(model)(x, angle).at[heading_index(model)].add(angle)


def check_heading(model: "ControlAffine") -> None:
    """Check that what a model says of its heading is so.

    Raises:
        ModelError: it names what is no state or input, or f and g do not turn so.
    """
    told, name = model.heading, type(model).__name__
    if told is None:
        return
    if not isinstance(told, Heading):
        raise ModelError(f"`heading` of `{name}` is {told!r}, and must be a `Heading` or None.")
    for what, pairs, known in (
        ("state", ((told.state,), *told.vectors), model.state_names),
        ("input", told.inputs, model.input_names),
    ):
        for member in itertools.chain.from_iterable(pairs):
            if member not in known:
                raise ModelError(
                    f"`heading` of `{name}` names `{member}`, which is no {what}; allowed are "
                    f"{listing(known)}{did_you_mean(member, known)}."
                )
    if not (gap := heading_gap(model)) <= _GAP:
        raise ModelError(
            f"`heading` of `{name}` says that its motion turns with `{told.state}`, and turned by "
            f"some angle f or g differs by {gap:.3g} from what turns; name all that turns in "
            "`vectors` and `inputs`, or leave `heading` out."
        )


@memoize
def heading_gap(model: "ControlAffine") -> float:
    """Return how far f and g are from turning with the heading, at samples, relative to their size.

    The largest |f(T x) - D f(x)| and |g(T x) S E - D g(x) S| near the trim, over all angles.
    """
    draw = np.random.default_rng(0)
    trim = np.asarray(model.trim[0], float)
    x = trim + draw.uniform(-0.5, 0.5, (_SAMPLES, len(trim)))
    angles = draw.uniform(-np.pi, np.pi, _SAMPLES)
    with precision("float64"):
        found = _gaps(model, x, angles)
    gaps, sizes = map(np.asarray, found)
    return float((gaps / np.maximum(1.0, sizes)).max())


@cached_jit
def _gaps(model: "ControlAffine", x: jax.Array, angles: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the gap (S, n, 1 + m) at each sample, and the size of what it is of (n, 1 + m)."""
    D, E = state_turn(model), input_turn(model)

    def field(x: State, v: jax.Array) -> State:
        return model.velocity(x, model.physical(v))

    def one(x: State, angle: Scalar) -> tuple[jax.Array, jax.Array]:
        def at(v: jax.Array) -> tuple[State, State]:
            here = D(field(x, v), angle)
            return here - field(turned(model, x, angle), E(v, angle)), here

        m = len(model.input_names)
        return jax.vmap(at, out_axes=1)(jnp.concatenate([jnp.zeros((1, m)), jnp.eye(m)]))

    gaps, sizes = jax.vmap(one)(x, angles)
    return jnp.abs(gaps), jnp.abs(sizes).max(axis=0)
