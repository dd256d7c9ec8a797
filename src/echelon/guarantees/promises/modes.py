"""Hypotheses on the modes of the loop: at the trim, along the leader's path, and when sampled."""

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
from echelon.agents.models.relative_equilibrium import moves, path_states
from echelon.agents.models.straight_range import is_straight
from echelon.core.compiled import cached_jit
from echelon.core.digits import about, at_least, at_most
from echelon.core.linear import newton_least, sampled_radius
from echelon.core.rational import bisect
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded, vacuous
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem, amount
from echelon.guarantees.local.local_certificate import LocalCertificate
from echelon.guarantees.local.local_lines import local_lines
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.speeds import slowest_about, speed_lines
from echelon.simulation.engine.law_drive import Laws
from echelon.synthesis.certificates.margins import detectability

# ---- a law whose gain turns with the heading -----------------------------------------------------
# Where f and g turn with the heading, the guarantee for errors at the trim holds at any constant
# heading. A heading that turns at a steady rate w about a state of rest in the turning axes leaves
# delta' = (A - w G - c lambda B R^-1 B'P) delta, with A and B taken there: constant again.

_NAME = Hypothesis.HEADING_FRAME
_HALVINGS = 20
_FREE = 1e6
"""How much rather a place is changed than a state that the motion depends on."""


def turns_with_heading(case: GuaranteeInputs) -> bool:
    """Tell whether the followers' law turns."""
    drive = case.parts.drive
    return isinstance(drive, Laws) and drive.follower.turning


def turning(case: GuaranteeInputs) -> Iterator[Statement]:
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
    remedy = "use another gain"
    remedy = f"turn no faster than {at_most(fastest)} rad/s" if fastest > 0.0 else remedy
    yield fails(_NAME, kind, text, *number, remedy=remedy, reason=text)


def turns_in_words(case: GuaranteeInputs) -> str:
    """Return what the heading of the leader may do besides; nothing where no law turns."""
    if not turns_with_heading(case):
        return ""
    rates = [about(rate) for rate in slowest_in_turns(case)]
    steady = f" or to a steady turn at {' or '.join(rates)} rad/s" if rates else ""
    return f"{steady}, at any `{heading_of(case.parts.model).state}`"


def slowest_in_turns(case: GuaranteeInputs) -> dict[float, float]:
    """Return the slowest mode (1/s) in steady turns at the least and largest rate of the path."""
    if not turns_with_heading(case):
        return {}
    rates = case.frozen.turns if case.frozen else ()
    modes = {rate: slowest_in_turn(case, rate) for rate in rates}
    return {rate: slowest for rate, slowest in modes.items() if slowest is not None}


def slowest_in_turn(case: GuaranteeInputs, rate: float) -> float | None:
    """Return the slowest mode in a steady turn (rad/s) about the trim, 1/s; None without a turn."""
    there = steady_turn(case.parts.model, rate)
    return None if there is None else slowest_about(case, *there, rate)


def steady_turn(model: ControlAffine, rate: float) -> tuple[Array, Array] | None:
    """Return a state (n,) and a normalized input (m,) near the trim that turn on the spot.

    In axes that turn at a rate (rad/s) nothing moves there: f + g u = rate (e + G x), where e is 1
    at the heading. None where Newton's method, by least changes from the trim, finds none.
    """
    n, start = len(model.state_names), np.append(model.trim[0], np.zeros(len(model.input_names)))
    # Where a trim moves, its place on the circle is free, and its speed is to stay.
    free = np.ones(len(start))
    free[list(path_states(model)) if moves(model) else []] = _FREE

    def left(z: Array) -> tuple[Array, Array]:
        rest, slope = map(np.asarray, _left(model, jnp.asarray(z), jnp.asarray(rate)))
        return rest, slope

    there = newton_least(left, start, free)
    return None if there is None else (there[:n], there[n:])


