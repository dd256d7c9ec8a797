"""What is guaranteed of a run: the interface of every guarantee, and the one place to ask for it.

All that state a guarantee read it here: `check`, a run before it starts and its report, `design`,
`compare` and `summary.json`. It is computed for the model, graph, coupling, step, integrator,
feed-forward, limits and starts that run; what a gain claims of itself is only compared.
"""

import abc
import dataclasses
import importlib
import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

from echelon.core.cache import load_or_compute
from echelon.core.claim import Claim, Number, Rounding
from echelon.core.errors import EchelonError
from echelon.core.identity import foreign_key
from echelon.core.numerics import precision
from echelon.core.statement import Cause, Hypothesis, Statement
from echelon.core.trace import shared_traces
from echelon.core.types import Array
from echelon.core.words import GuaranteeVerdict, Kind, Theorem, Verdict
from echelon.guarantees.local.spectra import Split
from echelon.guarantees.promises.closed_loop import LinearLoop
from echelon.guarantees.promises.region import CertifiedSet
from echelon.laws.law import Law
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts, Starts
from echelon.simulation.engine.prepare import Prepared, prepare
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate

_T = TypeVar("_T")
REQUIRED = (
    Hypothesis.SYMMETRY,
    Hypothesis.SMOOTH,
    Hypothesis.MATCHED_MOTION,
    Hypothesis.DISAGREEMENT_DECAY,
    Hypothesis.SAMPLING,
    Hypothesis.CLAIMS,
)
"""Hypotheses that every guarantee has a line on, beside those on agents and leaders."""
_BEHIND_GROWTH = (Hypothesis.DETECTABLE, Hypothesis.COUPLING)


class Proved(Protocol):
    """What a theorem says of a run."""

    @property
    def theorem(self) -> Theorem: ...  # noqa: D102
    @property
    def kind(self) -> Kind: ...  # noqa: D102


