"""The text of a run's report: what happened, and what is guaranteed."""

from collections.abc import Iterator

import numpy as np

from echelon.agents.network.hearing import who_hears_whom
from echelon.core.digits import at_least, at_most
from echelon.core.errors import Outcome
from echelon.core.statement import Hypothesis
from echelon.core.words import amount
from echelon.experiments.results.agent_metrics import Metrics
from echelon.experiments.results.avoidance import avoidance
from echelon.experiments.results.event_outcomes import event_outcomes
from echelon.experiments.results.lyapunov import lyapunov
from echelon.guarantees.promises.promise import Promise, coverage, promise
from echelon.output.reports.causes import grows, observations, sizes
from echelon.simulation.engine.result import Result


def explain(result: Result, numbers: Metrics) -> tuple[str, ...]:
    """Return the sentences of a report: outcome, what was observed, world, guarantee, V."""
    guarantee = promise(result.parts, result.settings)
    return (
        *_outcome(result, numbers, guarantee),
        *_closest(result, numbers),
        *(outcome.sentence() for outcome in event_outcomes(result)),
        *_waiting(result),
        *_lag(result),
        *observations(result, numbers, guarantee),
        *_world(result),
        *_guarantee(result, guarantee),
        *_lyapunov_trend(result, guarantee),
    )


def _outcome(result: Result, numbers: Metrics, guarantee: Promise) -> Iterator[str]:
    yield result.message
    if result.outcome is Outcome.DIVERGED or len(result.times) < 2:
        return
    unit = f" {result.length_unit}".rstrip()
    if grows(result, guarantee):
        first, last = sizes(result)
        yield (
            f"The formation error grows: {first:.3g}{unit} at the start, "
            f"{last:.4g}{unit} at {result.times[-1]:g} s."
        )
        return
    here = np.ones(result.graph.agents, bool) if result.presence is None else result.presence[-1]
    there = " that are there" * (not here.all())
    times = [follower.settling_time for follower in numbers.followers if here[follower.agent]]
    settled = [time for time in times if time is not None]
    count, late = len(times), len(times) - len(settled)
    if not count:
        yield "No follower is there at the end."
    elif not late:
        who = "The follower stays" if count == 1 else f"All {count} followers{there} stay"
        goals = "its goal" if count == 1 else "their goals"
        yield f"{who} within 0.01{unit} of {goals} from {max(settled):.3g} s on."
    else:
        who = "The follower" if count == 1 else f"{late} of {count} followers{there}"
        verb = "has" if late == 1 else "have"
        yield f"{who} {verb} not settled to 0.01{unit} by {result.times[-1]:g} s."


def _closest(result: Result, numbers: Metrics) -> Iterator[str]:
    """Yield which agents came closest to each other, and whether vehicles would have touched."""
    if numbers.closest is not None and result.outcome is not Outcome.DIVERGED:
        yield numbers.closest.sentence(result.radius, result.length_unit)
    kept = avoidance(result)
    yield from () if kept is None else (kept.sentence(),)


def _waiting(result: Result) -> Iterator[str]:
    """Yield for how long leaders waited that do."""
    if result.late is None or not len(result.late):
        return
    late, end = float(result.late[-1]), result.times[-1]
    if late < 0.5e-3:
        yield "The leaders' plan waited for nobody."
        return
    until = result.times[np.flatnonzero(result.late < late - 1e-3)[-1:]].max(initial=0.0)
    yield (
        f"The leaders' plan waited for stragglers until about {until:.3g} s, and is {late:.3g} s "
        f"late at {end:g} s."
    )


