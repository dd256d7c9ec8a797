"""Spreads the agents over the devices of JAX, of one host or of several.

A chunk begins and ends with the same numbers on every device, so that the rest of a run is as on
one. Within a chunk each device steps its own agents, and JAX transfers what they receive.
"""

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError
from echelon.core.types import Array
from echelon.simulation.step.loop import Loop, Moment
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.sequence import Frames, advance


def mesh_of(devices: int, agents: int) -> Mesh:
    """Return a row of devices, over which the agents are spread.

    Raises:
        SimulationError: JAX has fewer, or the number of agents is no multiple of them.
    """
    available = jax.devices()
    if devices > len(available):
        raise SimulationError(
            f"`devices` is {devices}, and JAX has {len(available)} ({available[0].platform}); of "
            "processors it has as many as `JAX_NUM_CPU_DEVICES` says."
        )
    if devices < len(available) and jax.process_count() > 1:
        raise SimulationError(
            f"`devices` is {devices}, and must be {len(available)}, all of those of the"
            f" {jax.process_count()} processes."
        )
    if agents % devices:
        raise SimulationError(
            f"`devices` is {devices}, and {agents} agents cannot be parted among them: their number"
            " must be a multiple."
        )
    return Mesh(np.array(available[:devices]), ("agents",))


@cached_jit
def advance_parted(
    mesh: Mesh,
    loop: Loop,
    now: Moment,
    counts: jax.Array,
    reference: Array | None,
    first: jax.Array,
) -> tuple[Moment, Frames, Sums]:
    """Do what `advance` does, with the agents spread over the devices of a mesh."""
    agents = len(loop.offsets)

    def part(leaf: jax.Array) -> jax.Array:
        # What has no row for each agent, such as the followers' memories, starts on all devices.
        mine = leaf.ndim > 0 and len(leaf) == agents
        return _place(leaf, mesh, PartitionSpec("agents") if mine else PartitionSpec())

    done = advance(loop, jax.tree.map(part, now), counts, reference, first)
    return jax.tree.map(lambda leaf: _place(leaf, mesh, PartitionSpec()), done)


def _place(leaf: jax.Array, mesh: Mesh, spec: PartitionSpec) -> jax.Array:
    return jax.lax.with_sharding_constraint(leaf, NamedSharding(mesh, spec))
