"""What the stored states and inputs of the runs of a sweep have in common."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from echelon.core.errors import ScenarioError
from echelon.core.types import Array
from echelon.experiments.scenario.build import Experiment
from echelon.simulation.engine.chunk_grid import ChunkGrid
from echelon.simulation.engine.result import Result

StoredFrames: TypeAlias = Mapping[str, Array]
"""`states` (runs, T, N, n) and `inputs` (runs, T, N, m); NaN where a run has none."""
NAMES = ("states", "inputs")


class FrameShape(NamedTuple):
    """What the runs of a sweep that stores states have in common.

    Attributes:
        times: (T,) s.
        states, inputs: names.
        agents: their number N.
    """

    times: tuple[float, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    agents: int

    @classmethod
    def of(cls, experiment: Experiment, every: int) -> "FrameShape":
        """Return the shape of a run that stores every so-manieth step."""
        parts, settings = experiment
        grid = ChunkGrid(settings._replace(store_every=every), 1)
        steps = np.arange(settings.steps + 1)
        times = settings.dt * steps[grid.stored(steps)]
        model = parts.model
        return cls(tuple(times), model.state_names, model.input_names, parts.graph.agents)

    @property
    def numbers(self) -> int:
        """How many numbers are stored of each run."""
        return len(self.times) * self.agents * (len(self.states) + len(self.inputs))

    def check(self, other: "FrameShape", key: str) -> None:
        """Check that a value of a key leaves the shape as it is.

        Raises:
            ScenarioError: it does not.
        """
        if self != other:
            raise ScenarioError(
                f"--over {key}: its values change the agents, states or times of a run, and runs "
                "whose states are stored must have them in common; leave `--keep-states` out."
            )

    def stored(self, results: Sequence[Result | None]) -> StoredFrames:
        """Return the frames of some runs; None of those that could not be built."""
        sizes = (len(self.states), len(self.inputs))
        frames = {
            name: np.full((len(results), len(self.times), self.agents, size), np.nan)
            for name, size in zip(NAMES, sizes, strict=True)
        }
        for k, result in enumerate(results):
            if result is not None:
                for name, whole in frames.items():
                    whole[k, : len(result.times)] = getattr(result, name)
        return frames
