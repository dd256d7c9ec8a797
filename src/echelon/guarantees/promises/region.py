"""Certificate of a gain's metric P on its domain, computed again for the parts that run.

The region stored in a gain is a claim about the parts for which it was computed. Here the Jacobians
are enclosed for the model that runs, the strength 2 c lambda_min is that of its coupling and graph,
and a proof is repeated. The results are cached per process. The certified set are the starts from
which no follower leaves the domain.
"""

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from echelon.agents.models.linearization import at_trim, linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.straight_range import straight_range
from echelon.core.digits import about, at_least, at_most
from echelon.core.errors import GainError
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Feedforward, Kind, Theorem, Verdict
from echelon.guarantees.promises.leaders import Leaders, excursion, own_paths, own_run
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import simulate
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate
from echelon.synthesis.certificates.domain import Domain
from echelon.synthesis.certificates.domain_metrics import (
    DomainPairs,
    contracting_region,
    drift_region,
    pairs_on,
)
from echelon.synthesis.certificates.jacobians import (
    constant_inputs,
    has_constant_input_map,
    jacobians,
    unfelt_states,
)
from echelon.synthesis.certificates.lmi import falls
from echelon.synthesis.gains.gain import Gain

_NAME = Hypothesis.REGION
_INNER = "the hull is of the drift without the gain's inner loop", "remove the inner loop"
_ROUNDED = 1e-9  # of a normalized input
_SLACK = 0.01
"""Of the radius of a set, within which a run that enters it has to be."""
_FRAMES, _AGENT_STEPS = 4_000, 10_000_000
"""Stored frames of a run into a set, and the most steps of all agents that it may take."""
_NEAR = 1e-3
"""How far about a trim the slopes of its sides are looked at, in units of each state."""


class Region(NamedTuple):
    """What is promised on a domain, if anything, the line that says so, and the bare claim.

    Attributes:
        certificate: of the law that runs; None where nothing is promised.
        relayed: what the metric promises where the leader's input is relayed; None for nothing.
    """

    certificate: RegionCertificate | None
    relayed: RegionCertificate | None
    line: Statement


def region_of(parts: Parts, settings: Settings, leaders: Leaders) -> Region:
    """Return what is promised on the domain that the gain of prepared parts was made for."""
    gain = parts.drive.gain
    if gain is not None and gain.certificate.region is None and at_trim(parts.model).kinks.any():
        return _region_at_bend(parts, settings, leaders, gain)
    if gain is None or gain.certificate.region is None:
        text = "a gain by `robust-lqr` or `contraction` with a `domain` has one"
        return Region(None, None, unneeded(_NAME, Kind.PROOF, text, number_text="none"))
    try:
        certificate = _computed(parts, gain, gain.certificate.region)
    except GainError as error:
        return Region(None, None, _lost(str(error).rstrip("."), "compute the gain again"))
    if certificate is None and not _strength(parts, gain) > 0.0:
        text = "on this graph no sum of squares is known that decreases for all slopes"
        return Region(None, None, _lost(text, "make the links bidirectional"))
    if certificate is None:
        text = f"P does not contract on the domain at coupling {about(gain.coupling, 4)}, "
        text += f"2 c lambda_min = {about(_strength(parts, gain), 4)}"
        return Region(None, None, _lost(text, "raise `coupling`, or shrink the `domain`"))
    why = _INNER if gain.inner is not None else _not_the_law(parts, settings, leaders, certificate)
    if why[0]:
        return Region(None, certificate, _lost(*why))
    other = _other_agents(parts)
    if other:
        return Region(
            None, certificate, _lost(f"{certificate.theorem} is about {other}", _LEAVE_OUT)
        )
    return Region(certificate, certificate, _line(parts, certificate))


_LEAVE_OUT = "leave out of the world what differs from that"


def _other_agents(parts: Parts) -> str:
    """Return what a theorem is about, where the agents that run are others; empty where not."""
    if parts.drive.unknown:
        return "echelon's own laws and members of a step"
    return parts.world.presumed


