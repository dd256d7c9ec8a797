"""Models that are the same in every heading: how their states and inputs turn with it.

With T the turn of a state by an angle and D its slope, f(T x) = D f(x) and g(T x) E = D g(x), where
E turns the inputs. So a law for one heading is a law for every heading, in axes that turn.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine, Heading, Turn
from echelon.core.cache import memoize
from echelon.core.compiled import cached_jit
from echelon.core.errors import ModelError, did_you_mean, listing
from echelon.core.numerics import precision
from echelon.core.types import Input, Scalar, State

_SAMPLES = 16
_TOLERANCE = 1e-9
"""Relative, of f and g; an inertia makes some entries tens of thousands."""


def state_turn(model: ControlAffine) -> Turn:
    """Return how differences of a model's states turn, D; the identity without a heading."""
    return Turn.of(model.state_names, model.heading.vectors if model.heading else ())


def input_turn(model: ControlAffine) -> Turn:
    """Return how a model's normalized inputs turn, E."""
    return Turn.of(model.input_names, model.heading.inputs if model.heading else ())


def heading_of(model: ControlAffine) -> Heading:
    """Return the heading of a model that states one."""
    assert model.heading is not None
    return model.heading


def heading_index(model: ControlAffine) -> int:
    """Return the index of the heading in the state of a model that states one."""
    return model.state_names.index(heading_of(model).state)


def rest_heading(model: ControlAffine) -> float:
    """Return the heading of the trim, rad, for which gains are computed."""
    return float(np.asarray(model.trim[0], float)[heading_index(model)])


def rotate_state(model: ControlAffine, x: State, angle: Scalar) -> State:
    """Return T x, the state (n,) of an agent rotated about the origin by an angle (rad)."""
    return state_turn(model)(x, angle).at[heading_index(model)].add(angle)


def check_heading(model: ControlAffine) -> None:
    """Raise `ModelError` unless f and g turn with the heading that a model states."""
    heading, name = model.heading, type(model).__name__
    if heading is None:
        return
    if not isinstance(heading, Heading):
        raise ModelError(f"`heading` of `{name}` is {heading!r}, and must be a `Heading` or None.")
    for what, pairs, allowed in (
        ("state", ((heading.state,), *heading.vectors), model.state_names),
        ("input", heading.inputs, model.input_names),
    ):
        for member in itertools.chain.from_iterable(pairs):
            if member not in allowed:
                raise ModelError(
                    f"`heading` of `{name}` names `{member}`, which is no {what}; allowed are "
                    f"{listing(allowed)}{did_you_mean(member, allowed)}."
                )
    if not (gap := heading_gap(model)) <= _TOLERANCE:
        raise ModelError(
            f"`heading` of `{name}` states that the motion turns with `{heading.state}`, but after "
            f"a rotation f or g differs by {gap:.3g} from that; name all states and inputs that "
            "turn in `vectors` and `inputs`, or leave `heading` out."
        )


@memoize
def heading_gap(model: ControlAffine) -> float:
    """Return max |f(T x) - D f(x)|, |g(T x) S E - D g(x) S| near the trim, over their size."""
    draw = np.random.default_rng(0)
    trim = np.asarray(model.trim[0], float)
    x = trim + draw.uniform(-0.5, 0.5, (_SAMPLES, len(trim)))
    angles = draw.uniform(-np.pi, np.pi, _SAMPLES)
    with precision("float64"):
        gaps, sizes = map(np.asarray, _gaps(model, x, angles))
    return float((gaps / np.maximum(1.0, sizes)).max())


@cached_jit
def _gaps(
    model: ControlAffine, x: Float[jax.Array, "S n"], angles: Float[jax.Array, " S"]
) -> tuple[jax.Array, jax.Array]:
    """Return the gap (S, n, 1 + m) at each sample, and the size of what it is of (n, 1 + m)."""
    D, E = state_turn(model), input_turn(model)

    def field(x: State, v: Input) -> State:
        return model.velocity(x, model.physical(v))

    def gap_at(x: State, angle: Scalar) -> tuple[jax.Array, jax.Array]:
        def of_input(v: Input) -> tuple[State, State]:
            velocity = D(field(x, v), angle)
            return velocity - field(rotate_state(model, x, angle), E(v, angle)), velocity

        m = len(model.input_names)
        return jax.vmap(of_input, out_axes=1)(jnp.concatenate([jnp.zeros((1, m)), jnp.eye(m)]))

    gaps, sizes = jax.vmap(gap_at)(x, angles)
    return jnp.abs(gaps), jnp.abs(sizes).max(axis=0)
