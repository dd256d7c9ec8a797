"""How late agents may know their own states, with motors that lag and inputs that are held (T9.5).

One agent's step is linearized at the trim as it runs: law, memory, motors and integrator. With what
it hears as an input h it is s+ = A s + B y + E z, z = d o - h, o = F y + G s, where y is its state
some steps ago and o its deviation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from jax.flatten_util import ravel_pytree

from echelon.agents.world.actuator import MotorArrays
from echelon.agents.world.world import World
from echelon.core.compiled import cached_jit
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Estimation, Kind
from echelon.laws.law import LocalView
from echelon.laws.stopping_point import StoppingPoint
from echelon.simulation.step.action import act
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.loop import Loop, assemble
from echelon.simulation.step.motion import Motion

_MOST, _LARGEST = 1.0, 1000
"""Delays that are looked at, s, and matrices for them."""
_MANY = 13
"""Different factors of agents that hear each other, the leader's among them."""
_STEADY = 3
"""Steps until a memory at rest repeats."""
_EDGE = 1.0 - 1e-9
"""Of a spectral radius: what rounding leaves of 1."""
_DECAYED, _LONGEST = 1e-6, 50_000
"""Of a response, beyond which it is not summed, and after how many steps nothing is known of it."""


class LateStep(NamedTuple):
    """A step of one agent at rest, linearized; y is its state some steps ago.

    Attributes:
        A, B, E: s+ = A s + B y + E z of s = (x, memory, motors).
        G, F: its deviation o = G s + F y.
        states: how many entries of s are x.
    """

    A: Array
    B: Array
    E: Array
    G: Array
    F: Array
    states: int

    def loop(self, own: complex, delay: int) -> Array:
        """Return the matrix of a step with z = own * o, for a delay in steps."""
        A, B = self.A + own * self.E @ self.G, self.B + own * self.E @ self.F
        n, size = self.states, len(A)
        whole = np.zeros((size + n * delay, size + n * delay), np.result_type(A, own))
        whole[:size, :size] = A
        if not delay:
            whole[:size, :n] += B
            return whole
        whole[:size, size + n * (delay - 1) :] = B
        whole[size : size + n, :n] = np.eye(n)
        whole[size + n :, size:-n] = np.eye(n * (delay - 1))
        return whole

    def radius(self, own: complex, delay: int) -> float:
        """Return the spectral radius of the same."""
        return float(np.abs(np.linalg.eigvals(self.loop(own, delay))).max())

    def passed_on(self, own: float, delay: int) -> float:
        """Return the largest sum over time of |o|, over what is heard as an impulse of size own.

        It is 1 where an agent follows what it hears without going beyond it.
        """
        whole = sp.csr_array(self.loop(own, delay))
        n, size, m = self.states, len(self.A), self.E.shape[1]
        x, total = np.zeros((size + n * delay, m)), np.zeros((m, m))
        x[:size] = -own * self.E
        first = 0.0
        for _ in range(_LONGEST):
            late = x[:n] if not delay else x[-n:]
            o = np.abs(self.G @ x[:size] + self.F @ late)
            largest = float(np.abs(x).max())
            first = max(first, largest)
            total, x = total + o, whole @ x
            if largest < _DECAYED * first:
                return float(total.sum(axis=1).max())
        return np.inf


class OwnCase(NamedTuple):
    """What the margin of own states is computed of.

    Attributes:
        problem: prepared.
        world: of the run.
        law: of the followers.
        own: (K,) factors on z of single loops, real or complex: sums of weights over a network,
            eigenvalues of the graph on the ideal one.
        heard: grounded Laplacian of followers that hear each other over a network; else None.
    """

    problem: Problem
    world: World
    law: StoppingPoint
    own: Array
    heard: sp.csr_array | None


def own_delay_line(case: OwnCase) -> Statement | None:
    """Return how late own states may be; None where they are exact and motors are quick."""
    dt, world = case.problem.settings.dt, case.world
    lag = 0.0 if world.actuator is None else world.actuator.lag
    delay = 0 if world.sensing is None else round(world.sensing.delay / dt)
    if not lag and not delay:
        return None
    name, kind = Hypothesis.OWN_STATE, Kind.LINEARIZATION
    if case.heard is not None and len(case.own) > _MANY:
        text = "no margin is known of agents that hear each other with many sums of weights"
        return unneeded(name, kind, text)
    step = late_step(case.problem, case.law, lag)
    text = f"own state {1e3 * delay * dt:.3g} ms late, " * bool(delay)
    estimated = world.sensing is not None and world.sensing.estimator is not Estimation.NONE
    text += f"lag {1e3 * lag:.3g} ms, " * bool(lag) + "without the estimator, " * estimated
    text += f"inputs held for {1e3 * dt:.3g} ms: "
    if step is None:
        return unneeded(name, kind, f"{text}the model has no linearization at its trim")
    most = longest_delay(case, step)
    shown = "none" if most < 0 else f"{1e3 * most * dt:.3g} ms"
    number = max(most, 0) * dt, shown
    if most >= delay:
        text += f"the linearized loop decays with own states up to {shown} late"
        return holds(name, kind, text, *number)
    decays = "does not decay" if case.heard is None else "is not known to decay"
    text += f"the linearized loop {decays}"
    if most >= 0:
        text += f", but with own states {'that are current' if not most else f'up to {shown} late'}"
    remedy = "lower `coupling` or `roots`"
    remedy += "" if case.heard is None else ", or set `graph.directed: true`"
    return fails(name, kind, text, *number, remedy=remedy)


