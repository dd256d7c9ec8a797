"""Methods side by side on one scenario: the same agents, starts, limits and disturbance."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from echelon.core.errors import EchelonError, LawError, did_you_mean, listing
from echelon.core.numerics import precision
from echelon.core.words import Feedforward
from echelon.experiments.results.metrics import Metrics, metrics
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.build import Experiment, build
from echelon.experiments.scenario.scenario import Scenario
from echelon.guarantees.promises.promise import Promise, promise
from echelon.laws.consensus import Consensus
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.initial import initial_states
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import RunSoFar, simulate
from echelon.simulation.optimal.drives import Plans, RecedingHorizon
from echelon.simulation.step.drive import Drive
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats
from echelon.synthesis.gains.fixed import FixedGain
from echelon.synthesis.gains.gain import Gain, Method, synthesize
from echelon.synthesis.gains.inner_loop import InnerLoop
from echelon.synthesis.gains.riccati import Riccati

OWN = "own"
"""Asks for what drives the agents in the scenario itself."""


class Flight(NamedTuple):
    """What a method made of the scenario.

    Attributes:
        result: the run.
        promise: of what flew.
        told: what each agent must be told by others, in words.
        computing: seconds of computing for one agent and one second of flight, compilation apart.
        solver: what solving took; None for a law.
    """

    result: Result
    promise: Promise
    told: tuple[str, ...]
    computing: float
    solver: SolverStats | None


class ComparisonRow(NamedTuple):
    """A method's label, its flight and numbers; or else the reason why there are none."""

    label: str
    flight: Flight | None
    numbers: Metrics | None
    reason: str = ""

    @property
    def converged(self) -> bool:
        """Whether every follower settled for good."""
        return self.numbers is not None and self.settled is not None

    @property
    def settled(self) -> float | None:
        """When the last follower came within 1 cm for good, s; None where one did not."""
        times = [each.settling_time for each in self.numbers.followers] if self.numbers else []
        known = [time for time in times if time is not None]
        # The swarm has settled when all have; those that did say nothing for one that did not.
        return max(known) if known and len(known) == len(times) else None

    @property
    def whole(self) -> float | None:
        """The largest whole-run error of a follower."""
        return self._worst("rmse")

    @property
    def steady(self) -> float | None:
        """The largest steady error of a follower."""
        return self._worst("steady_rmse")

    @property
    def effort(self) -> float | None:
        """Root mean square of the followers' normalized inputs about the trim."""
        values = [each.effort for each in self.numbers.followers] if self.numbers else []
        known = [value for value in values if value is not None]
        # The mean of squares and not of their roots, so that it is that of all inputs together.
        return float(np.sqrt(np.mean(np.square(known)))) if known else None

    def _worst(self, name: str) -> float | None:
        values = [getattr(each, name) for each in self.numbers.followers] if self.numbers else []
        known = [value for value in values if value is not None]
        return max(known) if known and len(known) == len(values) else None


class Comparison(NamedTuple):
    """All methods on one scenario.

    Attributes:
        scenario: its name.
        rows: one a method.
        horizon: s, alike for all.
        steady_window: its last part that counts as steady, s.
        conditions: wind and plant, in words; empty where the run is ideal.
    """

    scenario: str
    rows: tuple[ComparisonRow, ...]
    horizon: float
    steady_window: float
    conditions: tuple[str, ...]


_LAW_NAMES = {
    entry.target.rpartition(":")[2]: name for name, entry in registry.FOLLOWER_LAWS.items()
}

DriveOf = Callable[[Parts], Drive]
"""What drives the agents of a scenario under a method."""


def _consensus(
    gain: Callable[[Parts], Gain], feedforward: Feedforward, trim: bool = True
) -> DriveOf:
    """Return the drive under the consensus law with a gain, the scenario's leader kept."""
    return lambda parts: parts.drive.with_follower(
        Consensus(gain(parts), feedforward, trim, parts.drive.frame)
    )


def _synthesized(method: Method) -> Callable[[Parts], Gain]:
    return lambda parts: synthesize(parts.model, parts.graph, method)


def _riccati(parts: Parts) -> Gain:
    """Return the scenario's own Riccati gain, or the model's default one."""
    own = parts.drive.gain
    if own is not None and own.method == Riccati.name:
        return own
    return synthesize(parts.model, parts.graph, Riccati())


def _reference(parts: Parts) -> Any:
    """Return what the scenario's leader follows, if anything."""
    return getattr(getattr(parts.drive, "leader", None), "reference", None)


_DRIVES: Mapping[str, DriveOf] = {
    # The printed law has neither the leader's input nor a trim input.
    "literal": _consensus(_synthesized(FixedGain()), Feedforward.NONE, trim=False),
    f"{Riccati.name}-relay": _consensus(_riccati, Feedforward.RELAY),
    Riccati.name: _consensus(_riccati, Feedforward.NONE),
    InnerLoop.name: _consensus(_synthesized(InnerLoop()), Feedforward.RELAY),
    _LAW_NAMES[StoppingPoint.__name__]: lambda parts: Laws(
        StoppingLeader(reference=_reference(parts)), StoppingPoint()
    ),
    "optimization": lambda parts: Plans(_reference(parts)),
    "mpc": lambda parts: RecedingHorizon(_reference(parts)),
}

LABELS = tuple(_DRIVES)
"""The methods that are compared."""


