"""The one place that says what is promised of what runs, with each hypothesis and its number.

Everything that tells of a promise reads it here: `check`, a run before it starts and its report,
`design`, `compare` and `summary.json`. It is computed for the model, graph, coupling, step,
integrator, feed-forward, limits and starts that run; what a gain says of itself is only compared.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeAlias, cast, final
from weakref import WeakKeyDictionary

import numpy as np

from echelon.agents.models.linearization import at_trim
from echelon.core.errors import EchelonError
from echelon.core.numerics import precision
from echelon.core.statement import Cause, Hypothesis, Statement
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem, Verdict
from echelon.guarantees.promises.case import Case
from echelon.guarantees.promises.certified_set import CertifiedSet, certified_set, set_lines
from echelon.guarantees.promises.claims import claims_line
from echelon.guarantees.promises.closed_loop import LinearLoop, loop_of
from echelon.guarantees.promises.frozen_laws import (
    FrozenLaws,
    ModeMatrices,
    frozen_at,
    frozen_of,
    longest_step,
)
from echelon.guarantees.promises.hypotheses import agent_lines, hypotheses
from echelon.guarantees.promises.leaders import leaders_of
from echelon.guarantees.promises.modes import held
from echelon.guarantees.promises.region import region_of, slopes_beside, weaken
from echelon.guarantees.promises.turning import slowest_in_turns, turns_in_words
from echelon.guarantees.stopping.stopping_run import (
    StoppingRun,
    condition_lines,
    drift_reason,
    stopping_of,
)
from echelon.guarantees.stopping.tube import Tube, tube_of
from echelon.simulation.engine.initial import Starts
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared, prepare
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate

_BEHIND_GROWTH = (Hypothesis.DETECTABLE, Hypothesis.COUPLING)


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Promise:
    """What is promised of a closed loop, and what that rests on.

    Attributes:
        loop: near the trim; what margins are taken of.
        region: what is promised on a domain; None without more than the linearization.
        certified: the set of starts that the region certifies; None without one.
        hypotheses: each with its verdict, its number and what would be needed.
        domain: the region's domain in words; empty without one.
        condition: on the leader, in words; empty where there is none.
        without: what acts on the agents that is left out, in words; empty without any.
        own: the leader's slowest mode by itself, 1/s; None where it follows nothing.
        frozen: the laws away from the trim; None where they are not looked at.
        turns: what the leader's heading may do, in words; empty where the law does not turn.
        tube: what T5 promises; None under other laws, or where it promises nothing.
        hold: the longest step that T5 allows, s; None under other laws.
        slowest_turn: the slowest mode in the steady turns of `turns`, 1/s.
    """

    loop: LinearLoop
    region: RegionCertificate | None
    certified: CertifiedSet | None
    hypotheses: Mapping[Hypothesis, Statement]
    domain: str
    condition: str
    without: str
    own: float | None
    frozen: FrozenLaws | None
    turns: str = ""
    tube: Tube | None = None
    hold: float | None = None
    slowest_turn: float = -math.inf

    @property
    def linear(self) -> bool:
        """Whether the model has a linearization at its trim, and so modes."""
        return not self.hypotheses[Hypothesis.SMOOTH].fails

    @property
    def reasons(self) -> tuple[str, ...]:
        """What stands against any promise; nothing where there is one."""
        failed = (each for each in self.hypotheses.values() if each.fails)
        return tuple(dict.fromkeys(each.reason for each in failed if each.reason))

    @property
    def promised(self) -> bool:
        """Whether anything is promised."""
        return not self.reasons

    @property
    def _ground(self) -> RegionCertificate | Tube | None:
        return (self.tube or self.region) if self.promised else None

    @property
    def theorem(self) -> Theorem | None:
        """The theorem behind the promise; None where it is the linearization alone, or nothing."""
        region = self._ground
        return None if region is None else region.theorem

    @property
    def kind(self) -> Kind:
        """The kind of argument behind the promise."""
        region = self._ground
        return Kind.LINEARIZATION if region is None else region.kind

    @property
    def rate(self) -> float | None:
        """At what rate errors shrink, 1/s; of the slowest mode near the trim without a theorem.

        None where nothing is promised; 0 where V is promised not to rise, and no more.
        """
        if not self.promised:
            return None
        ground = self._ground
        if ground is None and self.loop.common is not None:
            return max(0.0, min(self.loop.common, -self.slowest_turn))
        if ground is None:
            return -max(self.loop.slowest, self.slowest_turn)
        return ground.rate

    @property
    def edge(self) -> float | None:
        """The coupling from which on every mode is proved to decay; None where none is known."""
        return self.loop.certificate.edge if self.linear else None

    @property
    def slowest(self) -> float | None:
        """The slowest mode near the trim, 1/s; None where the model bends there and has none."""
        if self.tube is not None:
            return -self.tube.rate
        return self.loop.slowest if self.linear else None

    @property
    def decays(self) -> bool:
        """Whether errors that are small enough are known to shrink, in continuous time."""
        return self.hypotheses[Hypothesis.DISAGREEMENT_DECAY].verdict is Verdict.HOLDS

    def longest_step(self, settings: Settings) -> float:
        """Return the longest step (s) with which modes decay at the trim and wherever agents go."""
        if self.hold is not None:
            return self.hold
        return longest_step(self.loop, self.frozen, settings)

    @property
    def causes(self) -> tuple[Cause, ...]:
        """The hypotheses whose failure explains why errors do not shrink.

        A mode that does not decay is explained by what the law cannot feel, or a weak coupling.
        """
        failed = {name: each for name, each in self.hypotheses.items() if each.fails}
        grows = Hypothesis.DISAGREEMENT_DECAY in failed
        why = tuple(failed[name].cause for name in _BEHIND_GROWTH if grows and name in failed)
        rest = (each for name, each in failed.items() if each.reason and name not in _BEHIND_GROWTH)
        rest = (x for x in rest if not why or x.statement is not Hypothesis.DISAGREEMENT_DECAY)
        return (*why, *(each.cause for each in rest))

    def sentence(self) -> str:
        """Return what is promised, in sentences, and no more than that."""
        told = self._promised() if self.promised else None
        told = told or f"Nothing is promised: {'; '.join(self.reasons)}. {self._help()}"
        claims = self.hypotheses[Hypothesis.CLAIMS]
        return f"{told} Note: {claims.explanation}." if claims.fails else told

    def _help(self) -> str:
        """Return what would help against all that stands against a promise."""
        against = (each for each in self.hypotheses.values() if each.fails and each.reason)
        return f"What would help: {'; '.join(dict.fromkeys(x.remedy for x in against))}."

    def _promised(self) -> str:
        region = self.region
        if self.tube is not None:
            text = self.tube.sentence()
            without = f" This is said without what the scenario adds: {self.without}."
            return text + without if self.without else text
        if self.linear:
            text = "by linearization: followers that start near enough to their goals, with the "
            text += f"leader near enough to the trim{self.turns}, converge to them{self.condition}"
            text += "; no region is proved" if region is None else ""
        else:
            text = "on a domain alone, with the slopes of all sides of the trim: the model bends "
            text += "there, and has no linearization"
        text = f"Promised, {text}."
        text = text if region is None else f"{text} {self._regional(region)}"
        without = f" This is said without what the scenario adds: {self.without}."
        return text + without if self.without else text

    def _regional(self, region: RegionCertificate) -> str:
        """Return what the region adds, as strong as its own argument and no stronger."""
        found, condition, theorem = self.certified, self.condition, region.theorem
        by, what = self.kind.value, f"errors shrink at {region.rate:.3g} 1/s or faster"
        what = "V does not rise" if theorem is Theorem.A5 else what
        if found is None:
            text = f"small {what}{condition}, while the leader stays in {self.domain}"
            return f"{by}: {text} ({theorem})."
        if not found.radius:
            text = f"for as long as all agents stay in {self.domain} ({theorem}), and no start is "
            return f"{by}: {what}{condition}, {text}certified to stay: {found.why}; {found.remedy}."
        read = "" if found.kind is self.kind else ", the leader going as in a run of its own"
        start = f"any start with sum_i delta_i'P delta_i <= {found.radius:.3g}^2"
        start = "everywhere" if found.radius == float("inf") else start
        return f"{by}: from {start}, {what}{condition}{read} ({theorem})."

    def as_mapping(self) -> dict[str, Any]:
        """Return the whole promise ready for JSON; what does not exist is None."""
        certificate, found = self.loop.certificate, self.certified
        theorem = self.theorem
        return {
            "promised": self.promised,
            "sentence": self.sentence(),
            "reasons": list(self.reasons),
            "theorem": None if theorem is None else str(theorem),
            "kind": str(self.kind),
            "rate": self.rate,
            "slowest_mode": self.slowest,
            "coupling": self.loop.closed.coupling,
            "edge": self.edge,
            "lambda_min": certificate.lambda_min,
            "lambda_max": certificate.lambda_max,
            "domain": self.domain or None,
            "certified_set": None
            if found is None
            else {
                "radius": found.radius if found.radius < float("inf") else None,
                "kind": str(found.kind),
                "why": found.why,
            },
            "anywhere": None if self.tube is None else self.tube.as_mapping(),
            "hypotheses": [each.as_mapping() for each in self.hypotheses.values()],
        }


_kept: WeakKeyDictionary[Parts, dict[Settings, Promise]] = WeakKeyDictionary()


def promise(parts: Parts, settings: Settings) -> Promise:
    """Return what is promised of parts under settings; computed once for as long as they live.

    Where a theorem certifies a set behind a leader that moves, and where free leaders start apart,
    the leaders are run by themselves.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    known = _kept.get(parts, {}).get(settings)
    return known or _made(prepare(parts, settings), parts, settings)


