"""What steps the agents of a loop whose numbers are turned while it runs."""

import abc
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.errors import MissingExtraError
from echelon.core.numerics import Precision, precision
from echelon.core.types import Array
from echelon.laws.law import Law
from echelon.simulation.native import is_installed
from echelon.simulation.native.stepper import NativeStepper, beyond
from echelon.simulation.scalars import Unsupported
from echelon.simulation.step.loop import Loop, Moment, begin, control, step
from echelon.simulation.step.settings import Settings

_MANY = 200
"""With more agents than this JAX steps them in float32, which takes half the time."""


class LiveStep(NamedTuple):
    """A moment, the states (N, n) there, and the inputs (N, m) that are delivered from it on."""

    now: Moment
    states: Array
    inputs: Array


class Mover(abc.ABC):
    """Steps agents; a loop that is like the first but for its numbers compiles nothing again."""

    kind: Precision
    engine: str

    @abc.abstractmethod
    def move(self, loop: Loop, now: Moment, count: int) -> LiveStep:
        """Take so many steps in a loop from a moment on."""

    @abc.abstractmethod
    def beyond(self, states: Array) -> Array:
        """Return which states (N, n) are beyond what can be computed."""

    def begin(self, loop: Loop, states: Array, step: int = 0) -> Moment:
        """Return the moment at which agents begin at states (N, n), at a step."""
        with precision(self.kind):
            moment = begin(loop, jnp.asarray(states))
            return moment._replace(step=jnp.asarray(step, jnp.int32))


def mover_of(loop: Loop, unlike: Loop, states: Array, settings: Settings) -> Mover:
    """Return what steps a loop: native code wherever it can be made.

    Args:
        loop: to begin with.
        unlike: one that differs from it in all numbers that will be turned.
        states: (N, n) at the beginning.
        settings: of the scenario.
    """
    by_jax = _ByJax(settings.precision if len(states) <= _MANY else "float32")
    if settings.engine == "jax" or not is_installed() or jax.default_backend() != "cpu":
        return by_jax
    try:
        return _Native(loop, unlike, states)
    except (Unsupported, MissingExtraError, TypeError):
        # A law that wants its numbers as numbers is traced by JAX as it stands.
        return by_jax


@final
class _Native(Mover):
    """By code for this machine, in float64: it takes a tenth of a picture's time even so."""

    kind: Precision = "float64"
    engine = "native"

    def __init__(self, loop: Loop, unlike: Loop, states: Array) -> None:
        with precision(self.kind):
            self.stepper = NativeStepper([loop], states, 64, None, unlike=unlike)
        self.loop = loop

    def move(self, loop: Loop, now: Moment, count: int) -> LiveStep:
        if loop is not self.loop:
            self.loop = loop
            self.stepper.turn(loop)
        with precision(self.kind):
            wanted = self._reference(now, count)
            # A frame now, from which all steps are taken, and one at their end.
            counts = np.array([count, 0] if count else [0], np.int32)
            made = self.stepper.advance(now, counts, wanted)
        return LiveStep(made.now, made.states[-1], made.inputs[-1])

    def _reference(self, now: Moment, count: int) -> Array | None:
        """Return what the meter measures leaders against, which nobody asks for here."""
        if not self.stepper.plan.table:
            return None
        times = self.loop.motion.dt * (int(now.step) + jnp.arange(count + 1))
        return np.asarray(_followed(self.loop.leader, self.loop.model, times), np.float64)

    def beyond(self, states: Array) -> Array:
        return beyond(states, 64)


@cached_jit
def _followed(leader: Law, model: ControlAffine, times: jax.Array) -> jax.Array | None:
    return leader.reference_states(model, times)


@final
class _ByJax(Mover):
    """By JAX: what native code cannot say."""

    engine = "jax"

    def __init__(self, kind: Precision) -> None:
        self.kind = kind

    def move(self, loop: Loop, now: Moment, count: int) -> LiveStep:
        with precision(self.kind):
            now, inputs = _advance(loop, now, np.asarray(count, np.int32))
            return LiveStep(now, np.asarray(now.states, float), np.asarray(inputs, float))

    def beyond(self, states: Array) -> Array:
        return ~np.isfinite(states)


@cached_jit
def _advance(loop: Loop, now: Moment, count: Array) -> tuple[Moment, Any]:
    """Take steps, and return the moment with the inputs (N, m) there."""

    def one(_: jax.Array, now: Moment) -> Moment:
        return step(loop, now, control(loop, now))

    now = jax.lax.fori_loop(0, count, one, now)
    return now, control(loop, now).inputs
