"""What a run shows and why, in sentences made from its numbers and its promise."""

from collections.abc import Iterator

import numpy as np

from echelon.agents.network.hearing import who_hears_whom
from echelon.core.errors import Outcome
from echelon.core.statement import Hypothesis
from echelon.experiments.results.lyapunov import Lyapunov, lyapunov
from echelon.experiments.results.metrics import Metrics
from echelon.guarantees.promises.covering import coverage
from echelon.guarantees.promises.promise import Promise, promise
from echelon.output.reports.causes import causes, grows, sizes
from echelon.simulation.engine.result import Result


def explain(result: Result, numbers: Metrics) -> tuple[str, ...]:
    """Return what happened, why, and what to be wary of, a sentence each."""
    found = promise(result.parts, result.settings)
    return (
        *_story(result, numbers, found),
        *(each.sentence() for each in causes(result, numbers, found)),
        *_imperfections(result),
        *_promises(result, found),
        *_lyapunov_story(result, found),
    )


def _story(result: Result, numbers: Metrics, found: Promise) -> Iterator[str]:
    """Tell the outcome and how the formation did."""
    yield result.message
    if result.outcome is Outcome.DIVERGED or len(result.times) < 2:
        return
    unit = "" if result.unit == "state" else f" {result.unit}"
    if grows(result):
        first, last = sizes(result)
        yield (
            f"The formation error grows: {first:.3g}{unit} at the start, "
            f"{last:.4g}{unit} at {result.times[-1]:g} s."
        )
        return
    times = [each.settling_time for each in numbers.followers]
    known = [time for time in times if time is not None]
    if len(known) == len(times):
        yield (
            f"All {len(times)} followers stay within 0.01{unit} of their goals "
            f"from {max(known):.3g} s on."
        )
    else:
        yield (
            f"{len(times) - len(known)} of {len(times)} followers have not settled to 0.01{unit} "
            f"by {result.times[-1]:g} s."
        )


def _imperfections(result: Result) -> Iterator[str]:
    """Tell what the laws did not know."""
    told = result.world.describe(result.model)
    if told["plant"]:
        yield f"Plant: {told['plant']}; laws and gains know the model alone."
    if told["disturbance"]:
        yield f"Disturbance: {told['disturbance']}; no law is told of it."


def _promises(result: Result, found: Promise) -> Iterator[str]:
    """Say what is promised, whether this run is covered, and what the law needs to be told."""
    yield found.sentence()
    if result.drive.gain is not None and found.slowest is not None:
        edge = "" if found.edge is None else f"; from {found.edge:.4g} on every mode decays"
        yield (
            f"Near the trim the slowest mode is {found.slowest:.3g} 1/s at coupling "
            f"{found.loop.closed.coupling:.4g}{edge}."
        )
    yield from coverage(result, found)
    if len(result.graph.leaders) > 1:
        yield f"Who follows whom: {who_hears_whom(result.graph)}; goals are the nearest leader's."
    needs = ", ".join(result.drive.information.follower) or "nothing from others"
    yield f"Each follower is told: {needs}."


def _lyapunov_story(result: Result, found: Promise) -> Iterator[str]:
    """Tell whether V fell, and warn where it rose although theory says that it may not."""
    v = lyapunov(result)
    if v is None or len(v.value) < 2 or not np.isfinite(v.value).all():
        return
    rises, forbidden = int(v.rises().sum()), int(v.forbidden().sum())
    # V' <= 0 is proved of the undisturbed loop that decays, and forbids nothing to others.
    excused = result.world.disturbance or found.hypotheses[Hypothesis.DISAGREEMENT_DECAY].fails
    if forbidden and not excused:
        when = result.times[int(np.argmax(v.forbidden()))]
        yield (
            f"Warning: V rises at {forbidden} of {len(v.value)} stored steps (first at {when:.4g} "
            "s) although V' <= 0 where they begin; the step `dt` is too long: halve it."
        )
    elif rises:
        grows = found.hypotheses[Hypothesis.DISAGREEMENT_DECAY].fails
        # Of a loop that grows by itself nobody can tell what part the wind has.
        excuse = "the loop grows by itself" if grows else "the disturbance pushes it up"
        if found.hypotheses[Hypothesis.SAMPLING].fails:
            excuse = "the input is held over a `dt` too long, and V' is that of one that follows"
        elif result.world.disturbance is None:
            excuse = f"theory allows it, since {_excuse(v, found)}"
        yield f"V rises at {rises} of {len(v.value) - 1} frames; {excuse}."
    else:
        yield f"V never rises: {v.value[0]:.3g} at the start, {v.value[-1]:.3g} at the end."


def _excuse(v: Lyapunov, found: Promise) -> str:
    coupled = found.hypotheses[Hypothesis.COUPLING]
    if coupled.fails:
        return coupled.text
    # Drifts cancel within V', so that rounding leaves some 1e-16 of its largest value.
    broken = float(np.mean(v.drift > 1e-9 * np.abs(v.rate).max()))
    if broken:
        return f"Assumption 5 fails on {100.0 * broken:.0f} % of the frames"
    return "the leader's input is not matched or a limit acts"
