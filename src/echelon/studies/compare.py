"""Methods side by side on one scenario: the same agents, starts, limits and disturbance."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from echelon.core.errors import EchelonError, LawError, did_you_mean, listing
from echelon.core.numerics import precision
from echelon.core.words import Feedforward
from echelon.engine.initial import initial_states
from echelon.engine.parts import Parts
from echelon.engine.result import Result, imperfections
from echelon.engine.simulate import simulate
from echelon.engine.work import SolverStats, solver_stats
from echelon.gains.fixed import FixedGain
from echelon.gains.gain import Gain, Method, synthesize
from echelon.gains.inner_loop import InnerLoop
from echelon.gains.riccati import Riccati
from echelon.laws.consensus import Consensus
from echelon.optimal.pilots import simulate_mpc, simulate_plans
from echelon.results.metrics import Metrics, metrics
from echelon.scenario.build import build
from echelon.scenario.scenario import Scenario

LABELS = ("literal", "riccati-relay", "riccati", "inner-loop", "optimization", "mpc")


class Flight(NamedTuple):
    """What a method made of the scenario.

    Attributes:
        result: the run.
        told: what each agent must be told by others, in words.
        computing: seconds of computing for one agent and one second of flight, compilation apart.
        solver: what solving took; None for a law.
    """

    result: Result
    told: tuple[str, ...]
    computing: float
    solver: SolverStats | None


class Row(NamedTuple):
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
    rows: tuple[Row, ...]
    horizon: float
    steady_window: float
    conditions: tuple[str, ...]


Fly = Callable[[Parts], Flight]


def known_labels(asked: Sequence[str] | None) -> tuple[str, ...]:
    """Return the methods asked for in the order of `LABELS`; all where none is named.

    Raises:
        LawError: a name is no method's.
    """
    for label in asked or ():
        if label not in LABELS:
            raise LawError(
                f"`--method` is `{label}`, allowed are {listing(LABELS)}"
                f"{did_you_mean(label, LABELS)}."
            )
    return tuple(label for label in LABELS if not asked or label in asked)


def compare(
    scenario: Scenario,
    parts: Parts | None = None,
    only: tuple[str, ...] = LABELS,
    began: Callable[[str], None] = lambda label: None,
) -> Comparison:
    """Fly each method on a scenario from the same starts, under the same limits and wind.

    Args:
        scenario: the agents, their graph, formation, starts and conditions; its horizon is flown.
        parts: its parts, built unless given.
        only: the labels of the methods to fly.
        began: called with each method's label before it flies.

    A method that does not apply, or whose solver is missing, is a row with its reason. Where the
    scenario's own law is none of the methods, it flies too, under the name of its gain.

    Raises:
        ScenarioError: a part cannot be made.
    """
    built = build(scenario) if parts is None else parts
    scene, window = _with_starts(built), scenario.report.steady_window
    flights = {label: _FLY[label] for label in only} | (_own(built) if only == LABELS else {})
    rows = []
    for label, fly in flights.items():
        began(label)
        rows.append(_row(label, fly, scene, window))
    horizon = built.settings["horizon"]
    return Comparison(scenario.name, tuple(rows), horizon, window, _conditions(rows))


def _row(label: str, fly: Fly, parts: Parts, window: float) -> Row:
    try:
        flight = fly(parts)
    except EchelonError as error:
        return Row(label, None, None, str(error))
    return Row(label, flight, metrics(flight.result, window))


def _with_starts(parts: Parts) -> Parts:
    """Return the parts with the starts drawn once, the leader's error included."""
    given = parts.settings
    with precision("float64"):
        leader = parts.leader.prepared(parts.model, parts.graph)
        states = initial_states(
            *parts[:3], leader, given["initial"], given["start_error"], given["seed"]
        )
    return parts._replace(settings={**given, "initial": states, "start_error": {}})


def _conditions(rows: list[Row]) -> tuple[str, ...]:
    """Return what differs from the model in every run, in words."""
    flown = [row.flight.result for row in rows if row.flight is not None]
    told = imperfections(flown[0]) if flown else {}
    return tuple(f"{name}: {text}" for name, text in told.items() if text)


# ---- the methods --------------------------------------------------------------------------------


def _consensus(gain: Callable[[Parts], Gain], feedforward: Feedforward, trim: bool = True) -> Fly:
    """Return the flight under the consensus law with a gain."""

    def fly(parts: Parts) -> Flight:
        law = Consensus(gain(parts), feedforward, trim)
        watch = _Watch()
        result = simulate(
            *parts[:3], leader=parts.leader, follower=law, progress=watch, **parts.settings
        )
        return Flight(
            result,
            law.information,
            watch.seconds / (parts.graph.agents * result.settings.horizon),
            None,
        )

    return fly


class _Watch:
    """Times the steps of a run, all but the first chunk, which compiles."""

    def __init__(self) -> None:
        self.ticks: list[tuple[float, int, int]] = []

    def __call__(self, done: int, total: int) -> None:
        self.ticks.append((time.perf_counter(), done, total))

    @property
    def seconds(self) -> float:
        """Seconds that the whole run takes at the pace of its compiled steps."""
        (first, begun, total), (last, done, _) = self.ticks[0], self.ticks[-1]
        return (last - first) * total / max(1, done - begun)


def _synthesized(method: Method) -> Callable[[Parts], Gain]:
    return lambda parts: synthesize(parts.model, parts.graph, method)


def _own(parts: Parts) -> dict[str, Fly]:
    """Return the flight under the scenario's own law, where no method is that one."""
    law = parts.follower
    gain = getattr(law, "gain", None)
    if not isinstance(law, Consensus) or not isinstance(gain, Gain):
        return {}
    if gain.method in ("riccati", "inner-loop", "given"):
        return {}
    label = (
        gain.method if law.feedforward is Feedforward.NONE else f"{gain.method}-{law.feedforward}"
    )
    return {label: _consensus(lambda parts: gain, law.feedforward, law.trim)}


def _riccati(parts: Parts) -> Gain:
    """Return the scenario's own Riccati gain, or the model's default one."""
    own = getattr(parts.follower, "gain", None)
    if isinstance(own, Gain) and own.method == "riccati":
        return own
    return synthesize(parts.model, parts.graph, Riccati())


def _optimized(fly: Callable[..., Result]) -> Fly:
    """Return the flight in which every agent, the leader too, minimizes a cost of its own."""

    def flight(parts: Parts) -> Flight:
        reference = getattr(parts.leader, "reference", None)
        result = fly(*parts[:3], reference=reference, **parts.settings)
        figures = solver_stats(result)
        assert figures is not None
        seconds = figures.seconds / (parts.graph.agents * result.settings.horizon)
        return Flight(result, result.follower.information, seconds, figures)

    return flight


_FLY: Mapping[str, Fly] = {
    "literal": _consensus(_synthesized(FixedGain()), Feedforward.NONE, trim=False),
    "riccati-relay": _consensus(_riccati, Feedforward.RELAY),
    "riccati": _consensus(_riccati, Feedforward.NONE),
    "inner-loop": _consensus(_synthesized(InnerLoop()), Feedforward.RELAY),
    "optimization": _optimized(simulate_plans),
    "mpc": _optimized(simulate_mpc),
}
