"""Compares all gain methods on a scenario, recommends one of them, or changes of a run."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.core.digits import at_most
from echelon.core.errors import EchelonError, GainError, ScenarioError, check_name
from echelon.core.files import notebook_page
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis
from echelon.core.words import Theorem
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.named_class import resolve
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.sections import GainSpec
from echelon.experiments.scenario.yaml import ScenarioFault
from echelon.guarantees.local.step_margins import GainMargin, delay_margin, gain_margin
from echelon.guarantees.promises.integral_modes import sum_costs, sum_sentence
from echelon.guarantees.promises.promise import Guarantee, guarantee
from echelon.laws.consensus import Consensus
from echelon.laws.integral_check import sums_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.gains.gain import FixedGain, Gain, Method, synthesize
from echelon.synthesis.gains.integral import Integral
from echelon.synthesis.gains.riccati import InnerLoop


class Design(NamedTuple):
    """A method on the scenario: its gain with its properties, or the reason why there is none.

    Attributes:
        gain: None where the method fails, for the `reason`.
        parts: of the scenario with that gain.
        fastest: largest modulus of a pole of the loop, 1/s.
        step: the longest sampling period (s) for which all checked modes remain stable.
        factors: the interval of factors on the coupling with which the steps that run decay; None
            if they do not, or agents do not split by the graph.
        delay: by how much all disagreements may be late in them, s, in whole steps; None likewise.
        seconds: computing time of the synthesis.
    """

    method: str
    gain: Gain | None
    parts: Parts | None = None
    promise: Guarantee | None = None
    reason: str = ""
    fastest: float | None = None
    step: float = 0.0
    factors: GainMargin | None = None
    delay: float | None = None
    seconds: float = 0.0

    @property
    def stable(self) -> bool:
        """Whether every mode of the disagreement decays."""
        return self.promise is not None and self.promise.decays

    def merit(self, dt: float) -> tuple[bool, int, int, float]:
        """Return the key by which stable designs are ranked, larger for better ones.

        First whether the step dt (s) is short enough, then the kind of argument, its theorem, and
        the rate: of the theorem, or of the slowest mode of the linearization.
        """
        assert self.promise is not None
        region, slowest = self.promise.region, self.promise.loop.slowest
        if not self.promise.governed:
            slowest = self.promise.slowest or 0.0
        if region is None:
            return self.step > dt, 0, 0, -slowest
        theorem = _RANK[region.theorem]
        return self.step > dt, region.kind.strength, theorem, region.rate


_RANK = {Theorem.T1: 3, Theorem.T2: 2, Theorem.A5: 1}
"""For errors of all sizes, for small errors, and without decay."""


class Designs(NamedTuple):
    """The designs of all methods, the recommended one if any, the reason, and their settings."""

    designs: tuple[Design, ...]
    recommended: Design | None
    because: str
    settings: Settings

    def _repr_html_(self) -> str:
        return notebook_page("report", self)


def design(
    scenario: Scenario | tuple[Parts, Settings],
    method: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Designs:
    """Apply the gain methods to a scenario, and recommend one.

    Args:
        scenario: a scenario, or its parts and settings. A method uses its keys in the scenario and
            the domain there; with parts, the domain of their gain.
        method: the only method, all by default.
        progress: called before each method with the number of those that are done, and of all.

    Raises:
        EchelonError: a part is malformed or does not fit the others. A method that does not apply
            is a design with its reason.
    """
    if method is not None:
        check_name("`method` is", method, registry.METHODS, GainError)
    spec = scenario.follower.gain if isinstance(scenario, Scenario) else None
    built = _built(scenario) if isinstance(scenario, Scenario) else Experiment(*scenario)
    names = registry.METHODS if method is None else [method]
    methods = [resolve(registry.METHODS[name]) for name in names]
    # A method that needs a P, for example, does not compute a gain by itself.
    able = [cls for cls in methods if method or _computes(cls)]
    designs = list[Design]()
    for cls in able:
        progress(len(designs), len(able))
        designs.append(_design(cls, _arguments(cls, spec, built.parts), built))
    designs = tuple(designs)
    best, dt = recommended(designs, built.settings.dt), built.settings.dt
    reason = _why_none(designs) if best is None else because(best, designs, dt)
    return Designs(designs, best, reason, built.settings)


def _computes(cls: type[Method]) -> bool:
    return not cls.literal and {*cls.needs} <= {"domain", *cls.defaults}


_SIMPLE_GAIN = GainSpec(method=FixedGain.name, P="identity")
"""A gain that exists for every model."""


def _built(scenario: Scenario) -> Experiment:
    """Build a scenario; if only its gain cannot be computed, with a gain that exists always."""
    try:
        return build(scenario)
    except ScenarioError as error:
        faults: tuple[ScenarioFault, ...] = getattr(error, "faults", ())
        spec = scenario.follower.gain
        # A missing file is a mistake, while a method that fails is a design with its reason.
        if spec.file or spec.python or {fault.field for fault in faults} != {"follower.gain"}:
            raise
        follower = scenario.follower.model_copy(update={"gain": _SIMPLE_GAIN})
        built = build(scenario.model_copy(update={"follower": follower}))
        # An invalid domain is a mistake too.
        if spec.domain is not None and not _is_domain(built.parts.model, spec.domain):
            raise
        return built


def _is_domain(model: ControlAffine, bounds: Mapping[str, Any]) -> bool:
    try:
        Domain.about(model, bounds)
    except GainError:
        return False
    return True


def recommended(designs: tuple[Design, ...], dt: float) -> Design | None:
    """Return the best of the stable designs; None without any."""
    return max((d for d in designs if d.stable), key=lambda d: d.merit(dt), default=None)


def _why_none(designs: tuple[Design, ...]) -> str:
    """Return that no design is recommended, and what stands against a guarantee of all of them."""
    each = [set(d.promise.reasons) for d in designs if d.promise is not None]
    common = sorted(set.intersection(*each)) if each else []
    text = "No method gives a stable loop here"
    return f"{text}: {'; '.join(common)}." if common else f"{text}."


def because(best: Design, designs: tuple[Design, ...], dt: float) -> str:
    """Return why a design is recommended, from the numbers by which it was chosen."""
    assert best.promise is not None
    step = f"The scenario's step of {dt:g} s is short enough."
    if best.step <= dt:
        step = f"It needs a step below {at_most(best.step)} s; the scenario's is {dt:g} s."
    others = [d for d in designs if d.stable and d is not best]
    text = f"Recommended: {best.method}. {_advantage(best, others, dt)} {step}"
    assert best.parts is not None
    text = f"{text} {sum_sentence(best.parts, best.promise.loop)}".rstrip()
    # The step has been mentioned.
    reasons = [
        line.reason
        for line in best.promise.hypotheses.values()
        if line.fails and line.reason and line.statement is not Hypothesis.SAMPLING
    ]
    return f"{text} Nothing is guaranteed with it: {'; '.join(reasons)}." if reasons else text


def _advantage(best: Design, others: list[Design], dt: float) -> str:
    assert best.promise is not None
    _, *argument, rate = best.merit(dt)
    rivals = [d for d in others if (d.step > dt) == (best.step > dt)]
    if not others:
        return "It is the only stable design."
    if not rivals:
        text = f"Of {1 + len(others)} stable designs only this one is "
        return f"{text}stable at the scenario's step."
    number = {1: "both"}.get(len(rivals), f"all {1 + len(rivals)}") + " stable designs"
    if len(rivals) < len(others):
        number += f" with a step {'above' if best.step > dt else 'below'} the scenario's"
    region = best.promise.region
    if region is None:
        local = f"{number[0].upper()}{number[1:]} are only locally guaranteed"
        return f"{local}; this one converges fastest ({at_most(rate)} 1/s)."
    same = 1 + sum([*d.merit(dt)[1:3]] == argument for d in rivals)
    text = f"Of {number} it has the strongest guarantee: {at_most(rate)} 1/s on its domain "
    text += f"({region.kind}, {region.theorem})"
    return f"{text}." if same == 1 else f"{text}, the fastest of {same} with this argument."


def _design(method: type[Method], arguments: dict[str, Any], built: Experiment) -> Design:
    """Return the design of a method; a missing optional dependency is a reason like any other."""
    name, (parts, settings) = method.name, built
    missing = [key for key in method.needs if key not in arguments]
    if missing:
        return Design(name, None, reason=_missing_keys(name, missing, parts))
    began = time.perf_counter()
    try:
        gain = synthesize(parts.model, parts.graph, method(**arguments))
    except EchelonError as error:
        return Design(name, None, reason=str(error), seconds=time.perf_counter() - began)
    # Without the promise, whose computing time is the same for all.
    seconds = time.perf_counter() - began
    parts = with_gain(parts, gain)
    stated = guarantee(parts, settings)
    with precision("float64"):
        return _evaluate(gain, parts, settings, stated)._replace(seconds=seconds)


def _missing_keys(method: str, missing: list[str], parts: Parts) -> str:
    model = parts.model
    state = [*model.state_groups, *model.state_names][0]
    examples = {"domain": f"domain: {{{state}: HALF_WIDTH, ...}}"}
    keys = ", ".join(examples.get(key, f"{key}: ...") for key in missing)
    gain = f"{{method: {method}, {keys}}}"
    if parts.drive.gain is None:
        # The scenario's law takes no gain, so it must be replaced too.
        law = registry.DEFAULT_FOLLOWER_LAW
        return f"set `follower={{law: {law}, gain: {gain}}}` to try it"
    return f"set `follower.gain={gain}` to try it"


def with_gain(parts: Parts, gain: Gain) -> Parts:
    """Return the parts with another gain and the same feed-forward.

    A leader that reacts to its neighbours does so by this gain.
    """
    drive = parts.drive
    law = Consensus(gain, drive.feedforward, drive.trimmed, drive.frame, integral=_sums(drive))
    law = law if law.integral is None else law.prepared(parts.model, parts.graph)
    if isinstance(drive, Laws) and getattr(drive.leader, "reaction", None) is not None:
        drive = Laws(eqx.tree_at(lambda leader: leader.reaction, drive.leader, gain), law)
    return parts.replace(drive=drive.with_follower(law))


def _sums(drive: Controller) -> Integral | None:
    """Return the integral action of the followers' law; None of a law without any."""
    return sums_of(drive.follower) if isinstance(drive, Laws) else None


