"""Guarantee of theorem T5 for a run in which agents agree on their stopping points."""

import dataclasses
from types import MappingProxyType
from typing import Any, cast, final

import numpy as np

from echelon.core.claim import Claim
from echelon.core.statement import Hypothesis, Statement, Topic, holds, unneeded
from echelon.core.words import Kind
from echelon.guarantees.messages.late_messages import messages_line
from echelon.guarantees.messages.own_delay import OwnCase, own_delay_line
from echelon.guarantees.promises.case import GuaranteeInputs
from echelon.guarantees.promises.closed_loop import LinearLoop, loop_of
from echelon.guarantees.promises.hypotheses import agent_lines
from echelon.guarantees.promises.leaders import leaders_of
from echelon.guarantees.promises.promise import AgreementModes, Guarantee
from echelon.guarantees.stopping.lasting_drift import drift_line
from echelon.guarantees.stopping.separation import Separation, separation_of
from echelon.guarantees.stopping.stopping_run import (
    StoppingRun,
    agreement_modes,
    condition_lines,
    of_leaders,
    stopping_run_of,
)
from echelon.guarantees.stopping.tube import Tube, tube_of
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import Prepared
from echelon.simulation.step.drive import Problem
from echelon.simulation.step.settings import Settings

_BETWEEN = 128
"""Factors from the least to the largest eigenvalue of a graph whose others are not computed."""


@final
@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class StoppingPromise(Guarantee):
    """What T5 guarantees, and what that rests on.

    Attributes:
        strength: the coupling c.
        hold: the longest step (s) that keeps the largest stopping point from growing.
    """

    run: StoppingRun
    tube: Tube | None
    strength: float
    hold: float
    separation: Separation | None

    @classmethod
    def of(cls, prepared: Prepared, settings: Settings, brief: bool = False) -> "StoppingPromise":
        """Return what is guaranteed of prepared parts; `brief` leaves out arrival."""
        run = stopping_run_of(prepared.parts, settings, prepared.problem.states)
        return cls._of_run(run, prepared, brief)

    def again(self, prepared: Prepared, settings: Settings, brief: bool) -> "StoppingPromise":
        """Return the same from other starts, computing only what they change."""
        return self._of_run(self.run.again(settings, prepared.problem.states), prepared, brief)

    @classmethod
    def _of_run(cls, run: StoppingRun, prepared: Prepared, brief: bool) -> "StoppingPromise":
        loop, ignored, leader_mode, known = _known_lines(run, prepared.parts)
        tube, tube_lines = tube_of(run, brief)
        own = None if brief else _own_line(run, prepared.problem)
        more = drift_line(run), own
        lines = [*known, *tube_lines, *(line for line in more if line is not None)]
        by_name = {cast(Hypothesis, x.statement): x for x in lines}
        against = any(line.fails and line.reason for line in by_name.values())
        tube = None if against else tube
        separation = separation_of(run, tube, bool(ignored))
        if separation is not None:
            by_name[Hypothesis.SEPARATION] = separation.line
        return cls(
            loop=loop,
            hypotheses=MappingProxyType(by_name),
            ignores=ignored,
            leader_mode=leader_mode,
            complete=not brief,
            run=run,
            # In float64, which a law computes in only here.
            strength=run.coupling,
            hold=run.longest_step,
            tube=tube,
            separation=separation,
        )

    @property
    def governed(self) -> bool:
        """Whether modes at the trim are those of what runs: chains are closed by roots instead."""
        return False

    @property
    def coupling(self) -> float:
        """The coupling c, with which stopping points agree."""
        return self.strength

    @property
    def ground(self) -> Tube | Separation | None:
        """What T5 or T10 says; None where nothing is guaranteed."""
        return self.separation or self.tube

    @property
    def rate(self) -> float | None:
        """At what rate errors shrink in the end, 1/s; None where that is not guaranteed."""
        # Agents that hold each other back may do so for ever.
        return None if self.tube is None or self.separation is not None else self.tube.rate

    @property
    def slowest(self) -> float | None:
        """The slowest mode of the formation, 1/s; None where nothing is guaranteed of it."""
        return None if self.tube is None else -self.tube.rate

    def longest_step(self, settings: Settings) -> float:
        """Return the longest step (s) that keeps the largest stopping point from growing."""
        return self.hold

    def claim(self) -> Claim:
        """Return what T5, T9 or T10 claims."""
        assert self.ground is not None
        return self.ground.claim()

    def why_covered(self) -> str:
        """Return why a run is covered in which no limit acted."""
        return f"no limit acted, and from these starts {self.hypotheses[Hypothesis.STARTS].text}"

    @property
    def agreement(self) -> AgreementModes:
        """How stopping points agree, zeta~' = -c lambda zeta~."""
        return AgreementModes(self.strength, agreement_modes(self.run.parts.graph, self.run.law))

    @property
    def paper_lines(self) -> tuple[Statement, ...]:
        """Assumption 5, Lemma 4 and the conditions on P where stopping points agree."""
        text = "in flat coordinates, with equality: zeta' = 0 in silence, P = T'T for zeta = T x"
        offsets = "for offsets of every flat output: they are symmetries of the chains"
        none = "T5 asks nothing of a P"
        return (
            holds(Topic.MONOTONE, Kind.PROOF, text, 0.0, "0"),
            holds(Topic.DRIFT_ALONG_Z, Kind.PROOF, offsets),
            unneeded(Topic.LMI_AS_PRINTED, Kind.PROOF, none),
            unneeded(Topic.FINITE, Kind.PROOF, none),
        )

    def anywhere(self) -> dict[str, Any] | None:
        """Return the tube ready for JSON; None where nothing is guaranteed."""
        if self.tube is None or self.separation is None:
            return None if self.tube is None else self.tube.as_mapping()
        return self.tube.as_mapping() | {"separation": self.separation.as_mapping()}


@of_leaders
def _known_lines(
    run: StoppingRun, parts: Parts
) -> tuple[LinearLoop, tuple[str, ...], float | None, list[Statement]]:
    """Return the loop near the trim, what is ignored, the leaders' mode, and lines.

    These are of no start of a follower.
    """
    leaders = leaders_of(parts, run.states)
    case = GuaranteeInputs(parts, run.settings, loop_of(parts), leaders)._replace(
        over_network=run.network is not None
    )
    messages = messages_line(parts, run.settings, run.late)
    lines = [*agent_lines(case), *condition_lines(run)]
    lines += [] if messages is None else [messages]
    return case.loop, case.ignored, leaders.slowest, lines


def _own_line(run: StoppingRun, problem: Problem) -> Statement | None:
    parts, law, network = run.parts, run.law, run.network
    if parts.graph.schedule is not None or run.late is not network:
        # What is known of the ideal network is not true of one that no theorem covers.
        return None
    heard, between = None, False
    if network is None:
        own = agreement_modes(parts.graph, law)
        between = not law.leaderward and len(own) < parts.graph.spectrum().total
        own = np.geomspace(own[0], own[-1], _BETWEEN) if between else own
    else:
        own = network.sums
        [L] = parts.graph.stretches(law.leaderward)
        heard = L if network.ways is None else None
    # A leader answers to its path as a follower with this factor would.
    led = float(run.leader.strength(run.settings.dt)) / run.coupling
    case = OwnCase(problem, parts.world, law, np.append(own, led), between, heard)
    return own_delay_line(case)
