"""At which speeds a law made for a trim that moves still holds agents, and the speeds of a path.

About steady straight motion at another speed s the disagreement obeys delta' = (A - c lambda B
R^-1 B'P) delta, with A and B taken there: constant again. The range ends where the slowest of these
modes no longer decays, where there is no such motion, or where an input is at its limit.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from echelon.agents.models.heading_symmetry import state_turn
from echelon.agents.models.linearization import Linearization
from echelon.agents.models.model import ControlAffine, position_unit
from echelon.agents.models.model_check import limited
from echelon.agents.models.relative_equilibrium import (
    moves,
    path_states,
    trim_speed,
    trim_velocity,
)
from echelon.core.compiled import cached_jit
from echelon.core.digits import about, at_least, at_most
from echelon.core.linear import newton_least
from echelon.core.rational import bisect
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.integral_modes import gain_in_use, slowest_in_axes
from echelon.simulation.engine.law_drive import Laws
from echelon.synthesis.gains.gain import Gain

_NAME = Hypothesis.SPEEDS
_MOST, _UP, _DOWN = 50.0, 61, 41
"""Of the trim's speed: the largest that is tried, and how many above and below, as far as -1."""
_HALVINGS, _DECAYS = 30, -1e-9
_ROUNDING = 1e-6
"""Of the trim's speed: what derivatives of a path leave of a speed that is constant."""
_TIMES, _SHORT, _STOPS = 2048, 1e-5, 1e-3


class SpeedRange(NamedTuple):
    """The speeds between which modes decay, what ends them in words, and that of the trim."""

    low: float
    high: float
    below: str
    above: str
    made: float

    def holds(self, speeds: Array) -> Bool[Array, " T"]:
        """Tell which speeds (T,) are in it; whoever stops is in no range that begins at 0."""
        near = _ROUNDING * self.made
        low = _STOPS * self.made if self.low == 0.0 else self.low - near
        return (speeds >= low) & (speeds <= self.high + near)


class SteadyModes(NamedTuple):
    """The slowest mode (1/s) about a steady motion, and whether limits leave its input as it is."""

    slowest: float
    delivered: bool

    @property
    def ends(self) -> str:
        """Why no larger range is known; empty where it goes on."""
        if not self.slowest < _DECAYS:
            return "modes do not decay"
        return "" if self.delivered else "an input is at its limit"


def slowest_about(case: GuaranteeInputs, x: Array, v: Array, rate: float = 0.0) -> float:
    """Return the slowest mode (1/s) about a state and a normalized input, in axes that turn."""
    model = case.parts.model
    A, B = (np.asarray(part) for part in _slopes(model, jnp.asarray(x), jnp.asarray(v)))
    turning = Linearization(A - rate * state_turn(model).slope, B)
    return slowest_in_axes(case.parts, case.loop, turning, rate)


