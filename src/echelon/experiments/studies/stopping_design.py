"""Design of the law `stopping-point`: roots and speeds for which the motors provably suffice."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from echelon.core.errors import EchelonError
from echelon.core.numerics import precision
from echelon.core.words import Feedforward
from echelon.guarantees.promises.promise import Promise, promise
from echelon.guarantees.stopping.motor_load import motors_bear
from echelon.guarantees.stopping.stopping_run import stopping_of
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.settings import Settings

_RATES = (4.0, 3.0, 2.0)
"""Slowest roots that are tried, 1/s; the best one between them differs little."""
_SPEEDS, _LEAD = (1.4, 1.4, 0.7, 0.3), (0.7, 0.7, 0.7, 0.3)
"""Speeds of a body in space at a factor of 1; with the slowest roots motors use half the range."""
_FACTORS = (1.0, 0.7, 0.5, 0.35, 0.25)


class StoppingDesign(NamedTuple):
    """Roots and speeds with which motors provably suffice, as keys of a scenario.

    Attributes:
        rate: the slowest root, 1/s.
        speed, leader: the followers' and the leader's speed for each output.
        promise: of the parts with them.
    """

    rate: float
    speed: tuple[float, ...]
    leader: tuple[float, ...]
    promise: Promise

    @property
    def time(self) -> float:
        """The time (s) after which followers provably stay within 1 cm; infinite where unknown."""
        tube = self.promise.tube
        arrival = None if tube is None else tube.arrival
        return float("inf") if arrival is None else arrival.time

    def sentence(self) -> str:
        """Return the keys to set, and the guarantee with them."""
        keys = (
            *(f"follower.rate={self.rate:g}", f"leader.rate={self.rate:g}"),
            *(f"follower.speed={list(self.speed)}", f"leader.speed={list(self.leader)}"),
        )
        changes = " ".join(f'--set "{key}"' for key in keys)
        return f"Certified with motors: {changes}. {self.promise.sentence()}"

    def as_mapping(self) -> dict[str, Any]:
        """Return the design as JSON data."""
        numbers = {"rate": self.rate, "speed": list(self.speed), "leader": list(self.leader)}
        return {**numbers, "promise": self.promise.as_mapping()}


def design_stopping(parts: Parts, settings: Settings) -> StoppingDesign | None:
    """Return the fastest design for these starts for which the motors provably suffice.

    None where the followers have another law, or no design that is tried suffices.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    drive = parts.drive
    if not isinstance(drive, Laws) or not isinstance(drive.follower, StoppingPoint):
        return None
    by_parents = drive.follower.feedforward is Feedforward.PARENT
    links = int(parts.graph.depths().max()) if by_parents else 1
    designs = [design for rate in _RATES for design in _certified(parts, settings, rate, links)]
    return min(designs, key=lambda design: design.time, default=None)


def _certified(
    parts: Parts, settings: Settings, rate: float, links: int
) -> Iterator[StoppingDesign]:
    """Yield the design with the largest certified speeds at a rate, if there is one."""
    for factor in _FACTORS:
        speed = tuple(round(factor * s / links, 4) for s in _SPEEDS)
        leader = tuple(round(factor * s, 4) for s in _LEAD)
        candidate = _with_laws(parts, rate, speed, leader)
        try:
            prepared = prepare(candidate, settings)
            with precision("float64"):
                run = stopping_of(prepared.parts, settings, prepared.problem.states)
                suffices = run is not None and motors_bear(run)
        except EchelonError:
            # For example, a number of roots other than the model's.
            return
        if suffices and promise(candidate, settings).promised:
            yield StoppingDesign(rate, speed, leader, promise(candidate, settings))
            return


def _with_laws(
    parts: Parts, rate: float, speed: tuple[float, ...], leader: tuple[float, ...]
) -> Parts:
    """Return parts with other roots and speeds, and the default coupling for them."""
    law, lead = parts.drive.follower, parts.drive.leader  # pyright: ignore
    assert isinstance(law, StoppingPoint) and isinstance(lead, StoppingLeader)
    follower = StoppingPoint(
        rate=rate,
        speed=speed,
        observer=law.observer,
        feedforward=law.feedforward,
        hears=law.hears,
    )
    first = StoppingLeader(
        rate=rate, speed=leader, observer=lead.observer, reference=lead.reference
    )
    return parts.replace(drive=Laws(first, follower))
