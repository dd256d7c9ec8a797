"""The errors of a run over the paper's 10 s, like those of its Table II.

The paper's followers have errors of distances between agents. Ours elsewhere are of the vector from
each follower to its goal, which is the stricter measure.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from echelon.core.types import Array, JsonObject
from echelon.simulation.engine.result import Result

HORIZON = 10.0
"""The paper's, s."""
SAMPLES = 100
"""Of the paper's run, the start included."""
PRINTED: Mapping[str, tuple[float, ...]] = {
    "consensus": (0.186, 9.289e-17, 7.692e-17, 5.207e-17),
    "optimization": (0.186, 0.0302, 7.692e-17, 0.018),
}
"""RMSE in m of leader and followers 1, 2, 3, per method, over 10 s."""


def is_papers_experiment(scenario: str, model: str, agents: int) -> bool:
    """Return whether a scenario is comparable: `paper` or a variant, with 4 quadrotors."""
    return (
        model in ("Quadrotor", "PrintedQuadrotor")
        and agents == 4
        and (scenario == "paper" or scenario.startswith("paper-"))
    )


def is_of_the_paper(result: Result) -> bool:
    """Return whether a run is comparable with the paper's."""
    scenario, model = result.provenance.get("scenario", ""), type(result.model).__name__
    return is_papers_experiment(scenario, model, result.graph.agents)


class TableTwo(NamedTuple):
    """Root-mean-square errors over the first 10 s of a run, m.

    Attributes:
        leader: of its place on the reference; None without a reference.
        distances: of each follower's distance to the agent in `measured`, as in the paper.
        vectors: of the vector from each follower to its goal relative to its leader.
        measured: to which agent each follower's distance is, its first neighbour outward.
        frames: how many stored frames the errors are taken over.
        every: whether these are all steps of the 10 s; otherwise frames stored further apart.
        sampled: the leader's error at the paper's 100 samples, which include the start.
    """

    leader: float | None
    distances: tuple[float, ...]
    vectors: tuple[float, ...]
    measured: tuple[int, ...]
    frames: int
    every: bool
    sampled: float | None

    @property
    def basis(self) -> str:
        """What the errors are taken over, in words."""
        return f"all {self.frames} steps" if self.every else f"{self.frames} stored frames"

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""
        return {
            "leader_rmse": self.leader,
            "distance_rmse": list(self.distances),
            "vector_rmse": list(self.vectors),
            "distance_to": list(self.measured),
            "frames": self.frames,
            "every_step": self.every,
        }


def missing(result: Result) -> str:
    """Return why a run has no errors over the paper's 10 s; empty if it has them."""
    if result.presence is not None:
        return "agents join or leave"
    end = float(result.times[-1]) if len(result.times) else 0.0
    short = end < HORIZON - 0.5 * result.settings.dt
    return f"the run ends at {end:.4g} s" if short else ""


def table_two(result: Result) -> TableTwo | None:
    """Return the errors of a run over the paper's 10 s, of stored frames; None if `missing`.

    As in the sums of a run, an error is measured at the beginning of each step.
    """
    if missing(result):
        return None
    early, leader = _early(result), leader_errors(result)
    errors, steps = distance_errors(result), round(HORIZON / result.settings.dt)
    away = result.formation_errors[early][:, list(result.graph.followers)]
    samples = np.linspace(0.0, HORIZON, SAMPLES)
    nearest = np.abs(result.times[:, None] - samples).argmin(axis=0)
    return TableTwo(
        leader=None if leader is None else _rms(leader[early]),
        distances=tuple(_rms(column) for column in errors[early].T),
        vectors=tuple(_rms(column) for column in away.T),
        measured=tuple(measured_to(result).values()),
        frames=int(early.sum()),
        every=int(early.sum()) == steps,
        sampled=None if leader is None else _rms(leader[nearest]),
    )


def leader_errors(result: Result) -> Float[np.ndarray, " T"] | None:
    """Return the first leader's distance from its reference; None without one."""
    if result.reference is None:
        return None
    first = result.graph.leaders[0]
    off = result.states[:, first] - result.offsets_in()[..., first, :] - result.reference
    return np.linalg.norm(off[:, list(result.measured)], axis=1)


def measured_to(result: Result) -> dict[int, int]:
    """Return the agent from which each follower keeps its distance: the first one before it."""
    outward = dict(result.graph.outward())
    return {follower: outward[follower][0] for follower in result.graph.followers}


def distance_errors(result: Result) -> Float[np.ndarray, "T F"]:
    """Return each follower's distance to its agent in `measured_to` less the desired one."""
    pairs = np.array(list(measured_to(result).items()))
    space = list(result.measured)
    one, other = (result.states[:, column][..., space] for column in pairs.T)
    goals = result.offsets_in()[..., space]
    desired = np.linalg.norm(goals[..., pairs[:, 0], :] - goals[..., pairs[:, 1], :], axis=-1)
    return np.linalg.norm(one - other, axis=2) - desired


def _early(result: Result) -> Bool[np.ndarray, " T"]:
    return result.times < HORIZON - 0.5 * result.settings.dt


def _rms(values: Array) -> float:
    # Of a law that diverges the squares may be beyond floats.
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.mean(values * values)))
