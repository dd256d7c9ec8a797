"""The world of a run: plants, disturbances, actuators, sensors and network, unknown to the laws."""

import dataclasses
import numbers
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.channel import Network
from echelon.agents.part import Effects, WorldPart
from echelon.agents.world.actuator import Actuator
from echelon.agents.world.disturbance import Disturbance
from echelon.agents.world.sensing import Sensing
from echelon.core.errors import ModelError, SimulationError, check_kind, did_you_mean, listing


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


@final
@dataclasses.dataclass(frozen=True)
class Plants(WorldPart):
    """Agents that move unlike the model: the plant of all, and those of single agents."""

    key, needs_laws = "plant", False

    plant: ControlAffine | None
    plants: Mapping[int, ControlAffine]

    def ignored(self) -> str:
        """Return that agents are others."""
        return "the agents differ from the model"

    def presumed(self) -> str:
        """Return of what agents theorems are."""
        return "agents that move as the model says"

    def effects(self) -> Effects:
        """Return that agents are others."""
        return Effects(other_agents=True)

    def faults(self, model: ControlAffine, agents: int) -> Iterator[str]:
        """Yield that there is no such agent, or that its plant is of another class."""
        kind = type(model if self.plant is None else self.plant)
        for k, plant in self.plants.items():
            if not 0 <= k < agents:
                yield f"got a plant for agent {k}, and the agents are 0 to {agents - 1}."
            elif type(plant) is not kind:
                yield (
                    f"the plant of agent {k} is a `{type(plant).__name__}`, and must be a "
                    f"`{kind.__name__}` as those of the others."
                )

    def words(self, model: ControlAffine) -> str:
        """Return in words how they differ from the model."""
        plants = [] if self.plant is None else [differences(model, self.plant)]
        plants += [f"agent {k}: {differences(model, x)}" for k, x in sorted(self.plants.items())]
        return "; ".join(plants)

    def sentences(self, result: Any) -> str:
        """Return what a report says of them."""
        return f"Plant: {self.words(result.model)}; laws and gains use the model's values."


KEYS = "plant", "disturbance", "network", "actuator", "sensing"
"""The sections of a scenario that are parts of a world."""


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
        parts: of your own, such as a sensor or a medium (page on extending).
    """

    plant: ControlAffine | None = None
    disturbance: Disturbance | None = None
    network: Network | None = None
    actuator: Actuator | None = None
    sensing: Sensing | None = None
    plants: Mapping[int, ControlAffine] = dataclasses.field(default_factory=dict)
    parts: Sequence[WorldPart] = ()

    @property
    def all_parts(self) -> tuple[WorldPart, ...]:
        """The parts that are there; yours come last."""
        unlike = self.plant is not None or bool(self.plants)
        plants = Plants(self.plant, self.plants) if unlike else None
        known = self.disturbance, plants, self.network, self.actuator, self.sensing
        return (*(part for part in known if part is not None), *self.parts)

    @property
    def ideal(self) -> bool:
        """Whether the agents are as the model says, undisturbed, and the network is ideal."""
        return not (self.ignored or self.parts)

    @property
    def ignored(self) -> tuple[str, ...]:
        """What theorems of the ideal world leave out, a phrase each."""
        return tuple(filter(None, (part.ignored() for part in self.all_parts)))

    @property
    def ignored_at_rest(self) -> tuple[str, ...]:
        """What the steps at rest leave out, a phrase each."""
        return tuple(filter(None, (part.ignored_at_rest() for part in self.all_parts)))

    @property
    def presumed(self) -> str:
        """Of what agents theorems are, where these are others; empty where they are not."""
        asked = *self.parts, *self.all_parts
        return next(filter(None, (part.presumed() for part in asked)), "")

    @property
    def effects(self) -> Effects:
        """What theorems may bound of all parts."""
        columns = zip(Effects(), *(part.effects() for part in self.all_parts), strict=True)
        joined: Any = [sum(x) if isinstance(x[0], float) else max(x) for x in columns]
        return Effects(*joined)

    def plant_for(self, model: ControlAffine) -> ControlAffine:
        """Return the plant, or the model if there is none."""
        return model if self.plant is None else self.plant

    def check(self, model: ControlAffine) -> tuple[str, ...]:
        """Check all parts, and return warnings.

        Raises:
            ModelError: the plant is malformed, or has other states or inputs than the model.
            SimulationError: a part is of another kind.
        """
        kinds = dict(disturbance=Disturbance, network=Network, actuator=Actuator, sensing=Sensing)
        named = [(name, getattr(self, name), kind) for name, kind in kinds.items()]
        if not isinstance(self.parts, Sequence):
            kind = type(self.parts).__name__
            raise SimulationError(f"`parts` is a `{kind}`, and must be a list of `WorldPart`.")
        named += [(f"parts[{k}]", part, WorldPart) for k, part in enumerate(self.parts)]
        for name, part, kind in named:
            if part is not None:
                check_kind(name, part, kind)
        warnings = tuple[str, ...]()
        for plant in (self.plant, *self.plants.values()):
            if plant is not None:
                # First: a malformed plant may have no names to compare.
                warnings += check_model(plant)
                check_plant(model, plant)
        return warnings

    def check_agents(self, model: ControlAffine, agents: int) -> None:
        """Raise `SimulationError` with what does not fit the model or the number of agents."""
        for part in self.all_parts:
            for fault in part.faults(model, agents):
                raise SimulationError(fault)

    def describe(self, model: ControlAffine) -> dict[str, str | None]:
        """Return each part in words by its key; None for each that is absent.

        Parts of your own are joined under `parts`, where there are any.
        """
        words = {part.key: part.words(model) or None for part in self.all_parts if part.key}
        own = "; ".join(part.words(model) for part in self.parts)
        return {**dict.fromkeys(KEYS), **words, **({"parts": own} if own else {})}
