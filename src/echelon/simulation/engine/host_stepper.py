"""Agents whose inputs come from the host: a pilot gives them every few steps, the plant moves."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.core.compiled import cached_jit
from echelon.core.errors import SimulationError
from echelon.core.types import Array, Inputs, States
from echelon.simulation.step.drive import Chunk, Problem, Stepper, Stopped
from echelon.simulation.step.meter import Meter, Sums, on_host, reference_at
from echelon.simulation.step.motion import Motion
from echelon.simulation.step.solver_stats import SolverStats

Pilot: TypeAlias = Callable[[int, Array], Array]
"""(step, states (N, n)) -> wanted physical inputs (N, m) from that step on."""

_PLANS = 64
"""Plans of one agent each in a chunk: a solver takes some 20 ms for one."""


@final
class HostStepper(Stepper):
    """The plant under the inputs of a pilot, which gives them every `hold` steps.

    Args:
        problem: the agents and how they move.
        pilot: gives the inputs.
        hold: steps for which they are held.
        work: returns what solving took so far.
    """

    def __init__(
        self,
        problem: Problem,
        pilot: Pilot,
        hold: int,
        work: Callable[[], SolverStats],
    ) -> None:
        """Keep what never changes."""
        self.problem, self.pilot, self.hold, self._work = problem, pilot, hold, work

    @property
    def work(self) -> SolverStats:
        """What solving took so far."""
        return self._work()

    @property
    def longest(self) -> int:
        """Steps in which a few dozen plans are made."""
        return self.hold * max(1, _PLANS // len(self.problem.states))

    def recall(self, leaves: Sequence[Array]) -> "_Held":
        """Refuse: what a pilot has planned is no part of the moment.

        Raises:
            SimulationError: always.
        """
        raise SimulationError("a run whose inputs are planned cannot go on from what was kept.")

    def start(self) -> "_Held":
        """Return the moment at which the run begins, before the pilot gives any input."""
        x = jnp.asarray(self.problem.states)
        still = jnp.zeros((len(x), len(self.problem.model.input_names)), x.dtype)
        return _Held(0, x, still, jnp.zeros(len(x), bool))

    def advance(self, now: "_Held", counts: Array, reference: Array | None) -> Chunk:
        """Store frames and take steps, until a pilot stops or a state is not finite."""
        made = _Made(self.problem.meter.nothing(), now.step, reference)
        try:
            for count in counts:
                now = self._frame(now, int(count), made)
                if not np.isfinite(made.states[-1]).all():
                    break
        except Stopped as reason:
            made.stopped = f"The run was stopped, since {reason}"
        except KeyboardInterrupt:
            made.stopped = "The run was interrupted"
        return made.chunk(now)

    def _frame(self, now: "_Held", count: int, made: "_Made") -> "_Held":
        """Store a frame and take `count` steps; query the pilot wherever a hold begins."""
        end = now.step + count
        try:
            # The last frame has no steps after it, and so no plan of its own.
            now = self._query_pilot(now) if count else now
        finally:
            # Where the pilot stops right here, the frame is kept with the inputs that led to it.
            if now.step or now.fresh:
                made.store(now)
        while now.step < end:
            now = self._query_pilot(now)
            # To the next frame or the next plan, whichever comes first.
            steps = min(end, (now.step // self.hold + 1) * self.hold) - now.step
            states, sums = self._hold(now, steps, made)
            made.sums = made.sums.plus(sums)
            now = now._replace(step=now.step + steps, states=states, fresh=False)
            # No solver is given a state that is not finite: it would fail, and count as a failure.
            if not np.isfinite(np.asarray(states)).all():
                return now
        return now

    def _hold(self, now: "_Held", steps: int, made: "_Made") -> tuple[States, Sums]:
        """Return the states after `steps` steps under held inputs, and the sums over them."""
        # As one array, so that another step or length compiles nothing again.
        span = np.array([now.step, made.first, steps], np.int32)
        problem, reference = self.problem, made.reference
        return _hold_inputs(problem.motion, problem.meter, now[1:4], jnp.asarray(span), reference)

    def _query_pilot(self, now: "_Held") -> "_Held":
        """Return the moment with the pilot's inputs, where a hold begins and they are not new."""
        if now.fresh or now.step % self.hold:
            return now
        # Solvers work in float64, and so are the states that they start from.
        wanted = jnp.asarray(self.pilot(now.step, np.asarray(now.states, np.float64)))
        inputs = self.problem.motion.deliver(wanted.astype(now.states.dtype))
        # To the bit, as `limit` returns what fits.
        limited = jnp.any(inputs != wanted, axis=1)
        return now._replace(inputs=inputs, limited=limited, fresh=True)


class _Held(NamedTuple):
    """A moment: the step, the states (N, n), the inputs (N, m) that are held and who is limited.

    `fresh` says that the pilot gave them at this very step.
    """

    step: int
    states: States
    inputs: Inputs
    limited: jax.Array
    fresh: bool = False


@final
class _Made:
    """The frames and sums of a chunk while it is flown."""

    def __init__(self, sums: Sums, first: int, reference: Array | None) -> None:
        self.states: list[Array] = []
        self.inputs: list[Array] = []
        self.sums, self.first, self.reference = sums, first, reference
        self.stopped: str | None = None

    def store(self, now: _Held) -> None:
        """Store a frame."""
        self.states.append(np.asarray(now.states, np.float64))
        self.inputs.append(np.asarray(now.inputs, np.float64))

    def chunk(self, now: _Held) -> Chunk:
        """Return what was made."""
        shape = np.shape(now.states), np.shape(now.inputs)
        states, inputs = (
            np.array(rows).reshape(len(rows), *each)
            for rows, each in zip((self.states, self.inputs), shape, strict=True)
        )
        return Chunk(now, states, inputs, on_host(self.sums), self.stopped)


@cached_jit
def _hold_inputs(
    motion: Motion,
    meter: Meter,
    held: tuple[States, Inputs, jax.Array],
    span: jax.Array,
    reference: Array | None,
) -> tuple[States, Sums]:
    """Return the states after some steps under held inputs, and the sums over them.

    `held` are states, inputs and who is limited; `span` (3,) is the step, the first step that the
    reference speaks of, and the number of steps.
    """
    states, inputs, limited = held

    def one(step: jax.Array, done: tuple[States, Sums]) -> tuple[States, Sums]:
        x, sums = done
        wanted = reference_at(reference, step - span[1], x)
        # An input that is held does not alternate.
        read = meter.read(step, x, inputs, limited, jnp.zeros_like(limited), wanted)
        return motion.advance(x, inputs, step), sums.plus(read)

    return jax.lax.fori_loop(span[0], span[0] + span[2], one, (states, meter.nothing()))
