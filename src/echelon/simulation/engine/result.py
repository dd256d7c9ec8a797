"""The result of a run: everything that metrics, figures and files read, in float64 NumPy."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, Generic, NamedTuple, TypeVar, final

import numpy as np
from jaxtyping import Float, Int

from echelon.agents.models.model import ControlAffine
from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.switching import Schedule
from echelon.agents.world.world import World
from echelon.core.errors import Outcome
from echelon.core.files import CellPage, notebook_page
from echelon.core.types import Array
from echelon.core.words import amount
from echelon.simulation.engine.frame_numbers import ClosestPair, FrameChoice, FrameNumbers
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.traffic import Traffic, traffic
from echelon.simulation.step.drive import Controller
from echelon.simulation.step.meter import Sums
from echelon.simulation.step.settings import Settings
from echelon.simulation.step.solver_stats import SolverStats

_T = TypeVar("_T")


class Later(NamedTuple, Generic[_T]):
    """A field that `compute` returns when it is first read."""

    compute: Callable[[], _T]


class _Lazy(Generic[_T]):
    """A field of a dataclass, without a default, that takes its value or a `Later`."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: object | None, owner: type) -> _T:
        if instance is None:
            # A dataclass takes what its class holds under the name of a field for its default.
            raise AttributeError(f"`{self.name}` is a field of the instances.")
        value: Any = vars(instance)[self.name]
        if isinstance(value, Later):
            value = vars(instance)[self.name] = value.compute()
        return value

    def __set__(self, instance: object, value: "_T | Later[_T]") -> None:
        vars(instance)[self.name] = value


