"""All gain methods on one scenario, side by side, and one of them recommended."""

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.errors import (
    EchelonError,
    GainError,
    ScenarioError,
    did_you_mean,
    listing,
)
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis
from echelon.core.words import Theorem
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.law_sections import GainSpec
from echelon.experiments.scenario.named_class import resolve
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.yaml import Fault
from echelon.experiments.studies.speedup import speedup
from echelon.guarantees.promises.promise import LawDesign, Promise, promise, prover_of
from echelon.laws.consensus import Consensus
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates import margins
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.gains.fixed import FixedGain
from echelon.synthesis.gains.gain import Gain, Method, synthesize

_ADVISED = 100
"""Followers of the largest swarm that is advised on its graph; of more it would take minutes."""


class Design(NamedTuple):
    """One method on the scenario: its gain and what is known of it, or why there is none.

    Attributes:
        method: its name.
        gain: None where there is none, and then `reason` says why.
        parts: of the scenario with that gain.
        promise: of these parts.
        reason: empty where there is a gain.
        fastest: largest modulus of a pole of the loop, 1/s.
        step: the longest step (s) with inputs held with which every mode looked at decays.
        factors: the interval of factors on the coupling that it bears; None if unstable.
        delay: of all disagreements that it bears, s; None if unstable.
        advice: what else a user of the method should know.
        seconds: what the synthesis took.
    """

    method: str
    gain: Gain | None
    parts: Parts | None = None
    promise: Promise | None = None
    reason: str = ""
    fastest: float | None = None
    step: float = 0.0
    factors: margins.GainMargin | None = None
    delay: float | None = None
    advice: str = ""
    seconds: float = 0.0

    @property
    def stable(self) -> bool:
        """Whether every mode of the disagreement decays."""
        found = self.promise
        return found is not None and found.decays

    def merit(self, dt: float) -> tuple[bool, int, int, float]:
        """Return what stable designs are ranked by, the better the larger.

        First that the step dt (s) is short enough, then the kind of argument, then its theorem,
        then the rate: of the theorem, or of the slowest mode near the trim.
        """
        assert self.promise is not None
        region, slowest = self.promise.region, self.promise.loop.slowest
        if region is None:
            return self.step > dt, 0, 0, -slowest
        theorem = _RANK[region.theorem]
        return self.step > dt, region.kind.strength, theorem, region.rate


_RANK = {Theorem.T1: 3, Theorem.T2: 2, Theorem.A5: 1}
"""Of errors of all sizes, of small ones, and of none that shrinks."""


class Designs(NamedTuple):
    """The methods that were tried, the one that is recommended if any, and why.

    `settings` are those that all were tried under. `law_design` is what else the followers' own law
    can be guaranteed with, if it seeks anything.
    """

    designs: tuple[Design, ...]
    recommended: Design | None
    because: str
    settings: Settings
    law_design: LawDesign | None = None


def design(scenario: Scenario | tuple[Parts, Settings], method: str | None = None) -> Designs:
    """Try the gain methods on a scenario, and recommend one.

    Args:
        scenario: a scenario, or its parts and settings. Of a scenario a method keeps the keys that
            are its own, and its domain; of parts, the domain that their gain was made for.
        method: the only one to try.

    Raises:
        EchelonError: a part is malformed or does not fit the others. A method that does not apply
            is a design with its reason.
    """
    if method is not None and method not in registry.METHODS:
        raise GainError(
            f"`method` is `{method}`, allowed are {listing(registry.METHODS)}"
            f"{did_you_mean(method, registry.METHODS)}."
        )
    spec = scenario.follower.gain if isinstance(scenario, Scenario) else None
    built = _built(scenario) if isinstance(scenario, Scenario) else Experiment(*scenario)
    names = registry.METHODS if method is None else [method]
    methods = [resolve(registry.METHODS[name]) for name in names]
    tried = tuple(
        _tried(each, _arguments(each, spec, built.parts), built)
        for each in methods
        if method is not None or _chooses(each)
    )
    best, dt = recommended(tried, built.settings.dt), built.settings.dt
    why = "No method gives a stable loop here." if best is None else because(best, tried, dt)
    own = prover_of(built.parts.drive).design(*built) if method is None else None
    return Designs(tried, best, why, built.settings, own)


_ALWAYS = GainSpec(method=FixedGain.name, P="identity")
"""A gain that there is for every model."""


def _built(scenario: Scenario) -> Experiment:
    """Build a scenario; where its own gain alone cannot be made, with one that always can."""
    try:
        return build(scenario)
    except ScenarioError as error:
        faults: tuple[Fault, ...] = getattr(error, "faults", ())
        own = scenario.follower.gain
        # A file that is not there was meant to be, while a method that fails has its row.
        if own.file or own.python or {fault.field for fault in faults} != {"follower.gain"}:
            raise
        follower = scenario.follower.model_copy(update={"gain": _ALWAYS})
        built = build(scenario.model_copy(update={"follower": follower}))
        # A domain that is none is a mistake, and not what a method fails at.
        if own.domain is not None and not _is_domain(built.parts.model, own.domain):
            raise
        return built


def _is_domain(model: ControlAffine, bounds: Mapping[str, Any]) -> bool:
    try:
        Domain.about(model, bounds)
    except GainError:
        return False
    return True


def _chooses(method: type[Method]) -> bool:
    """Whether a method finds a gain by itself: one that wants a P, say, is no choice of design."""
    return {*method.needs} <= {"domain", *method.defaults}


def recommended(tried: tuple[Design, ...], dt: float) -> Design | None:
    """Return the best of the stable designs; None without any."""
    return max((d for d in tried if d.stable), key=lambda d: d.merit(dt), default=None)


