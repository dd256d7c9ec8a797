"""Builds the parts of a checked scenario, and runs them."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast, final

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.channel import Bursts, Network
from echelon.agents.network.events import Cut, Event, Join, Lose, check_heirs, event_faults
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate, Scale
from echelon.agents.network.graph import Graph
from echelon.agents.references.guide import Guide
from echelon.agents.references.reference import Reference, check_reference
from echelon.agents.world.actuator import Actuator
from echelon.agents.world.disturbance import Disturbance
from echelon.agents.world.plant import check_plant, vary_parameters
from echelon.agents.world.sensing import Sensing
from echelon.agents.world.world import World
from echelon.core.errors import (
    EchelonError,
    FormationError,
    MissingExtraError,
    ModelError,
    ScenarioError,
    did_you_mean,
    listing,
)
from echelon.core.numerics import precision
from echelon.core.provenance import versions
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.named_class import (
    NamedClass,
    accepted,
    as_scenario_error,
    check_names,
    law_class,
    named_class,
    offered,
)
from echelon.experiments.scenario.scenario import (
    Scenario,
    ScenarioFault,
    ScenarioLike,
    as_scenario,
    refuse,
)
from echelon.experiments.scenario.sections import (
    EventSpec,
    GainSpec,
    MotionSpec,
    PlantSpec,
    ShapeKeys,
    VariationSpec,
    law_arguments,
)
from echelon.experiments.scenario.self_contained import self_contained
from echelon.experiments.scenario.values import marked_keys
from echelon.experiments.scenario.yaml import joined, quoted
from echelon.laws.law import Law
from echelon.laws.law_check import prepare_law
from echelon.laws.safety import Safety
from echelon.simulation.engine.initial import initial_states
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import check_engine, check_memory
from echelon.simulation.engine.record import Stretch
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import Keep, Progress, simulate
from echelon.simulation.step.leadership import Leadership
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import Gain, Method, synthesize
from echelon.synthesis.gains.gain_file import load_gain

_Part = TypeVar("_Part")


@final
class _Faults:
    """Collects the faults of parts, each with the place of its key."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.faults: list[ScenarioFault] = []

    @contextlib.contextmanager
    def at(self, *path: str | int) -> Iterator[None]:
        """Record an error that is raised inside, and continue."""
        try:
            yield
        except MissingExtraError:
            raise
        except EchelonError as error:
            # Of a part that is checked key by key, and then whole, each fault once.
            if str(error) not in {fault.message for fault in self.faults}:
                place = self.scenario.place(*path)
                self.faults.append(ScenarioFault(place, joined(path), str(error)))

    def part(self, make: Callable[[], _Part], *path: str | int) -> _Part:
        """Return a part; in place of one with a fault None, until `settle` raises the fault."""
        with self.at(*path):
            return make()
        return cast(_Part, None)

    def settle(self) -> None:
        """Raise all recorded faults, a line each."""
        if self.faults:
            refuse(self.faults)


class Experiment(NamedTuple):
    """The arguments of `simulate`: the parts of a scenario, and its settings."""

    parts: Parts
    settings: Settings


def build(scenario: ScenarioLike, to_run: bool = False) -> Experiment:
    """Return the parts and the settings of a scenario.

    Args:
        scenario: a scenario, its name, its file, the folder of a run, or a mapping of its keys.
        to_run: also check that a run of it would fit in memory, that its engine can step it, and
            that it has no `live` events, which `echelon run` cannot repeat.

    Raises:
        ScenarioError: one line for each part that cannot be built, with its place in the file.
        EchelonError: the engine cannot step a run of it.
    """
    scenario = as_scenario(scenario)
    faults = _Faults(scenario)
    # Gains are computed here, and would have 7 digits under float32.
    with precision("float64"):
        settings = faults.part(lambda: _settings(scenario), "simulation")
        model = faults.part(lambda: _model(scenario), "model")
        graph = faults.part(lambda: _graph(scenario), "graph")
        reference = faults.part(lambda: _reference(scenario, model), "reference")
        # Before the laws: they need the model and the graph, and would report these faults again.
        faults.settle()
        if to_run:
            # And before a gain is computed, which takes long for many agents.
            _check_run(scenario, faults, model, graph, settings)
        parts = _parts(scenario, faults, model, graph, reference)
    if to_run:
        check_engine(parts, settings)
    return Experiment(parts, settings)


