"""Hypotheses of a guarantee about agents, leaders, offsets, events and limits, as lines of `check`.

A failed line with a `reason` rules out any guarantee; without one it weakens or explains it.
"""

import math
from collections.abc import Iterator

import jax
import numpy as np

from echelon.agents.models.linearization import at_trim
from echelon.agents.models.model import ControlAffine, position_unit
from echelon.agents.models.model_check import Shortfall, at_limits, is_limited, trim_shortfall
from echelon.agents.models.relative_equilibrium import trim_speed, trim_velocity
from echelon.agents.network.graph import Graph
from echelon.agents.part import Event
from echelon.core.compiled import compiled_for_one_call
from echelon.core.digits import about, at_least
from echelon.core.errors import listing
from echelon.core.identity import digest
from echelon.core.numerics import precision
from echelon.core.statement import (
    Hypothesis,
    Statement,
    fails,
    holds,
    left_to_run,
    unneeded,
)
from echelon.core.types import Array, JsonObject, States
from echelon.core.words import GuaranteeVerdict, Kind
from echelon.guarantees.messages.late_messages import bias_line
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.leaders import apart
from echelon.guarantees.promises.modes import modes
from echelon.guarantees.promises.promise import Guarantee
from echelon.guarantees.promises.turning_lag import turning_lag
from echelon.laws.law import Feeds, Law, Proves
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.jacobians import offsets_are_symmetries

_LINEAR = Kind.LINEARIZATION
_NEAR_TRIM = "the leader stays close to its trim"
_LEAVES = 1e-9
"""1/s; a slower mode is that of rounding."""


def hypotheses(case: GuaranteeInputs) -> Iterator[Statement]:
    """Yield what any promise of the loop near the trim rests on."""
    yield from agent_lines(case)
    yield _symmetric(case)
    yield from () if case.smooth or not case.governed else (_smooth(case),)
    yield _matched(case)
    yield from _leaving(case)
    yield from modes(case)
    bias = bias_line(case.parts, case.settings)
    yield from () if bias is None else (bias,)


def agent_lines(case: GuaranteeInputs) -> Iterator[Statement]:
    """Yield what any promise asks of the agents and their leaders."""
    yield _trim_applied(case)
    yield trim_line(case.parts, case.settings)
    yield _exact(case)
    yield _agreement(case)
    yield from events_line(case.parts)


# ---- the agents and their leaders ---------------------------------------------------------------


def _trim_applied(case: GuaranteeInputs) -> Statement:
    """Definition 1 wants f(0) = 0: about the trim it holds, if the law applies the trim input."""
    parts = case.parts
    there = np.zeros_like(parts.formation.offsets)
    drifts = goal_drifts(parts.model, there, parts.drive) - trim_velocity(parts.model)
    size, speed = float(np.abs(drifts).max()), trim_speed(parts.model)
    number = size, f"|f + g u*| {at_least(size, 2)}"
    if parts.drive.trimmed or not np.any(np.asarray(parts.model.trim[1], float)):
        about_it = f"the trim, which moves at {about(speed)}" if speed else "the trim"
        text = f"holds about {about_it}, since the law applies the trim input"
        return holds(Hypothesis.TRIM_APPLIED, Kind.PROOF, text, *number)
    text, remedy = "the law leaves out the trim input", "set `follower.trim: true`"
    return fails(Hypothesis.TRIM_APPLIED, Kind.PROOF, text, *number, remedy=remedy, reason=text)


def goal_drifts(model: ControlAffine, offsets: Array, law: Law | Controller | None = None) -> Array:
    """Return the drift at the goals about the trim, (N, n), with the law's inner loop if any."""
    with precision("float64"):
        goals = np.asarray(model.trim[0], float) + offsets
        return np.asarray(_drifts(model, law, goals), np.float64)


@compiled_for_one_call
def _drifts(model: ControlAffine, law: Law | Controller | None, states: States) -> jax.Array:
    if law is None:
        return jax.vmap(model.normalized_drift)(states)
    return jax.vmap(lambda x: Proves.of(law).drift(model, x))(states)