def known_labels(asked: Sequence[str] | None) -> tuple[str, ...]:
    """Return the methods asked for in the order of `LABELS`, then `own`; all where none is named.

    Raises:
        LawError: a name is no method's.
    """
    allowed = (*LABELS, OWN)
    for label in asked or ():
        if label not in allowed:
            raise LawError(
                f"`--method` is `{label}`, allowed are {listing(allowed)}"
                f"{did_you_mean(label, allowed)}."
            )
    return tuple(label for label in allowed if not asked or label in asked)


def compare(
    scenario: Scenario,
    built: Experiment | None = None,
    only: tuple[str, ...] = (*LABELS, OWN),
    began: Callable[[str], None] = lambda label: None,
    check: Callable[[], None] = lambda: None,
    landed: Callable[[ComparisonRow], None] = lambda row: None,
) -> Comparison:
    """Fly each method on a scenario from the same starts, under the same limits and wind.

    Args:
        scenario: the agents, their graph, formation, starts and conditions; its horizon is flown.
        built: its parts and settings, built unless given.
        only: the labels of the methods to fly, `own` among them for the scenario's own drive.
        began: called with each method's label before it flies.
        check: called between chunks of steps and between flights; where it raises
            KeyboardInterrupt, what is left is not flown, and has a row that says so.
        landed: called with each row as soon as it is there.

    A method that does not apply, or whose solver is missing, is a row with its reason. The
    scenario's own drive is a row under the name of its gain, unless another row is the same.

    Raises:
        ScenarioError: a part cannot be made.
    """
    parts, settings = build(scenario) if built is None else built
    scene = _with_starts(parts, settings)
    rows = list[ComparisonRow]()

    def fly(label: str, drive: DriveOf) -> None:
        try:
            check()
            began(label)
            rows.append(_row(label, drive, scene, settings, check))
        except KeyboardInterrupt:
            rows.append(
                ComparisonRow(label, None, None, "it was not flown, since it was interrupted.")
            )
        landed(rows[-1])

    for label in (label for label in only if label != OWN):
        fly(label, _DRIVES[label])
    own = _own_label(parts, rows) if OWN in only else None
    if own is not None:
        fly(own, lambda parts: parts.drive)
    return Comparison(
        scenario.name, tuple(rows), settings.horizon, settings.window, _conditions(parts)
    )


def _row(
    label: str, drive: DriveOf, parts: Parts, settings: Settings, check: Callable[[], None]
) -> ComparisonRow:
    try:
        flight = _fly(parts.replace(drive=drive(parts)), settings, check)
    except EchelonError as error:
        return ComparisonRow(label, None, None, str(error))
    return ComparisonRow(label, flight, metrics(flight.result))


def _with_starts(parts: Parts, settings: Settings) -> Parts:
    """Return the parts with the starts drawn once, the leader's error included."""
    with precision("float64"):
        drive = parts.drive.prepare(parts.model, parts.graph)
        states = initial_states(parts.replace(drive=drive), settings.seed)
    # The leader's error is in the states already, and would be added once more.
    return parts.replace(initial=states, start_error={})


def _conditions(parts: Parts) -> tuple[str, ...]:
    """Return what differs from the model in every run, in words."""
    described = parts.world.describe(parts.model)
    return tuple(f"{name}: {text}" for name, text in described.items() if text)


def _fly(parts: Parts, settings: Settings, check: Callable[[], None]) -> Flight:
    """Run a method, and take its time: of solving, or else of the compiled steps."""
    watch = _Watch(check)
    result = simulate(parts, settings, watch)
    seconds = watch.seconds if result.work is None else result.work.seconds
    computing = seconds / (parts.graph.agents * settings.horizon)
    told, found = result.drive.information.follower, promise(result.parts, settings)
    return Flight(result, found, told, computing, result.work)


class _Watch:
    """Times the steps of a run, all but the first chunk, which compiles."""

    def __init__(self, check: Callable[[], None]) -> None:
        self.ticks: list[tuple[float, int, int]] = []
        self.check = check

    def __call__(self, run: RunSoFar) -> None:
        self.ticks.append((time.perf_counter(), run.done, run.steps))
        self.check()

    @property
    def seconds(self) -> float:
        """Seconds that the whole run takes at the pace of its compiled steps."""
        (first, begun, total), (last, done, _) = self.ticks[0], self.ticks[-1]
        return (last - first) * total / max(1, done - begun)


def _own_label(parts: Parts, rows: list[ComparisonRow]) -> str | None:
    """Return what to call the scenario's own drive; None where a row has flown it already."""
    drive = parts.drive.prepare(parts.model, parts.graph)
    flown = (row.flight.result.drive for row in rows if row.flight is not None)
    # By value, gains included: a scenario that says by hand what a method is would else fly twice.
    if any(eqx.tree_equal(drive, each) for each in flown):
        return None
    gain, feedforward = drive.gain, drive.feedforward
    name = _law_name(drive) if gain is None else gain.method
    label = name if feedforward is Feedforward.NONE else f"{name}-{feedforward}"
    return f"{label}, own" if label in {row.label for row in rows} else label


def _law_name(drive: Drive) -> str:
    """Return a scenario's name of the followers' law, or that of the class that drives them."""
    kind = type(getattr(drive, "follower", drive)).__name__
    return _LAW_NAMES.get(kind, kind)