def _check_run(
    scenario: Scenario, faults: _Faults, model: ControlAffine, graph: Graph, settings: Settings
) -> None:
    """Check that a scenario has no live events, and that its run fits in memory."""
    with faults.at("live"):
        if scenario.live:
            raise ScenarioError(
                f"got {len(scenario.live)} events, which only `echelon live` repeats; remove "
                "`live` to run the scenario without them."
            )
    with faults.at("simulation"):
        check_memory(model, graph.agents, settings)
    faults.settle()


def _parts(
    scenario: Scenario,
    faults: _Faults,
    model: ControlAffine,
    graph: Graph,
    reference: Guide | None,
) -> Parts:
    """Return all parts, from the model, the graph and the reference."""
    plant, plants = _plants(scenario, faults, model)
    disturbance = _disturbance(scenario, faults, model)
    leadership = _leadership(scenario, faults, graph)
    events = _events(scenario, faults, graph, leadership)
    formation = faults.part(lambda: _formation(scenario, faults, model, graph), "formation")
    follower = faults.part(lambda: _follower(scenario, faults, model, graph), "follower")
    reaction = getattr(follower, "gain", None) if scenario.leader.reacts else None
    leader = faults.part(
        lambda: _leader(scenario, faults, model, graph, reference, reaction), "leader"
    )
    for place, named in (
        (("initial", "spread"), scenario.initial.spread or {}),
        (("leader", "start_error"), scenario.leader.start_error),
    ):
        for name in named:
            with faults.at(*place, name):
                model.states_called(name)
    faults.settle()
    # Spreads by state or group, and states by agent: these are different keys.
    initial: Any = dict(scenario.initial.spread or {}) | dict(scenario.initial.states or {})
    parts = Parts(
        model,
        graph,
        formation,
        Laws(cast(Law, leader), cast(Law, follower)),
        initial=initial,
        start_error=scenario.leader.start_error,
        world=World(
            plant,
            disturbance,
            _network(scenario, faults),
            _actuator(scenario, faults, model),
            _sensing(scenario, faults, model),
            plants,
        ),
        events=events,
        leadership=leadership,
    )
    faults.settle()
    _check_world(faults, parts, scenario.simulation.dt)
    with faults.at("initial"):
        initial_states(parts, scenario.seed)
    faults.settle()
    return parts


def run(
    scenario: ScenarioLike,
    progress: Progress | None = None,
    built: Experiment | None = None,
    keep: Keep | None = None,
    before: Sequence[Stretch] = (),
) -> Result:
    """Simulate a scenario, and record in the result what it was computed from.

    Args:
        scenario: a scenario, its name, its file, the folder of a run, or a mapping of its keys.
        progress: as in `simulate`.
        built: its parts and settings, built if None.
        keep: as in `simulate`.
        before: as in `simulate`.

    Raises:
        ScenarioError: there is no such scenario, it has faults, or a part cannot be built.
    """
    scenario = as_scenario(scenario)
    parts = build(scenario) if built is None else built
    # Before the run, during which a file may change.
    origin = origin_of(scenario)
    return dataclasses.replace(simulate(*parts, progress, keep, before), **origin)


def origin_of(scenario: Scenario) -> dict[str, Any]:
    """Return the fields of a result that state its scenario, its files and the versions."""
    text, files = self_contained(scenario)
    software = {f"version_{name}": version for name, version in versions().items()}
    return {
        "provenance": {"scenario": scenario.name, "scenario_text": text, **software},
        "files": {name: file.read_bytes() for name, file in files.items()},
    }


# ---- agents, graph and formation -----------------------------------------------------------------


def _model(scenario: Scenario) -> ControlAffine:
    spec = scenario.model
    part = named_class(scenario, ControlAffine, registry.MODELS, spec.name, spec.python)
    extra = {"allow_unphysical": True} if spec.allow_unphysical else {}
    if extra and "allow_unphysical" not in accepted(part.cls):
        raise ModelError(f"`allow_unphysical` is not a parameter of `{part.name}`; leave it out.")
    parameters = spec.parameters or {}
    arguments = {"set": parameters} if isinstance(parameters, str) else {**parameters}
    if spec.file is not None:
        model = _read(part._replace(arguments={**arguments, **extra}), scenario.folder / spec.file)
        check_model(model)
        return model
    if "set" in arguments and "set" not in accepted(part.cls):
        model = _named_set(part, arguments.pop("set"), {**arguments, **extra})
    else:
        model = part._replace(arguments={**arguments, **extra}).create()
    check_model(model)
    return model


