"""What a run shows and why, in sentences made from its numbers."""

from collections.abc import Iterator

import numpy as np

from echelon.certificates.certificate import Certificate, certify
from echelon.core.errors import Outcome
from echelon.core.linear import held_radius
from echelon.core.words import Feedforward, Theorem
from echelon.engine.result import Result
from echelon.gains.gain import Gain
from echelon.models.linearization import linearize
from echelon.models.model import ControlAffine
from echelon.results.lyapunov import Lyapunov, lyapunov
from echelon.results.metrics import Metrics, formation_errors

_LAG = 1e-6
"""A steady error above this, in the result's unit, is told as a lag."""


def explain(result: Result, numbers: Metrics) -> tuple[str, ...]:
    """Return what happened, why, and what to be wary of, a sentence each."""
    return (
        *_story(result, numbers),
        *_imperfections(result),
        *_promises(result),
        *_lyapunov_story(result),
    )


def _story(result: Result, numbers: Metrics) -> Iterator[str]:
    """Tell the outcome and how the formation did."""
    yield result.message
    if result.outcome is Outcome.DIVERGED:
        yield from _why_growth(result)
    if result.outcome is Outcome.DIVERGED or len(result.times) < 2:
        return
    error = formation_errors(result)[:, list(result.graph.followers)]
    with np.errstate(over="ignore"):
        first, last = (float(np.sqrt((row**2).mean())) for row in (error[0], error[-1]))
    unit = "" if result.unit == "state" else f" {result.unit}"
    if last > 2.0 * first + 1e-9:
        yield (
            f"The formation error grows: {first:.3g}{unit} at the start, "
            f"{last:.4g}{unit} at {result.times[-1]:g} s."
        )
        yield from _why_growth(result)
        return
    settled = [each.settling_time for each in numbers.followers]
    if all(time is not None for time in settled):
        latest = max(time for time in settled if time is not None)
        yield (
            f"All {len(settled)} followers stay within 0.01{unit} of their goals "
            f"from {latest:.3g} s on."
        )
    else:
        missing = sum(time is None for time in settled)
        yield (
            f"{missing} of {len(settled)} followers have not settled to 0.01{unit} "
            f"by {result.times[-1]:g} s."
        )
        yield from _unseen(result)
    yield from _lag(result, numbers, unit)


def _why_growth(result: Result) -> Iterator[str]:
    """Name the structural cause of growth where the linearization shows one."""
    gain = result.drive.gain
    if gain is None:
        return
    yield from _unseen(result)
    if not result.drive.trimmed and np.any(np.asarray(result.model.trim[1])):
        yield "The law has no trim input either, so nothing holds the followers against gravity."
    if gain.certificate.edge is not None and gain.coupling < gain.certificate.edge:
        yield (
            f"Cause: coupling {gain.coupling:.4g} is below the edge {gain.certificate.edge:.4g} "
            "= 1/(2 lambda_min) of what this gain guarantees."
        )
    yield from _long_step(result, gain)


def _unseen(result: Result) -> Iterator[str]:
    """Tell of directions of disagreement that never enter an input."""
    gain, n = result.drive.gain, len(result.model.state_names)
    if gain is not None and gain.certificate.observable < n:
        rank = gain.certificate.observable
        yield (
            f"Cause: observability of (A, g^T P) has rank {rank} of {n}, so {n - rank} directions "
            "of disagreement never enter any input and the law cannot reduce them."
        )


def _long_step(result: Result, gain: Gain) -> Iterator[str]:
    """Tell where the input, held over a step, makes grow what would decay in continuous time."""
    if not gain.certificate.stable:
        return
    A, B = linearize(result.model)
    inner = np.zeros_like(B.T) if gain.inner is None else gain.inner
    strength = gain.coupling * gain.certificate.lambda_max
    K = inner + strength * np.linalg.solve(gain.R, B.T @ gain.P)
    dt = result.settings.dt
    radius = held_radius(A, B, K, dt)
    if radius > 1.0:
        yield (
            f"Cause: the step `dt` = {dt:g} s is too long for this gain: with the input held over "
            f"it, the fastest mode grows by a factor {radius:.3g} a step."
        )


