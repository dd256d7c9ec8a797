"""The closed loop in time: parts in, one `Result` out, whatever drives the agents."""

import math
import time
from collections.abc import Callable
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np

from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.engine.drive import Stepper
from echelon.engine.parts import Parts
from echelon.engine.prepare import Prepared, prepare
from echelon.engine.record import Recorder, frame_counts
from echelon.engine.result import Result
from echelon.engine.settings import Settings
from echelon.engine.sums import on_host

Progress: TypeAlias = Callable[[int, int], None]
"""Called now and then with the steps done and the steps in all."""

_CHUNKS = 100
"""Parts of a run between which progress is reported, and Ctrl-C or a divergence ends it."""


def simulate(parts: Parts, settings: Settings, progress: Progress | None = None) -> Result:
    """Run the closed loop and return what happened.

    Args:
        parts: agents, graph, formation, what drives them, starts and world.
        settings: horizon, step and the like.
        progress: called about a hundred times with (steps done, steps in all).

    Raises:
        EchelonError: a part is malformed or does not fit the others. A run that diverges or is
            interrupted by Ctrl-C is no error: the result says so and holds what was computed.
    """
    began = time.perf_counter()
    prepared = prepare(parts, settings)
    with precision("float64"):
        # Plans and solvers are made in float64, in whatever precision the run then is.
        stepper = prepared.parts.drive.stepper(prepared.problem)
    with precision(settings.precision):
        recorder = _run(stepper, prepared, progress)
        record = recorder.close(on_host(prepared.problem.meter.nothing()))
    return Result(
        times=record.times,
        states=record.states,
        inputs=record.inputs,
        reference=record.reference,
        sums=record.sums,
        outcome=record.outcome,
        message=record.message,
        warnings=prepared.warnings,
        parts=prepared.parts,
        settings=settings,
        wall_time=time.perf_counter() - began,
        work=stepper.work,
    )


def _run(stepper: Stepper, prepared: Prepared, progress: Progress | None) -> Recorder:
    """Advance chunk by chunk, so that Ctrl-C or a divergence keeps what was computed."""
    problem = prepared.problem
    counts = frame_counts(problem.settings)
    size = math.ceil(len(counts) / _CHUNKS)
    # Chunks of one length compile once; the padding stores the last frame again, and is cut off.
    padded = np.concatenate([counts, np.zeros(-len(counts) % size, np.int32)])
    chunks = padded.reshape(-1, size)
    # The last chunks have fewer steps; a reference of one length keeps them from compiling anew.
    longest = int(chunks.sum(axis=1).max())
    recorder, done = Recorder(problem), 0
    try:
        now = stepper.start()
        for chunk in chunks:
            # One more row, for a frame at a chunk's end, which no step follows.
            reference = _sample_reference(prepared, done, longest + 1)
            made = stepper.advance(now, chunk, reference)
            now, done = made.now, done + int(chunk.sum())
            if not recorder.keep(made, chunk, reference):
                break
            if progress is not None:
                progress(done, int(counts.sum()))
    # Between chunks, or within one of JAX's: that chunk is lost, and what was recorded is kept.
    except KeyboardInterrupt:
        pass
    return recorder


def _sample_reference(prepared: Prepared, first: int, steps: int) -> Array | None:
    """Return what the leaders follow from a step on, (steps, n) in float64."""
    with precision("float64"):
        # In float64: after three hours float32 has a millisecond between two times.
        times = prepared.problem.settings.dt * jnp.arange(first, first + steps)
        reference = prepared.parts.drive.reference_states(prepared.parts.model, times)
        return None if reference is None else np.asarray(reference, np.float64)
