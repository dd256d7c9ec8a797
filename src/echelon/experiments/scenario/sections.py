"""The sections of a scenario file: their keys, units and defaults.

The sentence below a key is its description in the JSON schema. `TakenBy` names the choices of a
section, such as graphs, laws or methods, that take a key; whatever lists, checks or offers keys
reads it from there. A new law or method is added to these marks, and its own keys as further
fields.
"""

import abc
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from echelon.core.limits import horizon_fault
from echelon.core.words import (
    DEFAULT_FEEDFORWARD,
    ENGINES,
    Estimation,
    Feedforward,
    Frame,
    MessageContent,
    NeighbourChoice,
    Prediction,
    amount,
)
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.values import (
    Agent,
    Agents,
    Allowed,
    ClassInFile,
    Count,
    Edges,
    Finding,
    MatrixOrIdentity,
    NameOrUserClass,
    NeededBy,
    NotNegative,
    Numbers,
    Numeric,
    OneOf,
    Parameters,
    Positive,
    Section,
    Seed,
    Speed,
    TakenBy,
    Unit,
    WeightMatrix,
    either,
    marked_keys,
)


@final
class ModelSpec(Section, **either("name", "python")):
    """The model of all agents: the name of a bundled model, or a class in a file of yours."""

    one_of: ClassVar = ("name", "python")
    name: Annotated[str, OneOf(registry.MODELS)] | None = None
    """Name of a model."""
    python: ClassInFile | None = None
    """`file.py:Class`, the file relative to the scenario file."""
    parameters: Parameters = None
    """Name of a set of parameters, or the parameters in the model's units; with the key `set` they
    change those of the named set."""
    file: str | None = None
    """File relative to the scenario file. MATLAB file of the model `linear`: A and B, and where
    given C and the step `Ts` of a discrete-time model. URDF or MJCF file of the model `quadrotor`:
    mass and inertia."""
    allow_unphysical: bool = False
    """Whether parameters that no rigid body can have are accepted."""


def _named(model: object) -> object:
    return {"name": model} if isinstance(model, str) else model


@final
class GroupSpec(Section):
    """A group of agents of one model, in a formation of unlike agents."""

    count: Count
    """How many they are; agents are numbered from 0, one group after another."""
    model: Annotated[ModelSpec, BeforeValidator(_named, json_schema_input_type=str | ModelSpec)]
    """The model of the group: the name of a bundled one, or the keys of `model`."""
    name: str | None = None
    """Name of the group, with which its inputs begin; default that of the model."""


@final
class VariationSpec(Section):
    """An actual agent, where it differs from the model."""

    parameters: Annotated[dict[str, Numeric], Unit("the parameters'")] = {}
    """Parameters that differ, in the model's units."""
    scale: Annotated[dict[str, Positive], Unit("1")] = {}
    """Factors on the model's parameters; a list is multiplied number by number."""


@final
class PlantSpec(Section):
    """The actual agents, where they differ from the model that laws and gains use."""

    parameters: Annotated[dict[str, Numeric], Unit("the parameters'")] = {}
    """Parameters that differ, in the model's units."""
    scale: Annotated[dict[str, Positive], Unit("1")] = {}
    """Factors on the model's parameters; a list is multiplied number by number."""
    agents: dict[int, VariationSpec] = {}
    """By number, agents that differ from the others; theirs replaces what stands above."""


@final
class StretchSpec(Section):
    """The edges from a given time on."""

    at: Annotated[Positive, Unit("s")]
    """Time at which they replace the previous ones, s."""
    edges: Annotated[Edges, Unit("1")]
    """Edges `[i, j]` or `[i, j, weight]`; an empty list where no agent receives anything."""


