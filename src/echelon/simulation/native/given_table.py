"""Numbers of each agent and step that the host computes ahead of a kernel, some steps at a time."""

from collections.abc import Sequence
from typing import final

import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import Plan, aligned
from echelon.simulation.native.blocks import Places
from echelon.simulation.native.varying import VaryingNumbers
from echelon.simulation.scalars import HostPart
from echelon.simulation.step.loop import Loop

_AHEAD, _AT_ONCE = 64, 50_000
"""Steps that are computed at once, and agent steps at most; a call takes 0.5 ms."""


@final
class GivenTable:
    """The numbers of some steps, in blocks.

    Args:
        varying: numbers of the loops.
        loops: of the formations.
        parts: what is computed of leaders and of all others.
        places: of the agents.
        plan: of the kernel.
        dtype: of the numbers.
    """

    def __init__(
        self,
        varying: VaryingNumbers,
        loops: Sequence[Loop],
        parts: tuple[HostPart, HostPart],
        places: Places,
        plan: Plan,
        dtype: np.dtype,
    ) -> None:
        self.varying, self.parts, self.places, self.size = varying, parts, places, plan.given
        agents = len(loops) * len(loops[0].places.offsets)
        self.ahead = max(1, min(_AHEAD, _AT_ONCE // agents)) if self.size else 0
        shape = self.ahead, places.blocks, self.size, places.lanes
        self.table = aligned(shape, dtype)
        self.forget(loops)

    def forget(self, loops: Sequence[Loop]) -> None:
        """Continue with loops that may have other numbers."""
        self.loops, self.first = loops, -1
        keys = map(self.varying.keys_of, loops) if self.size else ()
        self.keys = [np.stack(key) for key in zip(*keys, strict=True)]

    def left(self, step: int) -> int:
        """Return for how many steps from one on numbers are computed at once."""
        return self.ahead - step % self.ahead if self.size else np.iinfo(np.int64).max

    def of(self, step: int) -> Array:
        """Return the numbers of a step in blocks, with those of the next ones behind them."""
        first = step - step % self.ahead
        if first != self.first:
            self._fill(first)
        return self.table[step - first]

    def _fill(self, first: int) -> None:
        loop, self.first = self.loops[0], first
        steps, count = first + np.arange(self.ahead), len(loop.places.offsets)
        values = np.zeros((self.ahead, len(self.loops), count, self.size), self.table.dtype)
        groups = loop.laws.leaders, loop.laws.followers
        for part, agents in zip(self.parts, groups, strict=True):
            if part.size:
                numbers = part.numbers(self.keys, steps, np.asarray(agents))
                values[:, :, agents, : part.size] = numbers
        blocks = values.reshape(self.ahead, -1, self.size)[:, self.places.agents]
        blocks = blocks.reshape(self.ahead, self.places.blocks, self.places.lanes, self.size)
        self.table[:] = blocks.swapaxes(2, 3)
