"""Distances between agents at a step: along edges, and of the closest two."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.model import ControlAffine
from echelon.simulation.step.records import Mask
from echelon.simulation.step.settings import Settings

PAIRED = 32
"""Agents up to which the closest two are found at every step; of more, in stored frames only."""


def spacing_error(square: jax.Array, desired: jax.Array) -> jax.Array:
    """Return the squared errors of distances, given as squares, from the desired ones."""
    return (distance_of(square) - desired) ** 2


def distance_of(square: jax.Array) -> jax.Array:
    """Return the root of a square, with a slope of 1 where two agents meet."""
    # A root has no slope at 0, and a single `where` would still differentiate it there.
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), square)


def finds_pairs(model: ControlAffine, agents: int, settings: Settings) -> bool:
    """Return whether steps between stored frames are searched for the closest two agents."""
    return settings.store_every > 1 and bool(model.position) and 2 <= agents <= PAIRED


def closest_two(
    step: jax.Array, places: Float[jax.Array, "N d"], here: Mask
) -> dict[str, jax.Array]:
    """Return the terms `closest` and `met` of a step, of the agents that are present."""
    i, j = np.triu_indices(len(places), 1)
    # No cost depends on it, and a root has no slope at 0.
    places = jax.lax.stop_gradient(places)
    squares = ((places[i] - places[j]) ** 2).sum(axis=1)
    known = ~jnp.isnan(squares)
    known = known if here is True else known & here[i] & here[j]
    squares = jnp.where(known, squares, jnp.inf)
    k = squares.argmin()
    met = jnp.stack([step, jnp.asarray(i)[k], jnp.asarray(j)[k]])
    return {"closest": jnp.sqrt(squares[k])[None], "met": met.astype(jnp.int32)[None]}
