"""The world of a run: plants, disturbances, actuators, sensors and network, unknown to the laws."""

import dataclasses
import numbers
from collections.abc import Callable, Mapping
from typing import Any, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.channel import Network
from echelon.agents.world.actuator import Actuator
from echelon.agents.world.disturbance import Disturbance
from echelon.agents.world.sensing import Sensing
from echelon.core.errors import ModelError, SimulationError, did_you_mean, listing


def vary_parameters(
    model: ControlAffine, parameters: Mapping[str, Any], scale: Mapping[str, float]
) -> ControlAffine:
    """Return a model with some parameters replaced and some multiplied by a factor.

    A factor on several numbers multiplies each.

    Raises:
        ModelError: the model has no such parameter, a factor has no number to scale, or the model
            rejects the values.
    """
    names = [field.name for field in dataclasses.fields(model) if field.init]
    name = type(model).__name__
    for parameter in (*parameters, *scale):
        if parameter not in names:
            has = f"it has {listing(names)}" if names else "it has none"
            raise ModelError(
                f"`{parameter}` is no parameter of `{name}`; {has}{did_you_mean(parameter, names)}."
            )
    changes = dict(parameters)
    if both := [parameter for parameter in scale if parameter in changes]:
        raise ModelError(f"`{both[0]}` of the plant has a value and a factor; give one of them.")
    for parameter, factor in scale.items():
        scaled = _scale_value(getattr(model, parameter), factor)
        if scaled is None:
            raise ModelError(
                f"`{parameter}` of `{name}` is {getattr(model, parameter)!r}, and only numbers can "
                "be scaled by a factor."
            )
        changes[parameter] = scaled
    try:
        # `replace` runs the checks of the model, so that an invalid plant is rejected.
        return dataclasses.replace(model, **changes)
    except (TypeError, ValueError) as error:
        message = (str(error).splitlines() or ["no message"])[0].rstrip(".")
        raise ModelError(f"`{name}` rejects these parameters: {message}.") from error


def _scale_value(value: Any, factor: float) -> Any:
    # True is a number to Python, but a switch cannot be scaled.
    if isinstance(value, bool | str):
        return None
    if isinstance(value, numbers.Real):
        return factor * float(value)
    if isinstance(value, np.ndarray):
        return factor * value
    if isinstance(value, tuple | list):
        scaled = tuple(_scale_value(entry, factor) for entry in value)
        return None if any(entry is None for entry in scaled) else scaled
    return None


def check_plant(model: ControlAffine, plant: ControlAffine) -> None:
    """Raise `ModelError` unless a plant has the states and inputs of the model."""
    for what in ("state_names", "input_names"):
        expected, got = getattr(model, what), getattr(plant, what)
        if expected != got:
            raise ModelError(
                f"`{what}` of the plant `{type(plant).__name__}` are {listing(got)}, and must be "
                f"those of the model `{type(model).__name__}`, {listing(expected)}."
            )


def differences(model: ControlAffine, plant: ControlAffine) -> str:
    """Return in words how a plant differs from the model."""
    name = f"`{type(plant).__name__}`"
    if type(plant) is not type(model):
        return f"{name} for `{type(model).__name__}`"
    changed = [
        f"`{field.name}` {_format_value(getattr(plant, field.name))} "
        f"for {_format_value(getattr(model, field.name))}"
        for field in dataclasses.fields(plant)
        if _as_lists(getattr(plant, field.name)) != _as_lists(getattr(model, field.name))
    ]
    return ", ".join(changed) or f"{name}, which equals the model"


def _as_lists(value: Any) -> Any:
    # Arrays compare entry by entry, lists as a whole.
    value = value.tolist() if isinstance(value, np.ndarray) else value
    return list(map(_as_lists, value)) if isinstance(value, tuple | list) else value


def _format_value(value: Any) -> str:
    value = _as_lists(value)
    if isinstance(value, list):
        return f"({', '.join(map(_format_value, value))})"
    return f"{value:.6g}" if isinstance(value, numbers.Real) else str(value)


LATE = "messages are late or lost"