@final
class GraphSpec(Section, **either("edges", "name", "file")):
    """The communication graph: a list of edges, the name of a generated graph, or a file.

    Agents are numbered from 0.
    """

    one_of: ClassVar = ("edges", "name", "file")
    edges: Edges | None = None
    """Edges `[i, j]` or `[i, j, weight]`; the weight has no unit, default 1. Each end receives from
    the other, unless `directed`."""
    weights: Annotated[
        Annotated[tuple[Positive, ...], Field(strict=False)] | None, Unit("1"), TakenBy("edges")
    ] = None
    """Weights of the edges in a separate list, one for each; above 0."""
    directed: bool = False
    """Edges are directed: `[i, j]` sends from i to j only. The graphs `path`, `ring` and `star`
    then point away from agent 0, all others away from the leaders."""
    schedule: Annotated[tuple[StretchSpec, ...], Field(strict=False), TakenBy("edges")] = ()
    """Other edges from later times on, as in `[{at: 3.0, edges: [[0, 1]]}]`; `edges` apply until
    then, and the last ones until the end."""
    period: Annotated[Positive | None, Unit("s"), TakenBy("edges")] = None
    """Period with which the edges of the `schedule` repeat, s."""
    name: Annotated[str, OneOf(registry.GRAPHS)] | None = None
    """Name of a generated graph; the keys below are its parameters."""
    file: str | None = None
    """File of the graph, relative to the scenario file: a table of edges (from, to, weight) or an
    adjacency matrix, GraphML, or a sparse matrix of SciPy (`.npz`). With `directed` every edge is
    directed; without, GraphML says so, or a matrix that is not symmetric."""
    agents: Annotated[
        Count | None,
        TakenBy("edges", "grid", needed_by=("path", "ring", "star", "complete", "geometric")),
    ] = None
    """Number of agents, leaders included; with `edges` the default is the largest number + 1."""
    rows: Annotated[Count | None, NeededBy("grid")] = None
    """Rows of the graph `grid`."""
    columns: Annotated[Count | None, NeededBy("grid")] = None
    """Columns of the graph `grid`."""
    radius: Annotated[Positive | None, Unit("sides of the square"), NeededBy("geometric")] = None
    """Of the graph `geometric`: agents at random places of a unit square are linked up to this
    distance, in sides of the square."""
    seed: Annotated[Seed, TakenBy("geometric")] = 0
    """Seed of the places in the graph `geometric`."""
    leaders: Agents = Field(default=(0,), min_length=1)
    """Numbers of the agents that lead; all others follow."""

    def faults(self) -> Iterator[Finding]:
        """Yield keys that do not agree; what no graph can be, the graph itself refuses."""
        yield from super().faults()
        edges, weights = self.edges or (), self.weights
        if weights is not None and len(weights) != len(edges):
            got = f"{amount(len(weights), 'weight')} for {amount(len(edges), 'edge')}"
            yield ("weights",), f"got {got}, allowed is one for each edge."
        elif weights is not None and any(edge[2] != 1.0 for edge in edges):
            yield ("edges",), "got an edge with a weight, allowed with `weights` is `[i, j]`."
        if self.period is not None and not self.schedule:
            yield ("period",), "got a period without a `schedule`, which it needs."
        if len({*self.leaders}) < len(self.leaders):
            yield ("leaders",), "got an agent twice, allowed is each agent once."
        size = (self.rows or 0) * (self.columns or 0)
        if size and self.agents not in (None, size):
            yield ("agents",), f"got `{self.agents}`, allowed is rows times columns, `{size}`."

    @property
    def stretches(self) -> list[tuple[float, Edges]]:
        """The listed edges with their weights, each stretch with the time at which it begins."""
        edges = self.edges or ()
        if self.weights is not None:
            edges = tuple((i, j, w) for (i, j, _), w in zip(edges, self.weights, strict=True))
        return [(0.0, edges), *((stretch.at, stretch.edges) for stretch in self.schedule)]


class ShapeKeys(Section, abc.ABC):
    """The keys of a shape."""

    one_of: ClassVar = ("name", "offsets", "distances")
    offsets: Annotated[dict[int, Numbers] | None, Unit("the position's, mostly m")] = None
    """Offset of each agent, as in `{1: [1, 0, 0]}`: a number for each coordinate of the position,
    usually m, or for each state; default 0."""
    distances: Annotated[
        list[Annotated[tuple[int, int, Positive], Field(strict=False)]] | None, Unit("m")
    ] = None
    """Distances between agents, as in `[[0, 1, 1.0], [1, 2, 0.8]]`, m; the shape that has them is
    turned to `initial.states`, and the goals are stored."""
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
class MotionSpec(Section, **either("rotate", "scale", "reshape", "python")):
    """How offsets change with time; several act one after the other, reshapes first."""

    one_of: ClassVar = tuple(registry.MOTIONS)
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


