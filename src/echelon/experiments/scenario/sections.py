"""The sections of a scenario file: their keys, units and defaults.

The sentence below a key is its description in the JSON schema, so the unit of each number stands
where the number is declared.
"""

from collections.abc import Mapping
from typing import Annotated, Any, final

from pydantic import BaseModel, ConfigDict, Field

from echelon.core.words import DEFAULT_FEEDFORWARD, ENGINES, Feedforward, Frame, NeighbourChoice
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.values import (
    Agents,
    Array,
    ClassInFile,
    Count,
    Edges,
    MatrixOrIdentity,
    NotNegative,
    Numbers,
    Numeric,
    OneOf,
    OwnOr,
    Parameters,
    Positive,
    Seed,
    Speed,
    Unit,
)

STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, use_attribute_docstrings=True)


def _either(*keys: str) -> ConfigDict:
    """Return the settings of a section that has exactly one of the keys."""
    extra: Any = {"oneOf": [{"required": [key]} for key in keys]}
    return STRICT | ConfigDict(json_schema_extra=extra)


@final
class ModelSpec(BaseModel, **_either("name", "python")):
    """What all agents are: a bundled model by its name, or a class in a file of yours."""

    name: Annotated[str, OneOf(registry.MODELS)] | None = None
    """Name of a model."""
    python: ClassInFile | None = None
    """`file.py:Class`, the file relative to the scenario file."""
    parameters: Parameters = None
    """Name of a set of parameters, or the parameters, in the model's units; with the key `set` they
    change those of a named set."""
    allow_unphysical: bool = False
    """Accept parameters that no body can have."""


@final
class PlantSpec(BaseModel, **STRICT):
    """The agents as they are, where they differ from the model that laws and gains know."""

    parameters: Annotated[dict[str, Numeric], Unit("the parameters'")] = {}
    """Parameters that differ, in the model's units."""
    scale: Annotated[dict[str, Positive], Unit("1")] = {}
    """Factors on the model's parameters, without unit; on each number of a list."""


@final
class StretchSpec(BaseModel, **STRICT):
    """The edges from some time on."""

    at: Annotated[Positive, Unit("s")]
    """When they take the place of those before, s."""
    edges: Annotated[Edges, Unit("1")]
    """Edges `[i, j]` or `[i, j, weight]`; none where nobody hears anybody."""


@final
class GraphSpec(BaseModel, **_either("edges", "name")):
    """Who hears whom: a list of edges, or the name of a graph that is made.

    Agents are numbered from 0.
    """

    edges: Edges | None = None
    """Edges `[i, j]` or `[i, j, weight]`; the weight has no unit, default 1. Both ends hear each
    other, unless `directed`."""
    weights: Annotated[Numbers | None, Unit("1")] = None
    """Weights of the edges, one for each, where they stand in a list of their own; above 0."""
    directed: bool = False
    """Edges are arrows along which it is told: of `[i, j]` j hears i, and i does not hear j. The
    graphs `path`, `ring` and `star` then lead away from agent 0, all others outward from the
    leaders."""
    schedule: Annotated[tuple[StretchSpec, ...], Field(strict=False)] = ()
    """Other edges from later times on, as in `[{at: 3.0, edges: [[0, 1]]}]`; `edges` hold until
    then, and the last ones for ever."""
    period: Annotated[Positive | None, Unit("s")] = None
    """After which all edges of the `schedule` begin again, s."""
    name: Annotated[str, OneOf(registry.GRAPHS)] | None = None
    """Name of a graph that is made, from the keys below."""
    agents: Count | None = None
    """Number of agents, leaders included; with `edges` the default is the largest number + 1."""
    rows: Count | None = None
    """Rows of the graph `grid`."""
    columns: Count | None = None
    """Columns of the graph `grid`."""
    radius: Annotated[Positive | None, Unit("sides of the square")] = None
    """Of the graph `geometric`: agents at random places of a unit square hear each other up to this
    distance, in sides of the square."""
    seed: Seed = 0
    """Seed of the places in the graph `geometric`."""
    leaders: Agents = Field(default=(0,), min_length=1)
    """Numbers of the agents that lead; all others follow."""

    @property
    def stretches(self) -> list[tuple[float, Edges]]:
        """The edges with their weights, and from when on; of listed ones."""
        edges = self.edges or ()
        if self.weights is not None:
            edges = tuple((i, j, w) for (i, j, _), w in zip(edges, self.weights, strict=True))
        return [(0.0, edges), *((each.at, each.edges) for each in self.schedule)]


