"""The closed loop stepped by JAX: what a law and a model mean, on whatever device there is."""

from collections.abc import Sequence
from functools import partial
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.compiled import cached_jit
from echelon.core.types import Array
from echelon.simulation.engine.devices import advance_parted, mesh_of
from echelon.simulation.native.varying import is_number
from echelon.simulation.step.drive import Chunk, Stepper
from echelon.simulation.step.loop import Loop, Moment, WorldState
from echelon.simulation.step.meter import on_host
from echelon.simulation.step.sequence import advance, begin

_AGENT_STEPS, _FEWEST = 100_000, 4
"""Steps of one agent each in a chunk, and the fewest of all agents.

A quadrotor's take 1.4 to 7 us, and a model may take longer. A chunk computes the inputs at each of
its frames once more, so that one of a single step would take twice the time.
"""


def _longest(agents: int) -> int:
    return max(_FEWEST, _AGENT_STEPS // agents)


def _told(instead: str) -> tuple[str, ...]:
    return (f"JAX steps the agents, since {instead}.",) * bool(instead)


@final
class JaxStepper(Stepper):
    """Moves agents under laws.

    Args:
        loop: of the run.
        states: (N, n) at its beginning.
        instead: why it stands where native code was wanted; empty where it was not.
        devices: among how many the agents are parted.

    Raises:
        SimulationError: so many are not there, or the agents are no multiple of them.
    """

    def __init__(self, loop: Loop, states: Array, instead: str = "", devices: int = 1) -> None:
        """Keep what the steps need."""
        self.loop, self.states, self.instead = loop, states, instead
        self.mesh = mesh_of(devices, len(states)) if devices > 1 else None

    @property
    def devices(self) -> int:
        """Among how many devices the agents are parted."""
        return 1 if self.mesh is None else self.mesh.size

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the run takes longer than it might."""
        return _told(self.instead)

    @property
    def longest(self) -> int:
        """Steps that take some tenths of a second, or a few of very many agents."""
        return _longest(len(self.states))

    @property
    def largest(self) -> float:
        """The magnitude of states beyond which nothing is computed: none."""
        return np.inf

    def turn(self, loop: Loop) -> None:
        """Continue in a loop that is like the one before but for its numbers."""
        self.loop = loop

    def start(self) -> Moment:
        """Return the moment at which the run begins."""
        return begin(self.loop, self.states)

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; what happens on the way is seen afterwards."""
        step = advance if self.mesh is None else partial(advance_parted, self.mesh)
        now, (states, inputs), sums = step(self.loop, now, counts, reference, now.step)
        states, inputs, sums = on_host((states, inputs, sums))
        return Chunk(now, states, inputs, sums.split(1))


# ---- many formations -----------------------------------------------------------------------------


@final
class JaxFormations(Stepper):
    """Moves the agents of many formations that are alike, each as if it were alone.

    Args:
        loops: of each formation; alike in their trees and in all that is no number.
        states: (N, n) at the beginning, formation by formation.
        instead: as in `JaxStepper`.
    """

    def __init__(self, loops: Sequence[Loop], states: Array, instead: str = "") -> None:
        """Put side by side what differs."""
        self.count, self.states, self.instead = len(loops), states, instead
        self.loop, self.axes = _side_by_side(loops)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the runs take longer than they might."""
        return _told(self.instead)

    @property
    def longest(self) -> int:
        """Steps of a chunk, those of one formation alone."""
        return _longest(len(self.states) // self.count)

    def start(self) -> Moment:
        """Return the moment at which all runs begin, a formation a row."""
        states = jnp.asarray(self.states).reshape(self.count, -1, self.states.shape[1])
        return _begin_all(self.loop, self.axes, states)

    def advance(self, now: Moment, counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps; formations follow each other in what is returned."""
        now, frames, sums = _advance_all(self.loop, self.axes, now, counts, reference)
        states, inputs = (part.reshape(len(part), -1, part.shape[3]) for part in on_host(frames))
        return Chunk(now, states, inputs, on_host(sums))


_ALL = Moment(None, 0, 0, 0, 0, WorldState(0, 0))  # type: ignore[arg-type]
"""All are at the same step."""


@cached_jit
def _begin_all(loop: Loop, axes: Any, states: jax.Array) -> Moment:
    return eqx.filter_vmap(begin, in_axes=(axes, 0), out_axes=_ALL)(loop, states)


@cached_jit
def _advance_all(loop: Loop, axes: Any, now: Moment, counts: jax.Array, wanted: Any) -> Any:
    each = (axes, _ALL, None, None, None)
    return eqx.filter_vmap(advance, in_axes=each, out_axes=(_ALL, 1, 0))(
        loop, now, counts, wanted, now.step
    )


def _side_by_side(loops: Sequence[Loop]) -> tuple[Loop, Any]:
    """Return loops as one whose leaves are rows where they differ, and along which axis."""
    if all(loop is loops[0] for loop in loops):
        return loops[0], None
    flat, tree = [jax.tree.leaves(loop) for loop in loops], jax.tree.structure(loops[0])
    stacked, axes = list[Any](), list[int | None]()
    for leaves in zip(*flat, strict=True):
        rows = any(leaf is not leaves[0] for leaf in leaves) and _differ(leaves)
        stacked.append(jnp.stack([jnp.asarray(leaf) for leaf in leaves]) if rows else leaves[0])
        axes.append(0 if rows else None)
    return tree.unflatten(stacked), tree.unflatten(axes)


def _differ(leaves: Sequence[Any]) -> bool:
    if not is_number(leaves[0]) and not isinstance(leaves[0], np.ndarray):
        return False
    return any(np.asarray(leaf).tobytes() != np.asarray(leaves[0]).tobytes() for leaf in leaves)
