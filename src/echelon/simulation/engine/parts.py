"""The parts of a run: agents, graph, formation, what drives the agents, starts and world."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias, final

import numpy as np
from jaxtyping import Bool, Float

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.events import Event
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.hearing import heard_along
from echelon.agents.world.world import World
from echelon.core.errors import SimulationError, check_kind
from echelon.core.types import Array
from echelon.core.words import amount
from echelon.simulation.step.drive import Drive, Information
from echelon.simulation.step.leadership import Leadership

Initial: TypeAlias = Mapping[str, float] | Mapping[int, Sequence[float]] | np.ndarray | None
"""Spreads by state or group, or states (n,) by agent, or the states (N, n) of all."""


def read_states(
    values: object, shape: tuple[int, ...], what: str, meaning: str
) -> Float[Array, "..."]:
    """Return a copy of given states, after checking them; `what` and `meaning` are for messages.

    Raises:
        SimulationError: they have another shape, or are not finite.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise SimulationError(
            f"{what} no numbers, and must be finite with shape {shape} {meaning}."
        ) from None
    if array.shape != shape or not np.isfinite(array).all():
        raise SimulationError(
            f"{what} shape {array.shape}, and must be finite with shape {shape} {meaning}."
        )
    return array


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Parts:
    """The agents, their graph and formation, what drives them, how they start, and their world.

    Args:
        model: the agents, all alike.
        graph: who receives messages of whom, and who leads.
        formation: the goal offsets, (N, n).
        drive: what drives the agents, such as `Laws(leader, follower)`.
        initial: spread of the followers' starts about their goals, per state or group (uniform
            within +- the number); or states (n,) by agent, all others on their goals; or all states
            (N, n).
        start_error: what is added to the leaders' starts, per state or group.
        world: what the laws do not know: a plant that differs from the model, wind and noise.
        events: what happens during the run: agents that are lost or join, and links that are cut.
            The graph becomes one that switches; laws and gains know nothing of it.
        leadership: who takes the lead when nobody hears of the leader any more; None for nobody.

    Raises:
        GraphError: an event is not possible, or leaves somebody without a path to the leader.
        SimulationError: a part is not of the kind of its place, graph and formation have different
            numbers of agents, or starts are malformed.
        ModelError: a spread or an error names no state and no group of states.
    """

    model: ControlAffine
    graph: Graph
    formation: Formation
    drive: Drive
    initial: Initial = None
    start_error: Mapping[str, float] = dataclasses.field(default_factory=dict)
    world: World = dataclasses.field(default_factory=World)
    events: Sequence[Event] = ()
    leadership: Leadership | None = None

    def __post_init__(self) -> None:
        """Check that each part is of the kind of its place, and what can be checked of starts."""
        # The model is left out: `check_model` says more of what is wrong with one.
        kinds = {"graph": Graph, "formation": Formation, "drive": Drive, "world": World}
        for place, kind in kinds.items():
            check_kind(place, getattr(self, place), kind)
        if self.leadership is not None:
            check_kind("leadership", self.leadership, Leadership)
        if len(self.formation.offsets) != self.graph.agents:
            raise SimulationError(
                f"the formation is of {amount(len(self.formation.offsets), 'agent')}, and the graph"
                f" of {self.graph.agents}."
            )
        self._check_starts()
        object.__setattr__(self, "events", tuple(self.events))
        object.__setattr__(self, "graph", self.graph.with_events(self.events, self.heirs))

    def _check_starts(self) -> None:
        """Check the shape of given states, and the names and signs of spreads."""
        for named in (self.initial, self.start_error):
            for name in named if isinstance(named, Mapping) else ():
                if isinstance(name, str) and isinstance(self.model, ControlAffine):
                    self.model.states_called(name)
        if isinstance(self.initial, Mapping):
            for name, spread in self.initial.items():
                if isinstance(name, str) and not 0.0 <= spread < math.inf:  # type: ignore[operator]
                    raise SimulationError(
                        f"the initial spread of `{name}` is {spread}, and must be a number from 0 "
                        "on."
                    )
        elif self.initial is not None:
            read_states(
                self.initial,
                self.formation.offsets.shape,
                "initial states have",
                "(agents, states)",
            )

    @property
    def heirs(self) -> tuple[int, ...]:
        """Who takes the lead after the leader, in this order."""
        return () if self.leadership is None else tuple(self.leadership.heirs)

    @property
    def information(self) -> Information:
        """What leaders and followers receive from others, over the network that there is."""
        ideal = self.drive.information_for(self.model, self.graph)
        network = self.world.network
        return ideal if network is None else ideal._replace(follower=(network.information,))

    @property
    def leaderward(self) -> bool:
        """Whether agents use only messages of neighbours that are nearer to a leader."""
        # A drive without laws, such as plans, uses all neighbours.
        return getattr(getattr(self.drive, "follower", None), "leaderward", False)

    @property
    def receives(self) -> Bool[np.ndarray, "E 2"]:
        """Whether each end of each edge receives from the other."""
        reacts = self.drive.reacts or "neighbours' states" in self.information.leader
        return heard_along(self.graph, self.leaderward, reacts)

    def replace(self, **changes: object) -> "Parts":
        """Return a copy with some parts changed."""
        return dataclasses.replace(self, **changes)  # type: ignore[arg-type]
