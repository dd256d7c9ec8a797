"""What is guaranteed by a linearization, or by a metric P: theorems T1, T2 and A5."""

import dataclasses
import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import cast, final

import numpy as np

from echelon.agents.models.linearization import at_trim
from echelon.core.claim import Claim, ClaimKind, Number, Rounding
from echelon.core.digits import about, at_least, at_most
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis, Statement, fails, holds, unneeded
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem
from echelon.guarantees.local.local_certificate import local_certificate
from echelon.guarantees.local.spectra import Split
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.closed_loop import LinearLoop, grounded_slowest, loop_of
from echelon.guarantees.promises.frozen_laws import frozen_of
from echelon.guarantees.promises.hypotheses import hypotheses
from echelon.guarantees.promises.integral_modes import longest_step_with_sums
from echelon.guarantees.promises.leaders import leaders_of
from echelon.guarantees.promises.limits_in_set import from_starts, held_line, limit_room
from echelon.guarantees.promises.modes import slowest_in_turns, turns_in_words
from echelon.guarantees.promises.promise import Guarantee, Promises, unknown_in
from echelon.guarantees.promises.region import (
    CertifiedSet,
    adjacent_slopes,
    certified_set,
    domain_in_words,
    entry,
    region_of,
    set_line,
    starts_line,
    weaken,
    within,
)
from echelon.laws.integral_check import sums_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts, Starts
from echelon.simulation.engine.prepare import Prepared
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate
from echelon.synthesis.gains.gain import Gain

# ---- what a gain claims of itself, compared ------------------------------------------------------

_SAME = 1e-6
"""Relative; less than that is rounding, or another library's eigenvalues."""
_ROUNDING = 1e-9  # of the fastest mode, in the slowest


def claims_line(parts: Parts, loop: LinearLoop, region: RegionCertificate | None) -> Statement:
    """Return whether the certificate that a gain carries is of what runs.

    `region` is what the metric promises here where the leader's input is relayed.
    """
    gain, name, kind = parts.drive.gain, Hypothesis.CLAIMS, Kind.LINEARIZATION
    if gain is None:
        law = getattr(parts.drive, "follower", None)
        text = "it is about the law without sums of errors" if sums_of(law) else "there is no gain"
        return unneeded(name, kind, text)
    text = _difference(parts, gain, loop, region)
    if text:
        return fails(name, kind, text, remedy="the guarantee here is computed from what runs")
    return holds(name, kind, "they agree with this model, graph and coupling")


def _difference(
    parts: Parts, gain: Gain, loop: LinearLoop, region: RegionCertificate | None
) -> str:
    claim, low = gain.certificate, parts.graph.spectrum().low
    if abs(claim.lambda_min - low) > _SAME * low:
        ours, theirs = about(low, 4), about(claim.lambda_min, 4)
        return f"the gain was made for lambda_min {theirs}, and this graph has {ours}"
    slowest = grounded_slowest(gain, loop.linear, parts.graph)
    fastest = float(np.abs(np.linalg.eigvals(loop.linear.A - loop.linear.B @ loop.gains[-1])).max())
    kinks = at_trim(parts.model).kinks.any()
    if not kinks and abs(claim.abscissa - slowest) > _SAME * abs(slowest) + _ROUNDING * fastest:
        text = f"the gain says that its slowest mode is {about(claim.abscissa, 4)} 1/s, and this "
        text += f"model at coupling {about(gain.coupling, 4)} has {about(slowest, 4)} 1/s"
        return text
    if claim.edge is not None and loop.certificate.edge is None:
        text = f"the gain says that every mode decays from coupling {about(claim.edge, 4)} on"
        return f"{text}, and here its argument does not hold"
    ours, theirs = _rate(region), _rate(claim.region)
    return "" if ours == theirs else f"the gain says {theirs} on its domain, and here it is {ours}"


def _rate(region: RegionCertificate | None) -> str:
    if region is None:
        return "nothing"
    kind, theorem = region.kind, region.theorem
    return f"{about(region.rate, 5)} 1/s ({kind}, {theorem})"


