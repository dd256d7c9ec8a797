"""Why a run ended poorly: changes of its scenario are simulated, and those that help are stated.

A cause is stated only if its removal changes the outcome by more than other seeds and starts do.
"""

import dataclasses
import enum
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, final

import numpy as np

from echelon.core.errors import EchelonError, Outcome
from echelon.core.types import JsonObject
from echelon.experiments.results.role_outcome import Grade, RoleOutcome, RunOutcome, run_outcome
from echelon.experiments.scenario.build import build
from echelon.experiments.scenario.named_class import modules_kept
from echelon.experiments.scenario.scenario import Scenario, ScenarioLike, as_scenario
from echelon.experiments.studies.scenario_changes import (
    Change,
    candidate_changes,
    keys_of,
    left_out,
    other_seed,
    without_sections,
)
from echelon.simulation.engine.parts import Parts, Starts
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import RunSoFar, simulate

SECONDS = 60.0
"""Computing time after which nothing more is tried, s."""
_FACTOR = 3.0
"""By which a bounded error must differ for a change to count."""
_CLEAR = 1.5
"""By which it must differ where the class does: nothing happens at 1 cm itself."""
_MOVED = 1e-9
"""How far starts are moved in a placebo, in the states' units."""
_MOVES, _SEEDS = 3, 3
"""Placebos with moved starts, and with other seeds."""
_REPEATED = (0, _MOVES)
"""Placebos in which a change that helps must help too: one with moved starts, one of a seed."""
ROLES = ("leader", "followers")


@final
class Effect(enum.StrEnum):
    """What a change does to the outcome of a role."""

    EXPLAINS = "explains"
    WORSENS = "worsens"
    NONE = "none"