@final
class ReferenceSpec(Section):
    """What the leader tracks: the name of a bundled reference, or a class in a file of yours.

    Its parameters are keys of this section, as `radius` with `name: circle`. Points have
    coordinates x, y, z, also of planar models.
    """

    one_of: ClassVar = ("name", "python")
    model_config = either("name", "python") | ConfigDict(extra="allow")
    # narrower than the base's: pydantic checks the further keys by this type
    __pydantic_extra__: dict[str, Numeric] = Field(init=False)  # pyright: ignore

    name: Annotated[str, OneOf(registry.REFERENCES)] | None = None
    """Name of a reference."""
    python: ClassInFile | None = None
    """`file.py:Class`, the file relative to the scenario file."""
    file: str | None = None
    """Table of the path, relative to the scenario file, with named columns in any order.
    `waypoints` has `t`, `x`, `y` and where given `z`, `yaw`, or `lat`, `lon`, `alt`, or is a GPX
    file; `states` has `t`, the states and the inputs; `polynomials` has `duration`, `x^0` to
    `x^7`, and likewise for `y`, `z`, `yaw`."""
    columns: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Names of the columns of `file`, in its order, in place of its header or without one."""
    begin: Annotated[float | None, Unit("s")] = None
    """Time at which the path of `file` begins, s; by default its own, 0 for Unix time stamps."""
    degrees: bool = False
    """Whether the yaw of `waypoints` is in degrees; a unit in the header of `file` is used."""
    ends: Annotated[str, OneOf(("rest", "free"))] | None = None
    """Whether `waypoints` begin and end at rest, or move there, as recorded paths do (`free`);
    default `rest`, and `free` with `smooth`."""
    smooth: Annotated[Positive | None, Unit("m")] = None
    """Largest distance of a smooth curve from the `waypoints`, m (of the yaw, rad); by default it
    passes through them."""
    resample: Annotated[Positive | None, Unit("s")] = None
    """Step of points that replace the `waypoints`, s, on straight lines between them."""
    slowdown: Annotated[Positive, Unit("1")] = 1.0
    """Factor on the time that the path takes: 2 for half of its speed; not for `states`."""

    @property
    def parameters(self) -> Mapping[str, object]:
        """The reference's parameters: numbers or nested tuples of numbers, in m, s and rad."""
        keys = ("columns", "begin", "degrees", "ends", "smooth", "resample")
        given = {key: getattr(self, key) for key in keys if key in self.model_fields_set}
        return {**(self.__pydantic_extra__ or {}), **given}


@final
class UserClass(Section):
    """A class in a file of yours, and its arguments."""

    model_config = ConfigDict(extra="allow")
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
class GainSpec(Section):
    """The gain of a law: a method with its arguments, or a gain file."""

    one_of: ClassVar = ("method", "file", "python")
    model_config = ConfigDict(extra="allow", json_schema_extra=_close_gain_schema)
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

    def choice(self, key: str) -> object:
        """Return the method or `file`; the class of the user alone knows its keys."""
        return None if key == "python" else super().choice(key)

    def faults(self) -> Iterator[Finding]:
        """Yield keys that do not agree, and those that only a class of the user may have."""
        yield from super().faults()
        if self.python is None:
            yield from (((key,), "") for key in self.model_extra or ())

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of the method."""
        return self.model_dump(exclude={"method", "python", "file"}, exclude_none=True)


_STOPPING = TakenBy("stopping-point")
_Roots = Annotated[tuple[Positive, ...] | None, Field(strict=False), Unit("1/s"), _STOPPING]
_Rate = Annotated[Positive | None, Unit("1/s"), _STOPPING]
_Speed = Annotated[Speed | None, Unit("the outputs' per s"), _STOPPING]
_Weights = Annotated[
    bool | NotNegative | Annotated[tuple[NotNegative, ...], Field(strict=False)],
    Allowed("is `true`, a number of at least 0, or a list of such numbers"),
]
_PER_SUM = Unit("1 over the outputs' squared, per s^2")


def law_arguments(section: BaseModel) -> dict[str, object]:
    """Return the keys of a role that are arguments of its law, the gain excepted."""
    arguments = {key: getattr(section, key) for key in marked_keys(type(section)) if key != "gain"}
    plain = {k: x.model_dump() if isinstance(x, ObserverSpec) else x for k, x in arguments.items()}
    return {key: value for key, value in plain.items() if value is not None}


@final
class ObserverSpec(Section):
    """The estimate of what the model lacks, from an agent's own motion."""

    push: Annotated[NotNegative, Unit("1/s")] = 8.0
    """Bandwidth of the estimated acceleration, 1/s; 0 for no observer."""
    scale: Annotated[NotNegative, Unit("1/s")] = 0.0
    """Rate, 1/s, at which a push along the thrust is ascribed to another mass or weaker motors;
    0 for never."""