@final
@dataclasses.dataclass(frozen=True, eq=False)
class Result(FrameNumbers):
    """A run: T stored frames of N agents with n states and m inputs.

    Attributes:
        times: (T,) s.
        states: (T, N, n).
        inputs: (T, N, m), physical, as delivered by the actuators from each frame on.
        reference: (T, n), the leader's reference state, or None where it follows nothing.
        outcome: how the run ended; `message` says it with time and agent.
        warnings: what is allowed but probably not meant, one sentence each.
        settings: how it was computed.
        wall_time: seconds of computing, compilation included; NaN where it is not stored.
        sums: over all steps, of which means are computed.
        parts: what ran, with its drive completed. Of a run from disk they are built when they are
            first read, which executes the classes that its scenario names.
        work: of the solvers; None where laws gave the inputs.
        engine: what computed the steps, `jax` or `native`.
        provenance: scenario text, versions and the like, as text.
        files: the files that the scenario text names, by the names that it gives them.

    Raises:
        OutputError: when `parts` of a run from disk are first read, its scenario is missing or was
            changed; when `sums` are, the file was written from a dataset, without them.
        ScenarioError: when `parts` are first read, its scenario cannot be built.
    """

    times: Array
    states: Array
    inputs: Array
    reference: Array | None
    outcome: Outcome
    message: str
    warnings: tuple[str, ...]
    settings: Settings
    wall_time: float
    sums: _Lazy[Sums] = _Lazy()
    parts: _Lazy[Parts] = _Lazy()
    work: SolverStats | None = None
    engine: str = "jax"
    provenance: Mapping[str, str] = dataclasses.field(default_factory=dict)
    files: Mapping[str, bytes] = dataclasses.field(default_factory=dict)

    @property
    def model(self) -> ControlAffine:
        """What the laws know of an agent."""
        return self.parts.model

    @property
    def graph(self) -> Graph:
        """The graph: who receives messages of whom, and who leads."""
        return self.parts.graph

    @property
    def formation(self) -> Formation:
        """The goal offsets."""
        return self.parts.formation

    @property
    def drive(self) -> Controller:
        """What drove the agents."""
        return self.parts.drive

    @property
    def world(self) -> World:
        """What the laws did not know: plant, disturbance and network."""
        return self.parts.world

    @property
    def saturated(self) -> Array:
        """The fraction of steps (N,) in which an actuator limit changed the agent's input."""
        return self.sums.limited / np.maximum(1.0, self.steps_present[0])

    def steps_with(self, agents: Int[np.ndarray, "K k"]) -> Float[np.ndarray, "2 K"]:
        """Return in how many steps, and of these in the steady window, all agents of a row are."""
        steps, schedule = self.sums.steps, self.graph.schedule
        if schedule is None or schedule.present is None:
            return np.tile(np.asarray(steps, float)[:, None], len(agents))
        times = self.settings.dt * np.arange(int(steps[0]))
        here = np.asarray(schedule.present[schedule.rows(times)][:, agents].all(axis=2))
        first = self.settings.first_steady
        return np.array([here.sum(axis=0), here[first:].sum(axis=0)], float)

    @functools.cached_property
    def steps_present(self) -> Float[np.ndarray, "2 N"]:
        """In how many steps, and of these in the steady window, each agent is there."""
        return self.steps_with(np.arange(self.graph.agents)[:, None])

    @property
    def schedule(self) -> Schedule | None:
        """When which links hold, and who is there; None where that never changes."""
        return self.graph.schedule

    @property
    def chatter(self) -> Array:
        """How many times (N,) an input jumped from one limit to the opposite one in a step."""
        return self.sums.chatter

    @property
    def closest(self) -> ClosestPair | None:
        """Which agents were closest to each other, over all steps or, of many, in the frames."""
        pair, sums = self.closest_pair(), self.sums
        if pair is None or self.settings.store_every == 1:
            return pair
        if not len(sums.closest):
            return pair._replace(frames=len(self.times))
        # The last state begins no step, and is a frame.
        if pair.distance <= sums.closest[0] * (1.0 + 1e-9):
            return pair
        step, one, other = (int(number) for number in sums.met[0])
        return ClosestPair(float(sums.closest[0]), (one, other), step * self.settings.dt)

    @functools.cached_property
    def traffic(self) -> Traffic | None:
        """What became of the messages; None in the ideal network."""
        steps = int(self.sums.steps[0])
        return traffic(self.parts, self.settings, self.times, steps)

    @property
    def offsets(self) -> Array:
        """The goal offsets, (N, n); of a formation that changes with time, the first ones."""
        return self.formation.offsets

    def offsets_in(self, frames: FrameChoice = slice(None)) -> Float[Array, "*F N n"]:
        """Return the goal offsets in some frames, (F, N, n), or constant ones, (N, n)."""
        if self.formation.motion is None:
            return self.offsets
        return self.formation.offsets_at(self.times[frames])

    @property
    def nearest(self) -> Array:
        """The leader nearest to each agent, (N,)."""
        return np.array(self.graph.nearest_leader())

    @property
    def position(self) -> tuple[int, ...]:
        """Indices of the states that are the position; none of an abstract agent."""
        return self.model.position_indices()

    @property
    def state_units(self) -> tuple[str, ...]:
        """The unit of each state."""
        return tuple(self.model.state_units)

    @property
    def radius(self) -> float | None:
        """The radius of an agent, m; None without a position or a size."""
        return self.model.radius if self.position else None

    @property
    def unit(self) -> str:
        """The unit of errors: m for a position, `state` for abstract states."""
        return self.length_unit or "state"

    def __repr__(self) -> str:
        # Neither arrays, which would fill the screen, nor parts, which may still have to be built.
        frames, agents = self.states.shape[:2]
        name = self.provenance.get("scenario", "")
        who = f"{name!r}, {agents} agents" if name else f"{agents} agents"
        return f"Result({who}, {amount(frames, 'frame')}, {self.message!r})"

    def _repr_html_(self) -> str:
        return notebook_page("result", self)

    def view(self, height: int = 560) -> CellPage:
        """Return the replay of the run, which a notebook shows in a cell.

        It states no guarantee, which takes seconds to compute; `echelon view` does.

        Args:
            height: pixels.

        Raises:
            OutputError: no frame is stored, or the run is too large for a page.
            MissingExtraError: the page's three.js is not built.
        """
        return CellPage(notebook_page("replay", self), height)