def trim_line(parts: Parts, settings: Settings) -> Statement:
    """Say whether the actuators deliver the trim input, without which no agent holds its trim."""
    model, world, name = parts.model, parts.world, Hypothesis.TRIM_WITHIN_LIMITS
    plants = (world.plant_for(model), *world.plants.values())
    trim = np.asarray(model.trim[1], float)
    asked = (part.off_trim(plant, trim) for part in world.all_parts for plant in plants)
    for text, remedy in filter(any, asked):
        return fails(name, Kind.PROOF, text, remedy=remedy, reason=f"{text}: no agent holds it")
    if not (settings.limits and any(map(is_limited, plants))):
        return unneeded(name, Kind.PROOF, "the inputs have no limits")
    short = dict[str, Shortfall]()
    for plant in plants:
        # A heavier plant needs more than the model's trim to stay where it is.
        short |= trim_shortfall(plant, trim) | (trim_shortfall(plant) if plant is not model else {})
    if not short:
        stuck = tuple(dict.fromkeys(i for plant in plants for i in at_limits(plant, trim)))
        if stuck:
            text = "the trim is at a limit of the actuators, which leaves no margin for "
            text, remedy = text + listing(stuck), "give the actuators a margin about the trim"
            # No small error gets the input that it asks for.
            return fails(name, Kind.PROOF, text, 0.0, "0 %", remedy=remedy, reason=text)
        if any(part.presumed() for part in world.parts):
            return unneeded(name, Kind.PROOF, "what parts of your own make of inputs is not known")
        text = "the actuators deliver the trim input with a margin on both sides"
        return holds(name, Kind.PROOF, text)
    units = dict(zip(model.input_names, model.input_units, strict=True))
    sizes = ((about(got, 4), about(asked, 4), units[i]) for i, (got, asked) in short.items())
    cut = [f"{got} of {asked} {unit}".rstrip() for got, asked, unit in sizes]
    text = "the actuators deliver " + ", ".join(f"`{i}` {part}" for i, part in zip(short, cut))
    worst = min(got / asked if asked else 0.0 for got, asked in short.values())
    remedy = "lighten the agents or strengthen their actuators"
    number, reason = (worst, f"{about(100.0 * worst)} %"), f"{text}, and cannot hold the trim"
    return fails(name, Kind.PROOF, text, *number, remedy=remedy, reason=reason)


def _exact(case: GuaranteeInputs) -> Statement:
    """Assumption 3: states are known exactly, and nothing acts that no law asked for."""
    acts = case.parts.world.ignored
    if not case.ignored and case.local is not None and acts:
        text = f"{' and '.join(acts)}; the steps that were examined contain this"
        return unneeded(Hypothesis.EXACT_STATES, _LINEAR, text)
    if not case.ignored:
        text = "states are known exactly, and nothing disturbs the agents"
        return holds(Hypothesis.EXACT_STATES, Kind.PROOF, text)
    text = f"{' and '.join(case.ignored)}; the guarantee ignores this"
    return fails(
        Hypothesis.EXACT_STATES, Kind.PROOF, text, remedy="leave it out to see what it costs"
    )


def _agreement(case: GuaranteeInputs) -> Statement:
    """Several leaders are one if they start alike and do the same; else nobody can follow all."""
    name, leaders = Hypothesis.LEADERS_AGREE, case.leaders
    if len(leaders.starts) == 1:
        return unneeded(name, Kind.PROOF, "there is one")
    if leaders.agree:
        return holds(name, Kind.PROOF, "they start alike and obey one law", 0.0, "0 apart")
    if leaders.answer and case.local is not None and case.local.holds:
        text = "they react, and the modes of the whole formation bring them together"
        return holds(name, _LINEAR, text)
    if leaders.meet:
        slow = case.loop.slowest if leaders.slowest is None else leaders.slowest
        text = "they start apart, and their own law brings them together"
        return holds(name, _LINEAR, text, slow, f"{at_least(slow)} 1/s")
    if leaders.answer:
        text = "leaders that react to their neighbours are driven apart by them"
        return fails(name, _LINEAR, text, remedy="set `leader.reacts: false`", reason=text)
    return _drifting(case)


