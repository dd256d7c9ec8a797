"""The sections of a scenario file for laws and gains, with the keys of every law and method.

`TakenBy` names the laws or methods that take a key; whatever lists, checks or offers keys reads it
from there. A new law or method is added to these marks, and its own keys as further fields.
"""

from collections.abc import Mapping
from typing import Annotated, Any, final

from pydantic import BaseModel, ConfigDict, Field

from echelon.core.words import DEFAULT_FEEDFORWARD, Feedforward, Frame, NeighbourChoice
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.values import (
    STRICT,
    ClassInFile,
    MatrixOrIdentity,
    NameOrUserClass,
    NeededBy,
    NotNegative,
    Numeric,
    OneOf,
    Positive,
    Speed,
    TakenBy,
    Unit,
    WeightMatrix,
    marked_keys,
)


@final
class UserClass(BaseModel):
    """A class in a file of yours, and its arguments."""

    model_config = STRICT | ConfigDict(extra="allow")
    # narrower than the base's: pydantic checks the further keys by this type
    __pydantic_extra__: dict[str, Numeric] = Field(init=False)  # pyright: ignore

    python: ClassInFile
    """`file.py:Class`, the file relative to the scenario file."""

    @property
    def parameters(self) -> Mapping[str, object]:
        """The arguments of the class: numbers or nested tuples of numbers."""
        return dict(self.__pydantic_extra__ or {})


def _close_gain_schema(schema: dict[str, Any]) -> None:
    """Allow further keys only with `python`, since they are arguments of the user's class."""
    schema["anyOf"] = [
        {"required": ["python"]},
        {"propertyNames": {"enum": list(schema["properties"])}},
    ]


_PER_STATE = Unit("1 over the states' squared")


@final
class GainSpec(BaseModel):
    """The gain of a law: a method with its arguments, or a gain file."""

    model_config = STRICT | ConfigDict(extra="allow", json_schema_extra=_close_gain_schema)
    # narrower than the base's: pydantic checks the further keys by this type
    __pydantic_extra__: dict[str, Numeric] = Field(init=False)  # pyright: ignore

    method: Annotated[str, OneOf(registry.METHODS)] = registry.DEFAULT_METHOD
    """Name of a method."""
    Q: Annotated[
        WeightMatrix | None, _PER_STATE, TakenBy("riccati", "inner-loop", "robust-lqr")
    ] = None
    """Weight of the states: its diagonal or rows; default the model's."""
    R: Annotated[
        WeightMatrix | None,
        Unit("1 over the inputs' squared"),
        TakenBy("riccati", "given", "inner-loop", "robust-lqr"),
    ] = None
    """Weight of the normalized inputs: its diagonal or rows; default the model's."""
    P: Annotated[MatrixOrIdentity | None, _PER_STATE, NeededBy("given")] = None
    """The matrix P of the method `given`: `identity`, its diagonal or rows."""
    coupling: Annotated[Positive | None, Unit("1"), TakenBy(*registry.METHODS)] = None
    """Coupling strength; default the method's choice."""
    domain: Annotated[
        dict[str, Numeric] | None,
        Unit("the states'"),
        NeededBy("monotone", "robust-lqr", "contraction"),
    ] = None
    """States about the trim for which a rate is proved: a half-width, or `[lower, upper]`, by
    state, group or normalized input."""
    rate: Annotated[Positive | None, Unit("1/s"), NeededBy("contraction")] = None
    """Desired rate of the method `contraction`, 1/s."""
    exact: Annotated[bool | None, TakenBy("robust-lqr", "contraction")] = None
    """Whether a rate is proved in exact arithmetic where possible."""
    symmetry_weight: Annotated[Numeric | None, _PER_STATE, TakenBy("inner-loop")] = None
    """Weight of the symmetric states in the P of `inner-loop`."""
    python: ClassInFile | None = None
    """A method of yours, `file.py:Class`, the file relative to the scenario file; its arguments are
    keys of this section."""
    file: str | None = None
    """Gain file of `echelon design`, relative to the scenario file."""

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of the method."""
        return self.model_dump(exclude={"method", "python", "file"}, exclude_none=True)


_STOPPING = TakenBy("stopping-point")
_Roots = Annotated[tuple[Positive, ...] | None, Field(strict=False), Unit("1/s"), _STOPPING]
_Rate = Annotated[Positive | None, Unit("1/s"), _STOPPING]
_Speed = Annotated[Speed | None, Unit("the outputs' per s"), _STOPPING]


def law_arguments(section: BaseModel) -> dict[str, object]:
    """Return the keys of a role that are arguments of its law, the gain excepted."""
    arguments = {key: getattr(section, key) for key in marked_keys(type(section)) if key != "gain"}
    plain = {k: x.model_dump() if isinstance(x, ObserverSpec) else x for k, x in arguments.items()}
    return {key: value for key, value in plain.items() if value is not None}


@final
class ObserverSpec(BaseModel, **STRICT):
    """The estimate of what the model lacks, from an agent's own motion."""

    push: Annotated[NotNegative, Unit("1/s")] = 8.0
    """Bandwidth of the estimated acceleration, 1/s; 0 for no observer."""
    scale: Annotated[NotNegative, Unit("1/s")] = 0.0
    """Rate, 1/s, at which a push along the thrust is ascribed to another mass or weaker motors;
    0 for never."""