class AgreementModes(NamedTuple):
    """Signals that agree by z' = -c lambda z: the coupling c, and each lambda (K,) of the graph."""

    coupling: float
    eigenvalues: Array


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Guarantee(abc.ABC):
    """What is guaranteed of a closed loop, and what that rests on.

    Attributes:
        loop: near the trim; what margins are taken of.
        hypotheses: each with its verdict, its number and what would be needed; those on agents and
            leaders and the `REQUIRED` ones are always there.
        ignores: what acts on the agents that is left out, a phrase each.
        leader_mode: the leader's slowest mode by itself, 1/s; None where it follows nothing.
        region: what is guaranteed on a domain; None without one.
        certified: the set of starts that the region certifies; None without one.
        domain: the region's domain in words; empty without one.
        complete: whether nothing was left out to save time.
        prefix: what is guaranteed until the first event that is not covered; None without one, or
            if nothing is.
    """

    loop: LinearLoop
    hypotheses: Mapping[Hypothesis, Statement]
    ignores: tuple[str, ...]
    leader_mode: float | None
    region: RegionCertificate | None = None
    certified: CertifiedSet | None = None
    domain: str = ""
    complete: bool = True
    prefix: "Prefix | None" = None

    # ---- what each kind of guarantee implements ----

    @classmethod
    @abc.abstractmethod
    def of(cls, prepared: Prepared, settings: Settings, brief: bool = False) -> "Guarantee":
        """Return what is guaranteed of prepared parts; `brief` leaves out what takes long."""

    def at(self, prepared: Prepared, settings: Sequence[Settings], brief: bool) -> "Promises":
        """Yield the same under settings that differ from those of `of` in the seed alone."""
        starts = Starts(prepared.parts)
        for each in settings:
            problem = prepared.problem._replace(settings=each, states=starts(each.seed))
            try:
                with precision("float64"):
                    prepared.parts.drive.accept(problem)
                    outcome = self.again(prepared._replace(problem=problem), each, brief)
            except EchelonError as error:
                outcome = error
            yield outcome

    def again(self, prepared: Prepared, settings: Settings, brief: bool) -> "Guarantee":
        """Return the same of parts that differ in the seed and in where agents start alone."""
        return self.of(prepared, settings, brief)

    @property
    def governed(self) -> bool:
        """Whether `loop` is near the trim what runs, and not that of another law."""
        return True

    @property
    @abc.abstractmethod
    def ground(self) -> Proved | None:
        """What a theorem says; None where nothing is guaranteed, or by linearization alone."""

    @property
    @abc.abstractmethod
    def rate(self) -> float | None:
        """At what rate errors shrink, 1/s; of the slowest mode near the trim without a theorem.

        None where nothing is guaranteed; 0 where V is guaranteed not to rise, and no more.
        """

    @property
    @abc.abstractmethod
    def slowest(self) -> float | None:
        """The slowest mode near the trim, 1/s; None where the model bends there and has none."""

    @abc.abstractmethod
    def longest_step(self, settings: Settings) -> float:
        """Return the longest step (s) with which modes decay at the trim and wherever agents go."""

    @abc.abstractmethod
    def claim(self) -> Claim:
        """Return what is claimed, where anything is."""

    @abc.abstractmethod
    def why_covered(self) -> str:
        """Return why the theorem covers a run that kept to its conditions, in words."""

    @property
    def agreement(self) -> AgreementModes | None:
        """Signals on which agents agree, whose margins stand for the loop's; None without any."""
        return None

    @property
    def steps(self) -> Split | None:
        """What the steps that run do to small errors that end; None where it is not known."""
        return None

    @property
    def paper_lines(self) -> tuple[Statement, ...]:
        """What takes the place of the paper's statements on the drift and P; none by default."""
        return ()

    def anywhere(self) -> dict[str, Any] | None:
        """Return what is guaranteed from any start, ready for JSON; None for nothing."""
        return None

    # ---- what follows from that ----

    @property
    def linear(self) -> bool:
        """Whether the loop has a linearization at the trim, and so modes."""
        return self.governed and not self.hypotheses[Hypothesis.SMOOTH].fails

    @property
    def coupling(self) -> float | None:
        """The coupling c; None of a law that has none."""
        return self.loop.closed.coupling if self.governed else None

    @property
    def reasons(self) -> tuple[str, ...]:
        """What stands against any guarantee; nothing where there is one."""
        failed = (line for line in self.hypotheses.values() if line.fails)
        return tuple(dict.fromkeys(line.reason for line in failed if line.reason))

    @property
    def conditions(self) -> tuple[str, ...]:
        """What the claim is conditional on: what only the run can show; nothing without a claim."""
        lines = self.hypotheses.values() if self.claimed else ()
        return tuple(dict.fromkeys(x.condition for x in lines if x.fails and x.condition))

    @property
    def claimed(self) -> bool:
        """Whether anything is claimed, be it conditional."""
        return not self.reasons

    @property
    def verdict(self) -> GuaranteeVerdict:
        """Whether the claim is guaranteed, conditional, or none."""
        left = GuaranteeVerdict.CONDITIONAL if self.conditions else GuaranteeVerdict.GUARANTEED
        return left if self.claimed else GuaranteeVerdict.NONE

    @property
    def promised(self) -> bool:
        """Whether anything is guaranteed, without a condition that is left to the run."""
        return self.verdict is GuaranteeVerdict.GUARANTEED

    @property
    def theorem(self) -> Theorem | None:
        """The theorem behind it; None where it is the linearization alone, or nothing."""
        return None if self.ground is None else self.ground.theorem

    @property
    def kind(self) -> Kind:
        """The kind of argument behind it."""
        return Kind.LINEARIZATION if self.ground is None else self.ground.kind

    @property
    def edge(self) -> float | None:
        """The coupling from which on every mode is proved to decay; None where none is known."""
        return self.loop.certificate.edge if self.linear else None

    @property
    def decays(self) -> bool:
        """Whether errors that are small enough are known to shrink, in continuous time."""
        return self.hypotheses[Hypothesis.DISAGREEMENT_DECAY].verdict is Verdict.HOLDS

    @property
    def causes(self) -> tuple[Cause, ...]:
        """The hypotheses whose failure explains why errors do not shrink.

        A mode that does not decay is explained by what the law cannot feel, or a weak coupling.
        """
        failed = {name: line for name, line in self.hypotheses.items() if line.fails}
        grows = Hypothesis.DISAGREEMENT_DECAY in failed
        why = tuple(failed[name].cause for name in _BEHIND_GROWTH if grows and name in failed)
        rest = (line for name, line in failed.items() if line.reason and name not in _BEHIND_GROWTH)
        rest = (x for x in rest if not why or x.statement is not Hypothesis.DISAGREEMENT_DECAY)
        return (*why, *(line.cause for line in rest))

    @property
    def covers_start(self) -> bool | None:
        """Whether the claim is of these starts; None where it is of starts that are close."""
        line = self.hypotheses.get(Hypothesis.STARTS)
        known = {Verdict.HOLDS: True, Verdict.FAILS: False}
        return None if line is None or not self.claimed else known.get(line.verdict)

    def as_mapping(self) -> dict[str, Any]:
        """Return it ready for JSON; what does not exist is None."""
        certified, claim = self.certified, self.claim() if self.claimed else None
        return {
            "verdict": str(self.verdict),
            "claim": None if claim is None else str(claim.what),
            "theorem": None if self.theorem is None else str(self.theorem),
            "kind": str(self.kind),
            "start": [] if claim is None else list(claim.start),
            "graphs": [] if claim is None else list(claim.graphs),
            "premises": [] if claim is None else list(claim.premises),
            "notes": [] if claim is None else list(claim.notes),
            "numbers": {name: x.as_mapping() for name, x in self._numbers(claim).items()},
            "conditions": [line.as_mapping() for line in self.hypotheses.values()],
            "ignores": list(self.ignores) if self.claimed else [],
            "covers_start": self.covers_start,
            "domain": self.domain or None,
            "certified_set": None if certified is None else certified.as_mapping(),
            "anywhere": self.anywhere(),
            "until": None if self.prefix is None else self.prefix.as_mapping(),
        }

    def _numbers(self, claim: Claim | None) -> dict[str, Number]:
        """Return the numbers of the loop and of the claim, each by one name."""
        certificate = self.loop.certificate
        numbers = {
            "rate": (self.rate, "1/s", Rounding.DOWN),
            "slowest_mode": (self.slowest, "1/s", Rounding.UP),
            "coupling": (self.coupling, "", Rounding.NEAREST),
            "edge": (self.edge, "", Rounding.UP),
            "lambda_min": (certificate.lambda_min, "", Rounding.NEAREST),
            "lambda_max": (certificate.lambda_max, "", Rounding.NEAREST),
        }
        known = {name: Number(*x) for name, x in numbers.items() if x[0] is not None}  # pyright: ignore
        return {**known, **({} if claim is None else claim.numbers)}


