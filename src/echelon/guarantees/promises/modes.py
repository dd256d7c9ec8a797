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
from echelon.core.compiled import cached_jit
from echelon.core.digits import about, at_least, at_most
from echelon.core.linear import sampled_radius
from echelon.core.rational import bisect
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded, vacuous
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem, amount
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.closed_loop import LinearLoop
from echelon.guarantees.promises.frozen_laws import longest_step
from echelon.laws.law import gain_of
from echelon.simulation.engine.law_drive import Laws
from echelon.synthesis.certificates.lmi import rate_of
from echelon.synthesis.certificates.margins import detectability
from echelon.synthesis.gains.gain import Gain

# ---- a law whose gain turns with the heading -----------------------------------------------------
# Where f and g turn with the heading, the guarantee for errors at the trim holds at any constant
# heading. A heading that turns at a steady rate w about a state of rest in the turning axes leaves
# delta' = (A - w G - c lambda B R^-1 B'P) delta, with A and B taken there: constant again.

_NAME = Hypothesis.HEADING_FRAME
_ROUNDS, _RESIDUAL = 20, 1e-10
"""Newton's, and what may be left of the rates, in units of the states."""
_HALVINGS = 20


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
    """Return the slowest mode (1/s) in steady turns at the least and largest rate of the path.

    Of graphs that take turns it is what the sum of all delta'P delta promises, halved (T8).
    """
    if not turns_with_heading(case):
        return {}
    rates = case.frozen.turns if case.frozen else ()
    modes = {rate: slowest_in_turn(case, rate) for rate in rates}
    return {rate: slowest for rate, slowest in modes.items() if slowest is not None}


def slowest_in_turn(case: GuaranteeInputs, rate: float) -> float | None:
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


def _fastest(case: GuaranteeInputs, rate: float) -> float:
    """Return up to which rate of a turn this way modes decay, rad/s, by halving."""

    def decays(size: float) -> bool:
        slowest = slowest_in_turn(case, float(np.copysign(size, rate)))
        return slowest is not None and slowest < 0.0

    return bisect(decays, 0.0, abs(rate), _HALVINGS)


# ---- lines of a check ----------------------------------------------------------------------------

