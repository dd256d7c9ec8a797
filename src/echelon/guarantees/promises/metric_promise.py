"""What is guaranteed by a linearization, or by a metric P: theorems T1, T2 and A5."""

import dataclasses
import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import cast, final

import numpy as np

from echelon.agents.models.linearization import at_trim
from echelon.core.digits import at_most
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis
from echelon.core.types import Array
from echelon.core.words import Theorem, Verdict
from echelon.guarantees.promises.case import Case
from echelon.guarantees.promises.certified_set import certified_set, set_line, starts_line
from echelon.guarantees.promises.claims import claims_line
from echelon.guarantees.promises.closed_loop import loop_of
from echelon.guarantees.promises.frozen_laws import (
    ModeMatrices,
    frozen_of,
    frozen_starts,
    longest_step,
)
from echelon.guarantees.promises.hypotheses import hypotheses
from echelon.guarantees.promises.leaders import leaders_of
from echelon.guarantees.promises.limits_line import limits_line
from echelon.guarantees.promises.modes import sampling_line
from echelon.guarantees.promises.promise import Promise, Promises
from echelon.guarantees.promises.region import (
    adjacent_slopes,
    domain_in_words,
    region_of,
    weaken,
)
from echelon.guarantees.promises.turning import slowest_in_turns, turns_in_words
from echelon.simulation.engine.parts import Starts
from echelon.simulation.engine.prepare import Prepared
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate


@final
@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class MetricPromise(Promise):
    """What is guaranteed near the trim, and on a domain where a metric contracts there.

    Attributes:
        case: what it was computed of.
        turns: what the leader's heading may do, in words; empty where the law does not turn.
        slowest_turn: the slowest mode in the steady turns of `turns`, 1/s.
    """

    case: Case
    turns: str = ""
    slowest_turn: float = -math.inf

    @classmethod
    def of(cls, prepared: Prepared, settings: Settings, brief: bool = False) -> "MetricPromise":
        """Return what is guaranteed of prepared parts."""
        parts, states = prepared.parts, prepared.problem.states
        leaders, loop = leaders_of(parts, states), loop_of(parts)
        region = region_of(parts, settings, leaders)
        case = Case(
            parts,
            settings,
            loop,
            leaders,
            region.certificate,
            adjacent_slopes(parts) if at_trim(parts.model).bends.any() else None,
        )
        # What does not decay at the trim has nothing to lose elsewhere.
        if loop.every and case.governed:
            case = case._replace(frozen=frozen_of(parts, settings, loop, leaders, states))
        lines = list(hypotheses(case))
        region = weaken(parts, region, lines)
        certificate = region.certificate
        certified = certified_set(parts, settings, leaders, certificate)
        lines += [region.line, set_line(certificate, certified)]
        lines += [starts_line(parts, states, certificate, certified)]
        lines += [claims_line(parts, loop, region.relayed)]
        lines += limits_line(parts, settings) if certificate is not None else ()
        return cls(
            loop=loop,
            hypotheses=MappingProxyType({cast(Hypothesis, x.statement): x for x in lines}),
            without=case.disturbed,
            leader_mode=None if leaders.rest else leaders.slowest,
            region=certificate,
            certified=certified,
            domain="" if certificate is None else domain_in_words(parts, certificate),
            case=case,
            turns=turns_in_words(case),
            slowest_turn=max(slowest_in_turns(case).values(), default=-math.inf),
        )

    def at(self, prepared: Prepared, settings: Sequence[Settings], brief: bool) -> Promises:
        """Yield the same from other starts: only what says something of these changes."""
        case = self.case
        if case.loop.every and case.governed and case.frozen is None:
            # Nobody left the trim, and another seed may be what does.
            yield from Promise.at(self, prepared, settings, brief)
            return
        with precision("float64"):
            states = Starts(prepared.parts).of([each.seed for each in settings])
            starts, decays = None, np.ones((len(states), 1), bool)
            if case.frozen is not None:
                starts = frozen_starts(prepared.parts, case.loop, case.frozen.path, states)
                decays = starts.decaying(settings[0]).reshape(len(states), -1)
        for k, each in enumerate(settings):
            there = case._replace(settings=each)
            if case.frozen is not None and starts is not None:
                frozen = case.frozen._replace(starts=_share(starts, k, len(states)))
                there = there._replace(frozen=frozen)
            yield self._from(there, states[k], bool(decays[k].all()))

    def _from(self, case: Case, states: Array, decays: bool) -> "MetricPromise":
        """Return the same from states (N, n), about which held steps decay or may not."""
        lines = dict(self.hypotheses)
        # The line tells of where they start only if steps grow there.
        same = decays and lines[Hypothesis.SAMPLING].verdict is Verdict.HOLDS
        if case.frozen is not None and case.smooth and not same:
            lines[Hypothesis.SAMPLING] = sampling_line(case)
        lines[Hypothesis.STARTS] = starts_line(case.parts, states, self.region, self.certified)
        return dataclasses.replace(self, hypotheses=MappingProxyType(lines), case=case)

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
        common, held = self.loop.common, self.loop.held_rate(self.case.settings)
        rate = -self.loop.slowest if common is None else common.rate
        return max(0.0, min(rate, held, -self.slowest_turn, -self.case.leaders_share))

    @property
    def slowest(self) -> float | None:
        """The slowest mode near the trim, 1/s; None where the model bends there and has none."""
        return max(self.loop.slowest, self.case.leaders_share) if self.linear else None

    def longest_step(self, settings: Settings) -> float:
        """Return the longest step (s) with which modes decay at the trim and wherever agents go."""
        return longest_step(self.loop, self.case.frozen, settings)

    @property
    def condition(self) -> str:
        """What is asked of the leader, in words; empty for nothing."""
        return "" if self.case.matched else ", once the leader's input rests at its trim"

    def guarantee(self) -> str:
        """Return what is guaranteed near the trim, and what the region adds."""
        if self.linear:
            text = "Local guarantee (linearization)" if self.promised else "By linearization"
            text += ": followers converge to their goals from "
            text += "sufficiently close starts, with the leader sufficiently close to the trim"
            text += f"{self.turns}{self.condition}"
        else:
            text = "Guaranteed on a domain only: the model is not differentiable at the trim, so "
            text += "the slopes on all of its sides are used"
        if self.region is None:
            return f"{text}; how close is not known."
        return f"{text}. {self._regional(self.region)}"

    def _regional(self, region: RegionCertificate) -> str:
        """Return what the region adds, as strong as its own argument and no stronger."""
        certified, condition, theorem = self.certified, self.condition, region.theorem
        by, what = self.kind.value, f"errors shrink at {at_most(region.rate)} 1/s or faster"
        what = "V does not increase" if theorem is Theorem.A5 else what
        if certified is None:
            text = f"small {what}{condition}, while the leader stays in {self.domain}"
            return f"{by}: {text} ({theorem})."
        if not certified.radius:
            text = f"for as long as all agents stay in {self.domain} ({theorem}), and no start is "
            text += f"certified to stay: {certified.why}; {certified.remedy}."
            return f"{by}: {what}{condition}, {text}"
        read = "" if certified.kind is self.kind else ", if the leader moves as in a run of its own"
        start = f"any start with sum_i delta_i'P delta_i <= {at_most(certified.radius)}^2"
        start = "everywhere" if certified.radius == float("inf") else start
        return f"{by}: from {start}, {what}{condition}{read} ({theorem})."

    def why_covered(self) -> str:
        """Return why a run is covered that stayed in the domain."""
        if self.theorem is Theorem.T2:
            return "the leader stayed in the domain, and small errors about it shrink"
        starts = self.hypotheses[Hypothesis.STARTS]
        if starts.fails:
            text = f"the starts lie outside of the certified set ({starts.number_text}), but all "
            return f"{text}agents stayed in the domain at every stored frame"
        text = f"the starts lie in the certified set ({starts.number_text}), and all agents stayed "
        return f"{text}in the domain"


def _share(starts: ModeMatrices, k: int, runs: int) -> ModeMatrices:
    """Return what is of one of so many runs."""
    size = len(starts.A) // runs
    return ModeMatrices(*(part[k * size : (k + 1) * size] for part in starts))
