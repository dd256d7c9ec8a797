"""The single changes of a scenario that may explain why a run of it ended poorly.

Each is made of keys, as `--set` changes them. Draws depend on the seed, the time and the agent's
number alone, so that leaving out a part shifts no other draw.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.references.reference import Reference
from echelon.core.digits import about
from echelon.core.words import Feedforward
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.yaml import part_at
from echelon.laws.law import gain_of, reference_of
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.result import Result

_MORE = 2.0
"""The factor of gains, of the path's time and of the horizon."""
_DIGITS = 4
"""Of a coupling: what is printed is what was simulated."""
_FEW = 4
"""Factor on the substeps that is always tried; more are where the model is faster than a step."""
_REACH = 2.5
"""Speed times step up to which Runge-Kutta is stable, on the real axis 2.785."""


class Change(NamedTuple):
    """One change of a scenario.

    Attributes:
        words: with which the run is another, as in `exact sensors`.
        keys: of the scenario, as `--set` changes them.
        family: what it changes; no pair is made of two changes of one family.
        remedy: whether it can be done, and does not only explain.
        removes: whether something of the scenario is left out, and not only made smaller.
        beside: the words of a change that it contains; it counts only beyond that one.
    """

    words: str
    keys: tuple[str, ...]
    family: str
    remedy: bool = True
    removes: bool = True
    beside: str = ""


class _Removal(NamedTuple):
    """A key, the value under which it does nothing, and what the run then has."""

    path: tuple[str, ...]
    value: str
    words: str
    remedy: bool = True
    part: bool = True


_REMOVALS = (
    _Removal(("sensing",), "null", "exact sensors"),
    _Removal(("actuator", "lag"), "0", "no actuator lag"),
    _Removal(("actuator", "levels"), "0", "actuators without steps"),
    _Removal(("actuator", "minimum"), "null", "no least thrust"),
    _Removal(("disturbance",), "null", "no disturbance", remedy=False),
    _Removal(("plant",), "null", "agents equal to the model", remedy=False),
    _Removal(("parts",), "null", "no parts of your own", remedy=False),
    _Removal(("events",), "[]", "no events", remedy=False),
    _Removal(("safety",), "null", "no collision avoidance"),
    _Removal(("formation", "motion"), "[]", "a formation that does not move"),
    _Removal(("leader", "start_error"), "{}", "a leader that starts on its path", part=False),
    _Removal(("leader", "observer"), "null", "no observer of the leader"),
    _Removal(("follower", "observer"), "null", "no observer of the followers"),
    _Removal(("leader", "speed"), "null", "no bound on the leader's speed"),
    _Removal(("follower", "speed"), "null", "no bound on the followers' speed"),
    _Removal(("leader", "reacts"), "false", "a leader that does not react"),
    _Removal(("follower", "trim"), "true", "the trim input"),
    _Removal(("follower", "frame"), "heading", "gains in axes that turn with the heading"),
    # A start is no part: without one, whatever is slow is not seen.
    _Removal(("initial",), "null", "starts at the goals", part=False),
    _Removal(("simulation", "integrator"), "rk4", "the integrator `rk4`"),
    _Removal(("simulation", "precision"), "float64", "float64", remedy=False),
)
"""Keys that may be left out, each tried where the scenario sets it to something else."""


def candidate_changes(scenario: Scenario, result: Result) -> list[Change]:
    """Return the changes that apply to a scenario, in the order in which they are tried.

    Args:
        scenario: of the run.
        result: the run, which tells its gains, and whether inputs were at their limits.
    """
    data, simulation = scenario.data, scenario.simulation
    found = list[Change]()
    if simulation.limits and result.saturated.max() > 0.0:
        words = "no limits of the inputs"
        found.append(Change(words, ("simulation.limits=false",), "limits", remedy=False))
    for removal in _REMOVALS:
        held = part_at(data, removal.path)
        # An empty section and zero do nothing already.
        acts = removal.value == "true" if held is False else held and str(held) != removal.value
        if acts:
            key = f"{'.'.join(removal.path)}={removal.value}"
            of = removal.path[0], removal.remedy, removal.part
            found.append(Change(removal.words, (key,), *of))
    found += [*_network(scenario), *_graph(scenario), *_relay(scenario)]
    # These are compiled already.
    found += [*_couplings(result), *_times(scenario, result)]
    shorter = shorter_step(scenario)
    if not isinstance(shorter, str):
        found.append(Change("half the step `dt`", shorter, "step"))
    if simulation.integrator != "printed":
        few, *more = _substeps(scenario, result.model)
        # First what the model needs, where it is faster than the step allows.
        found = [*more, *found, few]
    return found


def keys_of(changes: Sequence[Change]) -> tuple[str, ...]:
    """Return the keys of several changes, as `--set` changes them."""
    return without_sections([key for change in changes for key in change.keys])


def without_sections(keys: Sequence[str]) -> tuple[str, ...]:
    """Return keys without those of a section that is left out, which they would restore."""
    gone = tuple(f"{key.removesuffix('=null')}." for key in keys if key.endswith("=null"))
    return tuple(key for key in dict.fromkeys(keys) if not key.startswith(gone or "="))


def left_out(scenario: Scenario, result: Result) -> list[tuple[str, str]]:
    """Return the changes that cannot be tried, each with the reason."""
    shorter, path = shorter_step(scenario), _path(result)
    reasons = [("half the step `dt`", shorter)] if isinstance(shorter, str) else []
    if path is not None and not isinstance(path, Reference):
        reasons.append(("a slower path", "its states fit the equations at their own speed only"))
    return reasons


