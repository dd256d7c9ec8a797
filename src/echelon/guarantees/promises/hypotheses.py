"""What a promise rests on, a line each: its verdict, its number, and what would be needed.

A line whose `reason` is not empty stands against any promise where it fails; the others say what is
left of one, or why.
"""

from collections.abc import Iterator, Sequence

import jax
import numpy as np

from echelon.agents.models.linearization import at_trim
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import at_limits, is_limited, trim_shortfall
from echelon.core.compiled import cached_jit
from echelon.core.errors import listing
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis, Statement
from echelon.core.types import Array, States
from echelon.core.words import Kind, Verdict
from echelon.guarantees.promises.case import Case
from echelon.guarantees.promises.leaders import apart
from echelon.guarantees.promises.modes import modes
from echelon.laws.law import Law
from echelon.simulation.step.drive import Drive
from echelon.synthesis.certificates.jacobians import offsets_are_symmetries

_LINEAR = Kind.LINEARIZATION


def hypotheses(case: Case) -> Iterator[Statement]:
    """Yield what any promise of the loop near the trim rests on."""
    yield from agent_lines(case)
    yield _symmetric(case)
    yield _smooth(case)
    yield _matched(case)
    yield from modes(case)


def agent_lines(case: Case) -> Iterator[Statement]:
    """Yield what any promise asks of the agents and their leaders."""
    yield _trim_applied(case)
    yield _trim_held(case)
    yield _exact(case)
    yield _agreement(case)


# ---- the agents and their leaders ---------------------------------------------------------------


def _trim_applied(case: Case) -> Statement:
    """Definition 1 wants f(0) = 0: about the trim it holds, if the law applies the trim input."""
    parts, name = case.parts, Hypothesis.TRIM_APPLIED
    there = np.zeros_like(parts.formation.offsets)
    size = float(np.abs(goal_drifts(parts.model, there, parts.drive)).max())
    applied = parts.drive.trimmed or not np.any(np.asarray(parts.model.trim[1], float))
    text, remedy, reason = "about the trim, whose input the law applies", "", ""
    if not applied:
        text, remedy = "the law leaves out the trim input", "set `follower.trim: true`"
        reason = "the law leaves out the trim input"
    verdict, shown = Verdict.of(applied), f"|f + g u*| {size:.2g}"
    return Statement(name, verdict, Kind.PROOF, size, shown, text, remedy, reason)


def goal_drifts(model: ControlAffine, offsets: Array, law: Law | Drive | None = None) -> Array:
    """Return the drift at the goals about the trim, (N, n), with the law's inner loop if any."""
    with precision("float64"):
        goals = np.asarray(model.trim[0], float) + offsets
        return np.asarray(_drifts(model, law, goals), np.float64)


@cached_jit
def _drifts(model: ControlAffine, law: Law | Drive | None, states: States) -> jax.Array:
    if law is None:
        return jax.vmap(model.normalized_drift)(states)
    return jax.vmap(lambda x: law.drift(model, x))(states)


def _trim_held(case: Case) -> Statement:
    """Within limits an agent holds its trim only if its actuators deliver that input."""
    model, plant, name = case.parts.model, case.parts.world.plant, Hypothesis.TRIM_WITHIN_LIMITS
    moved = case.parts.world.plant_for(model)
    if not (case.settings.limits and is_limited(moved)):
        text = "no limit acts on the inputs"
        return Statement(name, Verdict.NOT_NEEDED, Kind.PROOF, text=text)
    short = trim_shortfall(moved, np.asarray(model.trim[1], float))
    if plant is not None:
        # A heavier plant needs more than the model's trim to stay where it is.
        short |= trim_shortfall(plant)
    if not short:
        held = at_limits(moved, np.asarray(model.trim[1], float))
        if held:
            return _no_room(name, held)
        text = "the actuators deliver the input that it takes, and more either way"
        return Statement(name, Verdict.HOLDS, Kind.PROOF, text=text)
    units = dict(zip(model.input_names, model.input_units, strict=True))
    cut = [f"{got:.4g} of {asked:.4g} {units[i]}".rstrip() for i, (got, asked) in short.items()]
    text = "the actuators deliver " + ", ".join(f"`{i}` {part}" for i, part in zip(short, cut))
    worst = min(got / asked if asked else 0.0 for got, asked in short.values())
    remedy = "lighten the agents or strengthen their actuators"
    reason = f"{text}, and cannot hold the trim"
    shown = f"{100.0 * worst:.3g} %"
    return Statement(name, Verdict.FAILS, Kind.PROOF, worst, shown, text, remedy, reason)


def _no_room(name: Hypothesis, held: Sequence[str]) -> Statement:
    """Say that the trim stands at a limit, where no small error gets the input that it asks for."""
    text = (
        f"the trim stands at a limit of the actuators, which deliver no change of {listing(held)}"
    )
    remedy = "give the actuators room about the trim"
    return Statement(name, Verdict.FAILS, Kind.PROOF, 0.0, "0 %", text, remedy, text)


def _exact(case: Case) -> Statement:
    """Assumption 3: states are known exactly, and nothing acts that no law asked for."""
    text, remedy = "states are known exactly, and nothing disturbs the agents", ""
    if case.disturbed:
        remedy = "leave it out to see what it costs"
        text = f"{case.disturbed}; what holds without is said, and how far it may push is below"
    verdict = Verdict.of(not case.disturbed)
    return Statement(Hypothesis.EXACT_STATES, verdict, Kind.PROOF, text=text, remedy=remedy)


