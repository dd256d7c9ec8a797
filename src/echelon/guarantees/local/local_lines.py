"""What the local certificate says, as lines of a check."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.core.digits import at_least, at_most
from echelon.core.linear import discretize
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.words import Kind, amount
from echelon.guarantees.local.local_certificate import FAR, Fault, LocalCertificate
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

_LINEAR = Kind.LINEARIZATION
_UNKNOWN = "it is not known what small errors do"
_CLOCK = "leave time and counts of steps out of it; a law reads `view.period` instead"


def local_lines(
    parts: Parts, settings: Settings, local: LocalCertificate, shorter: float
) -> Iterator[Statement]:
    """Yield what a guarantee near the goals rests on.

    `shorter` is a step (s) with which errors are known to end; 0 for none.
    """
    yield _repeats(parts, local)
    yield _rests(parts, local)
    yield _smooth(parts, local)
    yield _decays(parts, settings, local, shorter)
    yield _held(parts, settings, local)
    yield from _switches(parts, local)
    yield from _messages(local)


def _repeats(parts: Parts, local: LocalCertificate) -> Statement:
    """Return whether a step does the same from the same numbers, whenever it is taken."""
    name, what = Hypothesis.REPEATS, local.culprit
    if Fault.TIME in local.faults:
        text = f"`{what}` depends on time, so no one linearization holds for all steps"
        return fails(name, _LINEAR, text, remedy=_CLOCK, reason=text)
    if Fault.WHOLE in local.faults:
        text = f"`{what}` remembers whole numbers and acts by them"
        return fails(name, _LINEAR, text, remedy="remember real numbers alone", reason=text)
    if Fault.SWITCHES in local.faults:
        text = "the graph switches, and its rounded switches repeat after no whole number of steps"
        remedy = "choose a `period` that is a multiple of `simulation.dt`"
        return fails(name, _LINEAR, text, remedy=remedy, reason=text)
    if local.period == 1:
        return holds(
            name, Kind.PROOF, "every step does the same from the same numbers", 1, "1 step"
        )
    text = f"network and graph are the same again after {amount(local.period, 'step')}"
    return holds(name, Kind.PROOF, text, local.period, amount(local.period, "step"))


_RESTLESS = {
    Fault.SINGULAR: (
        "agents at rest at their goals have no finite input or message in the steps that run",
        "use models and laws with finite inputs at rest",
    ),
    Fault.NO_REST: (
        "agents at their goals do not stay there, and no place was found where they rest",
        "let the law return the trim input where nothing disagrees",
    ),
}


def _rests(parts: Parts, local: LocalCertificate) -> Statement:
    name = Hypothesis.REST
    if Fault.PLACES in local.faults:
        text = f"the step depends on where agents are: shifted as the trim moves, {local.culprit}"
        remedy = "let laws use differences of positions alone"
        return fails(name, _LINEAR, text, remedy=remedy, reason=text)
    for fault, (text, remedy) in _RESTLESS.items():
        if fault in local.faults:
            return fails(name, _LINEAR, text, remedy=remedy, reason=text)
    if Fault.OFF_GOALS in local.faults:
        text = f"agents rest {at_least(local.off)} off their goals in `{local.culprit}`"
        remedy = "let laws know the plant, or apply the trim input"
        number = local.off, f"{at_least(local.off)} off"
        return fails(name, _LINEAR, text, *number, remedy=remedy, reason=text)
    if _not_looked_at(local):
        return unneeded(name, _LINEAR, _UNKNOWN)
    text = "a formation at its goals stays there, with all that it remembers"
    return holds(name, _LINEAR, text, local.off, f"{at_least(local.off, 2)} off")


def _not_looked_at(local: LocalCertificate) -> bool:
    return bool({Fault.TIME, Fault.WHOLE, Fault.SWITCHES} & {*local.faults})


def _smooth(parts: Parts, local: LocalCertificate) -> Statement:
    name = Hypothesis.SMOOTH
    if Fault.KINK in local.faults:
        text = "what agents do bends or jumps at their goals, so there is no linearization"
        remedy = "use a law that is differentiable there"
        return fails(name, Kind.SAMPLES, text, remedy=remedy, reason=text)
    if local.radius is None:
        return unneeded(name, Kind.SAMPLES, _UNKNOWN)
    text = "values on both sides agree with the derivative of a step"
    return holds(name, Kind.SAMPLES, text)


def _decays(parts: Parts, settings: Settings, local: LocalCertificate, shorter: float) -> Statement:
    name, radius = Hypothesis.DISAGREEMENT_DECAY, local.radius
    if radius is None or {Fault.LARGE, Fault.LEADERLESS} & {*local.faults}:
        return _undecided(local)
    rate, dt = local.rate(settings.dt), settings.dt
    shown = "" if rate is None else f"{at_least(-rate)} 1/s"
    number = None if rate is None else -rate, shown, 0.0
    over = f"over {amount(local.modes, 'mode')} of the steps that run"
    if Fault.LASTING in local.faults:
        text = "the law uses a remembered number that never changes, so errors may stay"
        remedy = "let the law forget it, or act without it"
        return fails(name, _LINEAR, text, *number, remedy=remedy, reason=text)
    if Fault.ADRIFT in local.faults:
        names = ", ".join(f"`{each}`" for each in local.adrift)
        text = f"nothing drives {names} to the goal"
        remedy = "let the law act on them; of `consensus`, choose another P"
        return fails(name, _LINEAR, text, *number, remedy=remedy, reason=text)
    if Fault.UNDECIDED in local.faults:
        text = f"rounding hides whether the slowest mode decays, {over}"
        remedy = "bring the units of states and inputs nearer to each other"
        return fails(name, _LINEAR, text, *number, remedy=remedy, reason=text)
    if Fault.GROWS in local.faults:
        text = f"the spectral radius is {at_least(radius, 5)} a step of {dt:g} s, {over}"
        reason, remedy = "errors do not shrink in the steps that run", _against_growth(parts)
        if 0.0 < shorter < dt:
            reason = f"the step `dt` = {dt:g} s is too long for this gain"
            remedy = f"shorten `simulation.dt` below {at_most(shorter)} s"
        if local.exact is not None and local.exact < 1.0:
            reason = "errors grow in steps of the integrator, and not if agents move exactly"
            remedy = _by_substeps(parts, settings)
        return fails(name, _LINEAR, text, *number, remedy=remedy, reason=reason)
    text = f"spectral radius {at_least(radius, 7)} a step, {over}"
    if local.growth is not None and local.growth > 1.0 + 1e-9:
        text += f"; before, they may grow {at_least(local.growth)} times"
    return holds(name, _LINEAR, text, *number)


_TOLD = {Fault.TIME, Fault.WHOLE, Fault.SWITCHES, Fault.PLACES}
_TOLD |= {Fault.SINGULAR, Fault.NO_REST, Fault.OFF_GOALS, Fault.KINK}
"""What other lines tell."""


def _undecided(local: LocalCertificate) -> Statement:
    """Return why no radius is known; what no other line tells rules out any guarantee here."""
    name, faults = Hypothesis.DISAGREEMENT_DECAY, {*local.faults}
    if faults & _TOLD:
        return unneeded(name, _LINEAR, _UNKNOWN)
    if Fault.LARGE in faults:
        text = "the formation is too large for one matrix, and its agents are not alike"
        return fails(name, _LINEAR, text, remedy="take fewer agents", reason=text)
    text = str(next(iter(local.faults), _UNKNOWN))
    remedy = "bring the units nearer to each other, or let the slowest mode decay faster"
    if Fault.LEADERLESS in faults:
        remedy = "keep the leader to see what is guaranteed with it"
    return fails(name, _LINEAR, text, remedy=remedy, reason=text)


def _against_growth(parts: Parts) -> str:
    if not parts.world.ideal:
        return "try changes of the scenario by `echelon causes`"
    if parts.drive.gain is not None:
        return "another gain, coupling or model"
    return "let the law act against the disagreement, more or less strongly"


_SUBSTEPS = (2, 5, 10, 20, 50, 100, 200, 500, 1000)
_FOLLOWS = 1e-2
"""Of the exact flow in a step, relative: what an integrator may be off that follows it."""


def _by_substeps(parts: Parts, settings: Settings) -> str:
    """Return with how many substeps the integrator follows the plant, as a remedy."""
    plant: ControlAffine = parts.world.plant_for(parts.model)
    A, B = linearize(plant)
    exact = np.hstack(discretize(A, B, settings.dt))
    for substeps in _SUBSTEPS:
        made = np.hstack(discretize(A, B, settings.dt, settings.integrator, substeps))
        if np.abs(made - exact).max() <= _FOLLOWS * np.abs(exact).max():
            return f"set `simulation.substeps: {substeps}`, or shorten `simulation.dt`"
    return "shorten `simulation.dt`"


def _held(parts: Parts, settings: Settings, local: LocalCertificate) -> Statement:
    """Return whether errors shrink if agents move exactly while inputs are held."""
    name, exact, dt = Hypothesis.SAMPLING, local.exact, f"dt {settings.dt:g} s"
    if exact is None or local.radius is None:
        text = "no exact flow of a step is known" if local.radius is not None else _UNKNOWN
        return unneeded(name, _LINEAR, text, None, dt)
    text = f"spectral radius {at_least(exact, 7)} a step if agents move exactly under held inputs"
    if exact < 1.0:
        return holds(name, _LINEAR, text, exact, dt, 1.0)
    reason, remedy = "", _against_growth(parts)
    if local.radius < 1.0:
        text += "; the integrator damps what grows"
        reason = "if inputs are held and agents move exactly, errors grow"
        remedy = "shorten `simulation.dt`, or lower the gain"
    return fails(name, _LINEAR, text, exact, dt, 1.0, remedy=remedy, reason=reason)


def _switches(parts: Parts, local: LocalCertificate) -> Iterator[Statement]:
    """Yield which of the graphs decide; nothing of one that stays."""
    schedule, name = parts.graph.schedule, Hypothesis.SWITCHING
    if schedule is None:
        return
    if local.radius is None:
        yield unneeded(name, _LINEAR, _UNKNOWN)
        return
    if schedule.period is not None:
        text = f"the product of all graphs over {amount(local.period, 'step')} decides"
        yield holds(name, _LINEAR, text, local.period, amount(local.period, "step"))
        return
    since, before = at_least(schedule.starts[-1], 6), local.before
    text = f"the last graph decides, from {since} s on"
    if before is None:
        yield holds(name, _LINEAR, text)
        return
    text += f"; until then errors may grow {at_least(before)} times"
    number = before, f"{at_least(before)} times"
    if before <= FAR:
        yield holds(name, _LINEAR, text, *number)
        return
    remedy = "let the last graph begin earlier"
    yield fails(name, _LINEAR, text, *number, remedy=remedy, reason=text)


def _messages(local: LocalCertificate) -> Iterator[Statement]:
    """Yield of which ages of messages the modes are; nothing of the ideal network."""
    if local.radius is None or local.steady:
        return
    text = "messages are lost or late by chance, and modes are known of messages of one age alone"
    remedy = "leave out `loss`, `jitter` and `bursts` to see them"
    line = fails(Hypothesis.AGES, _LINEAR, text, remedy=remedy)
    yield dataclasses.replace(line, condition="every message arrives, after the same delay")
