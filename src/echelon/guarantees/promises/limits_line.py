"""Whether limits of the inputs can act, which leaves a claim conditional."""

import dataclasses
from collections.abc import Iterator

from echelon.agents.models.model_check import is_limited
from echelon.core.identity import digest
from echelon.core.statement import Hypothesis, Statement, fails
from echelon.core.words import Kind
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings

UNBOUNDED = "nothing bounds the inputs of this law within their limits"
_CONDITION = "no input of any agent is at a limit"
_REMEDY = "see whether a run is covered, or set `simulation.limits: false`"


def limits_act(parts: Parts, settings: Settings) -> bool:
    """Tell whether an input of an agent may be at a limit, or at the least thrust of a motor."""
    world, model, actuator = parts.world, parts.model, parts.world.actuator
    if actuator is not None and actuator.minimum is not None:
        return True
    plants = model, world.plant_for(model), *world.plants.values()
    return settings.limits and any(map(is_limited, plants))


def other_limits(parts: Parts) -> bool:
    """Tell whether an agent has other limits than the model, or motors with a minimum."""
    world, model = parts.world, parts.model
    actuator = world.actuator
    if actuator is not None and (actuator.levels or actuator.minimum is not None):
        return True
    plants = {id(x): x for x in (world.plant_for(model), *world.plants.values())}
    own = type(model).limit, digest(model.input_limits)
    return any((type(x).limit, digest(x.input_limits)) != own for x in plants.values())


def limits_line(parts: Parts, settings: Settings) -> Iterator[Statement]:
    """Yield that nothing bounds the inputs, where they have limits."""
    if limits_act(parts, settings):
        yield left_to_run(UNBOUNDED)


def left_to_run(
    text: str,
    number: float | None = None,
    number_text: str = "",
    remedy: str = _REMEDY,
    kind: Kind = Kind.PROOF,
) -> Statement:
    """Return the line of a claim that holds only while no input is at a limit, and why."""
    shown = number, number_text
    line = fails(Hypothesis.LIMITS, kind, text, *shown, remedy=remedy)
    return dataclasses.replace(line, condition=_CONDITION)