@final
class FormationSpec(BaseModel, **STRICT):
    """Each agent's goal relative to the leader's: offsets or a named shape; none means zero."""

    offsets: Annotated[dict[int, Numbers] | None, Unit("the position's, mostly m")] = None
    """Offset of each agent, as in `{1: [1, 0, 0]}`: a number for each coordinate of the position,
    usually m, or for each state; 0 for an agent that is not named."""
    name: Annotated[str, OneOf(registry.FORMATIONS)] | None = None
    """Name of a shape."""
    spacing: Annotated[Positive, Unit("m")] = 1.0
    """Distance between neighbours in the shape, m."""
    columns: Count | None = None
    """Columns of the shape `grid`."""


@final
class OwnClass(BaseModel):
    """A class in a file of the user's, and what it is made with beside it."""

    model_config = STRICT | ConfigDict(extra="allow")
    # narrower than the base's, as pydantic wants it to check the further keys
    __pydantic_extra__: dict[str, Numeric] = Field(init=False)  # pyright: ignore

    python: ClassInFile
    """`file.py:Class`, the file relative to the scenario file."""

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The class's own keys: numbers or nested tuples of numbers."""
        return dict(self.__pydantic_extra__ or {})


@final
class ReferenceSpec(BaseModel):
    """What the leader tracks: a bundled reference by its name, or a class in a file of yours.

    Own keys stand beside it, as `radius` beside `name: circle`. Points are x, y, z in a plane too.
    """

    model_config = _either("name", "python") | ConfigDict(extra="allow")
    # narrower than the base's, as pydantic wants it to check the further keys
    __pydantic_extra__: dict[str, Numeric] = Field(init=False)  # pyright: ignore

    name: Annotated[str, OneOf(registry.REFERENCES)] | None = None
    """Name of a reference."""
    python: ClassInFile | None = None
    """`file.py:Class`, the file relative to the scenario file."""
    file: str | None = None
    """CSV file of the reference `states`, relative to the scenario file: its first line names `t`,
    the states and the inputs."""

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The reference's own keys: numbers or nested tuples of numbers, in m, s and rad."""
        return dict(self.__pydantic_extra__ or {})


_GAIN_SCHEMA: Any = {
    "anyOf": [
        {"required": ["python"]},
        {"propertyNames": {"enum": list(registry.GAIN_KEYS)}},
    ]
}


@final
class GainSpec(BaseModel):
    """How the gain of a law is found: by a method and its arguments, or from a file."""

    # Arguments that deserve a description, or are no numbers, have their keys here; so that a new
    # method needs no more than its line in the registry, further ones may be numbers.
    model_config = STRICT | ConfigDict(extra="allow", json_schema_extra=_GAIN_SCHEMA)
    # narrower than the base's, as pydantic wants it to check the further keys
    __pydantic_extra__: dict[str, Numeric] = Field(init=False)  # pyright: ignore

    method: Annotated[str, OneOf(registry.METHODS)] = registry.DEFAULT_METHOD
    """Name of a method."""
    Q: Annotated[Array | None, Unit("1 over the states' squared")] = None
    """Weight of the states: its diagonal or rows; default the model's."""
    R: Annotated[Array | None, Unit("1 over the inputs' squared")] = None
    """Weight of the normalised inputs: its diagonal or rows; default the model's."""
    P: Annotated[MatrixOrIdentity | None, Unit("1 over the states' squared")] = None
    """The gain of the method `given`: `identity`, its diagonal or rows."""
    coupling: Annotated[Positive | None, Unit("1")] = None
    """Coupling strength, without unit; default what the method finds."""
    domain: Annotated[dict[str, Numeric] | None, Unit("the states'")] = None
    """States about the trim on which a rate is proved: a half-width, or `[lower, upper]`, by state,
    group or normalised input."""
    rate: Annotated[Positive | None, Unit("1/s")] = None
    """Rate that the method `contraction` is asked for, 1/s."""
    exact: bool | None = None
    """Whether a rate is proved in exact arithmetic where it can be."""
    symmetry_weight: Annotated[Numeric | None, Unit("1 over the states' squared")] = None
    """Weight of the symmetric states in the P of `inner-loop`."""
    python: ClassInFile | None = None
    """A method of one's own, `file.py:Class`, the file relative to the scenario file; its own keys
    stand beside it."""
    file: str | None = None
    """Gain file of `echelon design`, relative to the scenario file."""

    @property
    def arguments(self) -> dict[str, Any]:
        """What it gives the method."""
        return self.model_dump(exclude={"method", "python", "file"}, exclude_none=True)