class Prefix(NamedTuple):
    """What is guaranteed until a time (s), at which something happens that nothing covers."""

    at: float
    promise: "Guarantee"

    def as_mapping(self) -> dict[str, Any]:
        """Return it ready for JSON."""
        return {"at": self.at, "guarantee": self.promise.as_mapping()}


Promises: TypeAlias = Iterator[Guarantee | EchelonError]
_cache: WeakKeyDictionary[Parts, dict[Hashable, dict[Settings, Guarantee]]] = WeakKeyDictionary()
"""By parts, by what foreign code in them reads now, and by settings."""


def prover_of(parts: Parts) -> type[Guarantee]:
    """Return what proves the guarantees of parts: of laws, what the followers' law names."""
    drive = parts.drive
    law = drive.follower if isinstance(drive, Laws) else Law
    # By name, since a law is below all that is proved of it.
    module, _, name = law.prover.partition(":")
    if unknown_in(parts) and module.partition(".")[0] == "echelon":
        module, _, name = Law.prover.partition(":")
    return getattr(importlib.import_module(module), name)


def unknown_in(parts: Parts) -> str:
    """Return what of the parts echelon does not know, in words; empty without anything."""
    if parts.drive.unknown:
        return f"the law `{parts.drive.unknown}`"
    own = any(part.presumed() for part in parts.world.parts)
    return "all members of the step" if own else ""


