"""Who leads, and whom each agent receives, where those that lead announce it to all others."""

from collections.abc import Sequence
from typing import final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.compiled import cached_jit
from echelon.core.types import Array, PyTree
from echelon.simulation.codegen import aligned
from echelon.simulation.native.blocks import FormationBlocks, Places
from echelon.simulation.native.network_table import NetworkTable, stacked
from echelon.simulation.step.deliveries import Announcement, announce
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.records import LeaderPackets, Steps

_AHEAD, _AT_ONCE = 256, 4_000_000
"""Steps that are decided at once, and numbers of them at most."""


@final
class LeadTable(NetworkTable):
    """The packets of the agents of F formations, without what they say.

    Args:
        loops: of the formations.
        places: of the agents.
        rows: of a block.
    """

    def __init__(self, loops: Sequence[Loop], places: Places, rows: int) -> None:
        self.places, self.loop, self.count = places, loops[0], len(loops)
        self.leaders = np.asarray(self.loop.laws.leaders)
        one = places.swarm if isinstance(places, FormationBlocks) else places
        block, lane = np.divmod(one.position, one.lanes)
        self.agents, self.place = one.agents, block * rows * places.lanes + lane
        shape = places.groups, places.blocks // places.groups, places.lanes
        self.sources = aligned(shape, np.int32)
        each = self.count * self.loop.agents * (4 + len(self.leaders))
        self.ahead = max(1, min(_AHEAD, _AT_ONCE // each))
        self.forget(loops)
        self.clear()

    def clear(self) -> None:
        """Begin before the first packet."""
        one = self.loop.network.begin(self.loop, jnp.zeros((self.loop.agents, 0)), 1)
        self.after = jax.tree.map(lambda leaf: np.repeat(leaf[None], self.count, axis=0), one)
        self.first = self.until = 0

    def forget(self, loops: Sequence[Loop]) -> None:
        """Continue with loops that may have other numbers."""
        parts = [(loop.network.leadership, loop.roster) for loop in loops]
        self.parts, self.axes = stacked(parts)

    # ---- what is decided ----

    def left(self, step: int) -> int:
        """Return for how many steps from one on the same agents lead and are received."""
        if step >= self.until:
            self._decide(step)
        later = self.changes[self.changes > step]
        return int(later[0] if len(later) else self.until) - step

    def _decide(self, step: int) -> None:
        self.first, self.until = step, step + self.ahead
        numbers = self.leaders, np.asarray(self.loop.motion.dt), np.asarray(step, np.int32)
        self.after, decided = _decided(self.parts, self.axes, self.after, *numbers, self.ahead)
        self.before, self.leads, places = jax.tree.map(lambda x: np.asarray(x), decided)
        self.senders = places.astype(int)
        both = np.stack([self.leads, self.senders])
        changed = (np.diff(both, axis=1) != 0).any(axis=(0, 2, 3))
        self.changes = step + 1 + np.flatnonzero(changed)

    def rows(self, step: int) -> dict[str, Array]:
        """Return of each agent whether it leads, and whether it receives one that leads."""
        self.left(step)
        passed = step - self.first
        parts = self.leads[passed], self.senders[passed] >= 0
        return dict(zip(("lead", "sent"), (part.reshape(-1, 1) for part in parts), strict=True))

    def arguments(self, step: int) -> tuple[dict[str, Array], dict[str, int]]:
        """Return whom each agent receives."""
        self.left(step)
        # Any place is valid for who receives nobody.
        senders = self.leaders[np.maximum(self.senders[step - self.first], 0)]
        there, shape = self.place[senders][:, self.agents], self.sources.shape
        if self.places.batched:
            # The last formation fills its group.
            formation = np.minimum(np.arange(shape[0] * shape[2]), self.count - 1)
            lanes = there[formation].reshape(shape[0], shape[2], shape[1]).swapaxes(1, 2)
            self.sources[:] = lanes + np.arange(shape[2])
        else:
            self.sources[:] = there.reshape(shape)
        return {"sources": self.sources}, {}

    # ---- what packets say ----

    def load(self, step: int, memory: PyTree) -> Array:
        """Take the packets at a step; return what they say (F N, k)."""
        leading = (1,) * (self.count == 1)
        packets = jax.tree.map(lambda leaf: np.reshape(leaf, (*leading, *np.shape(leaf))), memory)
        content = packets.content
        self.after = packets._replace(content=np.zeros((*content.shape[:2], 1)))
        self.first = self.until = step
        return content.reshape(-1, content.shape[-1])

    def memory(self, step: int, packets: Array) -> PyTree:
        """Return the packets at a step, with what they say (F N, k)."""
        now = self.after
        if step < self.until:
            now = jax.tree.map(lambda leaf: leaf[step - self.first], self.before)
        content = packets.reshape(self.count, -1, packets.shape[-1])
        now = jax.tree.map(np.asarray, now)._replace(content=content)
        return now if self.count > 1 else jax.tree.map(lambda leaf: leaf[0], now)


@cached_jit
def _decided(
    parts: PyTree,
    axes: PyTree,
    now: LeaderPackets,
    leaders: Array,
    dt: Array,
    first: jax.Array,
    steps: int,
) -> tuple[LeaderPackets, Announcement]:
    """Return the packets after some steps, and what is decided in each, with those before it."""

    def one(parts: PyTree, now: LeaderPackets, step: jax.Array) -> Announcement:
        leadership, roster = parts
        return announce(leadership, roster, leaders, now, Steps(step, dt))

    def all_(now: LeaderPackets, step: jax.Array) -> tuple[LeaderPackets, Announcement]:
        decided = jax.vmap(one, (axes, 0, None))(parts, now, step)
        return decided.packets, decided._replace(packets=now)

    return jax.lax.scan(all_, now, first + jnp.arange(steps, dtype=jnp.int32))
