"""Gradients of a cost of a run by reverse-mode differentiation of the closed loop."""

from collections.abc import Hashable, Sequence
from typing import final

import jax
import numpy as np

from echelon.core.cache import BoundedCache
from echelon.core.errors import SimulationError
from echelon.core.identity import digest
from echelon.core.numerics import precision
from echelon.simulation.engine.content import content_of, copied
from echelon.simulation.engine.differentiable_run import (
    Cost,
    DifferentiableRun,
    Gradient,
    values_of,
)
from echelon.simulation.engine.jax_gradient import by_jax
from echelon.simulation.engine.law_drive import Laws, choose_engine
from echelon.simulation.engine.native_gradient import Native
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.simulate import sample_reference
from echelon.simulation.native.varying import alike
from echelon.simulation.step.loop import assemble
from echelon.simulation.step.settings import Settings

_WORTH = 10_000
"""Agent steps above which native code saves more time than generating it takes."""


def gradient(parts: Parts, settings: Settings, cost: Cost, wrt: Sequence[str]) -> Gradient:
    """Return a cost of a run and its derivatives by some of the run's parameters.

    The steps are differentiated backwards in float64, by native code or JAX as `settings.engine`
    says; both agree to rounding. States are stored at checkpoints and the steps between are
    computed again, so that memory grows with the square root of the number of steps.

    Args:
        parts: agents, graph, formation, laws, starts and world.
        settings: horizon, step and the like.
        cost: of the sums over the run's steps, such as `lambda sums: sums.errors[0].sum()`. It is
            traced once, as by `jax.jit`: values that it reads from its closure or module stay as
            they were then; pass a new function for other values.
        wrt: of `VARIABLES`.

    Raises:
        EchelonError: a part is malformed or does not fit the others; the agents are not driven by
            laws, or these have no gain; messages are late; a variable is unknown; the cost fails,
            or is not one number; `settings.engine` is `native`, and native code is unavailable.
    """
    if isinstance(wrt, str):
        raise SimulationError(f"`wrt` is the text {wrt!r}, and must be a list, such as [{wrt!r}].")
    if parts.formation.motion is not None:
        raise SimulationError(
            "got a formation that changes, but derivatives are of constant ones; leave out "
            "`motion` to tune, and give it to the runs afterwards."
        )
    if parts.world.network is not None:
        raise SimulationError("got a network, but derivatives are of messages that are never late.")
    if parts.drive.safety is not None:
        raise SimulationError("got `safety`, but derivatives are of agents that do not keep apart.")
    with precision("float64"):
        prepared = _take(parts, settings, tuple(wrt))
        result = choose_engine(
            settings,
            len(prepared.run.states),
            lambda: prepared.native_gradient(cost),
            lambda reason: by_jax(prepared.run, settings.steps, cost, reason),
            _WORTH,
        )
    _give_back(prepared)
    return result


# ---- runs prepared for later calls ---------------------------------------------------------------


_MOST_RUNS, _MOST_BYTES = 4, 128 * 2**20
"""Most runs cached for later calls, and the most bytes of them together."""
_cache = BoundedCache["_PreparedRun"](_MOST_RUNS, lambda run: run.size, _MOST_BYTES)


def _take(parts: Parts, settings: Settings, wrt: tuple[str, ...]) -> "_PreparedRun":
    """Return a prepared run, taken from the cache if it is there."""
    key = content_of(parts, settings, wrt)
    # Out of the cache while in use: another thread must not change its gain meanwhile.
    cached = _cache.pop(key)
    if cached is None or not cached.update(parts):
        return _PreparedRun(parts, settings, wrt, key)
    return cached


def _give_back(run: "_PreparedRun") -> None:
    """Put a run into the cache for the next call."""
    if run.key is not None:
        _cache.put(run.key, run)


@final
class _PreparedRun:
    """A checked run that can be differentiated many times, also with another gain."""

    def __init__(
        self, parts: Parts, settings: Settings, wrt: tuple[str, ...], key: Hashable | None
    ) -> None:
        # No frame is stored, and no cost depends on who is closest.
        self.key, self.wrt, prepared = key, wrt, prepare(parts, settings._replace(store_every=1))
        self.problem, drive = copied((prepared.problem, prepared.parts.drive))
        values = values_of(self.problem, drive, wrt)
        assert isinstance(drive, Laws)  # `values_of` rejects all others
        self.drive = drive
        loop = assemble(self.problem, self.drive.leader, self.drive.follower)
        reference = sample_reference(prepared, 0, settings.steps)
        self.run = DifferentiableRun(loop, values, self.problem.states, reference)
        self.gain, self._native = digest(parts.drive.gain), None

    def update(self, parts: Parts) -> bool:
        """Replace the gain; return False if the parts differ in more than its numbers.

        A law of the same form is not checked again.
        """
        gain = digest(parts.drive.gain)
        if gain is not None and gain == self.gain:
            return True
        problem, leader, new = self.problem, self.drive.leader, copied(parts.drive)
        assert isinstance(new, Laws)  # the key of the cache contains the type
        follower = new.follower.prepared(problem.model, problem.graph)
        drive = Laws(leader, follower.following(leader, problem.model))
        loop = assemble(problem, drive.leader, drive.follower)
        if not alike(loop, self.run.loop):
            return False
        drive.accept(problem)
        values = values_of(problem, drive, self.wrt)
        self.run, self.gain = self.run._replace(loop=loop, values=values), gain
        if self._native is not None and not self._native.update(self.run):
            self._native = None
        return True

    def native_gradient(self, cost: Cost) -> Gradient:
        """Return the gradient of a cost by native code."""
        if self._native is None:
            self._native = Native(self.run, self.problem.settings.steps)
        return self._native.gradient(cost)

    @property
    def size(self) -> int:
        """Bytes stored from one call to the next."""
        arrays = jax.tree.leaves((self.run, self.problem.graph.edges, self.problem.graph.weights))
        size = sum(np.asarray(array).nbytes for array in arrays)
        return size + (0 if self._native is None else self._native.size)
