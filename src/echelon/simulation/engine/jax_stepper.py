"""The closed loop stepped by JAX, which defines what laws and models mean, on any device.

Agents may be spread over several devices, of one host or of several. A chunk begins and ends with
the same numbers on every device, so that the rest of a run is as on one. Within a chunk each device
steps its own agents, and JAX transfers what they receive.
"""

from collections.abc import Sequence
from functools import partial
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError
from echelon.core.types import Array, PyTree
from echelon.simulation.native.varying import is_number
from echelon.simulation.step.drive import Chunk, Stepper
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.meter import Sums, on_host
from echelon.simulation.step.records import ComponentMemory, LoopState
from echelon.simulation.step.sequence import Frames, advance, begin

_AGENT_STEPS, _FEWEST = 100_000, 4
"""Steps of one agent each in a chunk, and the fewest of all agents.

A quadrotor's take 1.4 to 7 us, and a model may take longer. A chunk computes the inputs at each of
its frames once more, so that one of a single step would take twice the time.
"""


def _longest(agents: int) -> int:
    return max(_FEWEST, _AGENT_STEPS // agents)


def _warnings(reason: str) -> tuple[str, ...]:
    return (f"JAX steps the agents, since {reason}.",) * bool(reason)


@final
class JaxStepper(Stepper):
    """Steps agents under laws.

    Args:
        loop: of the run.
        states: (N, n) at its beginning.
        reason: why it replaces native code that was requested; empty otherwise.
        devices: over how many the agents are spread.

    Raises:
        SimulationError: JAX has fewer, or the number of agents is no multiple of them.
    """

    def __init__(self, loop: Loop, states: Array, reason: str = "", devices: int = 1) -> None:
        self.loop, self.states, self.reason = loop, states, reason
        self.mesh = mesh_of(devices, len(states)) if devices > 1 else None

    @property
    def devices(self) -> int:
        """How many devices the agents are spread over."""
        return 1 if self.mesh is None else self.mesh.size

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the run takes longer than by native code."""
        return _warnings(self.reason)

    @property
    def longest(self) -> int:
        """Steps that take some tenths of a second, or a few of very many agents."""
        return _longest(len(self.states))

    def replace_loop(self, loop: Loop) -> None:
        """Continue in a loop that is like the one before but for its numbers."""
        self.loop = loop

    def start(self) -> LoopState:
        """Return the moment at which the run begins."""
        return begin(self.loop, self.states)

    def advance(self, now: LoopState, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; a divergence is noticed afterwards."""
        step = advance if self.mesh is None else partial(advance_parted, self.mesh)
        now, frames, sums = step(self.loop, now, counts, reference, now.step)
        (states, inputs), sums = on_host((frames, sums))
        return Chunk(now, states, inputs, sums.split(1))


@final
class JaxFormations(Stepper):
    """Steps many formations whose loops differ in numbers alone, each as if it were alone."""

    def __init__(self, loops: Sequence[Loop], states: Array, reason: str = "") -> None:
        self.count, self.states, self.reason = len(loops), states, reason
        self.loop, self.axes = _stack(loops)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the runs take longer than by native code."""
        return _warnings(self.reason)

    @property
    def longest(self) -> int:
        """Steps of a chunk, those of one formation alone."""
        return _longest(len(self.states) // self.count)

    def start(self) -> LoopState:
        """Return the moment at which all runs begin, a formation a row."""
        states = jnp.asarray(self.states).reshape(self.count, -1, self.states.shape[1])
        return _begin_all(self.loop, self.axes, states)

    def advance(self, now: LoopState, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; formations follow each other in what is returned."""
        now, frames, sums = _advance_all(self.loop, self.axes, now, counts, reference)
        states, inputs = (part.reshape(len(part), -1, part.shape[3]) for part in on_host(frames))
        return Chunk(now, states, inputs, on_host(sums))


_ALL = LoopState(None, 0, 0, ComponentMemory(*(0,) * len(ComponentMemory._fields)))  # type: ignore[arg-type]
"""All are at the same step."""


@cached_jit
def _begin_all(loop: Loop, axes: PyTree, states: jax.Array) -> LoopState:
    return eqx.filter_vmap(begin, in_axes=(axes, 0), out_axes=_ALL)(loop, states)


@cached_jit
def _advance_all(
    loop: Loop, axes: PyTree, now: LoopState, counts: Array, reference: Array | None
) -> tuple[LoopState, Frames, Sums]:
    in_axes = (axes, _ALL, None, None, None)
    return eqx.filter_vmap(advance, in_axes=in_axes, out_axes=(_ALL, 1, 0))(
        loop, now, counts, reference, now.step
    )


def _stack(loops: Sequence[Loop]) -> tuple[Loop, PyTree]:
    """Return one loop whose leaves are stacked where they differ, and the axes of its leaves."""
    if all(loop is loops[0] for loop in loops):
        return loops[0], None
    flat, tree = [jax.tree.leaves(loop) for loop in loops], jax.tree.structure(loops[0])
    stacked, axes = list[object](), list[int | None]()
    for leaves in zip(*flat, strict=True):
        # By identity first, since most leaves are shared and a comparison reads all their bytes.
        rows = any(leaf is not leaves[0] for leaf in leaves) and _differ(leaves)
        stacked.append(jnp.stack([jnp.asarray(leaf) for leaf in leaves]) if rows else leaves[0])
        axes.append(0 if rows else None)
    return tree.unflatten(stacked), tree.unflatten(axes)


def _differ(leaves: Sequence[object]) -> bool:
    if not is_number(leaves[0]) and not isinstance(leaves[0], np.ndarray):
        return False
    # By their bits: NaN equals itself there, and -0 differs from 0.
    return any(np.asarray(leaf).tobytes() != np.asarray(leaves[0]).tobytes() for leaf in leaves)


def mesh_of(devices: int, agents: int) -> Mesh:
    """Return a row of devices; `SimulationError` if JAX has fewer, or agents are no multiple."""
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
    now: LoopState,
    counts: jax.Array,
    reference: Array | None,
    first: jax.Array,
) -> tuple[LoopState, Frames, Sums]:
    """Do what `advance` does, with the agents spread over the devices of a mesh."""
    agents = len(loop.places.offsets)

    def part(leaf: jax.Array) -> jax.Array:
        # What has no row for each agent, such as the followers' memories, starts on all devices.
        mine = leaf.ndim > 0 and len(leaf) == agents
        return _place(leaf, mesh, PartitionSpec("agents") if mine else PartitionSpec())

    done = advance(loop, jax.tree.map(part, now), counts, reference, first)
    return jax.tree.map(lambda leaf: _place(leaf, mesh, PartitionSpec()), done)


def _place(leaf: jax.Array, mesh: Mesh, spec: PartitionSpec) -> jax.Array:
    return jax.lax.with_sharding_constraint(leaf, NamedSharding(mesh, spec))