@final
class LeaderSpec(Section):
    """What the leader does."""

    one_of: ClassVar = ("law",)
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
    integral: Annotated[_Weights | None, _PER_SUM, TakenBy("tracking")] = None
    """Whether the leader sums the errors of its position and its heading, which removes those of
    constant pushes: `true`, or the weights of the sums, one for all or one for each."""

    def inner_loop(self, follower: "FollowerSpec") -> dict[str, object]:
        """Return the leader's roots or rate of the inner loop; without any, the followers'."""
        for arguments in (law_arguments(self), law_arguments(follower)):
            if arguments.keys() & {"roots", "rate"}:
                return {key: arguments[key] for key in ("roots", "rate") if key in arguments}
        return {}


@final
class FollowerSpec(Section):
    """What every follower does."""

    one_of: ClassVar = ("law",)
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
    integral: Annotated[_Weights | None, _PER_SUM, TakenBy("consensus")] = None
    """Whether followers sum the errors of positions and heading, which removes those of constant
    pushes: `true`, or the weights of the sums, one for all or one for each."""
    trim: Annotated[bool, TakenBy("consensus")] = True
    """Whether the law adds the trim input, such as a quadrotor's weight; the paper's printed law
    does not."""


@final
class InitialSpec(Section):
    """Where the followers start: randomly about their goals, or at given states."""

    spread: Annotated[dict[str, NotNegative] | None, Unit("the states'")] = None
    """Half-width of the spread, by state or group, in the states' units."""
    states: Annotated[dict[int, Numbers] | None, Unit("the states'")] = None
    """All states of an agent, in the states' units; the other agents start by the spread."""


@final
class DisturbanceSpec(Section):
    """Wind and noise that act on all agents."""

    constant: Annotated[dict[str, float], Unit("the states', per s")] = {}
    """Constant wind by state or group, in the states' units per second: m/s^2 for a velocity."""
    rms: Annotated[dict[str, NotNegative], Unit("the states', per s")] = {}
    """Root mean square of the random wind by state or group, for each state, in the states' units
    per second."""
    input_rms: Annotated[dict[str, NotNegative], Unit("normalized inputs'")] = {}
    """Root mean square of the noise by input, in normalized inputs; limits do not apply to it."""
    hold: Annotated[Positive, Unit("s")] = 0.5
    """Time for which a random draw stays constant, s."""
    common: bool = False
    """Whether all agents are subject to the same random wind."""
    seed: Seed | None = None
    """Seed of wind and noise; default the scenario's."""
    time: Annotated[Positive | None, Unit("s")] = None
    """Time constant of gusts, s: the random wind is then a Gauss-Markov process of each agent, in
    place of independent draws every `hold`."""
    air: Annotated[Numbers | None, Unit("m/s")] = None
    """Velocity of the air by coordinate of the position, m/s; it acts by `drag`."""
    drag: Annotated[NotNegative, Unit("1/s")] = 0.0
    """Acceleration of an agent by the air, 1/s times its velocity through the air."""


@final
class ActuatorSpec(Section):
    """Actuators of all agents that are not ideal; the laws know nothing of it."""

    lag: Annotated[NotNegative, Unit("s")] = 0.0
    """Time constant with which every actuator follows its command, s."""
    levels: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Number of values that a motor can be commanded between its limits; 0 for any value."""
    minimum: Annotated[NotNegative | None, Unit("the motors', mostly N")] = None
    """Least thrust of a motor, mostly N; default the lower limit."""


@final
class SensingSpec(Section):
    """What all agents measure of their own states, which laws and messages use."""

    delay: Annotated[NotNegative, Unit("s")] = 0.0
    """Age of the measurement, s; rounded to steps."""
    noise: Annotated[dict[str, NotNegative], Unit("the states'")] = {}
    """Standard deviation of each measurement, by state or group, in the states' units;
    independent from step to step."""
    seed: Seed | None = None
    """Seed of the noise; default the scenario's."""
    estimator: Annotated[str, OneOf(map(str, Estimation))] = "none"
    """What agents make of their measurements: `none`, they use them as they are; `constant-gain`,
    a prediction by the model, corrected by a constant gain."""


Share = Annotated[float, Field(ge=0.0, le=1.0)]


@final
class BurstsSpec(Section):
    """Outages of links, during which all messages on them are lost."""

    share: Annotated[Annotated[float, Field(ge=0.0, lt=1.0)], Unit("1")] = 0.0
    """Share of the time that a link is out."""
    length: Annotated[Positive, Unit("s")] = 0.2
    """Mean length of an outage, s."""


