"""The sections of a scenario file: their keys, units and defaults.

The sentence below a key is its description in the JSON schema. `TakenBy` names the choices of a
section, such as graphs, that take a key. The keys of laws and gains are in `law_sections`.
"""

from collections.abc import Mapping
from typing import Annotated, final

from pydantic import BaseModel, ConfigDict, Field

from echelon.core.words import ENGINES, Estimation, MessageContent, NeighbourChoice, Prediction
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.values import (
    STRICT,
    Agents,
    ClassInFile,
    Count,
    Edges,
    NeededBy,
    NotNegative,
    Numbers,
    Numeric,
    OneOf,
    Parameters,
    Positive,
    Seed,
    TakenBy,
    Unit,
    either,
)


@final
class ModelSpec(BaseModel, **either("name", "python")):
    """The model of all agents: the name of a bundled model, or a class in a file of yours."""

    name: Annotated[str, OneOf(registry.MODELS)] | None = None
    """Name of a model."""
    python: ClassInFile | None = None
    """`file.py:Class`, the file relative to the scenario file."""
    parameters: Parameters = None
    """Name of a set of parameters, or the parameters in the model's units; with the key `set` they
    change those of the named set."""
    file: str | None = None
    """MATLAB file of the model `linear`, relative to the scenario file: A and B, and where given C
    and the step `Ts` of a discrete-time model."""
    allow_unphysical: bool = False
    """Whether parameters that no rigid body can have are accepted."""


@final
class VariationSpec(BaseModel, **STRICT):
    """An actual agent, where it differs from the model."""

    parameters: Annotated[dict[str, Numeric], Unit("the parameters'")] = {}
    """Parameters that differ, in the model's units."""
    scale: Annotated[dict[str, Positive], Unit("1")] = {}
    """Factors on the model's parameters; a list is multiplied number by number."""


@final
class PlantSpec(BaseModel, **STRICT):
    """The actual agents, where they differ from the model that laws and gains use."""

    parameters: Annotated[dict[str, Numeric], Unit("the parameters'")] = {}
    """Parameters that differ, in the model's units."""
    scale: Annotated[dict[str, Positive], Unit("1")] = {}
    """Factors on the model's parameters; a list is multiplied number by number."""
    agents: dict[int, VariationSpec] = {}
    """By number, agents that differ from the others; theirs replaces what stands above."""


@final
class StretchSpec(BaseModel, **STRICT):
    """The edges from a given time on."""

    at: Annotated[Positive, Unit("s")]
    """Time at which they replace the previous ones, s."""
    edges: Annotated[Edges, Unit("1")]
    """Edges `[i, j]` or `[i, j, weight]`; an empty list where no agent receives anything."""


@final
class GraphSpec(BaseModel, **either("edges", "name")):
    """The communication graph: a list of edges, or the name of a generated graph.

    Agents are numbered from 0.
    """

    edges: Edges | None = None
    """Edges `[i, j]` or `[i, j, weight]`; the weight has no unit, default 1. Each end receives from
    the other, unless `directed`."""
    weights: Annotated[Numbers | None, Unit("1"), TakenBy("edges")] = None
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

    @property
    def stretches(self) -> list[tuple[float, Edges]]:
        """The listed edges with their weights, each stretch with the time at which it begins."""
        edges = self.edges or ()
        if self.weights is not None:
            edges = tuple((i, j, w) for (i, j, _), w in zip(edges, self.weights, strict=True))
        return [(0.0, edges), *((stretch.at, stretch.edges) for stretch in self.schedule)]


@final
class ReferenceSpec(BaseModel):
    """What the leader tracks: the name of a bundled reference, or a class in a file of yours.

    Its parameters are keys of this section, as `radius` with `name: circle`. Points have
    coordinates x, y, z, also of planar models.
    """

    model_config = either("name", "python") | ConfigDict(extra="allow")
    # narrower than the base's: pydantic checks the further keys by this type
    __pydantic_extra__: dict[str, Numeric] = Field(init=False)  # pyright: ignore

    name: Annotated[str, OneOf(registry.REFERENCES)] | None = None
    """Name of a reference."""
    python: ClassInFile | None = None
    """`file.py:Class`, the file relative to the scenario file."""
    file: str | None = None
    """CSV file of the path, relative to the scenario file; its first line names the columns, in any
    order. `waypoints` has `t`, `x`, `y`, `z`, `yaw`; `states` has `t`, the states and the inputs;
    `polynomials` has `duration`, `x^0` to `x^7`, and likewise for `y`, `z`, `yaw`."""
    degrees: bool = False
    """Whether the yaw of `waypoints` is in degrees."""

    @property
    def parameters(self) -> Mapping[str, object]:
        """The reference's parameters: numbers or nested tuples of numbers, in m, s and rad."""
        return {**(self.__pydantic_extra__ or {}), **({"degrees": True} if self.degrees else {})}


@final
class InitialSpec(BaseModel, **STRICT):
    """Where the followers start: randomly about their goals, or at given states."""

    spread: Annotated[dict[str, NotNegative] | None, Unit("the states'")] = None
    """Half-width of the spread, by state or group, in the states' units."""
    states: Annotated[dict[int, Numbers] | None, Unit("the states'")] = None
    """All states of an agent, in the states' units; the other agents start by the spread."""


@final
class DisturbanceSpec(BaseModel, **STRICT):
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
class ActuatorSpec(BaseModel, **STRICT):
    """Actuators of all agents that are not ideal; the laws know nothing of it."""

    lag: Annotated[NotNegative, Unit("s")] = 0.0
    """Time constant with which every actuator follows its command, s."""
    levels: Annotated[int, Field(ge=0, lt=2**31)] = 0
    """Number of values that a motor can be commanded between its limits; 0 for any value."""
    minimum: Annotated[NotNegative | None, Unit("the motors', mostly N")] = None
    """Least thrust of a motor, mostly N; default the lower limit."""


@final
class SensingSpec(BaseModel, **STRICT):
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
class BurstsSpec(BaseModel, **STRICT):
    """Outages of links, during which all messages on them are lost."""

    share: Annotated[Annotated[float, Field(ge=0.0, lt=1.0)], Unit("1")] = 0.0
    """Share of the time that a link is out."""
    length: Annotated[Positive, Unit("s")] = 0.2
    """Mean length of an outage, s."""


@final
class NetworkSpec(BaseModel, **STRICT):
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
class SafetySpec(BaseModel, **STRICT):
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


@final
class SimulationSpec(BaseModel, **STRICT):
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


@final
class ReportSpec(BaseModel, **STRICT):
    """What the report evaluates."""

    steady_window: Annotated[Positive, Unit("s")] = Field(default_factory=lambda: 1.0)
    """Length of the last part of the run, which counts as steady, s; default, and where it would
    not be shorter than the run, a fifth of the horizon."""
