"""The starts of agents in flat coordinates, less their offsets (T5)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from echelon.agents.models.chains import flat_output, flatten
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation_motion import FormationMotion
from echelon.core.compiled import cached_jit
from echelon.core.types import Array
from echelon.laws.stopping_point import StoppingPoint
from echelon.simulation.engine.parts import Parts

_TURN = 2.0 * np.pi


def flat_starts(
    parts: Parts, law: StoppingPoint, states: Float[Array, "N n"]
) -> Float[Array, "N r m"]:
    """Return states in flat coordinates, less the offsets.

    Without `safety` they are less the offsets' derivatives too, which the law adds by itself.
    """
    motion = parts.formation.motion
    offsets = jnp.asarray(parts.formation.offsets_at([0.0])[0])
    flat = np.array(_flat(parts.model, law, jnp.asarray(states), offsets))
    if motion is not None and law.safety is None:
        rates = np.asarray(_offset_rates(motion, flat.shape[1] - 1))
        flat[:, 1:, np.array(law.ready.places_of(parts.model))] -= rates[:, 1:]
    return flat


@cached_jit
def _flat(
    model: ControlAffine, law: StoppingPoint, states: jax.Array, offsets: jax.Array
) -> jax.Array:
    chains = law.ready.chains

    def one(x: jax.Array, offset: jax.Array) -> jax.Array:
        memory = law.begin(model, x)
        values = flatten(model, chains, x, memory.chain).values
        shift = flat_output(model, chains.outputs, offset)
        values = values.at[0].add(flat_output(model, chains.outputs, 0.0 * offset) - shift)
        # The law takes the turn of a heading that is next to the beginning of the leader's path.
        turns = jnp.round((law.signal(model, x, offset, memory) - law.ready.stop(values)) / _TURN)
        return values.at[0].add(_TURN * turns) if law.ready.angles else values

    return jax.vmap(one)(states, offsets)


@cached_jit
def _offset_rates(motion: FormationMotion, order: int) -> jax.Array:
    start, rows = jnp.zeros(()), jnp.asarray(motion.places)
    return jax.vmap(lambda row: motion.derivatives(row, start, order))(rows)