def _evaluate(gain: Gain, parts: Parts, settings: Settings, guarantee: Guarantee) -> Design:
    loop = guarantee.loop
    (A, B), closed = loop.linear, loop.closed
    poles = np.linalg.eigvals(A - closed.strengths[:, None, None] * (B @ closed.K))
    design = Design(gain.method, gain, parts, guarantee, fastest=float(np.abs(poles).max()))
    costs = {cost.whose: cost for cost in sum_costs(parts, loop)}
    if "followers" in costs:
        design = design._replace(fastest=costs["followers"].fastest)
    if not (loop.every and guarantee.linear or "followers" in costs and guarantee.decays):
        return design if guarantee.linear else design._replace(fastest=None)
    design, steps = design._replace(step=guarantee.longest_step(settings)), guarantee.steps
    factors = None if steps is None else gain_margin(steps)
    if steps is None or factors is None:
        return design
    return design._replace(factors=factors, delay=delay_margin(steps).steps * settings.dt)


def _arguments(method: type[Method], spec: GainSpec | None, parts: Parts) -> dict[str, Any]:
    if spec is not None and not spec.file and not spec.python and spec.method == method.name:
        return {**method.defaults, **spec.arguments}
    gain = parts.drive.gain
    claim = None if gain is None else gain.certificate.region
    domain = claim.domain if spec is None and claim is not None else None
    domain = spec.domain if spec is not None else domain
    if domain is None or "domain" not in method.needs:
        return {**method.defaults}
    return {**method.defaults, "domain": domain}


