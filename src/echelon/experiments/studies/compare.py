"""Compares methods on one scenario: the same agents, starts, limits and disturbance."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from echelon.core.errors import EchelonError, LawError, ScenarioError, check_name
from echelon.core.files import notebook_page
from echelon.core.numerics import precision
from echelon.core.words import Feedforward
from echelon.experiments.results.metrics import RunNumbers, metrics
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import (
    Scenario,
    ScenarioLike,
    as_scenario,
    with_overrides,
)
from echelon.experiments.scenario.yaml import inline_yaml
from echelon.guarantees.promises.promise import guarantee
from echelon.laws.consensus import Consensus
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts, Starts
from echelon.simulation.engine.simulate import RunSoFar, simulate
from echelon.simulation.optimal.drives import Plans, RecedingHorizon
from echelon.simulation.optimal.leader import OptimalTracking
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import FixedGain, Gain, Method, synthesize
from echelon.synthesis.gains.riccati import InnerLoop, Riccati

OWN = "own"
"""Stands for the scenario's drive among the methods to run."""
PLANNED_LEADER, PLANNED = "optimal-leader", "optimization"
"""Labels of the paper's two methods: consensus behind a planned leader, and plans alone."""


class ComparisonRow(NamedTuple):
    """A method's label with the numbers of its run, or the reason why there is none."""

    label: str
    flight: RunNumbers | None
    reason: str = ""

    def number(self, name: str) -> float | None:
        """Return a number of `RUN_NUMBERS`; None if it does not exist."""
        return None if self.flight is None else self.flight.number(name)


class Comparison(NamedTuple):
    """All methods on one scenario.

    Attributes:
        scenario: its name.
        rows: one for each method.
        horizon: s, the same for all.
        steady_window: the last part of it, which counts as steady, s.
        conditions: wind and plant, in words; empty where there are none.
    """

    scenario: str
    rows: tuple[ComparisonRow, ...]
    horizon: float
    steady_window: float
    conditions: tuple[str, ...]

    def _repr_html_(self) -> str:
        return notebook_page("report", self)


_LAW_NAMES = {
    entry.target.rpartition(":")[2]: name for name, entry in registry.FOLLOWER_LAWS.items()
}

INTERRUPTED = "it was not run because of an interruption."

DriveOf = Callable[[Parts, Settings], Controller]
"""Returns the drive of a method for the parts and the settings of a scenario."""


def _consensus(
    gain: Callable[[Parts], Gain], feedforward: Feedforward, trim: bool = True
) -> DriveOf:
    return lambda parts, settings: parts.drive.with_follower(
        Consensus(gain(parts), feedforward, trim, parts.drive.frame)
    )


def _synthesized(method: Method) -> Callable[[Parts], Gain]:
    return lambda parts: synthesize(parts.model, parts.graph, method)


def _riccati(parts: Parts) -> Gain:
    """Return the scenario's Riccati gain, or the model's default one."""
    gain = parts.drive.gain
    if gain is not None and gain.method == Riccati.name:
        return gain
    return synthesize(parts.model, parts.graph, Riccati())


def _reference(parts: Parts) -> Any:
    return getattr(getattr(parts.drive, "leader", None), "reference", None)


def _behind_a_plan(parts: Parts, settings: Settings) -> Controller:
    """Return the law of `riccati-relay` behind the paper's leader, which plans its whole path."""
    reference, first = _reference(parts), parts.graph.leaders[0]
    if reference is None:
        raise LawError("`optimal-leader` plans along a reference, and there is none.")
    # The plan begins where the leader does: `with_starts` has drawn all starts.
    start = np.asarray(parts.initial)[first] - parts.formation.offsets[first]
    with precision("float64"):
        error = start - np.asarray(OptimalTracking(reference).start(parts.model))
    off = dict(zip(parts.model.state_names, error.tolist(), strict=True))
    leader = OptimalTracking(reference, settings.horizon, off, settings.limits)
    law = Consensus(_riccati(parts), Feedforward.RELAY, frame=parts.drive.frame)
    return Laws(leader, law)