def _drifting(case: GuaranteeInputs) -> Statement:
    """Here e = y_F + L_g^-1 L_FL y_L of linear agents obeys the modes of the disagreement."""
    away = apart(case.parts, case.settings, case.leaders.starts)
    first, unit = case.parts.graph.leaders[0], f"{position_unit(case.parts.model)} ".lstrip()
    text = (
        f"leader {away.leader} starts {about(away.start)} {unit}off the place that leader {first} "
        f"gives it, is {about(away.end)} {unit}off at {case.settings.horizon:g} s and "
        f"{at_least(away.most)} {unit}at most"
    )
    remedy = "start the leaders alike, or give them a reference to follow"
    reason = (
        f"the leaders do not agree, but are {at_least(away.most)} {unit}apart; followers of linear "
        "agents then end in the leaders' convex hull"
    )
    number = away.most, f"{at_least(away.most)} {unit}apart"
    return fails(
        Hypothesis.LEADERS_AGREE, Kind.SAMPLES, text, *number, remedy=remedy, reason=reason
    )


def _symmetric(case: GuaranteeInputs) -> Statement:
    """Offsets are tried near the trim, and proved on the domain that a region speaks of."""
    name, parts, domain = Hypothesis.SYMMETRY, case.parts, case.domain
    model, formation = parts.model, parts.formation
    if formation.motion is not None:
        text, remedy = "offsets change with time", "use the law `stopping-point`"
        reason = f"{text}, and the theorems about this law are of constant ones"
        lag, unit = turning_lag(case), position_unit(model)
        if lag is None:
            return fails(name, Kind.PROOF, text, remedy=remedy, reason=reason)
        text += (
            f"; turning with the leader, followers end up to {at_least(lag)} {unit} off their goals"
        )
        number = lag, f"{at_least(lag)} {unit} off"
        return fails(name, Kind.PROOF, text, *number, remedy=remedy, reason=reason)
    if not np.ptp(formation.offsets, axis=0).any():
        return unneeded(name, Kind.PROOF, "there are none")
    broken = formation.broken_symmetries(model)
    kind, where = Kind.SAMPLES, ""
    if domain is not None and not broken:
        where = ", all over the domain"
        if offsets_are_symmetries(model, domain, formation.offsets):
            kind = Kind.PROOF
        else:
            bounds = (np.where(np.isfinite(b), b, s) for b, s in zip(domain.box, (-0.5, 0.5)))
            broken = formation.broken_symmetries(model, *bounds)
    if not broken:
        return holds(name, kind, f"f and g are invariant under them{where}", 0, "0 broken")
    agent, why = next(iter(broken.items()))
    text = f"the offset of agent {agent}: {why}{where}"
    remedy = "offset only states that f and g do not use"
    count, reason = len(broken), "an offset is no symmetry of the dynamics"
    if case.local is not None and domain is None:
        # What runs was looked at with each agent at its own goal.
        reason = ""
    return fails(name, kind, text, count, f"{count} broken", remedy=remedy, reason=reason)


def _smooth(case: GuaranteeInputs) -> Statement:
    """Lyapunov's first method wants slopes at the trim: one matrix A, whatever the side."""
    name, parts = Hypothesis.SMOOTH, case.parts
    kinks = at_trim(parts.model).kinks
    entry, variable = (parts.model.state_names[k] for k in np.argwhere(kinks)[0])
    text = f"the rate of `{entry}` bends or jumps with `{variable}` at the trim"
    if case.region is not None and case.region.kind is not Kind.SAMPLES:
        return fails(
            name, Kind.SAMPLES, text, remedy="the guarantee uses the slopes on all of its sides"
        )
    remedy = "use `robust-lqr` or `contraction`, whose hull contains the slopes of both sides"
    reason = f"{text}, so there is no linearization"
    return fails(name, Kind.SAMPLES, text, remedy=remedy, reason=reason)


def _matched(case: GuaranteeInputs) -> Statement:
    name, leaders = Hypothesis.MATCHED_MOTION, case.leaders
    remedy = "`feedforward: relay` removes the lag, "
    remedy += "but requires the leader's input at every follower"
    if not case.matched:
        return fails(name, Kind.PROOF, "followers lag behind a moving leader", remedy=remedy)
    if leaders.alike:
        text = "the leaders obey the followers' law, so there is nothing to send"
    elif leaders.rest:
        text = "the leader has no input beyond its trim, so there is nothing to send"
    elif case.fed_by_parents:
        text = "each follower is sent its parent's input"
    else:
        follower = getattr(case.parts.drive, "follower", None)
        signal = any(Feeds.may(follower, name) for name in ("message", "broadcast"))
        what = "feed-forward" if signal else "input"
        text = f"every follower receives the leader's {what}, "
        text += "which the paper's network does not provide"
    return holds(name, Kind.PROOF, text)