def _made(prepared: Prepared, parts: Parts, settings: Settings, briefly: bool = False) -> Promise:
    """Return what is promised of parts, and keep it if it is all of it."""
    with precision("float64"):
        found = _compute(prepared, settings, briefly)
    # A result holds the prepared parts, and asks again.
    for each in (parts, prepared.parts) if found.hold is None or not briefly else ():
        _kept.setdefault(each, {})[settings] = found
    return found


_Each: TypeAlias = Iterator[Promise | EchelonError]


def promises(parts: Parts, settings: Sequence[Settings], briefly: bool = False) -> _Each:
    """Yield what `promise` returns, or raises, under settings that differ in the seed alone.

    What no seed changes is computed once; `briefly` leaves out arrival and motors (T5).
    """
    for k, each in enumerate(settings):
        try:
            found = _first(parts, each, briefly)
        except EchelonError as error:
            # Others may start where the laws have a meaning.
            yield error
            continue
        yield from _alike(settings[k:], *found, briefly)
        return


def _first(parts: Parts, settings: Settings, briefly: bool) -> tuple[Promise, Prepared]:
    """Return what is promised under any such settings, and the parts under these."""
    prepared, alike = prepare(parts, settings), settings._replace(seed=0)
    known = (p for s, p in _kept.get(parts, {}).items() if s._replace(seed=0) == alike)
    return next(known, None) or _made(prepared, parts, settings, briefly), prepared