def _named_set(part: NamedClass, name: object, changes: Mapping[str, object]) -> ControlAffine:
    """Return a model with a named set of parameters, some of them changed."""
    named = getattr(part.cls, "named", None)
    if named is None:
        raise ModelError(
            f"got the parameter set {quoted(name)}, but `{part.name}` has none; give a mapping."
        )
    check_names(part.cls, part.name, changes)
    with as_scenario_error(f"`{part.name}` refuses these parameters"):
        return named(name, **changes)


def _graph(scenario: Scenario) -> Graph:
    spec = scenario.graph
    if spec.edges is not None:
        rest = spec.leaders, spec.agents, spec.directed
        if spec.schedule:
            return Graph.switching(spec.stretches, *rest, spec.period)
        return Graph.from_edges(spec.stretches[0][1], *rest)
    make = getattr(Graph, str(spec.name))
    graph = make(**offered(make, spec.model_dump(exclude_none=True)))
    return graph.one_way() if spec.directed and not graph.directed else graph


def _formation(
    scenario: Scenario, faults: _Faults, model: ControlAffine, graph: Graph
) -> Formation:
    """Return the formation of a scenario, with its motion; its faults are noted."""
    spec, starts = scenario.formation, scenario.initial.states
    formation = _shape(spec, model, graph)
    if spec.assign == "nearest":
        if not starts:
            raise FormationError(
                "`assign: nearest` needs `initial.states`: without them agents start about their "
                "own places."
            )
        n = len(model.state_names)
        whole = {agent: state for agent, state in starts.items() if len(state) == n}
        formation = formation.nearest(model, graph, whole)
    changes = list[OffsetMotion | Reshape]()
    for k, change in enumerate(spec.motion):
        with faults.at("formation", "motion", k):
            changes.append(_change(scenario, change, model, graph))
    # Of a motion with faults, which are noted, nothing else is said.
    complete = changes and len(changes) == len(spec.motion)
    return formation.moving(model, graph, changes) if complete else formation


def _change(
    scenario: Scenario, spec: MotionSpec, model: ControlAffine, graph: Graph
) -> OffsetMotion | Reshape:
    """Return a motion of the formation."""
    if spec.rotate is not None:
        return Rotate(spec.rotate)
    if spec.scale is not None:
        return Scale(spec.scale, cast(float, spec.rate))
    if spec.reshape is None:
        part = named_class(scenario, OffsetMotion, {}, None, spec.python, spec.parameters)
        return part.create()
    horizon, at = scenario.simulation.horizon, cast(float, spec.at)
    if at >= horizon:
        raise FormationError(
            f"got a reshape at {at:g} s, allowed is a time before the horizon, {horizon:g} s."
        )
    shape = _shape(spec.reshape, model, graph)
    return Reshape(shape.offsets, at, cast(float, spec.over), spec.assign == "nearest")


def _shape(spec: ShapeKeys, model: ControlAffine, graph: Graph) -> Formation:
    if spec.name is None:
        return Formation.from_offsets(model, graph, spec.offsets or {})
    make = getattr(Formation, spec.name)
    return make(model, graph, **offered(make, {"spacing": spec.spacing, "columns": spec.columns}))


# ---- laws and gains ------------------------------------------------------------------------------


def _reference(scenario: Scenario, model: ControlAffine | None) -> Guide | None:
    spec = scenario.reference
    # Files use the model's names, and a model that fails is reported by itself.
    if spec is None or model is None:
        return None
    part = named_class(
        scenario, Reference, registry.REFERENCES, spec.name, spec.python, spec.parameters
    )
    reference = (
        part.create()
        if spec.file is None
        else _read(part, scenario.folder / spec.file, model=model)
    )
    check_reference(reference)
    return reference


def _read(part: NamedClass, file: Path, **offers: object) -> Any:
    """Return a part from its file, with those of the offers that its class takes."""
    read = getattr(part.cls, "read", None)
    if read is None:
        raise ScenarioError(f"`{part.name}` does not read files; leave `file` out.")
    surplus = [name for name in part.arguments if name not in accepted(read)]
    if surplus:
        raise ScenarioError(
            f"got `file` and {listing(surplus)}, allowed is the file or the keys"
            f"{did_you_mean(surplus[0], accepted(read))}."
        )
    return read(file, **offered(read, offers), **part.arguments)


