"""How a run is cut into frames and chunks, and the chunk in which it diverges."""

from typing import final

import numpy as np
from jaxtyping import Bool

from echelon.core.types import Array
from echelon.simulation.step.drive import Chunk, LoopState, Stepper
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


def advance_until_lost(
    stepper: Stepper, now: LoopState, counts: Array, reference: Array | None, formations: int
) -> tuple[Chunk, Array]:
    """Return a chunk and the steps after its points, one of them where a formation diverges."""
    chunk = stepper.advance(now, counts, reference)
    if not stepper.repeats or np.isfinite(np.asarray(chunk.now.states)).all():
        return chunk, counts
    points = np.cumsum(counts) - counts
    frames = dict(zip(points.tolist(), zip(chunk.states, chunk.inputs, strict=True), strict=True))
    frames |= _first_lost(stepper, now, counts, reference, formations)
    order = sorted(frames)
    states, inputs = (np.stack([frames[point][k] for point in order]) for k in (0, 1))
    # Points that end the run, without steps after them, are in `frames` once.
    return chunk._replace(states=states, inputs=inputs), np.diff([*order, int(counts.sum())])


def _first_lost(
    stepper: Stepper, now: LoopState, counts: Array, reference: Array | None, formations: int
) -> dict[int, tuple[Array, Array]]:
    total, step, lost = int(counts.sum()), 0, np.zeros(formations, bool)
    frames = dict[int, tuple[Array, Array]]()
    while step < total and not lost.all():
        # As many points as before, so that nothing compiles anew.
        single = (np.arange(len(counts)) < total - step).astype(counts.dtype)
        chunk = stepper.advance(now, single, _from(reference, step))
        finite = finite_formations(chunk, formations)
        for k in range(int(single.sum())):
            if (~finite[k] & ~lost).any():
                frames[step + k] = chunk.states[k], chunk.inputs[k]
            lost |= ~finite[k]
        now, step = chunk.now, step + int(single.sum())
    return frames


def _from(reference: Array | None, step: int) -> Array | None:
    """Return the rows of a reference from a step on, as many as before."""
    if reference is None:
        return None
    return reference[np.minimum(step + np.arange(len(reference)), len(reference) - 1)]


def finite_formations(chunk: Chunk, formations: int) -> Bool[np.ndarray, "T F"]:
    """Return which formations are finite at each point of a chunk."""
    parts = (part.reshape(len(part), formations, -1) for part in (chunk.states, chunk.inputs))
    return np.all([np.isfinite(part).all(axis=2) for part in parts], axis=0)
