"""The section `formation` of a scenario file: a shape, and how it changes with time."""

import abc
from typing import Annotated, final

from pydantic import BaseModel, Field

from echelon.experiments.scenario import registry
from echelon.experiments.scenario.values import (
    STRICT,
    ClassInFile,
    Count,
    NeededBy,
    NotNegative,
    Numbers,
    Numeric,
    OneOf,
    Positive,
    TakenBy,
    Unit,
    either,
)


class ShapeKeys(BaseModel, abc.ABC, **STRICT):
    """The keys of a shape."""

    offsets: Annotated[dict[int, Numbers] | None, Unit("the position's, mostly m")] = None
    """Offset of each agent, as in `{1: [1, 0, 0]}`: a number for each coordinate of the position,
    usually m, or for each state; default 0."""
    name: Annotated[str, OneOf(registry.FORMATIONS)] | None = None
    """Name of a shape."""
    spacing: Annotated[Positive, Unit("m"), TakenBy(*registry.FORMATIONS)] = 1.0
    """Distance between neighbours in the shape, m."""
    columns: Annotated[Count | None, TakenBy("grid")] = None
    """Columns of the shape `grid`."""


@final
class ShapeSpec(ShapeKeys):
    """A shape: offsets (default zero), or a name."""


@final
class MotionSpec(BaseModel, **either("rotate", "scale", "reshape", "python")):
    """How offsets change with time; several act one after the other, reshapes first."""

    rotate: Annotated[float | None, Unit("rad/s"), TakenBy("rotate")] = None
    """Rate at which the shape turns about the vertical axis through the first leader, rad/s."""
    scale: Annotated[Annotated[float, Field(gt=-1, lt=1)] | None, Unit("1"), TakenBy("scale")] = (
        None
    )
    """Amplitude a: the shape is 1 + a sin(rate t) times as large."""
    rate: Annotated[float | None, Unit("rad/s"), NeededBy("scale")] = None
    """Rate of `scale`, rad/s."""
    reshape: Annotated[ShapeSpec | None, TakenBy("reshape")] = None
    """Another shape, with the keys of `formation`, to which agents move on straight lines."""
    at: Annotated[NotNegative | None, Unit("s"), NeededBy("reshape")] = None
    """Time at which the reshape begins, s."""
    over: Annotated[Positive | None, Unit("s"), NeededBy("reshape")] = None
    """How long it takes, s; position to fifth derivative are continuous."""
    assign: Annotated[str, OneOf(registry.ASSIGNMENTS), TakenBy("reshape")] = "number"
    """Which place each follower takes: the one of its `number`, or the `nearest`, so that the
    squares of all ways add up to as little as possible."""
    python: Annotated[ClassInFile | None, TakenBy("python")] = None
    """`file.py:Class`, an `OffsetMotion` of yours, the file relative to the scenario file."""
    parameters: Annotated[dict[str, Numeric], TakenBy("python")] = {}
    """Parameters of that class."""


@final
class FormationSpec(ShapeKeys):
    """Each agent's goal relative to the leader's: offsets (default zero) or a named shape."""

    assign: Annotated[str, OneOf(registry.ASSIGNMENTS)] = "number"
    """Which place each follower takes at first: the one of its `number`, or the `nearest` to its
    start in `initial.states`, so that the squares of all ways add up to as little as possible."""
    motion: Annotated[tuple[MotionSpec, ...], Field(strict=False)] = ()
    """How the offsets change with time, as in `[{rotate: 0.5}, {reshape: {name: line}, at: 8,
    over: 3}]`."""