def other_seed(scenario: Scenario, k: int) -> tuple[str, ...]:
    """Return the keys under which everything random of a scenario is drawn anew."""
    paths = [("seed",), *((part, "seed") for part in ("disturbance", "sensing", "network"))]
    set_ = [path for path in paths if path == ("seed",) or part_at(scenario.data, path) is not None]
    before = (int(part_at(scenario.data, path) or 0) for path in set_)
    return tuple(f"{'.'.join(p)}={seed + 1000 + k}" for p, seed in zip(set_, before, strict=True))


# ---- single changes ------------------------------------------------------------------------------


def shorter_step(scenario: Scenario) -> tuple[str, ...] | str:
    """Return the keys that halve `dt` and keep all else; a reason where that cannot be.

    What is rounded to steps keeps its length in seconds, so that the wind keeps its path.
    """
    simulation, dt = scenario.simulation, scenario.simulation.dt
    wind, sensing, network = scenario.disturbance, scenario.sensing, scenario.network
    if simulation.integrator == "printed":
        return "the integrator `printed` has no step"
    if sensing is not None and any(sensing.noise.values()):
        return "its measurements would have another noise"
    if wind is not None and wind.time is not None:
        return "its gusts would take another course"
    if network is not None and network.jitter:
        return "its messages would have other delays"
    if scenario.parts:
        return "its own parts may count in steps"
    keys = [f"simulation.dt={dt / 2!r}", f"simulation.store_every={2 * simulation.store_every}"]
    if wind is not None and (wind.rms or wind.input_rms):
        keys.append(f"disturbance.hold={max(1, round(wind.hold / dt)) * dt!r}")
    if sensing is not None:
        keys.append(f"sensing.delay={round(sensing.delay / dt) * dt!r}")
    if network is not None:
        # As `Network.prepared` rounds it.
        keys.append(f"network.delay={max(1, math.ceil(network.delay / dt - 1e-6)) * dt!r}")
    return tuple(keys)


def _substeps(scenario: Scenario, model: ControlAffine) -> list[Change]:
    simulation = scenario.simulation
    fastest = float(np.abs(np.linalg.eigvals(linearize(model)[0])).max())
    needed = fastest * simulation.dt / (simulation.substeps * _REACH)
    # As many as the fastest mode of the model alone needs, which is no statement but a guess.
    factors = {_FEW, max(_FEW, 2 ** math.ceil(math.log2(max(needed, 1.0))))}
    counts = [factor * simulation.substeps for factor in sorted(factors)]
    return [Change(f"{k} substeps", (f"simulation.substeps={k}",), "substeps") for k in counts]


def _network(scenario: Scenario) -> Iterator[Change]:
    network, ideal = scenario.network, "an ideal network"
    if network is None:
        return
    if scenario.leadership is None:
        yield Change(ideal, ("network=null",), "network")
        return
    # Backup leaders watch for messages, and need a network that carries them.
    rate = f"network.rate={1.0 / scenario.simulation.dt!r}"
    losses = "network.loss=0", "network.bursts={share: 0}", "network.jitter=0", "network.delay=0"
    yield Change("a network without loss and delay", (rate, *losses), "network")


def _graph(scenario: Scenario) -> Iterator[Change]:
    if scenario.graph.schedule:
        keys = "graph.schedule=[]", "graph.period=null"
        yield Change("the first graph throughout", keys, "graph")


def _relay(scenario: Scenario) -> Iterator[Change]:
    follower = scenario.follower
    if isinstance(follower.law, str) and follower.feedforward != str(Feedforward.RELAY):
        yield Change("the leader's input relayed", ("follower.feedforward=relay",), "feedforward")


def _couplings(result: Result) -> Iterator[Change]:
    """Yield half and twice the gain of followers and leaders, where a key of theirs sets it."""
    drive = result.drive
    if not isinstance(drive, Laws):
        return
    for role, whose in (("follower", "followers'"), ("leader", "leader's")):
        law: Any = getattr(drive, role)
        for name, factor in (("half", 1.0 / _MORE), ("twice", _MORE)):
            keys = _stronger(law, role, factor, result.settings.dt)
            if keys is not None:
                yield Change(f"{name} the {whose} gain", (keys,), f"{role} gain", removes=False)


def _stronger(law: Any, role: str, factor: float, dt: float) -> str | None:
    gain = gain_of(law)
    if gain is None:
        strength = getattr(law, "strength", None)
        return strength and f"{role}.coupling={about(factor * float(strength(dt)), _DIGITS)}"
    if role == "follower":
        return f"follower.gain.coupling={about(factor * gain.coupling, _DIGITS)}"
    if gain.inner is not None:
        return None
    # A leader's gain has the coupling 1; it is proportional to the inverse of R.
    P, R = gain.P.tolist(), (gain.R / factor).tolist()
    return f"leader.gain={{method: given, P: {P}, R: {R}}}"


def _times(scenario: Scenario, result: Result) -> Iterator[Change]:
    simulation = scenario.simulation
    longer = (f"simulation.horizon={_MORE * simulation.horizon!r}",)
    yield Change("twice the horizon", longer, "time", removes=False)
    if isinstance(_path(result), Reference) and scenario.reference is not None:
        slower = f"reference.slowdown={_MORE * scenario.reference.slowdown!r}"
        # Over twice the horizon, so that all of the path is followed.
        words = "a path of half the speed"
        yield Change(words, (slower, *longer), "time", removes=False, beside="twice the horizon")


def _path(result: Result) -> object:
    drive = result.drive
    return reference_of(drive.leader) if isinstance(drive, Laws) else None
