"""The grid of a run: its frames, and the chunks between them."""

from typing import final

import numpy as np

from echelon.core.types import Array
from echelon.simulation.step.settings import Settings

_CHUNKS = 100
"""Chunks of a run, where it has so many frames: between two of them progress is reported."""


@final
class ChunkGrid:
    """How a run is cut into chunks, each of some points with steps after them.

    The cut depends on the settings alone and never on the clock: sums are made chunk by chunk, and
    another cut would round them otherwise. So a resumed run has the bits of an uninterrupted one.

    Args:
        settings: of the run.
        longest: the most steps that a chunk may have.
    """

    def __init__(self, settings: Settings, longest: int) -> None:
        """Choose the points."""
        self.steps, self.every = settings.steps, settings.store_every
        longest = min(longest, self.every * -(-self.frames // _CHUNKS))
        # Frames farther apart than a chunk is long are cut between, and those cuts are not stored.
        self.piece = min(self.every, longest)
        self.pieces = longest // self.piece if self.piece == self.every else 1

    @property
    def frames(self) -> int:
        """The number of stored frames: one every so many steps, and the last."""
        return 1 + -(-self.steps // self.every)

    @property
    def longest(self) -> int:
        """The most steps of a chunk."""
        return self.piece * self.pieces

    def counts(self, first: int) -> Array:
        """Return the steps after each point of the chunk that begins at a step.

        All chunks have the same number of points, so that they compile once; those that come after
        the run's end have no steps.
        """
        starts = first + self.piece * np.arange(self.pieces)
        ends = np.minimum(starts + self.piece, (starts // self.every + 1) * self.every)
        return np.maximum(np.minimum(ends, self.steps) - starts, 0).astype(np.int32)

    def stored(self, points: Array) -> Array:
        """Return which of some steps in ascending order are those of a frame, each once."""
        repeated = np.concatenate([[False], points[1:] == points[:-1]])[: len(points)]
        return ((points % self.every == 0) | (points == self.steps)) & ~repeated