LeaderLaw = Annotated[
    Annotated[str, OneOf(registry.LEADER_LAWS)] | OwnClass,
    OwnOr(registry.LEADER_LAWS),
]
FollowerLaw = Annotated[
    Annotated[str, OneOf(registry.FOLLOWER_LAWS)] | OwnClass,
    OwnOr(registry.FOLLOWER_LAWS),
]


@final
class LeaderSpec(BaseModel, **STRICT):
    """What the leader does."""

    law: LeaderLaw = Field(default_factory=lambda: "passive")
    """Name of a law, or one of one's own, `{python: file.py:Class}` with its own keys; default
    `tracking` with a reference, `passive` without."""
    reacts: bool = False
    """Whether the leader answers to its neighbours too; with the law `tracking`."""
    start_error: Annotated[dict[str, float], Unit("the states'")] = {}
    """How far the leader starts from its reference, or from its trim without one, by state or group
    of states, in the states' units."""
    roots: Annotated[tuple[Positive, ...] | None, Field(strict=False), Unit("1/s")] = None
    """Of the law `stopping-point`: roots of the inner loop, 1/s, one fewer than the longest chain
    of the model; different from each other."""
    rate: Annotated[Positive | None, Unit("1/s")] = None
    """Of the law `stopping-point`: its slowest root, 1/s, instead of `roots`."""
    coupling: Annotated[Positive | None, Unit("1/s")] = None
    """Of the law `stopping-point`: how fast the leader comes to its reference; default
    twice the slowest root, or what the step holds."""
    speed: Annotated[Speed | None, Unit("the outputs' per s")] = None
    """Of the law `stopping-point`: the speed that agreement may ask for, of each flat output or of
    all, such as m/s; `inf` for none."""
    observer: bool | None = None
    """Of the law `stopping-point`: whether what the model lacks is estimated and opposed."""
    gain: GainSpec | None = None
    """Gain of the leader's own tracking, under `tracking` and `optimal-tracking`; default the
    model's Riccati gain."""


@final
class FollowerSpec(BaseModel, **STRICT):
    """What every follower does."""

    law: FollowerLaw = "consensus"
    """Name of a law, or one of one's own, `{python: file.py:Class}` with its own keys."""
    gain: GainSpec = Field(default_factory=GainSpec)
    """Gain of the law `consensus`."""
    roots: Annotated[tuple[Positive, ...] | None, Field(strict=False), Unit("1/s")] = None
    """Of the law `stopping-point`: roots of the inner loop, 1/s, one fewer than the longest chain
    of the model; different from each other."""
    rate: Annotated[Positive | None, Unit("1/s")] = None
    """Of the law `stopping-point`: its slowest root, 1/s, instead of `roots`."""
    coupling: Annotated[Positive | None, Unit("1/s")] = None
    """Of the law `stopping-point`: strength of the agreement, 1/s over the graph's
    weights; default twice the slowest root over lambda_min, or what the step holds."""
    speed: Annotated[Speed | None, Unit("the outputs' per s")] = None
    """Of the law `stopping-point`: the speed that agreement may ask for, of each flat output or of
    all, such as m/s; `inf` for none."""
    observer: bool | None = None
    """Of the law `stopping-point`: whether what the model lacks is estimated and opposed."""
    hears: Annotated[str, OneOf(map(str, NeighbourChoice))] | None = None
    """Of the law `stopping-point`: `all` neighbours are heard, or `leaderward` those alone that are
    nearer to a leader."""
    feedforward: Annotated[str, OneOf(map(str, Feedforward))] = str(DEFAULT_FEEDFORWARD)
    """What every follower is sent of the same step: `none`, nothing; `relay`, the leader's input;
    `relay-velocity`, the velocity that it makes; `parent`, the input of the neighbour nearer to the
    leader, on a tree."""
    frame: Annotated[str, OneOf(map(str, Frame))] = str(Frame.HEADING)
    """Axes of the gain, under `consensus`: `heading`, they turn with the heading that the leader
    follows, where the model states one; `world`, they stand still, as the paper has it."""
    trim: bool = True
    """Whether the law starts from the trim input, such as a quadrotor's weight, or from zero, as
    the paper prints it."""


@final
class InitialSpec(BaseModel, **STRICT):
    """Where the followers start: a random spread about their goals, save those of given states."""

    spread: Annotated[dict[str, NotNegative] | None, Unit("the states'")] = None
    """Half-width of the spread, by state or group, in the states' units."""
    states: Annotated[dict[int, Numbers] | None, Unit("the states'")] = None
    """All states of an agent, in the states' units; the others start by the spread."""


