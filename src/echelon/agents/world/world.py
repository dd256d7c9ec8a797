"""The world of a run: plant, disturbance and network, of which the laws know nothing."""

import dataclasses
from typing import final

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.channel import Network
from echelon.agents.world.disturbance import Disturbance
from echelon.agents.world.plant import check_plant, differences
from echelon.core.errors import SimulationError


@final
@dataclasses.dataclass(frozen=True)
class World:
    """How the simulated agents and network differ from the model that laws and gains use.

    Args:
        plant: the agents that move, with their actuators, where they differ from the model.
        disturbance: wind and noise on all agents.
        network: on which messages take time and are lost; left out, it is ideal.
    """

    plant: ControlAffine | None = None
    disturbance: Disturbance | None = None
    network: Network | None = None

    @property
    def ideal(self) -> bool:
        """Whether the agents are as the model says, undisturbed, and the network is ideal."""
        return self.plant is None and self.disturbance is None and self.network is None

    def plant_for(self, model: ControlAffine) -> ControlAffine:
        """Return the plant, or the model if there is none."""
        return model if self.plant is None else self.plant

    def check(self, model: ControlAffine) -> tuple[str, ...]:
        """Check plant and disturbance, and return warnings.

        Raises:
            ModelError: the plant is malformed, or has other states or inputs than the model.
            SimulationError: the disturbance is not a `Disturbance`.
        """
        if self.disturbance is not None and not isinstance(self.disturbance, Disturbance):
            raise SimulationError(
                f"`disturbance` is a `{type(self.disturbance).__name__}`, and must be a "
                "`Disturbance`."
            )
        if self.network is not None and not isinstance(self.network, Network):
            raise SimulationError(
                f"`network` is a `{type(self.network).__name__}`, and must be a `Network`."
            )
        if self.plant is None:
            return ()
        # First: a malformed plant may have no names to compare.
        warnings = check_model(self.plant)
        check_plant(model, self.plant)
        return warnings

    def describe(self, model: ControlAffine) -> dict[str, str | None]:
        """Return plant, disturbance and network in words; None for each that is absent."""
        return {
            "plant": None if self.plant is None else differences(model, self.plant),
            "disturbance": None if self.disturbance is None else str(self.disturbance),
            "network": None if self.network is None else str(self.network),
        }