def _agreement(case: Case) -> Statement:
    """Several leaders are one if they start alike and do the same; else nobody can follow all."""
    name, leaders = Hypothesis.LEADERS_AGREE, case.leaders
    if len(leaders.starts) == 1:
        return Statement(name, Verdict.NOT_NEEDED, Kind.PROOF, text="there is one")
    if leaders.agree:
        text = "they start alike and obey one law"
        return Statement(name, Verdict.HOLDS, Kind.PROOF, 0.0, "0 apart", text)
    if leaders.meet:
        slow = case.loop.slowest if leaders.slowest is None else leaders.slowest
        text = "they start apart, and their own law brings them together"
        return Statement(name, Verdict.HOLDS, _LINEAR, slow, f"{slow:.3g} 1/s", text)
    if leaders.answer:
        text = "leaders that answer to their neighbours are pushed apart by them"
        remedy = "set `leader.reacts: false`"
        return Statement(name, Verdict.FAILS, _LINEAR, None, "", text, remedy, text)
    return _drifting(case, name)


def _drifting(case: Case, name: Hypothesis) -> Statement:
    """Say by how much free leaders drift apart, and what is left: containment.

    Behind leaders that move freely, e = y_F + L_g^-1 L_FL y_L of linear agents obeys the modes of
    the disagreement; the rows of -L_g^-1 L_FL are weights that add to one.
    """
    away = apart(case.parts, case.settings, case.leaders.starts)
    first, unit = case.parts.graph.leaders[0], "m " if case.parts.model.position else ""
    text = (
        f"leader {away.leader} starts {away.start:.3g} {unit}off the place that leader {first} "
        f"gives it, is {away.end:.3g} {unit}off at {case.settings.horizon:g} s and "
        f"{away.most:.3g} {unit}at most"
    )
    remedy = "start the leaders alike, or give them a reference to follow"
    reason = (
        f"the leaders do not agree, but are {away.most:.3g} {unit}apart; followers of linear "
        "agents then end in the leaders' convex hull"
    )
    shown = f"{away.most:.3g} {unit}apart"
    return Statement(name, Verdict.FAILS, Kind.SAMPLES, away.most, shown, text, remedy, reason)


def _symmetric(case: Case) -> Statement:
    """Offsets are tried near the trim, and proved on the domain that a region speaks of."""
    name, parts, domain = Hypothesis.SYMMETRY, case.parts, case.domain
    model, formation = parts.model, parts.formation
    if not np.ptp(formation.offsets, axis=0).any():
        return Statement(name, Verdict.NOT_NEEDED, Kind.PROOF, text="there are none")
    broken = formation.broken_symmetries(model)
    kind, where = Kind.SAMPLES, ""
    if domain is not None and not broken:
        where = ", all over the domain"
        if offsets_are_symmetries(model, domain, formation.offsets):
            kind = Kind.PROOF
        else:
            bounds = (np.where(np.isfinite(b), b, s) for b, s in zip(domain.box, (-0.5, 0.5)))
            broken = formation.broken_symmetries(model, *bounds)
    text, remedy, reason = f"f and g do not notice them{where}", "", ""
    if broken:
        agent, why = next(iter(broken.items()))
        text, remedy = f"agent {agent}: {why}{where}", "offset only states that f and g ignore"
        reason = "an offset is no symmetry of the dynamics"
    verdict, count = Verdict.of(not broken), len(broken)
    return Statement(name, verdict, kind, count, f"{count} broken", text, remedy, reason)


def _smooth(case: Case) -> Statement:
    """Lyapunov's first method wants slopes at the trim: one matrix A, whatever the side."""
    name, parts = Hypothesis.SMOOTH, case.parts
    bends = at_trim(parts.model).bends
    if not bends.any():
        text = "values of f and g on either side of it show the slopes that A is made of"
        return Statement(name, Verdict.HOLDS, Kind.SAMPLES, text=text)
    entry, variable = (parts.model.state_names[k] for k in np.argwhere(bends)[0])
    text = f"the rate of `{entry}` bends or jumps with `{variable}` at the trim"
    remedy, reason = "what holds of all its sides is said", ""
    if case.region is None or case.region.kind is Kind.SAMPLES:
        remedy = "use `robust-lqr` or `contraction`, whose hull holds the slopes of both sides"
        reason = f"{text}, where nothing linear holds"
    verdict = Verdict.FAILS
    return Statement(name, verdict, Kind.SAMPLES, None, "", text, remedy, reason)


def _matched(case: Case) -> Statement:
    name, leaders, reason = Hypothesis.MATCHED_MOTION, case.leaders, ""
    text, remedy = "the leader has no input beyond its trim, so there is nothing to send", ""
    if leaders.alike:
        text = "the leaders obey the followers' law, so there is nothing to send"
    elif not leaders.rest:
        text = "the leader's input reaches every follower, which the paper's network does not give"
        text = "each follower is sent its parent's input" if case.fed_by_parents else text
    if not case.matched:
        text = "followers lag behind a moving leader"
        remedy = "`feedforward: relay` removes the lag, and asks for the leader's input at every "
        remedy += "follower"
        if leaders.answer and case.governed:
            text = reason = "the leader answers to followers that do not know its input, and "
            text = reason = f"{text}nothing is known of that loop"
    verdict = Verdict.of(case.matched)
    return Statement(name, verdict, Kind.PROOF, None, "", text, remedy, reason)