@final
class NetworkSpec(Section):
    """A network on which messages take time and are lost; without the section it is ideal.

    Each agent sends to all that receive from it, and uses what it last received; its own state is
    never late.
    """

    rate: Annotated[Positive, Unit("Hz")] = 50.0
    """Messages of an agent per second, Hz; it divides the control rate, 1 / `simulation.dt`."""
    delay: Annotated[NotNegative, Unit("s")] = 0.0
    """Delay of each message, s; rounded up to steps, and at least one."""
    jitter: Annotated[NotNegative, Unit("s")] = 0.0
    """Largest additional delay, s, drawn for each message and link; messages may overtake others,
    and an older one never replaces a newer one."""
    loss: Annotated[Share, Unit("1")] = 0.0
    """Probability that a message is lost on a link."""
    bursts: BurstsSpec = Field(default_factory=BurstsSpec)
    """Outages of links; by default none."""
    messages: Annotated[str, OneOf(map(str, MessageContent))] = "deviation"
    """Content of a message: `deviation`, the sender's deviation from where it expects the leader;
    `state`, its signal itself, with which followers lag behind a leader that moves."""
    prediction: Annotated[str, OneOf(map(str, Prediction))] = "preview"
    """How agents predict the leader from what it last sent: `preview`, by its plan, which they
    know; `packet`, carried on by the model from its last state and input. Only for the messages
    `deviation`."""
    forget: Annotated[Positive, Unit("s")] = 0.5
    """Age, s, beyond which a neighbour's deviation is not used."""
    hears: Annotated[str, OneOf(map(str, NeighbourChoice))] = "all"
    """Whose messages are used: of `all` neighbours, or `leaderward`, of those with fewer hops to
    the leader, as counted by the messages that arrive."""
    seed: Seed | None = None
    """Seed of losses and delays; default the scenario's."""


@final
class SafetySpec(Section):
    """Collision avoidance of the followers under the law `stopping-point`, with a proof.

    Upright ellipsoids about the agents are kept apart. Distances are scaled: heights are divided by
    the ellipsoid's height over its width.
    """

    radii: Annotated[Numbers | None, Unit("m")] = None
    """Radii of the ellipsoid along x, y and z, m, the first two equal; default the model's radius,
    and three times as much upward."""
    gain: Annotated[Positive, Unit("1/s")] = 4.0
    """Rate at which agents may use up their distance, 1/s; at most 1 / `simulation.dt`."""
    swirl: Annotated[NotNegative, Unit("m/s")] = 0.5
    """Speed with which an agent that is held back turns to its right, m/s."""
    margin: Annotated[NotNegative, Unit("m")] = 0.05
    """Added to the distance that is kept, m: for late messages, lag, noise and wind."""
    reach: Annotated[Positive, Unit("m")] = 3.0
    """Scaled distance up to which other agents are regarded, m, whatever the graph."""


_Link = Annotated[Annotated[tuple[Agent, Agent], Field(strict=False)] | None, Unit("agents")]


@final
class EventSpec(Section, **either("lose", "cut", "join", "python")):
    """What happens to the formation at a time; no law and no gain is made for it."""

    one_of: ClassVar = ("lose", "cut", "join", "python")
    at: Annotated[Positive, Unit("s")]
    """Time, s; below the horizon."""
    lose: Agent | None = None
    """The number of an agent that is lost: it falls silent, and its body is gone."""
    cut: _Link = None
    """The two agents of a link that carries nothing, either way."""
    duration: Annotated[Positive | None, Unit("s"), Field(alias="for"), TakenBy("cut")] = None
    """Time after which a cut link is restored, s; by default never."""
    join: Agent | None = None
    """The number of an agent that joins, in its initial state; before, or since it was lost, it is
    absent."""
    python: Annotated[ClassInFile | None, TakenBy("python")] = None
    """`file.py:Class`, an `Event` of yours, the file relative to the scenario file."""
    parameters: Annotated[dict[str, Numeric], TakenBy("python")] = {}
    """Parameters of that class, besides `at`."""


@final
class LeadershipSpec(Section):
    """Who takes the lead when nobody hears of the leader any more."""

    backups: Agents
    """Numbers of followers, in the order in which they take over."""
    timeout: Annotated[Positive, Unit("s")] = 0.3
    """Time without news of a leader after which the first backup takes the lead, s; the second
    does after twice that, and so on."""