@final
@dataclasses.dataclass(frozen=True)
class World:
    """How the simulated agents and network differ from the model that laws and gains use.

    Args:
        plant: the agents that move, with their actuators, where they differ from the model.
        disturbance: wind and noise on all agents.
        network: on which messages take time and are lost; left out, it is ideal.
        actuator: lag and levels of all agents' actuators; left out, inputs act at once.
        sensing: delay and noise of what agents measure of themselves; left out, it is exact.
        plants: of single agents, by number, where they differ from the others.
        members: a function that returns the loop of a run with other members of its components, a
            sensor or a medium of your own, for example (page on extending). Nothing is guaranteed
            of them.
    """

    plant: ControlAffine | None = None
    disturbance: Disturbance | None = None
    network: Network | None = None
    actuator: Actuator | None = None
    sensing: Sensing | None = None
    plants: Mapping[int, ControlAffine] = dataclasses.field(default_factory=dict)
    members: Callable[[Any], Any] | None = None

    @property
    def ideal(self) -> bool:
        """Whether the agents are as the model says, undisturbed, and the network is ideal."""
        return not any(self.differences.values())

    @property
    def differences(self) -> dict[str, bool]:
        """What no law knows and no promise covers, in words, and whether it is there."""
        return {
            "wind or noise acts on the agents": self.disturbance is not None,
            "the agents differ from the model": self.plant is not None or bool(self.plants),
            LATE: self.network is not None,
            "the actuators lag or have levels": self.actuator not in (None, Actuator()),
            "agents measure their states late or with noise": self.sensing not in (None, Sensing()),
            "the step has members of your own": self.members is not None,
        }

    @property
    def random(self) -> dict[str, bool]:
        """What is left out of the steps at rest, in words, and whether it is there."""
        levels = self.actuator is not None and self.actuator.levels > 0
        noisy = self.sensing is not None and any(self.sensing.noise.values())
        return {
            "wind or noise acts on the agents": self.disturbance is not None,
            "the actuators have levels": levels,
            "agents measure their states with noise": noisy,
        }

    def plant_for(self, model: ControlAffine) -> ControlAffine:
        """Return the plant, or the model if there is none."""
        return model if self.plant is None else self.plant

    def check(self, model: ControlAffine) -> tuple[str, ...]:
        """Check all parts, and return warnings.

        Raises:
            ModelError: the plant is malformed, or has other states or inputs than the model.
            SimulationError: a part is of another kind.
        """
        kinds = {
            "disturbance": Disturbance,
            "network": Network,
            "actuator": Actuator,
            "sensing": Sensing,
        }
        for name, kind in kinds.items():
            part = getattr(self, name)
            if part is not None and not isinstance(part, kind):
                raise SimulationError(
                    f"`{name}` is a `{type(part).__name__}`, and must be a `{kind.__name__}`."
                )
        if not (self.members is None or callable(self.members)):
            raise SimulationError(
                f"`members` is a `{type(self.members).__name__}`, and must be a function of a loop."
            )
        warnings = tuple[str, ...]()
        for plant in (self.plant, *self.plants.values()):
            if plant is not None:
                # First: a malformed plant may have no names to compare.
                warnings += check_model(plant)
                check_plant(model, plant)
        return warnings

    def check_agents(self, model: ControlAffine, agents: int) -> None:
        """Check the plants of single agents.

        Raises:
            SimulationError: there is no such agent, or a plant is of another class.
        """
        kind = type(self.plant_for(model))
        for k, plant in self.plants.items():
            if not 0 <= k < agents:
                raise SimulationError(
                    f"got a plant for agent {k}, and the agents are 0 to {agents - 1}."
                )
            if type(plant) is not kind:
                raise SimulationError(
                    f"the plant of agent {k} is a `{type(plant).__name__}`, and must be a "
                    f"`{kind.__name__}` as those of the others."
                )

    def describe(self, model: ControlAffine) -> dict[str, str | None]:
        """Return each part in words; None for each that is absent."""
        plants = [] if self.plant is None else [differences(model, self.plant)]
        plants += [f"agent {k}: {differences(model, x)}" for k, x in sorted(self.plants.items())]
        names = "disturbance", "network", "actuator", "sensing"
        parts = {name: getattr(self, name) for name in names}
        words = {name: None if part is None else str(part) for name, part in parts.items()}
        return {"plant": "; ".join(plants) or None, **words}
