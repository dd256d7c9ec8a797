"""Finds the step at which a run diverges, which does not depend on how it is cut into chunks."""

import numpy as np
from jaxtyping import Bool

from echelon.core.types import Array
from echelon.simulation.step.drive import Chunk, Moment, Stepper


def advance_until_lost(
    stepper: Stepper, now: Moment, counts: Array, reference: Array | None, formations: int
) -> tuple[Chunk, Array]:
    """Return a chunk, and the steps after each of its points.

    If formations diverge in it, there is a point at the first step at which each is not finite.
    """
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
    stepper: Stepper, now: Moment, counts: Array, reference: Array | None, formations: int
) -> dict[int, tuple[Array, Array]]:
    """Return states and inputs at the steps at which formations first are not finite."""
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