def longest_delay(case: OwnCase, step: LateStep) -> int:
    """Return up to which delay, in steps, the loop decays; -1 for none."""
    last, size = -1, len(step.A)
    most = min(round(_MOST / case.problem.settings.dt), (_LARGEST - size) // step.states)
    while last < most:
        # Every one at first, and then every tenth part of it.
        more = min(most, last + 1 + max(last, 0) // 10)
        if not _decays(case, step, more):
            return bisect_whole(lambda k: _decays(case, step, k), last, more)
        last = more
    return last


def bisect_whole(fits: Callable[[int], bool], low: int, high: int) -> int:
    """Return the last whole number that fits, of one that does and one that does not."""
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _decays(case: OwnCase, step: LateStep, delay: int) -> bool:
    """Tell whether every loop decays, and together those that hear each other."""
    if not all(step.radius(own, delay) < _EDGE for own in case.own):
        return False
    if case.heard is None:
        return True
    # By sums over all time, and so for messages of any age (the small-gain theorem).
    sums = case.heard.diagonal()
    passed = {d: step.passed_on(d, delay) for d in np.unique(sums).tolist()}
    gains = sp.diags_array([passed[d] / d for d in sums.tolist()])
    # Their radius is below 1 exactly if (1 - gains) x = 1 has a positive solution.
    whole = sp.csc_array(sp.eye_array(len(sums)) - gains @ (sp.diags_array(sums) - case.heard))
    x = spla.splu(whole).solve(np.ones(len(sums)))
    return bool((x > 0.0).all() and (whole @ x > 0.0).all())


def late_step(problem: Problem, law: StoppingPoint, lag: float) -> LateStep | None:
    """Return a step of a follower at the trim; None where it has no linearization."""
    settings, model = problem.settings, problem.model
    motors = MotorArrays(np.asarray(lag), *[None] * 5) if lag else None
    how = settings.dt, settings.integrator, settings.limits, settings.substeps, motors
    loop = assemble(problem._replace(motion=Motion(model, None, *how)), law, law)
    A, B, E, G, F = (np.asarray(part, float) for part in _slopes(loop, law))
    if not all(np.isfinite(part).all() for part in (A, B, E, G, F)):
        return None
    # A memory that is not used keeps its value for ever.
    moves = (np.hstack([A - np.eye(len(A)), B, E]) != 0.0).any(axis=1)
    moves[: B.shape[1]] = True
    return LateStep(A[moves][:, moves], B[moves], E[moves], G[:, moves], F, B.shape[1])


@cached_jit
def _slopes(loop: Loop, law: StoppingPoint) -> tuple[jax.Array, ...]:
    """Return A, B, E, G and F of `LateStep`."""
    model = loop.model
    rest = jnp.asarray(np.asarray(model.trim[0], float))
    level = law.initial_memory(model, rest, jnp.zeros(law.ready.weights.shape))
    start, whole = ravel_pytree((rest, level, loop.motion.begin(rest[None])))
    zero = jnp.zeros(len(law.ready.stiffness))

    def deviation(s: jax.Array, y: jax.Array) -> jax.Array:
        return law.signal(model, y, 0.0 * y, whole(s)[1])

    def moved(s: jax.Array, y: jax.Array, z: jax.Array) -> jax.Array:
        x, memory, motors = whole(s)
        view = LocalView(jnp.zeros(()), y, 0.0 * y, z, zero, loop.motion.dt)
        action = act(loop, law, view, memory, False)
        at = x[None], action.input[None], jnp.zeros((), jnp.int32), motors
        states, motors = loop.motion.advance(*at)
        return ravel_pytree((states[0], action.memory, motors))[0]

    for _ in range(_STEADY):
        start = moved(start, rest, zero)
    slopes = jax.jacfwd(moved, (0, 1, 2))(start, rest, zero)
    return *slopes, *jax.jacfwd(deviation, (0, 1))(start, rest)