def _each(prepared: Prepared, settings: Sequence[Settings], briefly: bool) -> _Each:
    """Yield what is promised of starts of which each is looked at by itself."""
    starts = Starts(prepared.parts)
    for each in settings:
        problem = prepared.problem._replace(settings=each, states=starts(each.seed))
        try:
            with precision("float64"):
                prepared.parts.drive.accept(problem)
                started = prepared._replace(problem=problem)
                found: Promise | EchelonError = _compute(started, each, briefly)
        except EchelonError as error:
            found = error
        yield found


def _alike(
    settings: Sequence[Settings], first: Promise, prepared: Prepared, briefly: bool
) -> _Each:
    """Yield the promises where the first is accepted."""
    if first.hold is not None or _asks_where(prepared.parts, first.loop) and first.frozen is None:
        # A tube is of where agents start; or nobody leaves the trim, and a seed may be what does.
        yield from _each(prepared, settings, briefly)
        return
    with precision("float64"):
        states = np.stack(list(map(Starts(prepared.parts), (each.seed for each in settings))))
        leaders, slopes = leaders_of(prepared.parts, states[0]), None
        decays: Array = np.ones((len(states), 1), bool)
        if first.frozen is not None:
            slopes = frozen_at(prepared.parts, settings[0], first.loop, leaders, states)
            decays = slopes.decaying(settings[0]).reshape(len(states), -1)
    case = Case(prepared.parts, settings[0], first.loop, leaders, first.region, None, first.frozen)
    for k, each in enumerate(settings):
        began = (
            None if slopes is None else ModeMatrices(*(_part(x, k, len(states)) for x in slopes))
        )
        yield _started(first, case._replace(settings=each), states[k], began, bool(decays[k].all()))