class TriedChange(NamedTuple):
    """One change, or two at once, and the outcome of the run with them.

    Attributes:
        effects: by role, `leader` and `followers`.
    """

    changes: tuple[Change, ...]
    outcome: RunOutcome
    effects: dict[str, Effect]

    @property
    def words(self) -> str:
        """The changes in words, as in `exact sensors`."""
        return " and ".join(change.words for change in self.changes)

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of the scenario, as `--set` changes them."""
        return keys_of(self.changes)

    @property
    def removes(self) -> bool:
        """Whether something is left out, and nothing only made smaller."""
        return all(change.removes for change in self.changes)

    @property
    def remedy(self) -> bool:
        """Whether it explains a poor outcome, and can be done."""
        return Effect.EXPLAINS in self.effects.values() and all(x.remedy for x in self.changes)

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""
        outcomes = {name: x and x.as_mapping() for name, x in self.outcome._asdict().items()}
        effects = {name: str(effect) for name, effect in self.effects.items()}
        keys = {"changes": [x.words for x in self.changes], "set": [*self.keys]}
        return {**keys, "outcome": outcomes, "effect": effects, "remedy": self.remedy}


@final
@dataclasses.dataclass(frozen=True)
class CauseStudy:
    """What was found about the outcome of a run.

    Attributes:
        scenario: its name.
        unit: of errors; empty for abstract states.
        outcome: of the run.
        placebos: of the same run with starts moved by 1e-9, and with other seeds.
        trials: each change that was simulated.
        untried: what was not, each with the reason.
        seconds: computing time allowed, s.
    """

    scenario: str
    unit: str
    outcome: RunOutcome
    placebos: tuple[RunOutcome, ...] = ()
    trials: tuple[TriedChange, ...] = ()
    untried: tuple[tuple[str, str], ...] = ()
    seconds: float = SECONDS

    @property
    def poor(self) -> tuple[str, ...]:
        """The roles that did not arrive."""
        outcomes = self.outcome._asdict()
        return tuple(x for x in ROLES if outcomes[x] and outcomes[x].grade is not Grade.ARRIVED)

    def causes(self, role: str) -> list[TriedChange]:
        """Return the changes without which a role's outcome would be another, best first.

        Smaller gains and slower paths are causes only where no part can be left out instead.
        """
        found = [trial for trial in self.trials if trial.effects[role] is Effect.EXPLAINS]
        removals = [trial for trial in found if trial.removes]
        return sorted(removals or found, key=lambda trial: _rank(trial.outcome, role))

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""

        def plain(outcome: RunOutcome) -> JsonObject:
            return {name: x and x.as_mapping() for name, x in outcome._asdict().items()}

        return {
            "scenario": self.scenario,
            "outcome": plain(self.outcome),
            "causes": {role: [x.words for x in self.causes(role)] for role in self.poor},
            "placebos": [plain(outcome) for outcome in self.placebos],
            "trials": [trial.as_mapping() for trial in self.trials],
            "untried": [{"changes": words, "reason": reason} for words, reason in self.untried],
            "seconds": self.seconds,
        }


def causes(
    scenario: ScenarioLike,
    seconds: float = SECONDS,
    result: Result | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CauseStudy:
    """Look for the cause of a poor run: simulate it with single changes, and with pairs of them.

    Args:
        scenario: of the run: a name, a file, the folder of a run, or a mapping of its keys.
        seconds: computing time after which nothing more is tried, s.
        result: the run, if it was simulated; else it is simulated first.
        progress: called with the runs that are done, and how many there are.

    Raises:
        EchelonError: the scenario has faults, or cannot be run.
    """
    scenario = as_scenario(scenario)
    if result is None:
        result = _finished(simulate(*build(scenario, to_run=True)))
    study = CauseStudy(scenario.name, result.length_unit, run_outcome(result), seconds=seconds)
    # Counted from here: it is the run itself that was asked for.
    with modules_kept():
        return study if not study.poor else _Search(scenario, result, study, progress).study()


def effect_of(after: RoleOutcome | None, spread: Sequence[RoleOutcome | None]) -> Effect:
    """Return what a change does to a role, beyond the spread of the runs without it.

    It must cross a class, or change a bounded error by a factor of 3.
    """
    if after is None or any(before is None for before in spread):
        return Effect.NONE
    known = [before for before in spread if before is not None]
    if all(_better(after, before) for before in known):
        return Effect.EXPLAINS
    return Effect.WORSENS if all(_better(x, after) for x in known) else Effect.NONE


def _better(one: RoleOutcome, other: RoleOutcome) -> bool:
    if one.error is None or other.error is None:
        # Numbers of a run that diverged mean nothing.
        return one.grade < other.grade
    if one.grade < other.grade:
        return other.error >= _CLEAR * one.error
    # Of an agent that is lost, the error tells how long it has been lost.
    same = one.grade is other.grade is Grade.BOUNDED
    return same and other.error >= _FACTOR * one.error


def _rank(outcome: RunOutcome, role: str) -> tuple[int, float]:
    own: RoleOutcome | None = getattr(outcome, role)
    if own is None:
        return Grade.LOST + 1, np.inf
    return own.grade, np.inf if own.error is None else own.error


def _finished(result: Result) -> Result:
    if result.outcome in (Outcome.INTERRUPTED, Outcome.STOPPED):
        # `simulate` keeps what it has; here it is of no use.
        raise KeyboardInterrupt
    return result


def moved_starts(parts: Parts, seed: int, draw: int, single: bool, by: float = _MOVED) -> Parts:
    """Return the parts with all starts moved by 1e-9, or by a few digits of single precision."""
    starts = Starts(parts)
    states = starts(seed)
    random = np.random.default_rng(draw).uniform(-1.0, 1.0, states.shape)
    digits = 4.0 * np.finfo(np.float32).eps * np.abs(states) if single else 0.0
    states = states + random * (by + digits)
    # Added again to leaders whose states are given.
    states[list(parts.graph.leaders)] -= starts.error
    return parts.replace(initial=dict(enumerate(states)))


@final
class _TimeOver(Exception):
    """The time that was allowed is over."""


@final
class _Search:
    """Simulates changes one after the other, until the time is over."""

    def __init__(
        self,
        scenario: Scenario,
        result: Result,
        study: CauseStudy,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.scenario, self.base, self.progress = scenario, study, progress
        self.changes = candidate_changes(scenario, result)
        self.end = time.monotonic() + study.seconds
        self.trials, self.done = list[TriedChange](), 0
        self.untried = left_out(scenario, result)
        self.placebos, self.spread = list[RunOutcome](), [study.outcome]

    def study(self) -> CauseStudy:
        waiting = ["changes"]
        try:
            for k in range(_MOVES + _SEEDS):
                self.placebos.append(self._outcome((), k))
            self.spread += self.placebos
            waiting = [change.words for change in self.changes]
            for change in self.changes:
                self._try((change,))
                waiting.pop(0)
            for role in self.base.poor:
                waiting = [f"pairs of changes for the {role}"]
                self._try_pairs(role)
                waiting.clear()
        except _TimeOver:
            over = f"{self.base.seconds:g} s were over"
            self.untried += [(words, over) for words in waiting]
        return dataclasses.replace(
            self.base,
            placebos=tuple(self.placebos),
            trials=tuple(self.trials),
            untried=tuple(self.untried),
        )

    def _try(self, changes: tuple[Change, ...]) -> None:
        keys = keys_of(changes)
        try:
            outcome = self._outcome(keys)
        except EchelonError as error:
            self.untried.append((_words(changes), str(error).splitlines()[0].rstrip(".")))
            return
        effects = {role: self._effect(role, outcome, changes) for role in ROLES}
        for placebo in _REPEATED if Effect.EXPLAINS in effects.values() else ():
            again = self._outcome(keys, placebo)
            for role, effect in effects.items():
                same = effect is self._effect(role, again, changes)
                effects[role] = effect if same or effect is not Effect.EXPLAINS else Effect.NONE
        self.trials.append(TriedChange(changes, outcome, effects))

    def _effect(self, role: str, outcome: RunOutcome, changes: tuple[Change, ...]) -> Effect:
        inside = {change.beside for change in changes if change.beside}
        before = [x.outcome for x in self.trials if x.words in inside]
        spread = [getattr(each, role) for each in (*self.spread, *before)]
        effect = effect_of(getattr(outcome, role), spread)
        if effect is not Effect.EXPLAINS:
            return effect
        # A pair of which one change explains alone says no more; what arrives needs no explanation.
        alone = any(
            trial.effects[role] is Effect.EXPLAINS and {*trial.changes} < {*changes}
            for trial in self.trials
        )
        return Effect.NONE if alone or role not in self.base.poor else effect

    def _try_pairs(self, role: str) -> None:
        """Try pairs until one explains, those first that leave out parts and helped most alone."""
        alone = [x for x in self.trials if len(x.changes) == 1]
        if any(trial.effects[role] is Effect.EXPLAINS for trial in self.trials):
            return
        if any(_rank(outcome, role)[0] == Grade.ARRIVED for outcome in self.spread):
            # Nothing counts where another seed does as much.
            return
        able = [trial for trial in alone if trial.effects[role] is Effect.NONE]
        ordered = sorted(able, key=lambda x: (not x.removes, _rank(x.outcome, role)))
        for one, other in _by_sum(ordered):
            changes = one.changes + other.changes
            if one.changes[0].family != other.changes[0].family:
                self._try(changes)
                if self.trials[-1].effects[role] is Effect.EXPLAINS:
                    return

    def _outcome(self, keys: tuple[str, ...], placebo: int | None = None) -> RunOutcome:
        """Return the outcome with changed keys, and with the start or the seed of a placebo."""
        self._check_time()
        seed = () if placebo is None or placebo < _MOVES else other_seed(self.scenario, placebo)
        scenario = self.scenario.with_(*without_sections(keys + seed))
        parts, settings = build(scenario, to_run=True)
        if placebo is not None and placebo < _MOVES:
            single = settings.precision == "float32"
            parts = moved_starts(parts, settings.seed, placebo, single)
        outcome = run_outcome(_finished(simulate(parts, settings, self._watch)))
        self.done += 1
        return outcome

    def _watch(self, run: RunSoFar) -> None:
        self._check_time()
        if self.progress is not None:
            total = _MOVES + _SEEDS + len(self.changes)
            self.progress(min(self.done, total), total)

    def _check_time(self) -> None:
        if time.monotonic() > self.end:
            raise _TimeOver


def _words(changes: tuple[Change, ...]) -> str:
    return " and ".join(change.words for change in changes)


def _by_sum(ordered: Sequence[TriedChange]) -> Iterator[tuple[TriedChange, TriedChange]]:
    """Yield all pairs, those of the first ones first."""
    places = itertools.combinations(range(len(ordered)), 2)
    for i, j in sorted(places, key=lambda pair: (sum(pair), pair)):
        yield ordered[i], ordered[j]
