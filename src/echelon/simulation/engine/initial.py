"""Where the agents start: leaders on their reference, followers about their goals."""

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.core.errors import SimulationError
from echelon.core.types import Array
from echelon.simulation.engine.parts import Parts, read_states


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
        """Compute what does not depend on the seed."""
        model, graph, initial = parts.model, parts.graph, parts.initial
        self.graph, self.shape = graph, (graph.agents, len(model.state_names))
        self.error = _per_state(model, parts.start_error, "start error")
        self.states: np.ndarray | None = None
        self.named: dict[int, ArrayLike] = {}
        if initial is not None and not isinstance(initial, Mapping):
            self.states = read_states(
                initial, self.shape, "initial states have", "(agents, states)"
            )
            # The caller's states are where leaders belong; the error is added to them.
            self.states[list(graph.leaders)] += self.error
            return
        named = dict(initial or {})
        spreads = {key: value for key, value in named.items() if isinstance(key, str)}
        self.spread = _per_state(model, spreads, "initial spread")
        self.named = {key: value for key, value in named.items() if not isinstance(key, str)}
        leaders = np.asarray(parts.drive.start(model), np.float64) + self.error
        self.goals = leaders + parts.formation.offsets_at([0.0])[0]

    def __call__(self, seed: int) -> Float[Array, "N n"]:
        """Return the states (N, n) for a seed."""
        return self.of([seed])[0]

    def of(self, seeds: Sequence[int]) -> Float[Array, "K N n"]:
        """Return the states (K, N, n) for some seeds."""
        if self.states is not None:
            return np.repeat(self.states[None], len(seeds), axis=0)
        leaders = list(self.graph.leaders)
        # Drawn for all agents and scaled afterwards, so that another spread keeps the directions,
        # and another choice of leaders the followers' draws.
        draws = [np.random.default_rng(seed).uniform(-1.0, 1.0, self.shape) for seed in seeds]
        deviations = self.spread * np.reshape(draws, (len(seeds), *self.shape))
        deviations[:, leaders] = 0.0
        states = self.goals + deviations
        _place(states, self.named, self.graph)
        states[:, [agent for agent in leaders if agent in self.named]] += self.error
        return states


def _place(states: Float[Array, "K N n"], named: Mapping[int, ArrayLike], graph: Graph) -> None:
    """Put agents into the states that are given for them, in all starts (K, N, n)."""
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
    """Return one finite number for each state, (n,), from numbers by state or group."""
    for name, value in named.items():
        if not np.isfinite(value):
            raise SimulationError(f"the {what} of `{name}` is {value}, and must be finite.")
    return model.per_state(named)
