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
from echelon.core.words import Kind
from echelon.laws.law import LocalView
from echelon.laws.stopping_point import StoppingPoint
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.motion import Limited, PlantStep, Unlimited, motors_of

# ---- a step of one agent that knows its own state late -------------------------------------------
# With what it hears as an input h it is s+ = A s + B y + E z, z = d o - h, o = F y + G s, where y
# is its state some steps ago and o its deviation. With z = own * o it decays where no zero of det(1
# - own T(z)) lies outside of the unit circle, with T from z to o: those are counted by the turns of
# the determinant along the circle (Nyquist), for all factors at once.

EDGE = 1.0 - 1e-9
"""Of a spectral radius: what rounding leaves of 1."""
_DECAYED, _LONGEST = 1e-6, 50_000
"""Of a response, beyond which it is not summed, and after how many steps nothing is known of it."""
_ALONG, _NEAR, _CLOSE = 1000, 40, 0.1
"""Points of half a circle, twice, and beside each eigenvalue so near to it."""
_TURN, _ROUNDS = 1.0, 6
"""rad from a point to the next; where it is more, points are added, so many times."""
_CHUNK = 32
"""Factors that are looked at together."""


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

    def response(self, delay: int, angles: Array) -> Array:
        """Return the eigenvalues (K, m) of T on the circle at angles (K,), rad."""
        z, n = EDGE * np.exp(1j * angles)[:, None, None], self.states
        late = z**-delay
        whole = z * np.eye(len(self.A)) - self.A
        whole[:, :, :n] -= late * self.B
        s = np.linalg.solve(whole, np.broadcast_to(self.E, (len(angles), *self.E.shape)))
        # In an order that is the same from point to point where they are apart.
        return np.sort(np.linalg.eigvals(self.G @ s + late * (self.F @ s[:, :n])), axis=1)


def all_decay(step: LateStep, own: Array, between: bool, delay: int) -> bool:
    """Tell whether a step decays for each of many factors.

    Args:
        step: of one agent.
        own: (K,) the factors, ascending by their real parts; of a conjugate pair one.
        between: whether those between the least and the largest count, all real.
        delay: in steps.
    """
    alone = np.linalg.eigvals(step.loop(0.0, delay))
    values = _resolved(step, own, delay, angles_beside(alone))
    turns, most = _turns(values, own)
    smooth = (most <= _TURN).all() and (turns == (np.abs(alone) >= EDGE).sum()).all()
    return bool(smooth and (not between or _joined(values, own)))


def _resolved(step: LateStep, own: Array, delay: int, angles: Array) -> Array:
    """Return T (K, m) at angles, and at more of them where a determinant turns quickly."""
    values = step.response(delay, angles)
    for _ in range(_ROUNDS):
        rough = np.flatnonzero(_turns(values, own)[1].max(axis=0) > _TURN)
        more = angles[rough, None] + np.diff(angles)[rough, None] * np.array([0.25, 0.5, 0.75])
        if not len(rough):
            break
        values = np.concatenate([values, step.response(delay, more.reshape(-1))])
        angles = np.concatenate([angles, more.reshape(-1)])
        order = np.argsort(angles)
        angles, values = angles[order], values[order]
    return values


def angles_beside(modes: Array) -> Array:
    """Return angles from 0 to pi, closer to each other near eigenvalues by the circle."""
    half = np.linspace(0.0, np.pi, _ALONG), np.geomspace(1e-12, np.pi, _ALONG)
    near = modes[(np.abs(np.abs(modes) - 1.0) < _CLOSE) & (np.imag(modes) >= 0.0)]
    widths = np.maximum(np.abs(np.abs(near) - 1.0), 1e-9)[:, None] * np.geomspace(0.01, 100, _NEAR)
    beside = (np.angle(near)[:, None] + np.hstack([-widths, widths])).reshape(-1)
    return np.unique(np.concatenate([*half, beside[(beside > 0.0) & (beside < np.pi)]]))