def _region_at_bend(parts: Parts, settings: Settings, leaders: Leaders, gain: Gain) -> Region:
    """It has no linearization there, but a hull holds the slopes of all its sides nearby."""
    text = "the model is not differentiable at the trim, and its slopes there do not all contract"
    none = unneeded(_NAME, Kind.VERTICES, text, number_text="none")
    try:
        pairs = _with_inner(parts, gain, pairs_on(parts.model, _near(parts.model), gain.R))
        certificate = pairs and _contraction(parts, gain, pairs, exact=False)
    except GainError:
        certificate = None
    if (
        certificate is None
        or certificate.kind is Kind.SAMPLES
        or _not_the_law(parts, settings, leaders, certificate)[0]
    ):
        return Region(None, None, none)
    return Region(certificate, None, _line(parts, certificate))


def _near(model: ControlAffine) -> Domain:
    return Domain.about(model, dict.fromkeys(model.state_names, _NEAR))


def adjacent_slopes(parts: Parts) -> Array | None:
    """Return the drift's slopes on all sides of the trim, (K, n, n); None where none are found."""
    gain = parts.drive.gain
    try:
        return None if gain is None else pairs_on(parts.model, _near(parts.model), gain.R).A
    except GainError:
        return None


def _with_inner(parts: Parts, gain: Gain, pairs: DomainPairs) -> DomainPairs | None:
    """Return the slopes with a gain's inner loop closed; None where g turns what the loop does."""
    if gain.inner is None:
        return pairs
    if pairs.W is not None:
        return None
    linear = linearize(parts.model)
    # g is constant, so the loop adds the same matrix to every slope.
    closed = pairs.A + (linear.with_inner(gain.inner).A - linear.A)
    return pairs._replace(A=closed, jacobians=pairs.jacobians._replace(matrices=closed))


def _contraction(
    parts: Parts, gain: Gain, pairs: DomainPairs, exact: bool
) -> RegionCertificate | None:
    B, spectrum = linearize(parts.model).B, parts.graph.spectrum()
    return contracting_region(pairs, gain.P, B, gain.R, exact, gain.coupling, spectrum)


def _computed(parts: Parts, gain: Gain, claim: RegionCertificate) -> RegionCertificate | None:
    model, spectrum, exact = parts.model, parts.graph.spectrum(), claim.kind is Kind.PROOF
    domain = _opened(model, claim.domain, gain.R)
    if claim.theorem is Theorem.A5:
        hull = jacobians(model, domain)
        if not falls(gain.P, hull.matrices):
            return None
        return drift_region(model, domain, hull, gain.P, gain.coupling, spectrum)
    return _contraction(parts, gain, pairs_on(model, domain, gain.R), exact)


def _opened(model: ControlAffine, domain: Domain, R: Array) -> Domain:
    """Return a domain without the bounds of states on which no slope depends."""
    free = unfelt_states(model, domain) & np.isfinite(domain.lower) & np.isfinite(domain.upper)
    if free.any():
        lower, upper = np.where(free, -np.inf, domain.lower), np.where(free, np.inf, domain.upper)
        wider = Domain(lower, upper, domain.input_lower, domain.input_upper)
        here = pairs_on(model, domain, R).jacobians
        try:
            there = pairs_on(model, wider, R).jacobians
        except GainError:
            return domain.straight(model)
        if there.kind is here.kind and np.array_equal(there.matrices, here.matrices):
            domain = wider
    return domain.straight(model)


def _strength(parts: Parts, gain: Gain) -> float:
    return 2.0 * gain.coupling * parts.graph.spectrum().proved