@cached_jit
def _left(model: ControlAffine, z: jax.Array, rate: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return how a state and a normalized input z (n + m,) move in turning axes, with the slope."""
    n, spin = len(model.state_names), jnp.asarray(state_turn(model).slope)

    def left(z: jax.Array) -> jax.Array:
        x, v = z[:n], z[n:]
        moved = model.velocity(x, model.physical(v)) - rate * (spin @ x)
        return moved.at[heading_index(model)].add(-rate)

    return left(z), jax.jacfwd(left)(z)


def _fastest(case: GuaranteeInputs, rate: float) -> float:
    """Return up to which rate of a turn this way modes decay, rad/s, by halving."""

    def decays(size: float) -> bool:
        slowest = slowest_in_turn(case, float(np.copysign(size, rate)))
        return slowest is not None and slowest < 0.0

    return bisect(decays, 0.0, abs(rate), _HALVINGS)


# ---- lines of a check ----------------------------------------------------------------------------

_LINEAR = Kind.LINEARIZATION
_GROWS = "with the input held over the step `dt` the disagreement grows"
_NOT_STABLE = "the disagreement does not decay at the trim"
_BENT = "the model is not differentiable at the trim and has no modes there"


def modes(case: GuaranteeInputs) -> Iterator[Statement]:
    """Yield what a promise rests on near the trim, as the model has modes there or bends."""
    if case.local is None:
        yield _no_law(case)
    elif case.governed and not case.smooth:
        yield from _bent(case)
    else:
        yield from _linear(case, case.local)


def _no_law(case: GuaranteeInputs) -> Statement:
    text = f"no theorem covers `{type(case.parts.drive).__name__}`"
    remedy = "use laws that a theorem covers"
    name = Hypothesis.DISAGREEMENT_DECAY
    return fails(name, _LINEAR, text, remedy=remedy, reason=text)


def _linear(case: GuaranteeInputs, local: LocalCertificate) -> Iterator[Statement]:
    if case.governed:
        yield _detectable(case)
        yield _coupled(case)
    known = case.governed and case.loop.every and not local.holds
    shorter = case.loop.longest_step(case.settings) if known else 0.0
    yield from local_lines(case.parts, case.settings, local, shorter)
    yield _along(case)
    yield from turning(case)
    yield from speed_lines(case) if case.known and is_straight(case.parts.model) else ()


# ---- where the model bends ----------------------------------------------------------------------


def _bent(case: GuaranteeInputs) -> Iterator[Statement]:
    for name in (Hypothesis.DETECTABLE, Hypothesis.COUPLING, Hypothesis.ALONG_PATH):
        yield vacuous(name, _LINEAR, _BENT)
    region = case.region
    if region is None or region.theorem is Theorem.A5:
        yield vacuous(Hypothesis.DISAGREEMENT_DECAY, _LINEAR, _BENT)
    else:
        text = "by the slopes on all sides of the trim, where the model is not differentiable"
        rate = -region.rate
        yield holds(
            Hypothesis.DISAGREEMENT_DECAY, region.kind, text, rate, f"{at_least(rate)} 1/s", 0.0
        )
    yield _sampled_bend(case)


def _sampled_bend(case: GuaranteeInputs) -> Statement:
    """Whether each side of a bend decays in steps of the integrator, as if it were all around."""
    name, loop, settings = Hypothesis.SAMPLING, case.loop, case.settings
    dt_text = f"dt {settings.dt:g} s"
    if case.region is None or case.slopes is None:
        return vacuous(name, Kind.SAMPLES, _BENT, None, dt_text)
    A, dt = case.slopes[:, None], settings.dt
    # What the integrator damps the exact flow may not.
    exact = sampled_radius(A, loop.linear.B, loop.gains, dt)
    radius = max(exact, sampled_radius(A, loop.linear.B, loop.gains, *settings.held))
    text = f"spectral radius {at_least(radius, 4)} a step, over the slopes of all sides of the trim"
    if radius < 1.0:
        return holds(name, Kind.SAMPLES, text, radius, dt_text, 1.0)
    text = f"the step `dt` = {dt:g} s is too long for this gain: {text}"
    remedy = "shorten `simulation.dt`, or lower the gain"
    return fails(name, Kind.SAMPLES, text, radius, dt_text, 1.0, remedy=remedy, reason=_GROWS)


# ---- where it has a linearization ---------------------------------------------------------------


def _detectable(case: GuaranteeInputs) -> Statement:
    model, loop, name = case.parts.model, case.loop, Hypothesis.DETECTABLE
    rank, n = loop.certificate.observable, len(model.state_names)
    hidden = detectability(loop.linear.A, loop.linear.B.T @ loop.closed.P)
    number = rank, f"rank {rank} of {n}"
    if not hidden:
        return holds(name, _LINEAR, "z = 0 is reached", *number)
    names = sorted({k for mode in hidden for k in np.flatnonzero(np.abs(mode.direction) > 0.1)})
    along = ", ".join(f"`{model.state_names[k]}`" for k in names)
    text = f"no input feels {n - rank} of {n} directions of disagreement, and along {along} it "
    text += "does not decay by itself"
    return fails(name, _LINEAR, text, *number, remedy="choose another P")


def _coupled(case: GuaranteeInputs) -> Statement:
    edge, c = case.loop.certificate.edge, case.loop.closed.coupling
    if not case.parts.world.ideal:
        text = "an edge is known of current states and quick actuators alone"
        return unneeded(Hypothesis.COUPLING, _LINEAR, text, c, f"c {about(c, 4)}")
    if edge is None:
        return holds(Hypothesis.COUPLING, Kind.PROOF, "no edge is known", c, f"c {about(c, 4)}")
    number = c, f"c {about(c, 4)}, edge {at_least(edge, 4)}", edge
    if c >= edge:
        text = "from the edge on every mode decays: near the trim, and of linear agents anywhere"
        return holds(Hypothesis.COUPLING, Kind.PROOF, text, *number)
    text = f"coupling {about(c, 4)} is below the edge {at_least(edge, 4)} "
    text += "of what this gain guarantees"
    remedy = f"raise `coupling` to {at_least(edge, 4)} or more"
    return fails(Hypothesis.COUPLING, Kind.PROOF, text, *number, remedy=remedy)


def _along(case: GuaranteeInputs) -> Statement:
    """Whether the laws are stable where the reference takes them, frozen there: no proof."""
    name, frozen = Hypothesis.ALONG_PATH, case.frozen
    if case.local is None or not case.local.holds:
        return unneeded(name, Kind.SAMPLES, _NOT_STABLE)
    if frozen is None or not frozen.on_path:
        text = "the leader rests at the trim or follows no path, or the law remembers something"
        return unneeded(name, Kind.SAMPLES, text)
    growth, states = frozen.growth(), len(frozen.times)
    number = growth.rate, f"{at_least(growth.rate)} 1/s"
    if not growth.lost:
        text = f"small errors decay over {amount(states, 'state')} of it, "
        return holds(name, Kind.SAMPLES, f"{text}each frozen until the next", *number)
    grown = f"{about(np.exp(min(growth.most, 99.0)), 2)}-fold on a part of it"
    grown = f"at {about(growth.rate)} 1/s" if growth.rate >= 0.0 else grown
    text = f"along the leader's path the {growth.whose} errors grow {grown}, fastest at "
    text += f"{about(growth.when)} s, where {frozen.culprit} takes the law farthest from its trim"
    remedy = f"keep {frozen.culprit.partition(' ')[0]} nearer to the trim there"
    return fails(name, Kind.SAMPLES, text, *number, remedy=remedy, reason=text)
