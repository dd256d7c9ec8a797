"""Guarantee for a law whose gain turns with the leader's heading.

Where f and g turn with the heading, the guarantee for errors at the trim holds at any constant
heading. A heading that turns at a steady rate w about a state of rest in the turning axes
leaves delta' = (A - w G - c lambda B R^-1 B'P) delta, with A and B taken there: constant again.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.heading_symmetry import (
    heading_gap,
    heading_index,
    heading_of,
    state_turn,
)
from echelon.agents.models.model import ControlAffine
from echelon.core.compiled import cached_jit
from echelon.core.digits import about, at_least, at_most
from echelon.core.rational import bisect
from echelon.core.statement import Hypothesis, Statement, fails, holds
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.guarantees.promises.case import Case
from echelon.laws.law import gain_of
from echelon.simulation.engine.law_drive import Laws
from echelon.synthesis.certificates.lmi import rate_of
from echelon.synthesis.gains.gain import Gain

_NAME = Hypothesis.HEADING_FRAME
_ROUNDS, _RESIDUAL = 20, 1e-10
"""Newton's, and what may be left of the rates, in units of the states."""
_HALVINGS = 20


def turns_with_heading(case: Case) -> bool:
    """Tell whether the followers' law turns."""
    drive = case.parts.drive
    return isinstance(drive, Laws) and drive.follower.turning


def turning(case: Case) -> Iterator[Statement]:
    """Yield whether small errors shrink in turns as fast as the leader's; nothing without any."""
    if not turns_with_heading(case):
        return
    model, kind = case.parts.model, Kind.SAMPLES
    name, gap = heading_of(model).state, heading_gap(model)
    text = f"f and g turn with `{name}`, up to {at_least(gap, 1)} at samples, so the law acts at "
    text += f"any `{name}` as at the trim"
    slowest = slowest_in_turns(case)
    if not slowest:
        yield holds(_NAME, kind, text, gap, f"gap {at_least(gap, 1)}")
        return
    worst = max(slowest, key=lambda rate: slowest[rate])
    number = slowest[worst], f"{at_least(slowest[worst])} 1/s at {about(worst)} rad/s"
    if slowest[worst] < 0.0:
        rate = at_most(-slowest[worst])
        text += f"; in a steady turn of {about(worst)} rad/s modes decay at {rate} 1/s"
        yield holds(_NAME, kind, text, *number)
        return
    text = f"in a steady turn of {about(worst)} rad/s, as on the leader's path, the disagreement "
    text += "does not decay"
    fastest = _fastest(case, worst)
    remedy = (
        f"turn no faster than {at_most(fastest)} rad/s" if fastest > 0.0 else "use another gain"
    )
    yield fails(_NAME, kind, text, *number, remedy=remedy, reason=text)


def turns_in_words(case: Case) -> str:
    """Return what the heading of the leader may do besides; nothing where no law turns."""
    if not turns_with_heading(case):
        return ""
    rates = [about(rate) for rate in slowest_in_turns(case)]
    steady = f" or to a steady turn at {' or '.join(rates)} rad/s" if rates else ""
    return f"{steady}, at any `{heading_of(case.parts.model).state}`"


def slowest_in_turns(case: Case) -> dict[float, float]:
    """Return the slowest mode (1/s) in steady turns at the least and largest rate of the path.

    Of graphs that take turns it is what the sum of all delta'P delta promises, halved (T8).
    """
    if not turns_with_heading(case):
        return {}
    rates = case.frozen.turns if case.frozen else ()
    modes = {rate: slowest_in_turn(case, rate) for rate in rates}
    return {rate: slowest for rate, slowest in modes.items() if slowest is not None}


def slowest_in_turn(case: Case, rate: float) -> float | None:
    """Return the slowest mode in a steady turn (rad/s) about the trim, 1/s; None without a turn."""
    model, loop, gain = case.parts.model, case.loop, case.parts.drive.gain
    assert isinstance(case.parts.drive, Laws) and isinstance(gain, Gain)
    there = steady_turn(model, rate)
    if there is None:
        return None
    A, B = (np.asarray(part) for part in _slopes(model, *map(jnp.asarray, there)))
    A = A - rate * state_turn(model).slope
    K = gain.R_inverse @ B.T @ gain.P
    gains = [loop.inner + strength * K for strength in loop.closed.strengths]
    own = gain_of(case.parts.drive.leader)
    gains += [] if own is None else [own.coupling * own.R_inverse @ B.T @ own.P]
    slowest = float(np.linalg.eigvals(A - B @ np.array(gains)).real.max())
    if case.parts.graph.schedule is None:
        return slowest
    # Decaying modes of each graph do not suffice; one sum that falls on all of them does.
    felt = 2.0 * gain.coupling * case.parts.graph.spectrum().proved
    return max(slowest, -rate_of(gain.P, (A - B @ loop.inner)[None], B, gain.R, felt))


def steady_turn(model: ControlAffine, rate: float) -> tuple[Array, Array] | None:
    """Return a state (n,) and a normalized input (m,) near the trim that turn on the spot.

    In axes that turn at a rate (rad/s) nothing moves there: f + g u = rate (e + G x), where e is 1
    at the heading. None where Newton's method, by least changes from the trim, finds none.
    """
    n, z = len(model.state_names), np.concatenate([model.trim[0], np.zeros(len(model.input_names))])
    for _ in range(_ROUNDS):
        rest, slope = map(np.asarray, _left(model, jnp.asarray(z), jnp.asarray(rate)))
        if np.abs(rest).max() <= _RESIDUAL:
            return z[:n], z[n:]
        if not (np.isfinite(rest).all() and np.isfinite(slope).all()):
            return None
        z = z - np.linalg.lstsq(slope, rest, rcond=None)[0]
    return None


@cached_jit
def _left(model: ControlAffine, z: jax.Array, rate: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return how a state and a normalized input z (n + m,) move in turning axes, with the slope."""
    n, spin = len(model.state_names), jnp.asarray(state_turn(model).slope)

    def left(z: jax.Array) -> jax.Array:
        x, v = z[:n], z[n:]
        moved = model.velocity(x, model.physical(v)) - rate * (spin @ x)
        return moved.at[heading_index(model)].add(-rate)

    return left(z), jax.jacfwd(left)(z)


@cached_jit
def _slopes(model: ControlAffine, x: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the slopes of the motion at a state and a normalized input, A (n, n) and B (n, m)."""

    def motion(x: jax.Array, v: jax.Array) -> jax.Array:
        return model.velocity(x, model.physical(v))

    return jax.jacfwd(motion, (0, 1))(x, v)


def _fastest(case: Case, rate: float) -> float:
    """Return up to which rate of a turn this way modes decay, rad/s, by halving."""

    def decays(size: float) -> bool:
        slowest = slowest_in_turn(case, float(np.copysign(size, rate)))
        return slowest is not None and slowest < 0.0

    return bisect(decays, 0.0, abs(rate), _HALVINGS)
