"""All gain methods on one scenario, side by side, and one of them recommended."""

import time
from typing import Any, NamedTuple

import numpy as np

from echelon.certificates import margins
from echelon.core.errors import EchelonError
from echelon.core.linear import longest_step
from echelon.core.numerics import precision
from echelon.gains.gain import Gain, Method, synthesize
from echelon.laws.consensus import Consensus
from echelon.promises.certified_set import CertifiedSet, certified_set
from echelon.promises.closed_loop import CheckedLoop, checked_loop
from echelon.scenario import registry
from echelon.scenario.build import Built, resolve
from echelon.scenario.scenario import Scenario
from echelon.studies.speedup import speedup

_ADVISED = 100
"""Followers of the largest swarm that is advised on its graph; of more it would take minutes."""


class Design(NamedTuple):
    """One method on the scenario: its gain and what is known of it, or why there is none.

    Attributes:
        method: its name.
        gain: None where there is none, and then `reason` says why.
        reason: empty where there is a gain.
        fastest: largest modulus of a pole of the loop, 1/s.
        step: the longest step (s) with inputs held with which every mode looked at decays.
        factors: the interval of factors on the coupling that it bears; None if unstable.
        delay: of all disagreements that it bears, s; None if unstable.
        certified: the certified set, less the leader's excursion; None without one.
        advice: what else a user of the method should know.
        seconds: what the synthesis took.
    """

    method: str
    gain: Gain | None
    reason: str = ""
    fastest: float | None = None
    step: float | None = None
    factors: margins.GainMargin | None = None
    delay: float | None = None
    certified: CertifiedSet | None = None
    advice: str = ""
    seconds: float = 0.0


def designs(scenario: Scenario, built: Built, only: str | None = None) -> tuple[Design, ...]:
    """Try the methods on a built scenario, or `only` one of them."""
    methods = [resolve(registry.METHODS[name]) for name in ([only] if only else registry.METHODS)]
    return tuple(_design(each, scenario, built) for each in methods if only or _chooses(each))


def _chooses(method: type[Method]) -> bool:
    """Whether a method finds a gain by itself: one that wants a P, say, is no choice of design."""
    return {*method.needs} <= {"domain", *method.usual}


def recommended(tried: tuple[Design, ...], dt: float) -> Design | None:
    """Return the stable design with the strongest promise, the fastest decay deciding a tie.

    One that needs a step speedup than `dt` comes after those that do not.
    """
    stable = [d for d in tried if d.gain is not None and d.gain.certificate.stable]
    return max(stable, key=lambda d: _merit(d, dt)) if stable else None


def because(best: Design, tried: tuple[Design, ...], dt: float) -> str:
    """Return why a design is recommended, in a sentence."""
    assert best.gain is not None and best.step is not None
    certificate, region = best.gain.certificate, best.gain.certificate.region
    stable = sum(d.gain is not None and d.gain.certificate.stable for d in tried)
    why = "it is the only one whose loop is stable"
    if stable > 1 and _merit(best, dt)[1]:
        assert region is not None
        why = f"it promises most: {region.rate:.3g} 1/s on its domain ({region.kind}, "
        why += f"{region.theorem})"
    elif stable > 1:
        why = f"of {stable} stable loops, none with more than a promise at the trim, its slowest "
        why += f"mode is the fastest, {certificate.abscissa:.3g} 1/s"
    step = f"the scenario's step of {dt:g} s is short enough for it"
    if best.step <= dt:
        step = f"it needs a step below {best.step:.3g} s, and the scenario's is {dt:g} s"
    return f"Recommended: {best.method}, because {why}; {step}."


def _merit(design: Design, dt: float) -> tuple[bool, int, float]:
    assert design.gain is not None and design.step is not None
    certificate = design.gain.certificate
    region = certificate.region
    strength = region.kind.strength if region is not None and region.rate > 0.0 else 0
    return design.step > dt, strength, -certificate.abscissa


def _design(method: type[Method], scenario: Scenario, built: Built) -> Design:
    """Try one method; an optional part that is missing is a reason like any other."""
    arguments = _arguments(method, scenario)
    missing = [f"`follower.gain.{key}`" for key in method.needs if key not in arguments]
    if missing:
        return Design(method.name, None, f"give {' and '.join(missing)} to try it")
    began = time.perf_counter()
    try:
        gain = synthesize(built.parts.model, built.parts.graph, method(**arguments))
    except EchelonError as error:
        return Design(method.name, None, str(error), seconds=time.perf_counter() - began)
    seconds = time.perf_counter() - began
    with precision("float64"):
        return _known(gain, with_gain(built, gain))._replace(seconds=seconds)


def with_gain(built: Built, gain: Gain) -> CheckedLoop:
    """Return the closed loop of the scenario under another gain, the feed-forward kept."""
    parts, settings = built
    drive = parts.drive.with_follower(Consensus(gain, parts.drive.feedforward, parts.drive.trimmed))
    with precision("float64"):
        return checked_loop(parts.replace(drive=drive), settings)


def _known(gain: Gain, loop: CheckedLoop) -> Design:
    """Return what is known of a gain and its loop."""
    closed, (A, B) = loop.closed, loop.linear
    poles = np.linalg.eigvals(A - closed.strengths[:, None, None] * (B @ closed.K))
    found = Design(gain.method, gain, fastest=float(np.abs(poles).max()))
    if not loop.every:
        return found._replace(step=0.0)
    ends = closed.strengths[[0, -1]]
    gains = loop.inner + ends[:, None, None] * closed.K
    return found._replace(
        step=longest_step(A + B @ loop.inner, B, list(gains)),
        factors=margins.gain_margin(closed),
        delay=margins.delay_margin(closed).delay,
        certified=certified_set(loop),
        advice=_advice(gain, loop),
    )


def _advice(gain: Gain, loop: CheckedLoop) -> str:
    """Return what else to know: of an inner loop, an edge or a leader that makes it faster.

    Any graph keeps it stable, and so the graph alone sets its rate.
    """
    graph = loop.parts.graph
    followers, pairs = len(graph.followers), graph.agents * (graph.agents - 1) // 2
    if gain.inner is None or followers > _ADVISED:
        return ""
    more = int(followers > 1), int(len(graph.edges) < pairs)
    return speedup(loop.parts.model, graph, gain, *more).sentence()


def _arguments(method: type[Method], scenario: Scenario) -> dict[str, Any]:
    """Return what the scenario says of this method, and its domain for those that need one."""
    spec = scenario.follower.gain
    if spec.method == method.name and spec.file is None:
        return {**method.usual, **spec.arguments}
    domain = {} if spec.domain is None or "domain" not in method.needs else {"domain": spec.domain}
    return {**method.usual, **domain}
