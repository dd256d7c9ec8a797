"""How late agents may know their own states, with motors that lag and inputs that are held (T9.5).

One agent's step is linearized at the trim as it runs: law, memory, motors and integrator, of the
model as the law knows it.
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
from echelon.core.digits import about, at_most
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Estimation, Kind
from echelon.guarantees.messages.delayed_step import EDGE, LateStep, all_decay
from echelon.laws.law import LocalView
from echelon.laws.stopping_point import StoppingPoint
from echelon.simulation.step.action import act
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.loop import Loop, assemble
from echelon.simulation.step.motion import Motion

_MOST, _LARGEST = 1.0, 1000
"""Delays that are looked at, s, and matrices for them."""
_FEW = 13
"""Different factors of agents that hear each other, the leader's among them."""
_EACH = 10
"""Steps up to which every delay is looked at."""
_STEADY = 3
"""Steps until a memory at rest repeats."""


class OwnCase(NamedTuple):
    """What the margin of own states is computed of.

    Attributes:
        problem: prepared.
        world: of the run.
        law: of the followers.
        own: (K,) factors on z of single loops, real or complex: sums of weights over a network,
            eigenvalues of the graph on the ideal one.
        between: whether all real factors between the least and the largest count too.
        heard: grounded Laplacian of followers that hear each other over a network; else None.
    """

    problem: Problem
    world: World
    law: StoppingPoint
    own: Array
    between: bool
    heard: sp.csr_array | None


def own_delay_line(case: OwnCase) -> Statement | None:
    """Return how late own states may be; None where they are exact and motors are quick."""
    dt, world = case.problem.settings.dt, case.world
    lag = 0.0 if world.actuator is None else world.actuator.lag
    delay = 0 if world.sensing is None else round(world.sensing.delay / dt)
    if not lag and not delay:
        return None
    name, kind = Hypothesis.OWN_STATE, Kind.LINEARIZATION
    if case.heard is not None and len(case.own) > _FEW:
        text = "no margin is known of agents that hear each other with many sums of weights"
        return unneeded(name, kind, text)
    step = late_step(case.problem, case.law, lag)
    text = f"own state {about(1e3 * delay * dt)} ms late, " * bool(delay)
    estimated = world.sensing is not None and world.sensing.estimator is not Estimation.NONE
    text += f"lag {about(1e3 * lag)} ms, " * bool(lag) + "without the estimator, " * estimated
    text += f"inputs held for {about(1e3 * dt)} ms: "
    if world.plant is not None or world.plants:
        text += "for agents as in the model, unlike these plants, "
    if step is None:
        return unneeded(name, kind, f"{text}the model has no linearization at its trim")
    most = longest_delay(case, step)
    shown = "none" if most < 0 else f"{at_most(1e3 * most * dt)} ms"
    number = max(most, 0) * dt, shown
    if most >= delay and _decays(case, step, delay):
        text += f"the linearized loop decays with own states up to {shown} late"
        text += ", at the delays that were tried" * (most > _EACH)
        return holds(name, kind, text, *number)
    decays = "does not decay" if case.heard is None else "is not known to decay"
    text += f"the linearized loop {decays}"
    if 0 <= most < delay:
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
        more = min(most, last + 1 + max(last, 0) // _EACH)
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
    # The loops of a conjugate pair mirror each other.
    own = np.unique(case.own[np.imag(case.own) >= 0.0])
    if len(own) > _FEW or case.between:
        if not all_decay(step, own, case.between, delay):
            return False
    elif not all(step.radius(each, delay) < EDGE for each in own):
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