def _part(array: Array, k: int, parts: int) -> Array:
    size = len(array) // parts
    return array[k * size : (k + 1) * size]


def _started(
    first: Promise, case: Case, states: Array, began: ModeMatrices | None, decays: bool
) -> Promise:
    """Return a promise as it is where agents start in other states (N, n)."""
    lines, frozen = dict(first.hypotheses), first.frozen
    if frozen is not None and began is not None:
        frozen = frozen._replace(starts=began)
        # The line tells of where they start only if steps grow there.
        holds = lines[Hypothesis.SAMPLING].verdict is Verdict.HOLDS
        if case.smooth and not (holds and decays):
            lines[Hypothesis.SAMPLING] = held(case._replace(frozen=frozen))
    for line in set_lines(case.parts, states, first.region, first.certified):
        lines[cast(Hypothesis, line.statement)] = line
    told = MappingProxyType(lines)
    return dataclasses.replace(first, hypotheses=told, frozen=frozen)


def _asks_where(parts: Parts, loop: LinearLoop) -> bool:
    """Tell whether laws are looked at away from the trim."""
    # What does not decay at the trim has nothing to lose elsewhere.
    return loop.every and parts.drive.metric(parts.model) is not None


def _compute(prepared: Prepared, settings: Settings, briefly: bool = False) -> Promise:
    parts, states = prepared.parts, prepared.problem.states
    leaders, loop = leaders_of(parts, states), loop_of(parts)
    run = stopping_of(parts, settings, states)
    if run is not None:
        return _anywhere(run, Case(parts, settings, loop, leaders, None, None, None), briefly)
    region = region_of(parts, leaders)
    case = Case(
        parts,
        settings,
        loop,
        leaders,
        region.certificate,
        slopes_beside(parts) if at_trim(parts.model).bends.any() else None,
        frozen_of(parts, settings, loop, leaders, states) if _asks_where(parts, loop) else None,
    )
    lines = list(hypotheses(case))
    region = weaken(parts, region, lines)
    certificate = region.certificate
    found = certified_set(parts, settings, leaders, certificate)
    lines += [region.line, *set_lines(parts, states, certificate, found)]
    lines.append(claims_line(parts, loop, region.relayed))
    return Promise(
        loop=loop,
        region=certificate,
        certified=found,
        hypotheses=MappingProxyType({cast(Hypothesis, x.statement): x for x in lines}),
        domain="" if certificate is None else certificate.domain.in_words(parts.model),
        condition="" if case.matched else ", once the leader's input rests at its trim",
        without=case.disturbed,
        own=None if leaders.rest else leaders.slowest,
        frozen=case.frozen,
        turns=turns_in_words(case),
        slowest_turn=max(slowest_in_turns(case).values(), default=-math.inf),
    )


def _anywhere(run: StoppingRun, case: Case, briefly: bool) -> Promise:
    """Return what is promised under the law `stopping-point`."""
    found, drifts = tube_of(run, briefly), drift_reason(run)
    lines = [*agent_lines(case), *condition_lines(run), *found.lines]
    lines += [drifts] if drifts is not None else []
    kept = MappingProxyType({cast(Hypothesis, x.statement): x for x in lines})
    tube = None if any(line.reason for line in kept.values() if line.fails) else found.tube
    own = case.leaders.slowest
    return Promise(
        case.loop, None, None, kept, "", "", case.disturbed, own, None, "", tube, run.longest_step
    )