def _gain(model: ControlAffine, graph: Graph, spec: GainSpec, scenario: Scenario) -> Gain:
    if spec.file is not None:
        return load_gain(scenario.folder / spec.file, model, graph)
    part = named_class(scenario, Method, registry.METHODS, spec.method, spec.python, spec.arguments)
    method = part.create()
    with part.guard():
        return synthesize(model, graph, method)


def _follower(
    scenario: Scenario, faults: _Faults, model: ControlAffine, graph: Graph
) -> Law | None:
    spec = scenario.follower
    part = law_class(scenario, registry.FOLLOWER_LAWS, spec.law)
    _check_keys(scenario, faults, "follower", part)
    offers = law_arguments(spec) | _safety(scenario, faults, part)
    if "gain" in accepted(part.cls):
        with faults.at("follower", "gain"):
            offers["gain"] = _gain(model, graph, spec.gain, scenario)
        if "gain" not in offers:
            return None
    return _law(part, offers, model, graph)


def _safety(scenario: Scenario, faults: _Faults, part: NamedClass) -> dict[str, Safety]:
    """Return how followers keep apart; nothing where they do not."""
    if scenario.safety is None:
        return {}
    with faults.at("safety"):
        if "safety" not in accepted(part.cls):
            raise ScenarioError(
                f"got `safety`, but the law `{part.name}` moves agents by their states, for which "
                "there is no proof; use `stopping-point`."
            )
        return {"safety": Safety(**scenario.safety.model_dump())}
    return {}


def _check_keys(scenario: Scenario, faults: _Faults, role: str, part: NamedClass) -> None:
    """Note the keys of a role that its law, a class of the user, does not take."""
    taken = accepted(part.cls)
    section = scenario.leader if role == "leader" else scenario.follower
    for key in marked_keys(type(section)):
        if key in section.model_fields_set and key not in taken:
            with faults.at(role, key):
                raise ScenarioError(
                    f"got a key that the law `{part.name}` does not take, allowed are the "
                    "arguments of its class."
                )


def _law(part: NamedClass, offers: Mapping[str, object], model: ControlAffine, graph: Graph) -> Law:
    """Return the law of a scenario, completed and checked."""
    law = part.create(offers)
    with part.guard():
        return prepare_law(law, model, graph)


def _leader(
    scenario: Scenario,
    faults: _Faults,
    model: ControlAffine,
    graph: Graph,
    reference: Guide | None,
    reaction: Gain | None,
) -> Law | None:
    spec = scenario.leader
    part = law_class(scenario, registry.LEADER_LAWS, spec.law)
    _check_keys(scenario, faults, "leader", part)
    if spec.reacts and "reaction" not in accepted(part.cls):
        raise ScenarioError(
            f"`reacts` is true, but the law `{part.name}` cannot react to neighbours; use "
            "`tracking`."
        )
    if spec.reacts and reaction is None:
        raise ScenarioError("`reacts` needs a follower law with a gain, but this law has none.")
    if reference is not None and "reference" not in accepted(part.cls):
        raise ScenarioError(f"got a `reference`, but the law `{part.name}` takes none.")
    offers = {
        "reference": reference,
        "reaction": reaction,
        "start_error": spec.start_error,
        "horizon": scenario.simulation.horizon,
        "limits": scenario.simulation.limits,
        **law_arguments(spec),
        # All agents have the same inner loop, unless the file says otherwise.
        **spec.inner_loop(scenario.follower),
    }
    if spec.gain is not None:
        with faults.at("leader", "gain"):
            offers["gain"] = _gain(model, graph, spec.gain, scenario)
        if "gain" not in offers:
            return None
    return _law(part, offers, model, graph)


# ---- the world, and how it is computed -----------------------------------------------------------


def _plants(
    scenario: Scenario, faults: _Faults, model: ControlAffine
) -> tuple[ControlAffine | None, dict[int, ControlAffine]]:
    """Return the agents that move, where they differ from the model: all, and single ones."""
    spec = scenario.plant
    if spec is None:
        return None, {}

    def varied(part: VariationSpec | PlantSpec) -> ControlAffine:
        plant = vary_parameters(model, part.parameters, part.scale)
        check_model(plant)
        check_plant(model, plant)
        return plant

    plants = {
        k: faults.part(lambda part=part: varied(part), "plant", "agents", k)
        for k, part in spec.agents.items()
    }
    alike = spec.agents and not (spec.parameters or spec.scale)
    return (None if alike else faults.part(lambda: varied(spec), "plant")), plants