def _lag(result: Result, numbers: Metrics, unit: str) -> Iterator[str]:
    worst = numbers.worst_steady
    if worst is None or worst <= _LAG or result.drive.feedforward is not Feedforward.NONE:
        return
    if result.reference is not None and np.ptp(result.reference, axis=0).max() > 0.0:
        yield (
            "Without feed-forward the followers do not know the leader's motion and lag: "
            f"{worst:.3g}{unit} RMS over the last {numbers.steady_window:.3g} s for the worst. "
            "`feedforward: relay` removes the lag, and asks for the leader's input "
            "at every follower."
        )


def _imperfections(result: Result) -> Iterator[str]:
    """Tell what the laws did not know."""
    told = result.world.describe(result.model)
    if told["plant"]:
        yield f"Plant: {told['plant']}; laws and gains know the model alone."
    if told["disturbance"]:
        yield f"Disturbance: {told['disturbance']}; no law is told of it."


def _promises(result: Result) -> Iterator[str]:
    """Say what the gain promises, and what the law needs to be told."""
    gain = result.drive.gain
    if gain is not None:
        certificate = gain.certificate
        abscissa, from_on = certificate.abscissa, certificate.edge
        if result.drive.feedforward is Feedforward.PARENT:
            abscissa, from_on = _with_parents(result, gain)
        verdict = _verdict(abscissa)
        edge = "" if from_on is None else f" (guaranteed for linear agents from {from_on:.4g} on)"
        yield (
            f"Promise of the gain, by linearization at the trim: the disagreement is {verdict}, "
            f"slowest mode {abscissa:.3g} 1/s at coupling {gain.coupling:.4g}{edge}; "
            f"{_region(certificate, result.model)}."
        )
    needs = ", ".join(result.drive.information.follower) or "nothing from others"
    yield f"Each follower is told: {needs}."


def _with_parents(result: Result, gain: Gain) -> tuple[float, float | None]:
    """Return the slowest mode and the edge where parents' inputs are fed forward.

    The modes are then those of the edges' weights (theory page, T4).
    """
    closed = linearize(result.model).with_inner(gain.inner)
    low, weights = result.graph.spectrum().low, result.graph.parent_spectrum()
    edge = gain.certificate.edge
    edge = None if edge is None else edge * low / weights.low
    return certify(closed, weights, gain.P, gain.R, gain.coupling, edge).abscissa, edge


def _region(certificate: Certificate, model: ControlAffine) -> str:
    """Return what is promised on a domain, with the kind of argument."""
    region = certificate.region
    if region is None:
        return "no region is proved"
    where = region.domain.in_words(model)
    if region.theorem is Theorem.A5:
        return f"the drift does not expand P for {where} ({region.kind})"
    scope = "everywhere there" if region.theorem is Theorem.T1 else "near the leader's path there"
    return (
        f"for {where} it contracts at {region.rate:.3g} 1/s {scope} "
        f"({region.kind}, {region.theorem})"
    )


def _verdict(abscissa: float) -> str:
    """Return what the slowest mode says of the disagreement."""
    if abs(abscissa) < 1e-9:
        return "not damped in every direction"
    return "stable" if abscissa < 0.0 else "unstable"


def _lyapunov_story(result: Result) -> Iterator[str]:
    """Tell whether V fell, and warn where it rose although theory says that it may not."""
    v = lyapunov(result)
    if v is None or len(v.value) < 2 or not np.isfinite(v.value).all():
        return
    rises, forbidden = int(v.rises().sum()), int(v.forbidden().sum())
    if forbidden and result.world.disturbance is None:
        when = result.times[int(np.argmax(v.forbidden()))]
        yield (
            f"Warning: V rises at {forbidden} of {len(v.value) - 1} frames (first at {when:.4g} s) "
            "although V' <= 0 there; the step `dt` is too long for this gain."
        )
    elif rises:
        excuse = _excuse(v) if result.world.disturbance is None else "the disturbance pushes it up"
        yield f"V rises at {rises} of {len(v.value) - 1} frames; {excuse}."
    else:
        yield f"V never rises: {v.value[0]:.3g} at the start, {v.value[-1]:.3g} at the end."


def _excuse(v: Lyapunov) -> str:
    broken = float(np.mean(v.drift > 1e-9 * np.abs(v.rate).max()))
    if broken:
        return f"theory allows it, since Assumption 5 fails on {100.0 * broken:.0f} % of the frames"
    return "theory allows it, since the leader's input is not matched or a limit acts"