_DRIVES: Mapping[str, DriveOf] = {
    # The printed law has neither the leader's input nor a trim input.
    "literal": _consensus(_synthesized(FixedGain()), Feedforward.NONE, trim=False),
    f"{Riccati.name}-relay": _consensus(_riccati, Feedforward.RELAY),
    Riccati.name: _consensus(_riccati, Feedforward.NONE),
    InnerLoop.name: _consensus(_synthesized(InnerLoop()), Feedforward.RELAY),
    _LAW_NAMES[StoppingPoint.__name__]: lambda parts, settings: Laws(
        StoppingLeader(reference=_reference(parts)), StoppingPoint()
    ),
    PLANNED_LEADER: _behind_a_plan,
    PLANNED: lambda parts, settings: Plans(_reference(parts)),
    "mpc": lambda parts, settings: RecedingHorizon(_reference(parts)),
}

LABELS = tuple(_DRIVES)
"""The methods that are compared."""


SLOW = (PLANNED_LEADER, PLANNED, "mpc")
"""Methods that solve optimization problems, which take seconds to minutes for each run."""

MethodRun = Callable[[str, DriveOf], Controller | None]
"""Runs a method under its label, and returns the completed drive; None if nothing ran."""


def known_labels(requested: Sequence[str] | None, slow: bool = True) -> tuple[str, ...]:
    """Return the requested methods: of `LABELS` in their order, laws of the user's, and `own`.

    A law of the user's is `mine.py:Law`, or a mapping as that of `follower.law`, `{python:
    "mine.py:Law", rate: 2}`. By default these are all labels, without those of `SLOW` if not
    `slow`.

    Raises:
        LawError: a label is unknown.
    """
    allowed = (*LABELS, OWN)
    if not requested:
        return tuple(label for label in allowed if slow or label not in SLOW)
    laws = tuple(dict.fromkeys(filter(_is_law, requested)))
    for label in requested:
        if label not in laws:
            check_name("`--method` is", label, allowed, LawError)
    named = tuple(label for label in LABELS if label in requested)
    return (*named, *laws, *[OWN][: OWN in requested])


def _is_law(text: str) -> bool:
    return text.lstrip().startswith("{") or ".py:" in text


def run_each(scenario: Scenario, parts: Parts, only: Sequence[str], fly: MethodRun) -> None:
    """Run each method; the scenario's own drive only if no other method has the same.

    Raises:
        ScenarioError: a law of the user's cannot be built.
    """
    laws = laws_of(scenario, parts, only)
    flown = {label: fly(label, _DRIVES[label]) for label in only if label in _DRIVES}
    for label, law in laws.items():
        flown[label] = fly(label, lambda parts, settings, law=law: law)
    drive = parts.drive.prepare(parts.model, parts.graph.before)
    # By value, gains included: the scenario may describe one of the methods.
    if OWN in only and not any(eqx.tree_equal(drive, other) for other in flown.values()):
        label = _label(drive)
        fly(f"{label}, own" if label in flown else label, lambda parts, settings: parts.drive)


def laws_of(scenario: Scenario, parts: Parts, only: Sequence[str]) -> dict[str, Controller]:
    """Return the user's laws by their class, with the keys in which those of one class differ.

    Raises:
        ScenarioError: one cannot be built.
    """
    keys, drives = list[Mapping[str, object]](), list[Controller]()
    for text in filter(_is_law, only):
        law = text if text.lstrip().startswith("{") else f"{{python: {json.dumps(text)}}}"
        changed, built = _with_law(scenario, law)
        drives.append(built.parts.drive)
        keys.append(changed.data["follower"]["law"])
    kinds = [_label(drive.prepare(parts.model, parts.graph.before)) for drive in drives]
    labels = list[str]()
    for kind, mine in zip(kinds, keys, strict=True):
        alike = [other for other, name in zip(keys, kinds, strict=True) if name == kind]
        differ = {k: v for k, v in mine.items() if any(other.get(k) != v for other in alike)}
        labels.append(kind + f"({inline_yaml(differ)[1:-1]})" * bool(differ))
    return dict(zip(labels, drives, strict=True))