def _disturbance(scenario: Scenario, faults: _Faults, model: ControlAffine) -> Disturbance | None:
    """Return wind and noise; None without."""
    spec = scenario.disturbance
    if spec is None:
        return None
    for key in ("constant", "rms", "input_rms"):
        with faults.at("disturbance", key):
            # Each alone, so that its fault is reported at its own line.
            Disturbance(**{key: getattr(spec, key)}).prepared(model, scenario.simulation.dt, 0)
    disturbance = None
    with faults.at("disturbance"):
        numbers: dict[str, Any] = spec.model_dump() | {"air": spec.air or ()}
        disturbance = Disturbance(**numbers)
        disturbance.prepared(model, scenario.simulation.dt, 0)
    return disturbance


def _actuator(scenario: Scenario, faults: _Faults, model: ControlAffine) -> Actuator | None:
    """Return the actuators; None for ideal ones."""
    spec = scenario.actuator
    if spec is None:
        return None
    actuator = None
    with faults.at("actuator"):
        actuator = Actuator(**spec.model_dump())
        actuator.prepared(model)
    return actuator


def _sensing(scenario: Scenario, faults: _Faults, model: ControlAffine) -> Sensing | None:
    """Return what agents measure; None for exact states."""
    spec = scenario.sensing
    if spec is None:
        return None
    sensing, simulation = None, scenario.simulation
    with faults.at("sensing", "noise"):
        model.per_state(spec.noise)
    with faults.at("sensing"):
        sensing = Sensing(**spec.model_dump())
        sensing.prepared(model, simulation.dt, simulation.horizon, 0)
    return sensing


def _network(scenario: Scenario, faults: _Faults) -> Network | None:
    """Return the network; None for the ideal one."""
    spec, simulation = scenario.network, scenario.simulation
    if spec is None:
        return None
    network = None
    with faults.at("network"):
        numbers: dict[str, Any] = spec.model_dump()
        numbers["bursts"] = Bursts(**numbers["bursts"])
        network = Network(**numbers)
        network.prepared(simulation.dt, simulation.horizon, scenario.seed)
    return network


def _leadership(scenario: Scenario, faults: _Faults, graph: Graph) -> Leadership | None:
    """Return who takes the lead after the leader; None for nobody."""
    spec = scenario.leadership
    if spec is None:
        return None
    leadership = None
    with faults.at("leadership", "heirs"):
        check_heirs(graph, spec.heirs)
        leadership = Leadership(**spec.model_dump())
    faults.settle()
    return leadership


def _events(
    scenario: Scenario, faults: _Faults, graph: Graph, leadership: Leadership | None
) -> list[Event]:
    """Return what happens during the run; a fault is noted at its event."""
    events = [_event(spec) for spec in scenario.events]
    heirs = () if leadership is None else leadership.heirs
    for k, text in event_faults(graph, events, heirs, scenario.simulation.horizon):
        with faults.at("events", k):
            raise ScenarioError(f"{text}.")
    faults.settle()
    return events


def _event(spec: EventSpec) -> Event:
    if spec.cut is not None:
        return Cut(spec.cut, spec.at, spec.duration)
    if spec.join is not None:
        return Join(spec.join, spec.at)
    assert spec.lose is not None, "the schema holds that there is one of three"
    return Lose(spec.lose, spec.at)


def _check_world(faults: _Faults, parts: Parts, dt: float) -> None:
    """Record what of a world does not suit the agents or their laws."""
    with faults.at("plant", "agents"):
        parts.world.check_agents(parts.model, parts.graph.agents)
    with faults.at("leadership"):
        parts.drive.check_heirs(parts.graph)
        if parts.leadership is not None:
            parts.leadership.check_network(parts.world.network)
    with faults.at("network"):
        parts.drive.check_world(parts.world, parts.graph, dt)


def _settings(scenario: Scenario) -> Settings:
    numbers, window = scenario.simulation.model_dump(), scenario.report.steady_window
    return Settings(**numbers, seed=scenario.seed, steady_window=window)