def because(best: Design, tried: tuple[Design, ...], dt: float) -> str:
    """Return why a design is recommended, from the numbers by which it was chosen."""
    assert best.promise is not None
    others = [d for d in tried if d.stable and d is not best]
    rivals = [d for d in others if (d.step > dt) == (best.step > dt)]
    step = f"the scenario's step of {dt:g} s is short enough for it"
    if best.step <= dt:
        step = f"it needs a step below {best.step:.3g} s, and the scenario's is {dt:g} s"
    text = f"Recommended: {best.method}, because {_why(best, others, rivals, dt)}; {step}."
    # The step has been spoken of.
    against = [
        each.reason
        for each in best.promise.hypotheses.values()
        if each.fails and each.reason and each.statement is not Hypothesis.SAMPLING
    ]
    return f"{text} Nothing is promised with it: {'; '.join(against)}." if against else text


def _why(best: Design, others: list[Design], rivals: list[Design], dt: float) -> str:
    """Return what sets a design apart from its rivals, those with which it shares the step."""
    assert best.promise is not None
    _, *argument, rate = best.merit(dt)
    if not others:
        return "it is the only one whose loop is stable"
    if not rivals:
        return f"of {1 + len(others)} stable loops it alone holds the scenario's step"
    loops = f"{1 + len(rivals)} stable loops"
    if len(rivals) < len(others):
        loops += f" that {'hold' if best.step > dt else 'do not hold'} the scenario's step"
    region = best.promise.region
    if region is None:
        text = f"of {loops}, none with more than a promise at the trim, its slowest mode is the "
        return f"{text}fastest, {-rate:.3g} 1/s"
    alike = 1 + sum([*d.merit(dt)[1:3]] == argument for d in rivals)
    text = f"it promises most of {loops}: {rate:.3g} 1/s on its domain "
    text += f"({region.kind}, {region.theorem})"
    return text if alike == 1 else f"{text}, the fastest of {alike} by that argument"


def _tried(method: type[Method], arguments: dict[str, Any], built: Experiment) -> Design:
    """Try one method; an optional part that is missing is a reason like any other."""
    name, (parts, settings) = method.name, built
    missing = [key for key in method.needs if key not in arguments]
    if missing:
        return Design(name, None, reason=_wish(name, missing, parts))
    began = time.perf_counter()
    try:
        gain = synthesize(parts.model, parts.graph, method(**arguments))
    except EchelonError as error:
        return Design(name, None, reason=str(error), seconds=time.perf_counter() - began)
    # Of the synthesis alone; what is promised is computed alike for all.
    seconds = time.perf_counter() - began
    parts = with_gain(parts, gain)
    found = promise(parts, settings)
    with precision("float64"):
        return _known(gain, parts, settings, found)._replace(seconds=seconds)


def _wish(method: str, missing: list[str], parts: Parts) -> str:
    """Return how a scenario gives a method the keys that it misses."""
    model = parts.model
    state = [*model.state_groups, *model.state_names][0]
    shown = {"domain": f"domain: {{{state}: HALF_WIDTH, ...}}"}
    keys = ", ".join(shown.get(key, f"{key}: ...") for key in missing)
    gain = f"{{method: {method}, {keys}}}"
    if parts.drive.gain is None:
        # The scenario's own law takes none, so that a gain beside it would be refused.
        return f"give `follower={{law: consensus, gain: {gain}}}` to try it"
    return f"give `follower.gain={gain}` to try it"


def with_gain(parts: Parts, gain: Gain) -> Parts:
    """Return the parts under another gain, the feed-forward kept."""
    drive = parts.drive
    law = Consensus(gain, drive.feedforward, drive.trimmed, drive.frame)
    return parts.replace(drive=drive.with_follower(law))


def _known(gain: Gain, parts: Parts, settings: Settings, found: Promise) -> Design:
    """Return what is known of a gain."""
    loop = found.loop
    (A, B), closed = loop.linear, loop.closed
    poles = np.linalg.eigvals(A - closed.strengths[:, None, None] * (B @ closed.K))
    known = Design(gain.method, gain, parts, found, fastest=float(np.abs(poles).max()))
    if not (loop.every and found.linear):
        return known if found.linear else known._replace(fastest=None)
    return known._replace(
        step=found.longest_step(settings),
        factors=margins.gain_margin(closed),
        delay=margins.delay_margin(closed).delay,
        advice=_advice(gain, parts),
    )


def _advice(gain: Gain, parts: Parts) -> str:
    """Return what else to know: of an inner loop, an edge or a leader that makes it faster.

    Any graph keeps it stable, and so the graph alone sets its rate.
    """
    graph = parts.graph
    followers, pairs = len(graph.followers), graph.agents * (graph.agents - 1) // 2
    fixed = not graph.directed and graph.schedule is None
    if gain.inner is None or followers > _ADVISED or not fixed:
        return ""
    # The last follower must stay one, and a complete graph has no pair left to link.
    more = int(followers > 1), int(len(graph.edges) < pairs)
    return speedup(parts.model, graph, gain, *more).sentence()


def _arguments(method: type[Method], spec: GainSpec | None, parts: Parts) -> dict[str, Any]:
    """Return what the scenario says of this method, and its domain for those that need one."""
    made = spec is not None and spec.file is None and spec.python is None
    if spec is not None and made and spec.method == method.name:
        return {**method.defaults, **spec.arguments}
    gain = parts.drive.gain
    claim = None if gain is None else gain.certificate.region
    domain = claim.domain if spec is None and claim is not None else None
    domain = spec.domain if spec is not None else domain
    given = {} if domain is None or "domain" not in method.needs else {"domain": domain}
    return {**method.defaults, **given}