# ---- what would give a run a guarantee -----------------------------------------------------------

_SHARE = 0.9
"""Share of the longest stable step for the checked modes, since further modes lie between them."""


def ways_out(parts: Parts, settings: Settings) -> tuple[str, ...]:
    """Return changes of a scenario under which something is guaranteed, where errors grow.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    stated = guarantee(parts, settings)
    hypotheses = Hypothesis.DISAGREEMENT_DECAY, Hypothesis.SAMPLING
    # A step that is too long for a short time only has no reason.
    grows = any(stated.hypotheses[hypothesis].reason for hypothesis in hypotheses)
    return tuple(_changes(parts, settings)) if grows else ()


def _changes(parts: Parts, settings: Settings) -> Iterator[str]:
    """Yield the changes of a scenario, quickly computed, under which something is guaranteed."""
    longest = _SHARE * guarantee(parts, settings).longest_step(settings)
    if 0.0 < longest < settings.dt:
        # With an integer fraction of the step, the horizon remains a whole number of steps.
        shorter = settings.dt / math.ceil(settings.dt / longest)
        if guarantee(parts, settings._replace(dt=shorter)).promised:
            yield f"simulation.dt={at_most(shorter, 6)}"
    law = parts.drive.follower if isinstance(parts.drive, Laws) else None
    if not isinstance(law, Consensus):
        return
    try:
        # An inner loop is stable with any coupling on any graph.
        gain = synthesize(parts.model, parts.graph, InnerLoop())
    except EchelonError:
        return
    changed = Consensus(gain, law.feedforward, law.trim, law.frame, integral=law.integral)
    drive = parts.drive.with_follower(changed)
    if guarantee(parts.replace(drive=drive), settings).promised:
        yield '"follower.gain={method: inner-loop}"'
