"""Find roots and speeds of the law for which the motors are certified to suffice."""

from collections.abc import Iterator
from typing import NamedTuple

from echelon.core.errors import EchelonError
from echelon.core.numerics import precision
from echelon.core.words import Feedforward
from echelon.guarantees.promises.promise import Promise, promise
from echelon.guarantees.stopping.motor_load import motors_suffice_for
from echelon.guarantees.stopping.stopping_run import stopping_run_of
from echelon.laws.stopping_point import StoppingLeader, StoppingPoint
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.step.settings import Settings

_RATES = (4.0, 3.0, 2.0)
"""Of the slowest root, 1/s; between them the best differs little."""
_SPEEDS, _LEAD = (1.4, 1.4, 0.7, 0.3), (0.7, 0.7, 0.7, 0.3)
"""Of a body in space, at a factor of 1: with the slowest roots these leave motors half
their range."""
_FACTORS = (1.0, 0.7, 0.5, 0.35, 0.25)


class MotorDesign(NamedTuple):
    """Roots and speeds that are certified with motors, as a scenario has them.

    Attributes:
        rate: of the slowest root, 1/s.
        speed, leader: of each output.
        promise: of the parts under them.
    """

    rate: float
    speed: tuple[float, ...]
    leader: tuple[float, ...]
    promise: Promise

    @property
    def time(self) -> float:
        """From when on followers are promised within 1 cm, s; infinite where that is not known."""
        arrival = (self.promise.anywhere() or {}).get("within_1_cm_from")
        return float("inf") if arrival is None else arrival

    @property
    def name(self) -> str:
        """The key under which JSON has it."""
        return "stopping_point"

    def sentence(self) -> str:
        """Return what to set, and what is promised then."""
        told = f"follower.rate={self.rate:g}", f"leader.rate={self.rate:g}"
        shown = *told, f"follower.speed={list(self.speed)}", f"leader.speed={list(self.leader)}"
        changes = " ".join(f'--set "{change}"' for change in shown)
        return f"Certified with motors: {changes}. {self.promise.sentence()}"

    def as_mapping(self) -> dict[str, object]:
        """Return it ready for JSON."""
        numbers = {"rate": self.rate, "speed": list(self.speed), "leader": list(self.leader)}
        return {**numbers, "promise": self.promise.as_mapping()}


def design_with_motors(parts: Parts, settings: Settings) -> MotorDesign | None:
    """Return the laws with which these starts are soonest within 1 cm, the motors certified.

    None where none of what is tried suffices for these starts.

    Raises:
        EchelonError: a part is malformed or does not fit the others.
    """
    links = int(parts.graph.depths().max()) if parts.drive.feedforward is Feedforward.PARENT else 1
    designs = [one for rate in _RATES for one in _certified(parts, settings, rate, links)]
    return min(designs, key=lambda one: one.time, default=None)


def _certified(parts: Parts, settings: Settings, rate: float, links: int) -> Iterator[MotorDesign]:
    """Yield the fastest speeds that are certified at a rate, if any are."""
    for factor in _FACTORS:
        speed = tuple(round(factor * s / links, 4) for s in _SPEEDS)
        leader = tuple(round(factor * s, 4) for s in _LEAD)
        tried = _under(parts, rate, speed, leader)
        try:
            prepared = prepare(tried, settings)
            with precision("float64"):
                run = stopping_run_of(prepared.parts, settings, prepared.problem.states)
                sufficient = motors_suffice_for(run)
        except EchelonError:
            # Roots of another number than the model's, say.
            return
        if sufficient and promise(tried, settings).promised:
            yield MotorDesign(rate, speed, leader, promise(tried, settings))
            return


def _under(parts: Parts, rate: float, speed: tuple[float, ...], leader: tuple[float, ...]) -> Parts:
    """Return parts under the law with other roots and speeds, and the coupling that suits them."""
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