def _leaving(case: GuaranteeInputs) -> Iterator[Statement]:
    """Yield that a leader that is left to itself leaves its trim; nothing where it stays."""
    slowest = case.leaders.slowest
    if slowest is None or slowest <= _LEAVES:
        return
    text, shown = "a leader alone leaves its trim", f"{at_least(slowest)} 1/s"
    remedy = "give the leader a law that holds it there"
    yield left_to_run(Hypothesis.LEADER, _NEAR_TRIM, text, slowest, shown, remedy, _LINEAR)


# ---- events of a run -----------------------------------------------------------------------------

_WITHOUT_EVENT = "remove the event to see what is guaranteed without it"


def events_line(parts: Parts) -> Iterator[Statement]:
    """Yield whether a guarantee covers all events of a run; nothing without any."""
    graph, name = parts.graph, Hypothesis.EVENTS
    if graph.backups and parts.world.network is not None:
        text = "a backup leader may take the lead whenever messages of the leader are lost for long"
        remedy = "remove `leadership` to see what is guaranteed without it"
        yield fails(name, Kind.PROOF, text, remedy=remedy, reason=text)
        return
    if not graph.events:
        return
    for event in graph.events:
        text = event.uncovered(graph)
        if text:
            shown = f"{event.at:g} s"
            yield fails(name, Kind.PROOF, text, event.at, shown, remedy=_WITHOUT_EVENT, reason=text)
            return
    text = "links that change, and an agent that nobody hears any more, are those of a graph that "
    text += "switches"
    yield holds(name, Kind.PROOF, text, len(graph.events), f"{len(graph.events)} covered")


def events_in_words(parts: Parts, guarantee: Guarantee) -> list[JsonObject]:
    """Return each event of a run, by time, and what is guaranteed through it, ready for JSON."""
    prefix = guarantee.prefix
    return [
        {**as_mapping(event), "guarantee": _through(parts.graph, event, holding)}
        for event in parts.graph.events
        for holding in (prefix.promise if prefix and event.at < prefix.at else guarantee,)
    ]


def as_mapping(event: Event) -> JsonObject:
    """Return an event ready for JSON."""
    return {
        "at": event.at,
        "what": type(event).__name__.lower(),
        "agents": list(event.agents),
        "until": event.end if math.isfinite(event.end) else None,
        "text": str(event),
    }


def _through(graph: Graph, event: Event, guarantee: Guarantee) -> JsonObject:
    """Return whether a guarantee covers an event, and why not."""
    why = event.uncovered(graph)
    verdict = GuaranteeVerdict.NONE if why else guarantee.verdict
    if guarantee.ignores and verdict is GuaranteeVerdict.GUARANTEED:
        # It is of another flight, and covers nothing of this one.
        verdict = GuaranteeVerdict.NONE
    return {
        "verdict": str(verdict),
        "of": "all" if event.comes is None else "others",
        "kind": str(guarantee.kind) if verdict is GuaranteeVerdict.GUARANTEED else None,
        "against": why,
        "conditions": list(guarantee.conditions) if not why else [],
        "ignores": list(guarantee.ignores) if not why and guarantee.claimed else [],
    }


# ---- limits of the inputs ------------------------------------------------------------------------


def limits_act(parts: Parts, settings: Settings) -> bool:
    """Tell whether an input of an agent may be at a limit, or at one that a part adds."""
    world, model = parts.world, parts.model
    if world.effects.limits:
        return True
    plants = model, world.plant_for(model), *world.plants.values()
    return settings.limits and any(map(is_limited, plants))


def other_limits(parts: Parts) -> bool:
    """Tell whether an agent has other limits than the model, or actuators that round."""
    world, model = parts.world, parts.model
    if world.effects.limits or world.effects.rounded:
        return True
    plants = {id(x): x for x in (world.plant_for(model), *world.plants.values())}
    own = type(model).limit, digest(model.input_limits)
    return any((type(x).limit, digest(x.input_limits)) != own for x in plants.values())