@shared_traces()
def guarantee(parts: Parts, settings: Settings) -> Guarantee:
    """Return what is guaranteed of parts under settings; computed once while the parts exist.

    Where a theorem certifies a set behind a leader that moves, and where free leaders start apart,
    the leaders are run by themselves.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    stored = _stored(parts).get(settings)
    return stored or _computed(prepare(parts, settings), parts, settings)


def guarantee_data(parts: Parts, settings: Settings) -> dict[str, Any]:
    """Return `guarantee` ready for JSON, from the disk cache if another process computed it.

    Raises:
        EchelonError: as `guarantee`.
    """
    return kept_on_disk(Guarantee.as_mapping, parts, settings)


def kept_on_disk(of: Callable[[Guarantee], _T], parts: Parts, settings: Settings) -> _T:
    """Return a function's value of `guarantee`, from the disk cache if another process computed it.

    Raises:
        EchelonError: as `guarantee`.
    """
    # All fields of the parts, but for two that are no plain values: by what they are made of.
    fields = [getattr(parts, field.name) for field in dataclasses.fields(parts)]
    formation, graph = parts.formation, parts.graph.before
    plain = [x for x in fields if not isinstance(x, type(formation) | type(graph))]
    links = graph.edges, graph.weights, graph.agents, graph.leaders, graph.directed, graph.schedule
    rest = formation.offsets, formation.motion, links, settings
    what = f"{of.__module__}.{of.__qualname__}"
    return load_or_compute(lambda: of(guarantee(parts, settings)), what, plain, rest)


def promises(parts: Parts, settings: Sequence[Settings], brief: bool = False) -> Promises:
    """Yield what `guarantee` returns, or raises, under settings that differ in the seed alone.

    What no seed changes is computed once; `brief` leaves out what takes long.
    """
    for k, each in enumerate(settings):
        try:
            prepared, alike = prepare(parts, each), each._replace(seed=0)
            stored = (p for s, p in _stored(parts).items() if s._replace(seed=0) == alike)
            first = next(stored, None) or _computed(prepared, parts, each, brief)
        except EchelonError as error:
            # Others may start where the laws have a meaning.
            yield error
            continue
        yield from first.at(prepared, settings[k:], brief)
        return


def _computed(
    prepared: Prepared, parts: Parts, settings: Settings, brief: bool = False
) -> Guarantee:
    with precision("float64"):
        computed = prover_of(prepared.parts).of(prepared, settings, brief)
    if not brief:
        computed = dataclasses.replace(computed, prefix=_prefix_of(computed, parts, settings))
    # A result holds the prepared parts, and asks again.
    for key in (parts, prepared.parts) if computed.complete else ():
        _stored(key)[settings] = computed
    return computed


def _prefix_of(computed: Guarantee, parts: Parts, settings: Settings) -> Prefix | None:
    line = computed.hypotheses.get(Hypothesis.EVENTS)
    if line is None or not line.fails or line.number is None:
        return None
    steps = math.floor(line.number / settings.dt + 1e-9)
    if not steps:
        return None
    graph = parts.graph.until(line.number)
    until = settings._replace(horizon=steps * settings.dt, steady_window=None)
    try:
        first = guarantee(parts.replace(graph=graph, events=graph.events), until)
    except EchelonError:
        # Without what happens later somebody has no path to a leader for ever.
        return None
    return Prefix(line.number, first) if first.claimed else None


def _stored(parts: Parts) -> dict[Settings, Guarantee]:
    # A formation is no dataclass, whose parts would be found.
    reads = foreign_key((parts, parts.formation.motion))
    return _cache.setdefault(parts, {}).setdefault(reads, {})
