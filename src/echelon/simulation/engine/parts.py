"""The parts of a run: agents, graph, formation, what drives the agents, starts and world.

And the states that follow from them at time zero: leaders are on their reference, followers about
their goals.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.unlike import UnlikeAgents, settled
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.hearing import heard_along
from echelon.agents.part import Event
from echelon.agents.world.world import World
from echelon.core.errors import SimulationError, check_kind
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.core.words import amount
from echelon.simulation.step.drive import Controller, Information
from echelon.simulation.step.leadership import Leadership

Initial: TypeAlias = Mapping[str, float] | Mapping[int, Sequence[float]] | np.ndarray | None
"""Spreads by state or group, or states (n,) by agent, or the states (N, n) of all."""


def read_states(
    values: object, shape: tuple[int, ...], what: str, meaning: str
) -> Float[Array, "..."]:
    """Return a checked copy of states, else `SimulationError` with `what` and `meaning`."""
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
    drive: Controller
    initial: Initial = None
    start_error: Mapping[str, float] = dataclasses.field(default_factory=dict)
    world: World = dataclasses.field(default_factory=World)
    events: Sequence[Event] = ()
    leadership: Leadership | None = None

    def __post_init__(self) -> None:
        # The model is left out: `check_model` says more of what is wrong with one.
        kinds = {"graph": Graph, "formation": Formation, "drive": Controller, "world": World}
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
        object.__setattr__(self, "formation", self._with_kinds())
        object.__setattr__(self, "graph", self.graph.with_events(self.events, self.backups))

    def _with_kinds(self) -> Formation:
        """Return the formation with the groups of unlike agents."""
        places = self.formation
        if not isinstance(self.model, UnlikeAgents):
            return places
        if places.motion is not None:
            raise SimulationError(
                "a formation that moves is of agents of one model, and these are unlike."
            )
        return Formation(self.model.with_kinds(places.offsets), remarks=places.remarks)

    def _check_starts(self) -> None:
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
    def backups(self) -> tuple[int, ...]:
        """Who takes the lead after the leader, in this order."""
        return () if self.leadership is None else tuple(self.leadership.backups)

    @property
    def information(self) -> Information:
        """What leaders and followers receive from others, in the world that there is."""
        known = self.drive.information_for(self.model, self.graph)
        for part in self.world.all_parts:
            known = known._replace(follower=part.received(known.follower))
        return known

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


def initial_states(parts: Parts, seed: int) -> Float[Array, "N n"]:
    """Return the states (N, n) at time zero.

    A leader starts where its drive says, or in its given state, plus its offset and `start_error`.
    A follower starts at its goal relative to the leader, plus a uniform random deviation within +-
    the spread of each state. The same seed draws the same deviations whatever the spreads are.

    Raises:
        SimulationError: the state given for an agent has a wrong shape or is not finite, or there
            is no such agent; a start error is not finite.
    """
    return Starts(parts)(seed)


@final
class Starts:
    """The states at time zero, for any seed.

    Args:
        parts: of the run.

    Raises:
        EchelonError: as in `initial_states`.
    """

    def __init__(self, parts: Parts) -> None:
        model, graph, initial = parts.model, parts.graph, parts.initial
        self.model, self.graph = model, graph
        self.shape = graph.agents, len(model.state_names)
        self.error = _per_state(model, parts.start_error, "start error")
        self.states: np.ndarray | None = None
        self.named: dict[int, ArrayLike] = {}
        if initial is not None and not isinstance(initial, Mapping):
            what = "initial states have", "(agents, states)"
            self.states = read_states(initial, self.shape, *what)
            # The caller's states are where leaders belong; the error is added to them.
            self.states[list(graph.leaders)] += self.error
            return
        named = dict(initial or {})
        spreads = {k: value for k, value in named.items() if isinstance(k, str)}
        self.spread = _per_state(model, spreads, "initial spread")
        self.named = {k: value for k, value in named.items() if not isinstance(k, str)}
        with precision("float64"):  # in float32 goals are .1 um off
            leaders = parts.drive.start(model) + self.error
            self.goals = np.asarray(leaders) + parts.formation.offsets_at([0.0])[0]
        if isinstance(model, UnlikeAgents):
            model.check_goals(self.goals)

    def __call__(self, seed: int) -> Float[Array, "N n"]:
        """Return the states (N, n) for a seed."""
        return self.of([seed])[0]

    def of(self, seeds: Sequence[int]) -> Float[Array, "K N n"]:
        """Return the states (K, N, n) for some seeds."""
        if self.states is not None:
            return np.repeat(settled(self.model, self.states)[None], len(seeds), axis=0)
        leaders = list(self.graph.leaders)
        # Drawn for all agents and scaled afterwards, so that another spread keeps the directions,
        # and another choice of leaders the followers' draws.
        draws = [np.random.default_rng(seed).uniform(-1.0, 1.0, self.shape) for seed in seeds]
        deviations = self.spread * np.reshape(draws, (len(seeds), *self.shape))
        deviations[:, leaders] = 0.0
        states = self.goals + deviations
        _place(states, self.named, self.graph)
        states[:, [agent for agent in leaders if agent in self.named]] += self.error
        return settled(self.model, states)


def _place(states: Float[Array, "K N n"], named: Mapping[int, ArrayLike], graph: Graph) -> None:
    for agent, state in named.items():
        _check_agent(agent, graph)
        states[:, agent] = read_states(
            state, states.shape[2:], f"the initial state of agent {agent} has", "(states,)"
        )


def _check_agent(agent: int, graph: Graph) -> None:
    if not 0 <= agent < graph.agents:
        raise SimulationError(
            f"an initial state is given for agent {agent}, "
            f"and agents are numbered from 0 to {graph.agents - 1}."
        )


def _per_state(model: ControlAffine, named: Mapping[str, Any], what: str) -> Float[Array, " n"]:
    for name, value in named.items():
        if not np.isfinite(value):
            raise SimulationError(f"the {what} of `{name}` is {value}, and must be finite.")
    return model.per_state(named)