def compare(
    scenario: ScenarioLike,
    built: Experiment | None = None,
    only: Sequence[str] = (*LABELS, OWN),
    progress: Callable[[str, float, int], None] = lambda label, done, methods: None,
    landed: Callable[[ComparisonRow], None] = lambda row: None,
) -> Comparison:
    """Run each method on a scenario from the same starts, under the same limits and wind.

    Args:
        scenario: the agents, their graph, formation, starts, conditions and horizon; a scenario,
            its name, its file, or a mapping.
        built: its parts and settings; built if None.
        only: the labels of the methods; `own` for the scenario's drive, or a law of your own as
            the scenario writes it, `{python: "mine.py:Law", rate: 2}`.
        progress: called between chunks of steps and between runs, with the label of the method,
            how many methods are done (with a part of this one), and how many there are; if it
            raises KeyboardInterrupt, the remaining methods have a row with that reason.
        landed: called with each row as soon as it is complete.

    A method that does not apply, or whose solver is missing, has a row with the reason. The
    scenario's drive has a row under the name of its gain, or of a user's class, unless another row
    has the same drive.

    Raises:
        ScenarioError: a part cannot be built.
    """
    scenario = as_scenario(scenario)
    parts, settings = build(scenario) if built is None else built
    [scene] = with_starts(parts, [settings.seed])
    rows = list[ComparisonRow]()

    def fly(label: str, drive: DriveOf) -> Controller | None:
        def part(done: float) -> None:
            progress(label, len(rows) + done, len(only))

        try:
            part(0.0)
            rows.append(_row(label, drive, scene, settings, part))
        except KeyboardInterrupt:
            rows.append(ComparisonRow(label, None, INTERRUPTED))
        landed(rows[-1])
        return None if rows[-1].flight is None else rows[-1].flight.result.drive

    run_each(scenario, parts, only, fly)
    conditions = conditions_of(parts)
    return Comparison(scenario.name, tuple(rows), settings.horizon, settings.window, conditions)


def conditions_of(parts: Parts) -> tuple[str, ...]:
    """Return wind and plant in words; empty where there are none."""
    described = parts.world.describe(parts.model)
    return tuple(f"{name}: {text}" for name, text in described.items() if text)


def _row(
    label: str, drive: DriveOf, parts: Parts, settings: Settings, part: Callable[[float], None]
) -> ComparisonRow:
    try:
        return ComparisonRow(
            label, _fly(parts.replace(drive=drive(parts, settings)), settings, part)
        )
    except EchelonError as error:
        return ComparisonRow(label, None, str(error))


def with_starts(parts: Parts, seeds: Sequence[int]) -> list[Parts]:
    """Return the parts with the starts of each seed, the leader's error included."""
    with precision("float64"):
        drive = parts.drive.prepare(parts.model, parts.graph.before)
        starts = Starts(parts.replace(drive=drive)).of(seeds)
    # The states contain the leader's error already.
    return [parts.replace(initial=states, start_error={}) for states in starts]


def _fly(parts: Parts, settings: Settings, part: Callable[[float], None]) -> RunNumbers:
    watch = _Watch(part)
    result = simulate(parts, settings, watch)
    seconds = watch.seconds if result.work is None else result.work.seconds
    computing = seconds / (parts.graph.agents * settings.horizon)
    return RunNumbers(result, metrics(result), guarantee(result.parts, settings), computing)


class _Watch:
    """Measures the time of a run's steps, without the first chunk, which includes compilation."""

    def __init__(self, part: Callable[[float], None]) -> None:
        self.ticks: list[tuple[float, int, int]] = []
        self.part = part

    def __call__(self, run: RunSoFar) -> None:
        self.ticks.append((time.perf_counter(), run.done, run.steps))
        self.part(run.done / run.steps)

    @property
    def seconds(self) -> float:
        """Time (s) of the whole run at the speed of its compiled steps."""
        (first, begun, total), (last, done, _) = self.ticks[0], self.ticks[-1]
        return (last - first) * total / max(1, done - begun)


def _with_law(scenario: Scenario, law: str) -> tuple[Scenario, Experiment]:
    """Return a scenario under a law, with gain and feed-forward if the law takes them."""
    for change in (f"follower.law={law}", f"follower={{law: {law}}}"):
        try:
            changed = with_overrides(scenario, [change])
            return changed, build(changed)
        except ScenarioError as error:
            why = str(error).replace(f"--set {change}", f"--method {law}")
    raise ScenarioError(why)


def _label(drive: Controller) -> str:
    law, gain, feedforward = getattr(drive, "follower", drive), drive.gain, drive.feedforward
    kind = type(law).__name__
    if not type(law).__module__.startswith("echelon."):
        return kind
    name = _LAW_NAMES.get(kind, kind) if gain is None else gain.method
    return name if feedforward is Feedforward.NONE else f"{name}-{feedforward}"