def _of_starts(
    parts: Parts,
    states: Array,
    region: RegionCertificate | None,
    certified: CertifiedSet | None,
    limits: Statement | None,
    enters: float | None,
) -> list[Statement]:
    """Return what changes with the starts (N, n): whether they lie in the set, and limits act."""
    starts = starts_line(parts, states, region, certified, enters)
    return [starts] if limits is None else [from_starts(limits, starts), starts]


# ---- the guarantee -------------------------------------------------------------------------------


@final
@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class MetricPromise(Guarantee):
    """What is guaranteed near the trim, and on a domain where a metric contracts there.

    Attributes:
        limits: in how large a set no limit acts, whatever the starts; None without a region.
        enters: when (s) a run from starts outside of the certified set enters it; None for never.
        turns: what the leader's heading may do, in words; empty where the law does not turn.
        slowest_turn: the slowest mode in the steady turns of `turns`, 1/s.
    """

    case: GuaranteeInputs
    limits: Statement | None = None
    enters: float | None = None
    turns: str = ""
    slowest_turn: float = -math.inf

    @classmethod
    def of(cls, prepared: Prepared, settings: Settings, brief: bool = False) -> "MetricPromise":
        """Return what is guaranteed of prepared parts."""
        parts, states = prepared.parts, prepared.problem.states
        leaders, loop, known = leaders_of(parts, states), loop_of(parts), not unknown_in(parts)
        region = region_of(parts, settings, leaders)
        case = GuaranteeInputs(
            parts,
            settings,
            loop,
            leaders,
            region.certificate,
            adjacent_slopes(parts) if at_trim(parts.model).kinks.any() else None,
            local=local_certificate(prepared) if isinstance(parts.drive, Laws) else None,
            known=known,
        )
        # What does not decay at the trim has nothing to lose elsewhere.
        if case.local is not None and case.local.holds:
            case = case._replace(frozen=frozen_of(parts, settings, loop, leaders))
        lines = list(hypotheses(case))
        region = weaken(parts, region, lines)
        certificate = region.certificate
        certified, limits = certified_set(parts, settings, leaders, certificate), None
        if certificate is not None:
            # A region says itself where the leader may go.
            lines = [line for line in lines if line.statement is not Hypothesis.LEADER]
            radius, limits = limit_room(parts, settings, leaders, certificate)
            held = held_line(parts, settings, certificate)
            lines += [held]
            certified = within(certified, radius, limits, held)
        lines += [region.line, set_line(certificate, certified)]
        enters = None if brief else entry(parts, settings, states, certified)
        lines += _of_starts(parts, states, certificate, certified, limits, enters)
        lines += [claims_line(parts, loop, region.relayed)]
        return cls(
            loop=loop,
            hypotheses=MappingProxyType({cast(Hypothesis, x.statement): x for x in lines}),
            ignores=case.ignored,
            leader_mode=None if leaders.rest else leaders.slowest,
            region=certificate,
            certified=certified,
            domain="" if certificate is None else domain_in_words(parts, certificate),
            case=case,
            limits=limits,
            enters=enters,
            turns=turns_in_words(case),
            slowest_turn=max(slowest_in_turns(case).values(), default=-math.inf),
        )

    def at(self, prepared: Prepared, settings: Sequence[Settings], brief: bool) -> Promises:
        """Yield the same from other starts: only what says something of these changes."""
        with precision("float64"):
            states = Starts(prepared.parts).of([each.seed for each in settings])
        for k, each in enumerate(settings):
            lines = dict(self.hypotheses)
            parts, own = self.case.parts, (self.region, self.certified, self.limits)
            enters = None if brief else entry(parts, each, states[k], self.certified)
            changed = _of_starts(parts, states[k], *own, enters)
            lines |= {cast(Hypothesis, line.statement): line for line in changed}
            case = self.case._replace(settings=each)
            yield dataclasses.replace(
                self, hypotheses=MappingProxyType(lines), case=case, enters=enters
            )

    @property
    def governed(self) -> bool:
        """Whether the followers run a law that a theorem speaks of."""
        return self.case.governed

    @property
    def ground(self) -> RegionCertificate | None:
        """The region of a theorem, where anything is guaranteed."""
        return self.region if self.claimed else None

    @property
    def rate(self) -> float | None:
        """At what rate errors shrink, 1/s; None where nothing is guaranteed."""
        if not self.claimed:
            return None
        if self.region is not None:
            return self.region.rate
        return max(0.0, min(-self._slowest, -self.slowest_turn))

    @property
    def slowest(self) -> float | None:
        """The slowest mode near the trim, 1/s; None where the model bends there and has none."""
        local = self.case.local
        known = local is not None and local.radius is not None
        return self._slowest if known and not self.hypotheses[Hypothesis.SMOOTH].fails else None

    @property
    def _slowest(self) -> float:
        """The slowest mode of the steps that run, and of leaders that followers inherit, 1/s."""
        local = self.case.local
        rate = None if local is None else local.rate(self.case.settings.dt)
        own = -math.inf if rate is None else -rate
        return max(own, self.case.leaders_share)

    @property
    def steps(self) -> Split | None:
        """What the steps that run do to small errors that end; None where it is not known."""
        return None if self.case.local is None else self.case.local.map

    def longest_step(self, settings: Settings) -> float:
        """Return the longest step (s) with which modes decay at the trim."""
        with_sums = longest_step_with_sums(self.case.parts, self.loop, settings)
        return self.loop.longest_step(settings) if with_sums is None else with_sums

    def claim(self) -> Claim:
        """Return what is claimed near the trim, and what the region adds."""
        region, close = self.region, "starts close to the goals"
        premises = () if self.case.matched else ("the leader's input rests at its trim",)
        if region is not None:
            premises = ("time is continuous", *premises)
        if region is not None and self.certified is not None:
            return self._of_set(region, self.certified, premises)
        if region is not None:
            premises = (f"the leader stays in {self.domain}", *premises)
            return Claim(ClaimKind.CONVERGES, (close,), premises=premises)
        if Hypothesis.LEADER not in self.hypotheses or self.turns:
            premises = (f"the leader stays close to the trim{self.turns}", *premises)
        return Claim(ClaimKind.CONVERGES, (f"{close}; how close is not known",), premises=premises)

    def _of_set(
        self, region: RegionCertificate, certified: CertifiedSet, premises: tuple[str, ...]
    ) -> Claim:
        what = ClaimKind.BOUNDED if region.theorem is Theorem.A5 else ClaimKind.CONVERGES
        if not certified.radius:
            start = (f"any, for as long as all agents stay in {self.domain}",)
            notes = (f"no start is certified to stay: {certified.why}", certified.remedy)
            return Claim(what, start, premises=premises, notes=notes)
        if certified.by_run:
            premises = ("the leader moves as in a run of its own", *premises)
        if math.isinf(certified.radius):
            return Claim(what, ("everywhere",), premises=premises)
        numbers = {"set_radius": Number(certified.radius, "", Rounding.DOWN)}
        start = [f"sum_i delta_i'P delta_i <= {at_most(certified.radius)}^2"]
        if self.enters is not None:
            numbers["set_entered"] = Number(self.enters, "s", Rounding.UP)
            start += [f"and from these starts, which reach that at {at_least(self.enters)} s"]
            premises = ("until then the agents move as in a run from these starts", *premises)
        return Claim(what, tuple(start), premises=premises, numbers=numbers)

    @property
    def edge(self) -> float | None:
        """The coupling from which on every mode is proved to decay; None where none is known."""
        # It is one of current states and quick actuators.
        return super().edge if self.case.parts.world.ideal else None

    def why_covered(self) -> str:
        """Return why a run is covered that stayed in the domain."""
        if self.theorem is Theorem.T2:
            return "the leader stayed in the domain, and small errors about it shrink"
        starts = self.hypotheses[Hypothesis.STARTS]
        where = "outside of" if starts.fails else "in"
        text = f"the starts lie {where} the certified set ({starts.number_text})"
        return f"{text}, and all agents stayed in the domain in every step"
