"""What a run leaves behind: everything that metrics, figures and files read, in float64 NumPy."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from echelon.core.errors import Outcome
from echelon.core.types import Array
from echelon.laws.law import Law
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.world.disturbance import Disturbance
from echelon.world.plant import differences


class Settings(NamedTuple):
    """How a run was computed: horizon and dt in s; see `simulate` for the rest."""

    horizon: float
    dt: float
    integrator: str
    limits: bool
    store_every: int
    precision: str
    seed: int


@dataclasses.dataclass(frozen=True)
class Result:
    """A run: T stored frames of N agents with n states and m inputs.

    Attributes:
        times: (T,) s.
        states: (T, N, n).
        inputs: (T, N, m), physical, as delivered by the actuators from each frame on.
        reference: (T, n), the leader's reference state, or None where it follows nothing.
        saturated: (N,) the fraction of steps in which an actuator limit changed the agent's input.
        outcome: how the run ended; `message` says it with time and agent.
        warnings: what is allowed but probably not meant, one sentence each.
        model, graph, formation, leader, follower, settings: the parts that ran.
        plant: the agents as they were, or None where that is `model`.
        disturbance: the wind and noise that acted, or None.
        wall_time: seconds of computing, compilation included.
        provenance: scenario text, versions and the like, as text.
    """

    times: Array
    states: Array
    inputs: Array
    reference: Array | None
    saturated: Array
    outcome: Outcome
    message: str
    warnings: tuple[str, ...]
    model: ControlAffine
    graph: Graph
    formation: Formation
    leader: Law
    follower: Law
    settings: Settings
    wall_time: float
    plant: ControlAffine | None = None
    disturbance: Disturbance | None = None
    provenance: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def errors(self) -> Array:
        """Deviation of each agent from its goal relative to its leader, (T, N, n).

        The leaders' rows are zero.
        """
        y = self.states - self.formation.offsets
        return y - y[:, list(self.graph.nearest_leader())]

    @property
    def moved(self) -> ControlAffine:
        """What moved: the plant, or the model where no other was given."""
        return self.model if self.plant is None else self.plant

    @property
    def measured(self) -> tuple[int, ...]:
        """Indices of the states that errors are measured on: the position if any, else all."""
        return self.model.position_indices() or tuple(range(len(self.model.state_names)))

    @property
    def unit(self) -> str:
        """The unit of errors: m for a position, `state` for abstract states."""
        return "m" if self.model.position else "state"

    def with_provenance(self, **texts: str) -> "Result":
        """Return the same run with more provenance."""
        return dataclasses.replace(self, provenance={**self.provenance, **texts})


def finite_or_none(value: Any) -> float | None:
    """Return a number as a float, or None where it does not exist or is not finite."""
    return float(value) if value is not None and np.isfinite(value) else None


def imperfections(result: Result) -> dict[str, str | None]:
    """Return in words how the plant differs from the model, and what disturbed it; else None."""
    plant, disturbance = result.plant, result.disturbance
    return {
        "plant": None if plant is None else differences(result.model, plant),
        "disturbance": None if disturbance is None else str(disturbance),
    }