@cached_jit
def _slopes(model: ControlAffine, x: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the slopes of the motion at a state and a normalized input, A (n, n) and B (n, m)."""

    def motion(x: jax.Array, v: jax.Array) -> jax.Array:
        return model.velocity(x, model.physical(v))

    return jax.jacfwd(motion, (0, 1))(x, v)


def modes_at(case: GuaranteeInputs, speed: float) -> SteadyModes | None:
    """Return the modes about steady motion at a speed along the trim's; None without one."""
    model, n = case.parts.model, len(case.parts.model.state_names)
    along = jnp.asarray(trim_velocity(model) / trim_speed(model))

    def left(z: Array) -> tuple[Array, Array]:
        rest, slope = _left(model, jnp.asarray(z), speed * along)
        return np.asarray(rest), np.asarray(slope)

    there = newton_least(left, np.append(model.trim[0], np.zeros(len(model.input_names))))
    if there is None:
        return None
    v = there[n:]
    u = model.physical(v)
    cut = np.abs(limited(model, u[None])[0] - u).max() > _ROUNDING * np.abs(u).max(initial=1.0)
    return SteadyModes(slowest_about(case, there[:n], v), not (case.settings.limits and cut))


@cached_jit
def _left(model: ControlAffine, z: jax.Array, w: jax.Array) -> tuple[jax.Array, jax.Array]:
    n = len(model.state_names)

    def left(z: jax.Array) -> jax.Array:
        return model.velocity(z[:n], model.physical(z[n:])) - w

    return left(z), jax.jacfwd(left)(z)


def speed_range(case: GuaranteeInputs) -> SpeedRange | None:
    """Return between which speeds about that of the trim modes decay; None if not at its own."""
    speed = trim_speed(case.parts.model)

    def fault(factor: float) -> str:
        found = modes_at(case, factor * speed)
        return "there is no steady motion" if found is None else found.ends

    if fault(1.0):
        return None
    high, above = _edge(fault, np.geomspace(1.0, _MOST, _UP))
    low, below = _edge(fault, np.linspace(1.0, -1.0, _DOWN))
    # At 0 most vehicles cannot be steered, and rounding is left of it.
    low = low if abs(low) > _ROUNDING else 0.0
    return SpeedRange(low * speed, high * speed, below, above, speed)


def _edge(fault: Callable[[float], str], factors: Array) -> tuple[float, str]:
    """Return the last factor before a fault, and which; none where there is none."""
    last = float(factors[0])
    for factor in factors[1:].tolist():
        why = fault(factor)
        if why:
            share = bisect(lambda s: not fault(last + s * (factor - last)), 0.0, 1.0, _HALVINGS)
            return last + share * (factor - last), why
        last = factor
    return last, ""


class PathSpeeds(NamedTuple):
    """Times (T,) and the speeds of a path then, along `path_states`."""

    times: Array
    speeds: Array


def path_speeds(case: GuaranteeInputs) -> PathSpeeds | None:
    """Return the speeds of the leaders' path over a run; None of leaders that follow none."""
    whole = _speeds(case, 0.0, case.settings.horizon)
    if whole is None:
        return None
    # A path may stop between two of these times.
    k = int(whole.speeds.argmin())
    near = _speeds(case, *whole.times[[max(0, k - 1), min(k + 1, _TIMES - 1)]])
    assert near is not None
    times = np.concatenate([whole.times, near.times])
    order, speeds = times.argsort(), np.concatenate([whole.speeds, near.speeds])
    return PathSpeeds(times[order], speeds[order])


def _speeds(case: GuaranteeInputs, begin: float, end: float) -> PathSpeeds | None:
    model, times = case.parts.model, np.linspace(begin, end, _TIMES)
    twice = jax.device_put(np.concatenate([times, times + _SHORT]))
    states = case.parts.drive.reference_states(model, twice)
    if states is None:
        return None
    now, soon = np.split(np.asarray(states)[:, list(path_states(model))], 2)
    return PathSpeeds(times, np.linalg.norm(soon - now, axis=1) / _SHORT)


def speed_lines(case: GuaranteeInputs) -> Iterator[Statement]:
    """Yield at which speeds the law holds, and whether the path keeps to them; none of rest."""
    model, drive = case.parts.model, case.parts.drive
    made = gain_in_use(drive.follower) if isinstance(drive, Laws) else None
    if not (moves(model) and isinstance(made, Gain)):
        return
    found, path = speed_range(case), path_speeds(case)
    if found is None:
        yield unneeded(_NAME, Kind.LINEARIZATION, "modes do not decay at the trim's own")
        return
    unit = f"{position_unit(model) or '1'}/s"
    low, high = (f"{show(x)}" for show, x in ((at_least, found.low), (at_most, found.high)))
    number = found.low, f"{low} to {high} {unit}"
    text = f"made at {about(trim_speed(model))} {unit}, modes of straight motion decay from {low} "
    text += f"({found.below or 'no slower was tried'}) to {high} {unit} "
    text += f"({found.above or 'no faster was tried'})"
    if path is None:
        yield holds(_NAME, Kind.LINEARIZATION, f"{text}; the leader follows no path", *number)
        return
    yield _compared(found, path, text, number, unit)


def _compared(
    found: SpeedRange, path: PathSpeeds, text: str, number: tuple[float, str], unit: str
) -> Statement:
    slowest, fastest = float(path.speeds.min()), float(path.speeds.max())
    outside = np.flatnonzero(~found.holds(path.speeds))
    if not len(outside):
        sizes = dict.fromkeys(about(x) for x in (slowest, fastest))
        text += f"; the path moves at {' to '.join(sizes)} {unit}"
        return holds(_NAME, Kind.LINEARIZATION, text, *number)
    speed, time = float(path.speeds[outside[0]]), float(path.times[outside[0]])
    text += f"; the path leaves that with {about(speed)} {unit} at {about(time)} s"
    stop = _first_stop(path, _STOPS * found.made)
    text += "" if stop is None else f", and stops at {about(stop)} s"
    remedy = "let the path keep to these speeds, or make the gain at another one"
    return fails(_NAME, Kind.LINEARIZATION, text, *number, remedy=remedy)


def _first_stop(path: PathSpeeds, least: float) -> float | None:
    """Return when a path is slowest in its first pause; None where it never pauses."""
    still = np.flatnonzero(path.speeds <= least)
    if not len(still):
        return None
    pause = still[still - np.arange(len(still)) == still[0]]
    return float(path.times[pause[path.speeds[pause].argmin()]])