def _turns(values: Array, own: Array) -> tuple[Array, Array]:
    """Return the turns (K,) of determinants of T (T + 1, m), and the most of each step (K, T)."""
    turns, most = np.zeros(len(own)), np.zeros((len(own), len(values) - 1))
    for k in range(0, len(own), _CHUNK):
        # The other half is that of the conjugate factors.
        for factors in (own[k : k + _CHUNK], np.conj(own[k : k + _CHUNK])):
            each = 1.0 - factors[:, None, None] * values
            angle = np.angle(each[:, 1:] / each[:, :-1])
            turns[k : k + _CHUNK] += angle.sum(axis=(1, 2)) / (2.0 * np.pi)
            here = most[k : k + _CHUNK]
            np.maximum(here, np.abs(angle).max(axis=2), out=here)
    return np.round(turns), most


def _joined(values: Array, own: Array) -> bool:
    """Each 1 - own * value is linear in the factor, so that it passes 0 only in half a turn."""
    each = 1.0 - own[:, None, None] * values
    return bool((np.abs(np.angle(each[1:] / each[:-1])) < 0.5 * np.pi).all())


# ---- how late an agent's own state may be --------------------------------------------------------

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
    dt, effects = case.problem.settings.dt, case.world.effects
    lag, delay = effects.lag, round(effects.delay / dt)
    if not lag and not delay:
        return None
    name, kind = Hypothesis.OWN_STATE, Kind.LINEARIZATION
    if case.heard is not None and len(case.own) > _FEW:
        text = "no margin is known of agents that hear each other with many sums of weights"
        return unneeded(name, kind, text)
    step = late_step(case.problem, case.law, lag)
    text = f"own state {about(1e3 * delay * dt)} ms late, " * bool(delay)
    text += (
        f"lag {about(1e3 * lag)} ms, " * bool(lag) + "without the estimator, " * effects.estimated
    )
    text += f"inputs held for {about(1e3 * dt)} ms: "
    if effects.other_agents:
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
    most = min(round(_MOST / case.problem.settings.dt), (_LARGEST - len(step.A)) // step.states)
    return last_delay(lambda delay: _decays(case, step, delay), most, _EACH)


def last_delay(decays: Callable[[int], bool], most: int, each: int) -> int:
    """Return the last delay with which all that are tried decay; -1 for none.

    Up to `each` all are tried, and then every tenth part of it, up to `most`.
    """
    last = -1
    while last < most:
        more = min(most, last + 1 + (last // 10 if last >= each else 0))
        if decays(more):
            last = more
            continue
        # The last one that decays, between one that does and one that does not.
        while more - last > 1:
            middle = (last + more) // 2
            last, more = (middle, more) if decays(middle) else (last, middle)
        break
    return last


def _decays(case: OwnCase, step: LateStep, delay: int) -> bool:
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
    limiter = Limited() if settings.limits else Unlimited()
    how = settings.dt, settings.integrator, limiter, settings.substeps, motors_of(motors)
    loop = assemble(problem._replace(motion=PlantStep(model, *how)), law, law)
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
    start, whole = ravel_pytree((rest, level, loop.motion.begin(rest)))
    zero = jnp.zeros(len(law.ready.stiffness))

    def deviation(s: jax.Array, y: jax.Array) -> jax.Array:
        return law.signal(model, y, 0.0 * y, whole(s)[1])

    def moved(s: jax.Array, y: jax.Array, z: jax.Array) -> jax.Array:
        x, memory, motors = whole(s)
        view = LocalView(jnp.zeros(()), y, 0.0 * y, z, zero, loop.motion.dt)
        action = loop.laws.act(model, loop.motion, law, view, memory, False)
        first = jnp.zeros((), jnp.int32)
        x, motors = loop.motion.move(motors, x, action.input, first, first)
        return ravel_pytree((x, action.memory, motors))[0]

    for _ in range(_STEADY):
        start = moved(start, rest, zero)
    slopes = jax.jacfwd(moved, (0, 1, 2))(start, rest, zero)
    return *slopes, *jax.jacfwd(deviation, (0, 1))(start, rest)