@final
class LeaderSpec(BaseModel, **STRICT):
    """What the leader does."""

    law: Annotated[
        Annotated[str, OneOf(registry.LEADER_LAWS)] | UserClass,
        NameOrUserClass(registry.LEADER_LAWS),
    ] = Field(default_factory=lambda: registry.default_leader_law(None, reference=False))
    """Name of a law, or a class of yours, `{python: file.py:Class}` with its arguments; default
    `tracking` with a reference, `passive` without."""
    reacts: bool = False
    """Whether the leader reacts to its neighbours too; with the law `tracking`."""
    start_error: Annotated[dict[str, float], Unit("the states'")] = {}
    """Distance at which the leader starts from its reference, or from its trim without one, by
    state or group of states, in the states' units."""
    roots: _Roots = None
    """Of the law `stopping-point`: roots of the inner loop, 1/s, one fewer than the longest chain
    of the model; different from each other."""
    rate: _Rate = None
    """Of the law `stopping-point`: its slowest root, 1/s, instead of `roots`."""
    coupling: Annotated[Positive | None, Unit("1/s"), _STOPPING] = None
    """Of the law `stopping-point`: rate at which the leader approaches its reference, 1/s; default
    twice the slowest root, or the largest that the step allows."""
    speed: _Speed = None
    """Of the law `stopping-point`: the largest speed that agreement commands, of each flat output
    or of all, such as m/s; `inf` for no bound."""
    observer: Annotated[bool | ObserverSpec | None, _STOPPING] = None
    """Of the law `stopping-point`: whether disturbances and model errors are estimated and
    compensated, or the numbers of the observer."""
    gain: Annotated[GainSpec | None, TakenBy("tracking", "optimal-tracking")] = None
    """Gain of the leader's tracking, under `tracking` and `optimal-tracking`; default the model's
    Riccati gain."""

    def inner_loop(self, follower: "FollowerSpec") -> dict[str, object]:
        """Return the leader's roots or rate of the inner loop; without any, the followers'."""
        for arguments in (law_arguments(self), law_arguments(follower)):
            if arguments.keys() & {"roots", "rate"}:
                return {key: arguments[key] for key in ("roots", "rate") if key in arguments}
        return {}


@final
class FollowerSpec(BaseModel, **STRICT):
    """What every follower does."""

    law: Annotated[
        Annotated[str, OneOf(registry.FOLLOWER_LAWS)] | UserClass,
        NameOrUserClass(registry.FOLLOWER_LAWS),
    ] = registry.DEFAULT_FOLLOWER_LAW
    """Name of a law, or a class of yours, `{python: file.py:Class}` with its arguments."""
    gain: Annotated[GainSpec, TakenBy("consensus")] = Field(default_factory=GainSpec)
    """Gain of the law `consensus`."""
    roots: _Roots = None
    """Of the law `stopping-point`: roots of the inner loop, 1/s, one fewer than the longest chain
    of the model; different from each other."""
    rate: _Rate = None
    """Of the law `stopping-point`: its slowest root, 1/s, instead of `roots`."""
    coupling: Annotated[Positive | None, Unit("1/s"), _STOPPING] = None
    """Of the law `stopping-point`: strength of the agreement, 1/s over the graph's weights; default
    twice the slowest root over lambda_min, or the largest that the step allows."""
    speed: _Speed = None
    """Of the law `stopping-point`: the largest speed that agreement commands, of each flat output
    or of all, such as m/s; `inf` for no bound."""
    observer: Annotated[bool | ObserverSpec | None, _STOPPING] = None
    """Of the law `stopping-point`: whether disturbances and model errors are estimated and
    compensated, or the numbers of the observer."""
    hears: Annotated[Annotated[str, OneOf(map(str, NeighbourChoice))] | None, _STOPPING] = None
    """Of the law `stopping-point`: whether agents use the information of `all` neighbours, or only
    of those nearer to a leader (`leaderward`)."""
    feedforward: Annotated[
        str, OneOf(map(str, Feedforward)), TakenBy("consensus", "stopping-point")
    ] = str(DEFAULT_FEEDFORWARD)
    """What every follower receives of the same step: `none`, nothing; `relay`, the leader's input;
    `relay-velocity`, the velocity that this input causes; `parent`, the input of the neighbour
    nearer to the leader, on a tree."""
    frame: Annotated[str, OneOf(map(str, Frame)), TakenBy("consensus")] = str(Frame.HEADING)
    """Axes of the gain, under `consensus`: `heading`, they turn with the leader's desired heading,
    if the model has one; `world`, they are fixed, as in the paper."""
    trim: Annotated[bool, TakenBy("consensus")] = True
    """Whether the law adds the trim input, such as a quadrotor's weight; the paper's printed law
    does not."""