@final
class SimulationSpec(Section):
    """How the run is computed."""

    horizon: Annotated[Positive, Unit("s")]
    """Length of the run, s."""
    dt: Annotated[Positive, Unit("s")]
    """Length of a step, s; at most the horizon."""
    integrator: Annotated[str, OneOf(registry.INTEGRATORS)] = "rk4"
    """Integration of a step at constant input: `rk4`, Runge-Kutta of order 4; `euler`,
    x + dt (f + g u); `printed`, the paper's Algorithm 1 literally, without dt."""
    limits: bool = True
    """Whether the actuators' limits apply."""
    store_every: Annotated[Count, Unit("steps")] = 1
    """Steps between stored frames; means are over all steps."""
    precision: Annotated[str, OneOf(("float64", "float32"))] = "float64"
    """Floating-point type of the run; gains and guarantees are always computed in float64."""
    engine: Annotated[str, OneOf(ENGINES)] = "auto"
    """What integrates the agents: `jax`, or `native` machine code, which differs by rounding;
    `auto` uses native code for long runs where possible."""
    substeps: Count = 1
    """Steps of the integrator in each `dt`, over which inputs are held."""
    devices: Count = 1
    """Number of JAX devices, such as GPUs, among which the agents are divided; more than one only
    with the engine `jax`, and the number of agents a multiple of it."""

    def faults(self) -> Iterator[Finding]:
        """Yield a horizon that is no whole number of steps, or of too many."""
        if fault := horizon_fault(self.horizon, self.dt):
            yield ("horizon",), f"got `{self.horizon:g}`, which {fault}."


@final
class ReportSpec(Section):
    """What the report evaluates."""

    steady_window: Annotated[Positive, Unit("s")] = Field(default_factory=lambda: 1.0)
    """Length of the last part of the run, which counts as steady, s; default, and where it would
    not be shorter than the run, a fifth of the horizon."""


@final
class LiveSpec(Section):
    """A change made during `echelon live`, which repeats it; `echelon run` rejects it."""

    at: Annotated[NotNegative, Unit("s")]
    """Time of the change, s."""
    law: str | None = None
    """The followers' law from then on; its memory starts anew."""
    coupling: Annotated[Positive | None, Unit("1")] = None
    """The coupling from then on."""
    weight: Annotated[Positive | None, Unit("1")] = None
    """Weight of the inputs in the Riccati equation of the gain, relative to the scenario's."""
    feedforward: Annotated[Annotated[float, Field(ge=0.0, le=1.0)] | None, Unit("1")] = None
    """Share of the feed-forward of `follower.feedforward` that followers receive: 1 all, 0
    nothing."""
    method: str | None = None
    """The method of the followers' gain, with the coupling that it chooses; `scenario` for the
    scenario's."""
    shape: str | None = None
    """Shape of the formation, by a name of `formation`; `scenario` for the scenario's."""
    reshape: str | None = None
    """Shape to which the formation changes within 3 s, by a name of `formation`; `scenario` for the
    scenario's."""
    size: Annotated[Positive | None, Unit("1")] = None
    """Size of the formation, relative to that of `formation`."""
    turn: Annotated[float | None, Unit("deg")] = None
    """Rotation of the formation about its first leader, degrees."""
    wind: Annotated[float | None, Unit("the states', per s")] = None
    """Wind on the first velocity, or on the first position, added to `disturbance`."""
    delay: Annotated[NotNegative | None, Unit("s")] = None
    """Delay of the messages of `network`, s."""
    loss: Annotated[Share | None, Unit("1")] = None
    """Share of these messages that is lost."""
    outages: Annotated[Share | None, Unit("1")] = None
    """Share of the time that each link of `network` is out."""
    noise: Annotated[NotNegative | None, Unit("1")] = None
    """Size of the noise, relative to that of `sensing`."""
    lose: int | None = None
    """The number of an agent that is lost: it falls silent, and its body is gone."""
    cut: Annotated[Annotated[tuple[int, int], Field(strict=False)] | None, Unit("agents")] = None
    """The two agents of an edge that is removed."""
    restore: Annotated[Annotated[tuple[int, int], Field(strict=False)] | None, Unit("agents")] = (
        None
    )
    """The two agents of an edge that is restored."""
    join: int | None = None
    """The number of a lost agent that joins again, in its initial state."""
    kick: Annotated[dict[int, Numbers] | None, Unit("the states'")] = None
    """By agent: jump of its states, in the states' units."""