def _not_the_law(
    parts: Parts, settings: Settings, leaders: Leaders, certificate: RegionCertificate
) -> tuple[str, str]:
    """Return why what is fed forward takes away what the metric could keep, and what would not."""
    if _turns_away(parts, leaders):
        text = f"the law turns with the leader's heading, and {certificate.theorem} needs fixed "
        return f"{text}axes", "keep the leader's heading at the trim's"
    feedforward, theorem = parts.drive.feedforward, certificate.theorem
    # The parent of all is a leader where no agent is farther away, and what it sends is relayed.
    if feedforward is Feedforward.PARENT and parts.graph.depths().max() > 1:
        text = "parents' inputs are fed forward, and the modes are no longer those of a symmetric "
        return f"{text}matrix, which {theorem} rests on", "set `feedforward: relay`"
    if feedforward is Feedforward.NONE and not leaders.rest:
        text = f"{theorem} needs the leader's input at every follower, or at rest at its trim"
        return text, "set `feedforward: relay`"
    # A leader at its trim makes no velocity beyond it, and its raw input is that of the trim.
    if feedforward is Feedforward.RELAY_VELOCITY and theorem is Theorem.T2 and not leaders.rest:
        text = "T2 covers the leader's raw input; what each agent computes from its velocity "
        return f"{text}varies with g, and is not enclosed", "set `feedforward: relay`"
    if not leaders.agree:
        return f"{theorem} covers one leader, or leaders that agree", "start them alike"
    return _uncovered_input(parts, settings, leaders, certificate.domain)


def _uncovered_input(
    parts: Parts, settings: Settings, leaders: Leaders, domain: Domain
) -> tuple[str, str]:
    """Slopes of f + g u depend on u where g varies; those in the hull are of the domain's u."""
    model, count = parts.model, len(leaders.starts)
    varying = ~constant_inputs(model, domain)
    if leaders.rest or not varying.any():
        return "", ""
    if leaders.answer:
        text = "the leader reacts to followers, and its inputs depend on them"
        return text, "set `leader.reacts: false`"
    run = own_run(parts, settings, leaders.starts)
    if run is None:
        return "the leader alone diverges", "give `leader.gain` another method"
    v = model.normalized(run.inputs[:, :count]).reshape(-1, len(model.input_names))
    beyond = np.maximum(v - domain.input_upper, domain.input_lower - v) * varying
    frame, k = np.unravel_index(beyond.argmax(), beyond.shape)
    # A law that computes its trim is off by rounding.
    if beyond[frame, k] <= _ROUNDED:
        return "", ""
    low, high, name = domain.input_lower[k], domain.input_upper[k], model.input_names[k]
    text = f"the leader's own input reaches {about(v[frame, k])} in `{name}`, and the hull covers "
    text += f"[{at_least(low)}, {at_most(high)}]"
    return text, f"name `{name}` in the `domain`, or slow the reference"


def _turns_away(parts: Parts, leaders: Leaders) -> bool:
    """Tell whether the law may be another than in the trim's axes."""
    if not (isinstance(parts.drive, Laws) and parts.drive.follower.turning):
        return False
    # A leader that rests at its trim keeps its heading.
    trim = np.asarray(parts.model.trim[0], float)
    return not (leaders.rest and (leaders.starts == trim).all())


def weaken(parts: Parts, region: Region, lines: Iterable[Statement]) -> Region:
    """Return a region no stronger than what its hypotheses say of the offsets on its domain."""
    [line] = (x for x in lines if x.statement is Hypothesis.SYMMETRY)
    certificate, needed = region.certificate, line.verdict is not Verdict.NOT_NEEDED
    if certificate is None:
        return region
    tried = {}
    if needed:
        tried["the offsets are tried at samples of the domain, and not proved"] = line.kind
    if not straight_range(parts.model).proved:
        tried["differences of states are x - y at samples, and not proved"] = Kind.SAMPLES
    for why, kind in tried.items():
        if kind.strength < certificate.kind.strength:
            certificate = dataclasses.replace(certificate, kind=kind, why=why)
            region = region._replace(certificate=certificate, line=_line(parts, certificate))
    return region


def domain_in_words(parts: Parts, certificate: RegionCertificate) -> str:
    """Return the bounds of a region, with those of all inputs where its slopes depend on them."""
    domain, model = certificate.domain, parts.model
    return domain.in_words(model, ~constant_inputs(model, domain))


def _lost(text: str, remedy: str) -> Statement:
    return fails(_NAME, Kind.PROOF, text, None, "none", remedy=remedy)


