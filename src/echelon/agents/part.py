"""What no law knows: a part of the world, or an event of a run, says all about itself."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

from echelon.agents.models.model import ControlAffine
from echelon.core.types import Array


class Effects(NamedTuple):
    """What a theorem may bound of parts of the world; as they are here, there is nothing to bound.

    Attributes:
        delay: of what agents know of their own states, s.
        lag: of the actuators, s.
        estimated: whether agents estimate their states.
        other_agents: whether agents move unlike the model.
        limits: what limits actuators beside the limits of the plant, a phrase.
        rounded: whether actuators round what they are commanded.
        age: of messages that arrive, s.
    """

    delay: float = 0.0
    lag: float = 0.0
    estimated: bool = False
    other_agents: bool = False
    limits: str = ""
    rounded: bool = False
    age: float = 0.0


class WorldPart:
    """A part of the world, such as wind, a sensor or a radio; laws and gains know nothing of it.

    All others ask a part about itself here. One that overrides `member` alone runs, and no theorem
    covers it. The local certificate is of the step that runs, with all its members.
    """

    key: str = ""
    """Its section of a scenario; empty for a class of yours."""
    needs_laws: bool = True
    """Whether it acts on what laws know or say, so that solvers in their place would ignore it."""

    def faults(self, model: ControlAffine, agents: int) -> Iterator[str]:
        """Yield a sentence for each thing that does not fit the model or the number of agents."""
        yield from ()

    def remarks(self, model: ControlAffine, horizon: float) -> Iterator[str]:
        """Yield a sentence for what is allowed and probably not meant; the horizon in s."""
        yield from ()

    def check_laws(self, laws: Any, graph: Any, dt: float) -> None:
        """Raise `EchelonError` unless laws on a graph work with it, at a step dt (s)."""

    def received(self, ideal: tuple[str, ...]) -> tuple[str, ...]:
        """Return what followers receive of others, in words, from what they would without it."""
        return ideal

    def member(self, loop: Any) -> Any:
        """Return a loop with what runs: other members of its components."""
        return loop

    def ignored(self) -> str:
        """Return what theorems of the ideal world leave out, a phrase; empty for nothing."""
        return f"`{type(self).__name__}` acts"

    def ignored_at_rest(self) -> str:
        """Return what the steps at rest leave out, a phrase, such as what is random."""
        return ""

    def presumed(self) -> str:
        """Return of what agents theorems are, where this makes them others; empty for none."""
        return "echelon's own laws and members of a step"

    def effects(self) -> Effects:
        """Return what theorems may bound of it."""
        return Effects()

    def off_trim(self, plant: ControlAffine, trim: Array) -> tuple[str, str]:
        """Return why the actuators of a plant do not deliver a trim input (m,), and a remedy."""
        return "", ""

    def unflown(self) -> str:
        """Return why `echelon fly` refuses it, and what to do; empty where agents fly with it."""
        return "" if self.key else f"`{type(self).__name__}` is not in a flight; leave it out"

    def simulated(self, plant: ControlAffine, dt: float) -> dict[str, Any]:
        """Return what simulated vehicles have of it in steps dt (s): `constant`, `rms`, `noise`.

        These are lists by state; `fade` is what a step leaves of a gust.
        """
        return {}

    def words(self, model: ControlAffine) -> str:
        """Return it in words, for data."""
        return str(self)

    def sentences(self, result: Any) -> str:
        """Return what a report says of it, in sentences."""
        return f"{(self.key or 'a part of your own').capitalize()}: {self.words(result.model)}."

    def variables(self, result: Any) -> Mapping[str, Any]:
        """Return what it adds to the labelled data of a run, by name, as xarray takes it."""
        return {}

    def __str__(self) -> str:
        own = {k: v for k, v in vars(self).items() if not k.startswith("_")}
        listed = ", ".join(f"{name} {value}" for name, value in own.items())
        return f"`{type(self).__name__}`" + f" ({listed})" * bool(listed)


class Event:
    """What happens to a formation at a time; all others ask an event about itself here.

    One of your own is a frozen dataclass with the field `at`, s. From then to its `end` edges have
    the weights of `carried`.
    """

    at: float
    comes: ClassVar[bool | None] = None
    """Whether its agent is there from then on, or is not; None where nobody comes or goes."""

    @property
    def agents(self) -> tuple[int, ...]:
        """The agents that it is about."""
        return ()

    @property
    def end(self) -> float:
        """When it ends, s."""
        return math.inf

    def faults(self, graph: Any) -> Iterator[str]:
        """Yield what does not fit the graph, which has no events yet."""
        yield from ()

    def carried(self, graph: Any, weights: Array) -> Array:
        """Return the weights (E,) of edges while it lasts, from those without it."""
        return weights

    def uncovered(self, graph: Any) -> str:
        """Return why no guarantee covers it; empty if one may, as of a graph that switches."""
        return f"{self} at {self.at:g} s, and no theorem is about that"

    def __str__(self) -> str:
        return f"`{type(self).__name__}` happens"