@final
class DisturbanceSpec(BaseModel, **STRICT):
    """Wind and noise that act on all agents."""

    constant: Annotated[dict[str, float], Unit("the states', per s")] = {}
    """Lasting wind by state or group, in the states' units per second: m/s^2 for a velocity."""
    rms: Annotated[dict[str, NotNegative], Unit("the states', per s")] = {}
    """Root mean square of the random wind by state or group, for each state, in the states' units
    per second."""
    input_rms: Annotated[dict[str, NotNegative], Unit("normalized inputs'")] = {}
    """Root mean square of the noise by input, in normalised inputs; no limit touches it."""
    hold: Annotated[Positive, Unit("s")] = 0.5
    """How long a random draw lasts, s."""
    common: bool = False
    """Whether all agents feel the same random wind."""
    seed: Seed | None = None
    """Seed of wind and noise; default the scenario's."""


@final
class SimulationSpec(BaseModel, **STRICT):
    """How the run is computed."""

    horizon: Annotated[Positive, Unit("s")]
    """Length of the run, s."""
    dt: Annotated[Positive, Unit("s")]
    """Length of a step, s; at most the horizon."""
    integrator: Annotated[str, OneOf(registry.INTEGRATORS)] = "rk4"
    """How a step is computed, the input held over it: `rk4`, Runge-Kutta of order 4; `euler`,
    x + dt (f + g u); `printed`, the paper's Algorithm 1 to the letter, without dt."""
    limits: bool = True
    """Whether the actuators' limits act; else any input is delivered."""
    store_every: Annotated[Count, Unit("steps")] = 1
    """Steps from one stored frame to the next; means are over all steps."""
    precision: Annotated[str, OneOf(("float64", "float32"))] = "float64"
    """Arithmetic of the run; gains and promises are always in float64."""
    engine: Annotated[str, OneOf(ENGINES)] = "auto"
    """What steps the agents: `jax`, or `native` code for this machine's vectors, which differs by
    rounding; `auto` takes that for long runs where it can."""
    devices: Count = 1
    """Among how many of JAX's devices the agents are parted, such as the GPUs of a host; more than
    one where JAX steps them, and the agents a multiple of it."""


@final
class ReportSpec(BaseModel, **STRICT):
    """What the report looks at."""

    steady_window: Annotated[Positive, Unit("s")] = Field(default_factory=lambda: 1.0)
    """The end of the run that counts as steady, s; a fifth of the horizon by default, and where it
    would not be shorter than the run."""


@final
class LiveSpec(BaseModel, **STRICT):
    """What was done at a time of `echelon live`, which does it again; `echelon run` refuses it."""

    at: Annotated[NotNegative, Unit("s")]
    """When, s."""
    law: str | None = None
    """The followers' law from then on; its agents remember nothing of the one before."""
    coupling: Annotated[Positive | None, Unit("1")] = None
    """The coupling from then on."""
    weight: Annotated[Positive | None, Unit("1")] = None
    """Weight of the inputs in the Riccati equation of the gain, times that of the scenario."""
    feedforward: Annotated[Annotated[float, Field(ge=0.0, le=1.0)] | None, Unit("1")] = None
    """1 where followers are sent what `follower.feedforward` says, 0 where nothing."""
    method: str | None = None
    """The method of the followers' gain, with the coupling that it chooses; `scenario` for the
    scenario's own."""
    shape: str | None = None
    """Shape of the formation, by a name of `formation`; `scenario` for the scenario's own."""
    size: Annotated[Positive | None, Unit("1")] = None
    """Size of the formation, times that of `formation`."""
    turn: Annotated[float | None, Unit("deg")] = None
    """Turn of the formation about its first leader, degrees."""
    wind: Annotated[float | None, Unit("the states', per s")] = None
    """Wind on the first velocity, or on the first position, beside `disturbance`."""
    cut: Annotated[Annotated[tuple[int, int], Field(strict=False)] | None, Unit("agents")] = None
    """The agents of an edge that is cut."""
    restore: Annotated[Annotated[tuple[int, int], Field(strict=False)] | None, Unit("agents")] = (
        None
    )
    """The agents of an edge that is restored."""
    kick: Annotated[dict[int, Numbers] | None, Unit("the states'")] = None
    """By agent: what is added to its states at once, in the states' units."""