def _line(parts: Parts, certificate: RegionCertificate) -> Statement:
    theorem, kind = certificate.theorem, certificate.kind
    text = f"{theorem}: {theorem.value} {domain_in_words(parts, certificate)}"
    text += f"; no more than {kind}, since {certificate.why}" if certificate.why else ""
    skew = parts.graph.spectrum().skew
    if skew > 1.0:
        text += f"; their squares weighted as T7 has it, {at_least(skew)} to 1 at most"
    return holds(_NAME, kind, text, certificate.rate, f"{at_most(certificate.rate)} 1/s")


# ---- the certified set ---------------------------------------------------------------------------


class CertifiedSet(NamedTuple):
    """{sum_i delta_i'P delta_i <= radius^2}, from which no follower leaves the domain.

    Attributes:
        radius: 0 where the set is empty, infinite where the domain bounds nothing.
        kind: of the argument; samples where the leader's excursion is read off a run of its own.
        by_run: whether it is.
        stays: whether all that is inside stays, as inputs are held, with no limit acting on it.
    """

    radius: float
    kind: Kind
    why: str
    remedy: str = ""
    by_run: bool = False
    stays: bool = False

    @property
    def entered_for_good(self) -> bool:
        """Whether a run that enters it is known from there on."""
        return self.stays and 0.0 < self.radius < np.inf

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON, where an infinite radius is None."""
        radius = self.radius if self.radius < float("inf") else None
        return {"radius": radius, "kind": str(self.kind), "why": self.why}


def certified_set(
    parts: Parts, settings: Settings, leaders: Leaders, region: RegionCertificate | None
) -> CertifiedSet | None:
    """Return the set that a region of theorem T1 or A5 certifies, less the leader's excursion.

    r^2 = min_j (margin_j - excursion_j)^2 / W_jj, W = P^-1. Where only the drift is known (A5) and
    g varies, what cannot rise is V = delta'(L kron P) delta, which costs the factor
    lambda_min / lambda_max.
    """
    if region is None or region.theorem is Theorem.T2:
        return None
    kind, free = region.kind, region.theorem is Theorem.A5
    if free and not leaders.rest and not _constant(parts, region):
        text = "g varies, and a moving leader then adds to V"
        return CertifiedSet(0.0, kind, text, "use a model whose g is constant")
    trim = np.asarray(parts.model.trim[0], float)
    if leaders.rest and (leaders.starts == trim).all():
        return _less(parts, region, kind, np.zeros(len(trim)))
    if leaders.answer:
        text = "the leader reacts to followers, so its excursion depends on them"
        return CertifiedSet(0.0, kind, text, "set `leader.reacts: false`")
    paths = own_paths(parts, settings, leaders.starts)
    if paths is None:
        text = "the leader alone diverges"
        return CertifiedSet(0.0, kind, text, "give `leader.gain` another method")
    return _less(parts, region, Kind.SAMPLES, excursion(parts, paths))._replace(by_run=True)


def _less(parts: Parts, region: RegionCertificate, kind: Kind, away: Array) -> CertifiedSet:
    """Return the set that is left when the leader goes so far from the trim, (n,)."""
    gain, model = parts.drive.gain, parts.model
    assert gain is not None
    margins = region.domain.margins()
    radii = np.maximum(margins - away, 0.0) / np.sqrt(np.diag(np.linalg.inv(gain.P)))
    if not np.isfinite(radii).any():
        return CertifiedSet(np.inf, region.kind, "everywhere: the domain bounds no state")
    j = int(np.argmin(radii))
    name, wide = model.state_names[j], margins[j]
    if radii[j] == 0.0:
        text = f"the leader alone reaches {about(away[j])} in `{name}`, "
        text += f"and the domain {about(wide)}"
        return CertifiedSet(0.0, kind, text, "widen the domain, or slow the reference")
    # On a directed graph a sum with weights falls, which one agent's share may exceed so much.
    shrink = 1.0 / np.sqrt(parts.graph.spectrum().skew)
    if region.theorem is Theorem.A5 and not _constant(parts, region):
        shrink = np.sqrt(parts.graph.spectrum().proved / parts.graph.spectrum().high)
    text = f"of sum_i delta_i'P delta_i <= r^2, limited by `{name}`: {at_most(wide)}"
    text += f" less {at_least(away[j])} of the leader" if away.any() else ", leader at the trim"
    return CertifiedSet(float(shrink * radii[j]), kind, text)


def within(
    certified: CertifiedSet | None, radius: float, limits: Statement, held: Statement
) -> CertifiedSet | None:
    """Return a certified set that is no larger than one in which no limit of an input acts.

    It holds what is inside where its lines on limits and on held inputs do not fail.
    """
    if certified is None:
        return None
    certified = certified._replace(stays=not (limits.fails or held.fails))
    if certified.radius <= radius:
        return certified
    text = "of sum_i delta_i'P delta_i <= r^2, limited by the inputs"
    remedy = "slow the reference, or strengthen the actuators"
    return certified._replace(radius=radius, why=text, remedy=remedy)


def _constant(parts: Parts, region: RegionCertificate) -> bool:
    return has_constant_input_map(parts.model, region.domain)


def sizes_of(parts: Parts, states: Array) -> Array:
    """Return r (...) of {sum_i delta_i'P delta_i = r^2}, on which states (..., N, n) lie."""
    gain = parts.drive.gain
    assert gain is not None
    y = states - parts.formation.offsets
    delta = y - y[..., list(parts.graph.nearest_leader()), :]
    return np.sqrt(np.einsum("...ia,ab,...ib->...", delta, gain.P, delta))


def set_line(region: RegionCertificate | None, certified: CertifiedSet | None) -> Statement:
    """Say which set of starts is certified."""
    if certified is None:
        return unneeded(Hypothesis.SET, Kind.PROOF, _no_set(region))
    if certified.radius > 0.0:
        number = certified.radius, f"radius {at_most(certified.radius)}"
        return holds(Hypothesis.SET, certified.kind, certified.why, *number)
    return fails(
        Hypothesis.SET,
        certified.kind,
        certified.why,
        certified.radius,
        "empty",
        remedy=certified.remedy,
    )


def entry(
    parts: Parts, settings: Settings, states: Array, certified: CertifiedSet | None
) -> float | None:
    """Return when (s) a run from states (N, n) outside of a set enters it; None where it does not.

    A share of the radius is left for rounding.
    """
    if certified is None or not (certified.entered_for_good and parts.world.ideal):
        return None
    many = settings.steps * len(states) > _AGENT_STEPS
    if many or sizes_of(parts, states) <= certified.radius:
        return None
    stored = settings._replace(store_every=1 + settings.steps // _FRAMES, precision="float64")
    result = simulate(parts.replace(initial=states, start_error={}), stored)
    return entered(result, certified.radius * (1.0 - _SLACK))


def entered(result: Result, radius: float) -> float | None:
    """Return the time (s) of the first stored frame in a set of some radius; None without one."""
    if result.formation.motion is not None:
        return None  # places are those of the start
    with np.errstate(over="ignore", invalid="ignore"):
        inside = np.flatnonzero(sizes_of(result.parts, result.states) <= radius)
    return float(result.times[inside[0]]) if len(inside) else None


def starts_line(
    parts: Parts,
    states: Array,
    region: RegionCertificate | None,
    certified: CertifiedSet | None,
    enters: float | None,
) -> Statement:
    """Say whether starts (N, n) lie in the set, or a run from them `enters` it (s)."""
    if certified is None:
        return unneeded(Hypothesis.STARTS, Kind.PROOF, _no_set(region))
    size = float(sizes_of(parts, states))
    number = size, f"{at_least(size)} of {at_most(certified.radius)}", certified.radius
    if size <= certified.radius:
        text = "no follower leaves the domain from these starts"
        return holds(Hypothesis.STARTS, certified.kind, text, *number)
    if enters is not None:
        text = f"a run from these starts enters the set at {at_least(enters)} s"
        return holds(Hypothesis.STARTS, Kind.SAMPLES, text, *number)
    text, remedy = "the starts are outside the certified set", "start nearer to the goals"
    return fails(Hypothesis.STARTS, certified.kind, text, *number, remedy=remedy)


def _no_set(region: RegionCertificate | None) -> str:
    local = region is not None and region.theorem is Theorem.T2
    return "T2 is local and certifies no set" if local else "needs a region"