def _lag(result: Result) -> Iterator[str]:
    """Yield by how much followers lag behind places that change with time, under laws that do."""
    late = np.flatnonzero(result.times >= result.settings.horizon - result.settings.window)
    if result.formation.motion is None or not result.drive.lags or not len(late):
        return
    largest = float(result.goal_distances(late)[:, list(result.graph.followers)].max())
    frames = "in the stored frames " * (result.settings.store_every > 1)
    yield (
        f"Followers lag behind places that change with time: observed {largest:.3g} "
        f"{result.unit} at most {frames}from {result.times[late[0]]:.4g} s on; under "
        "`stopping-point` they do not."
    )


def _world(result: Result) -> Iterator[str]:
    """Yield what the laws and gains do not know."""
    world = result.world.describe(result.model)
    if world["plant"]:
        yield f"Plant: {world['plant']}; laws and gains use the model's values."
    if world["disturbance"]:
        yield f"Disturbance: {world['disturbance']}; unknown to the laws."
    if world["network"]:
        yield f"Network: {world['network']}."
        yield from _messages(result)
    if world["actuator"]:
        yield f"Actuators: {world['actuator']}; unknown to the laws."
    if world["sensing"]:
        yield f"Sensing of own states: {world['sensing']}."


def _messages(result: Result) -> Iterator[str]:
    """Yield what became of the messages, if there were any."""
    traffic = result.traffic
    if traffic is None or not traffic.sent:
        return
    late = f", {traffic.late} arrived after a newer one" * (traffic.late > 0)
    ages = ""
    if np.isfinite(traffic.mean):
        ages = (
            f"; those in use were {1e3 * traffic.mean:.3g} ms old on average and "
            f"{1e3 * traffic.largest:.4g} ms at most"
        )
    yield f"Messages: {traffic.sent} sent, {traffic.lost} lost{late}{ages}."


def _guarantee(result: Result, guarantee: Promise) -> Iterator[str]:
    """Yield the guarantee, whether it covers this run, and the information that the law uses."""
    yield guarantee.sentence()
    slowest, coupling = guarantee.slowest, guarantee.coupling
    if result.drive.gain is not None and guarantee.governed and slowest is not None:
        mode = "the slowest mode decays" if slowest < 0.0 else "a mode grows"
        text = f"{mode} at {at_most(abs(slowest))} 1/s"
        # Rounding of a mode at 0 is no growth.
        text = "a mode does not decay" if 0.0 <= slowest < 1e-9 else text
        text = f"{text} (coupling {coupling:.4g})"
        if guarantee.edge is not None:
            text += f". Couplings above {at_least(guarantee.edge, 4)} are sufficient for stability"
        yield f"Linearized at the trim, {text}."
    yield from coverage(result, guarantee)
    if len(result.graph.leaders) > 1:
        yield f"Leaders: {who_hears_whom(result.graph)}; goals are relative to the nearest leader."
    information = "; ".join(result.parts.information.follower) or "nothing from others"
    yield f"Information used by each follower: {information}."


def _lyapunov_trend(result: Result, guarantee: Promise) -> Iterator[str]:
    """Yield whether V decreased, with a warning where theory forbids its increase."""
    v = lyapunov(result)
    if v is None or len(v.value) < 2 or not np.isfinite(v.value).all():
        return
    increases, forbidden = int(v.rises().sum()), int(v.forbidden().sum())
    # V' <= 0 is proved for the undisturbed loop that decays only.
    unstable = guarantee.hypotheses[Hypothesis.DISAGREEMENT_DECAY].fails
    if forbidden and not (unstable or not result.world.ideal):
        when = result.times[int(np.argmax(v.forbidden()))]
        yield (
            f"Warning: V increased at {forbidden} of {len(v.value)} stored steps (first at "
            f"{when:.4g} s) although V' <= 0 there."
        )
    elif increases:
        yield f"V increased in {increases} of {amount(len(v.value) - 1, 'frame')}."
    else:
        every = "V never increased"
        if result.settings.store_every > 1:
            every = f"V did not increase between the {len(v.value)} stored times"
        yield f"{every}: {v.value[0]:.3g} at the start, {v.value[-1]:.3g} at the end."