_LINEAR = Kind.LINEARIZATION
_GROWS = "with the input held over the step `dt` the disagreement grows"
_IN_TURNS = "on one of the graphs errors are multiplied by {} a step in the norm of P"
_INTEGRATOR = "errors grow in steps of the integrator"
_NO_SUM = "no sum of squares is known that decreases in held steps on all graphs"
_UNDECIDED = "not every mode is shown to decay"
_SUBSTEPS = (2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ON_PATH = "spectral radius {} a step along the leader's path"
_AT_STARTS = "spectral radius {} a step where agents start"
_NOT_STABLE = "the disagreement does not decay at the trim"
_BENT = "the model is not differentiable at the trim and has no modes there"


def modes(case: GuaranteeInputs) -> Iterator[Statement]:
    """Yield what a promise rests on near the trim, as the model has modes there or bends."""
    yield from _linear(case) if case.smooth or not case.governed else _bent(case)


def _linear(case: GuaranteeInputs) -> Iterator[Statement]:
    yield _detectable(case)
    yield _coupled(case)
    yield _decaying(case)
    yield _along(case)
    yield from turning(case)
    yield sampling_line(case)
    if case.parts.graph.schedule is not None:
        yield _taking_turns(case)


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
        yield holds(Hypothesis.DISAGREEMENT_DECAY, region.kind, text, rate, f"{at_least(rate)} 1/s")
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
        return holds(name, Kind.SAMPLES, text, radius, dt_text)
    text = f"the step `dt` = {dt:g} s is too long for this gain: {text}"
    remedy = "shorten `simulation.dt`, or lower the gain"
    return fails(name, Kind.SAMPLES, text, radius, dt_text, remedy=remedy, reason=_GROWS)


# ---- where it has a linearization ---------------------------------------------------------------


def _detectable(case: GuaranteeInputs) -> Statement:
    model, loop, name = case.parts.model, case.loop, Hypothesis.DETECTABLE
    if not case.governed:
        return unneeded(name, _LINEAR, "the law has no P")
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
    if edge is None:
        return holds(Hypothesis.COUPLING, Kind.PROOF, "no edge is known", c, f"c {about(c, 4)}")
    number = c, f"c {about(c, 4)}, edge {at_least(edge, 4)}"
    if c >= edge:
        text = "from the edge on every mode decays: near the trim, and of linear agents anywhere"
        return holds(Hypothesis.COUPLING, Kind.PROOF, text, *number)
    text = f"coupling {about(c, 4)} is below the edge {at_least(edge, 4)} "
    text += "of what this gain guarantees"
    remedy = f"raise `coupling` to {at_least(edge, 4)} or more"
    return fails(Hypothesis.COUPLING, Kind.PROOF, text, *number, remedy=remedy)


def _decaying(case: GuaranteeInputs) -> Statement:
    """Whether every mode of the network decays; `every` covers what lies between extremes."""
    name, loop = Hypothesis.DISAGREEMENT_DECAY, case.loop
    if not case.governed:
        drive = case.parts.drive
        text = f"no theorem covers `{type(drive).__name__}`"
        remedy = "use laws that a theorem covers"
        if isinstance(drive, Laws) and drive.metric(case.parts.model) is not None:
            text = "the model's `difference` of two states that are close is not x - y"
            remedy = "let `difference` wrap angles, and be x - y else"
        elif isinstance(drive, Laws):
            text, remedy = "the followers' law does not act on the disagreement", "use `consensus`"
        return fails(name, _LINEAR, text, remedy=remedy, reason=text)
    text = f"over {amount(loop.certificate.modes, 'eigenvalue')} of the graph"
    if case.fed_by_parents:
        text = "over the edges' weights, as parents' inputs are fed forward"
    elif len(loop.closed.eigenvalues) > loop.certificate.modes:
        text = f"at lambda_min and lambda_max{'; all between decay' if loop.every else ''}"
    number = loop.slowest, f"{at_least(loop.slowest)} 1/s"
    if loop.every:
        return holds(name, _LINEAR, text, *number)
    text = f"not every mode decays, {text}"
    edge = loop.certificate.edge
    remedy = "another gain, coupling or model"
    remedy = remedy if edge is None else f"a coupling of {at_least(edge, 4)} or more"
    reason = "the disagreement does not decay"
    return fails(name, _LINEAR, text, *number, remedy=remedy, reason=reason)


def _taking_turns(case: GuaranteeInputs) -> Statement:
    """Stable modes of each do not say so; a sum of squares that falls on all of them does (T8)."""
    name, loop = Hypothesis.SWITCHING, case.loop
    edge, c, common = loop.certificate.edge, loop.closed.coupling, loop.common
    if not case.governed:
        text = "no theorem covers this law on switching graphs"
        return fails(name, _LINEAR, text, remedy="use `consensus`", reason=text)
    if _has_sum(loop) and common is not None:
        text = "sum_i delta_i'P delta_i increases on no graph, whenever they switch"
        rate = max(0.0, common.rate)
        return holds(name, _LINEAR, text, rate, f"{at_most(rate)} 1/s")
    text = "no one P is known that serves all graphs of the schedule"
    remedy = "use the law `stopping-point`"
    if edge is not None and not c >= edge:
        remedy = f"raise `coupling` to {at_least(edge, 4)} or more, or {remedy}"
    return fails(name, _LINEAR, text, remedy=remedy, reason=text)


def _has_sum(loop: LinearLoop) -> bool:
    """Tell whether a sum of squares is known that increases on no graph of a schedule."""
    edge, common = loop.certificate.edge, loop.common
    # At the edge the sum may only stay; what feels nothing then decays by detectability.
    enough = edge is not None and loop.closed.coupling >= edge
    return enough and common is not None and common.weakest > 0.0


def _along(case: GuaranteeInputs) -> Statement:
    """Whether the laws are stable where the reference takes them, frozen there: no proof."""
    name, frozen = Hypothesis.ALONG_PATH, case.frozen
    if not (case.loop.every and case.governed):
        return unneeded(name, Kind.SAMPLES, _NOT_STABLE)
    if frozen is None or not frozen.on_path:
        text = "the leader rests at the trim, or follows no path of its own"
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


def sampling_line(case: GuaranteeInputs) -> Statement:
    """Whether it still decays in steps of the integrator that runs, with the input held."""
    name, loop, settings = Hypothesis.SAMPLING, case.loop, case.settings
    if not (loop.every and case.governed):
        return unneeded(name, _LINEAR, _NOT_STABLE, None, f"dt {settings.dt:g} s")
    radius, printed = loop.radius(settings), settings.integrator == "printed"
    goals = np.asarray(case.parts.model.trim[0], float) + case.parts.formation.offsets
    if printed and goals.any():
        text = "`printed` takes f + g u as the next state, which ignores the goals"
        return _step_line(case, np.inf, text, "use `simulation.integrator: rk4`")
    where = f"spectral radius {{}} a step, {loop.where}"
    radii = {where: radius} | ({_IN_TURNS: loop.growth(settings)} if _has_sum(loop) else {})
    if case.frozen and not printed:
        radii |= zip((_ON_PATH, _AT_STARTS), case.frozen.radii(settings))
    where = next((x for x, one in radii.items() if not one < 1.0), where)
    text, reasons = where.format(at_least(radii[where], 4)), {_AT_STARTS: "", _IN_TURNS: _NO_SUM}
    if printed:
        return _step_line(case, radii[where], text, "use `simulation.integrator: rk4`")
    exact = loop.radius(settings, exact=True)
    if radii[where] < 1.0 <= exact:
        # Exactly 1 stands for an interval of eigenvalues that are not all shown to decay.
        what = f"the spectral radius is {at_least(exact, 4)} a step" if exact > 1.0 else _UNDECIDED
        text = f"the integrator damps what the exact flow may not: there {what}"
        reason = _GROWS if exact > 1.0 else f"in the exact flow {_UNDECIDED}"
        return _step_line(case, exact, text, "shorten `simulation.dt`", reason)
    if not radius < 1.0 and exact < 1.0:
        text = f"the integrator, but not the exact flow, grows in such steps: {text}"
        return _step_line(case, radius, text, _by_substeps(case), _INTEGRATOR)
    # At the starts it lasts a moment, and a guarantee is for starts near the goals.
    return _step_line(case, radii[where], text, "", reasons.get(where, _GROWS))


def _by_substeps(case: GuaranteeInputs) -> str:
    settings = case.settings
    tried = (settings._replace(substeps=k) for k in _SUBSTEPS if k > settings.substeps)
    enough = next((x.substeps for x in tried if case.loop.radius(x) < 1.0), None)
    if enough is None:
        return "shorten `simulation.dt`"
    return f"set `simulation.substeps: {enough}`, or shorten `simulation.dt`"


def _step_line(
    case: GuaranteeInputs, radius: float, text: str, remedy: str, reason: str = _GROWS
) -> Statement:
    dt = case.settings.dt
    number = radius, f"dt {dt:g} s"
    if radius < 1.0:
        return holds(Hypothesis.SAMPLING, _LINEAR, text, *number)
    longest = 0.0 if remedy else longest_step(case.loop, case.frozen, case.settings)
    if 0.0 < longest < dt:
        text = f"the step `dt` = {dt:g} s is too long for this gain: {text}"
        remedy = f"shorten `simulation.dt` below {at_most(longest)} s"
    remedy = remedy or "another gain; no shorter `simulation.dt` is known to suffice"
    return fails(Hypothesis.SAMPLING, _LINEAR, text, *number, remedy=remedy, reason=reason)
