"""Builds the parts of a checked scenario, and runs them."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast, final

import numpy as np

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.models.unlike import UnlikeAgents
from echelon.agents.network.channel import Bursts, Network
from echelon.agents.network.events import Cut, Join, Lose, check_backups, event_faults
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate, Scale
from echelon.agents.network.graph import Graph
from echelon.agents.part import Event, WorldPart
from echelon.agents.references.reference import LeaderPath, Reference, check_reference
from echelon.agents.references.slowed_path import slowed
from echelon.agents.world.actuator import Actuator
from echelon.agents.world.disturbance import Disturbance
from echelon.agents.world.sensing import Sensing
from echelon.agents.world.world import World, check_plant, vary_parameters
from echelon.core.errors import (
    EchelonError,
    FormationError,
    MissingExtraError,
    ModelError,
    ReferenceError,
    ScenarioError,
    did_you_mean,
    listing,
)
from echelon.core.files import versions
from echelon.core.numerics import precision
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.named_class import (
    NOTHING,
    NamedClass,
    accepted,
    as_scenario_error,
    check_names,
    offered,
    resolve,
    user_class,
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
    FollowerSpec,
    GainSpec,
    GraphSpec,
    LeaderSpec,
    ModelSpec,
    MotionSpec,
    PlantSpec,
    ShapeKeys,
    UserClass,
    VariationSpec,
    law_arguments,
)
from echelon.experiments.scenario.self_contained import self_contained
from echelon.experiments.scenario.values import marked_keys
from echelon.experiments.scenario.yaml import joined, quoted
from echelon.laws.law import Law
from echelon.laws.law_check import prepare_law
from echelon.laws.safety import Safety
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts, initial_states
from echelon.simulation.engine.prepare import check_engine, check_memory
from echelon.simulation.engine.record import Segment
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import Keep, Progress, simulate
from echelon.simulation.step.leadership import Leadership
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import Gain, Method, synthesize
from echelon.synthesis.gains.gain_file import load_gain

_Part = TypeVar("_Part")


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
    # Gains are computed here, and would have 7 digits under float32.
    with precision("float64"):
        builder = _Builder(scenario)
        if to_run:
            # Before a gain is computed, which takes long for many agents.
            builder.check_run()
        parts = builder.parts()
    if to_run:
        check_engine(parts, builder.settings)
    return Experiment(parts, builder.settings)


def run(
    scenario: ScenarioLike,
    progress: Progress | None = None,
    built: Experiment | None = None,
    keep: Keep | None = None,
    before: Sequence[Segment] = (),
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


@final
class _Builder:
    def __init__(self, scenario: Scenario) -> None:
        """Build what all other parts need, whose faults they would report again."""
        self.scenario, self.faults = scenario, list[ScenarioFault]()
        self.remarks = list[str]()
        numbers, window = scenario.simulation.model_dump(), scenario.report.steady_window
        self.settings = self.part(
            lambda: Settings(**numbers, seed=scenario.seed, steady_window=window), "simulation"
        )
        self.model = self.part(self._agents, "agents" if scenario.agents else "model")
        self.graph = self.part(lambda: _graph(scenario.graph, scenario.folder), "graph")
        self.reference = self.part(self._reference, "reference")
        self.settle()
        if isinstance(self.model, UnlikeAgents):
            with self.at("agents"):
                self.model.check_count(self.graph.agents)
            self.settle()

    @contextlib.contextmanager
    def at(self, *path: str | int) -> Iterator[None]:
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

    def check_run(self) -> None:
        with self.at("live"):
            if self.scenario.live:
                raise ScenarioError(
                    f"got {len(self.scenario.live)} events, which only `echelon live` repeats; "
                    "remove `live` to run the scenario without them."
                )
        with self.at("simulation"):
            check_memory(self.model, self.graph.agents, self.settings)
        self.settle()

    def parts(self) -> Parts:
        scenario, model = self.scenario, self.model
        world, leadership = self._world(), self._leadership()
        events = self._events(leadership)
        formation = self.part(self._formation, "formation")
        follower = self.part(self._follower, "follower")
        reaction = getattr(follower, "gain", None) if scenario.leader.reacts else None
        leader = self.part(lambda: self._leader(reaction), "leader")
        spread, start_error = scenario.initial.spread or {}, scenario.leader.start_error
        places = (("initial", "spread"), spread), (("leader", "start_error"), start_error)
        for place, named in places:
            for name in named:
                with self.at(*place, name):
                    model.states_called(name)
        self.settle()
        # Spreads by state or group, and states by agent: these are different keys.
        initial: Any = dict(spread) | self._starts()
        laws = Laws(cast(Law, leader), cast(Law, follower))
        parts = Parts(
            *(model, self.graph, formation, laws),
            initial=initial,
            start_error=start_error,
            world=world,
            events=events,
            leadership=leadership,
        )
        with self.at("plant", "agents"):
            world.check_agents(model, self.graph.agents)
        with self.at("leadership"):
            laws.check_backups(parts.graph)
            if leadership is not None:
                leadership.check_network(world.network)
        for part in world.all_parts:
            with self.at(part.key or "parts"):
                part.check_laws(laws, parts.graph, scenario.simulation.dt)
        with self.at("initial"):
            initial_states(parts, scenario.seed)
        self.settle()
        return parts

    # ---- agents and formation ----

    def _starts(self) -> dict[int, Any]:
        """Return the given starts by agent; of unlike agents each by the states of its group."""
        given, model = self.scenario.initial.states or {}, self.model
        if not isinstance(model, UnlikeAgents):
            return dict(given)
        return {agent: model.start_of(agent, state) for agent, state in given.items()}

    def _class(
        self,
        kind: type,
        table: Mapping[str, registry.Entry],
        name: str | None,
        python: str | None,
        arguments: Mapping[str, object] = NOTHING,
    ) -> NamedClass:
        if python is not None:
            cls = user_class(self.scenario.folder, python, kind)
            return NamedClass(cls, python, arguments, by_user=True)
        return NamedClass(resolve(table[str(name)]), str(name), arguments, by_user=False)

    def _agents(self) -> ControlAffine:
        """Return the model of all agents, or of all groups of unlike ones."""
        scenario, groups = self.scenario, list[tuple[str, int, ControlAffine]]()
        if scenario.agents is None:
            return self._model(cast(ModelSpec, scenario.model))
        for k, group in enumerate(scenario.agents):
            with self.at("agents", k, "model"):
                name = group.name or group.model.name or str(group.model.python).partition(":")[2]
                groups.append((name, group.count, self._model(group.model)))
        # A fault of a group is noted, and of the others nothing else is said.
        self.settle()
        total, leader = sum(group.count for group in scenario.agents), scenario.graph.leaders[0]
        model = UnlikeAgents.of(groups, leader if leader < total else 0)
        check_model(model)
        return model

    def _model(self, spec: ModelSpec) -> ControlAffine:
        part = self._class(ControlAffine, registry.MODELS, spec.name, spec.python)
        extra = {"allow_unphysical": True} if spec.allow_unphysical else {}
        if extra and "allow_unphysical" not in accepted(part.cls):
            raise ModelError(
                f"`allow_unphysical` is not a parameter of `{part.name}`; leave it out."
            )
        parameters = spec.parameters or {}
        arguments = {"set": parameters} if isinstance(parameters, str) else {**parameters}
        part = part._replace(arguments={**arguments, **extra})
        if spec.file is not None:
            model = _read(part, self.scenario.folder / spec.file)
        elif "set" in arguments and "set" not in accepted(part.cls):
            model = _named_set(part, arguments.pop("set"), {**arguments, **extra})
        else:
            model = part.create()
        check_model(model)
        return model

    def _reference(self) -> LeaderPath | None:
        spec = self.scenario.reference
        # Files use the model's names, and a model that fails is reported by itself.
        if spec is None or self.model is None:
            return None
        part = self._class(Reference, registry.REFERENCES, spec.name, spec.python, spec.parameters)
        file = None if spec.file is None else self.scenario.folder / spec.file
        reference = part.create() if file is None else _read(part, file, model=self.model)
        check_reference(reference)
        reference = slowed(reference, spec.slowdown)
        _check_span(reference, self.scenario.simulation.horizon)
        return reference

    def _formation(self) -> Formation:
        spec = self.scenario.formation
        formation = self._shape(spec, spec.assign)
        if spec.assign == "nearest":
            formation = self._nearest(formation)
        changes = list[OffsetMotion | Reshape]()
        for k, change in enumerate(spec.motion):
            with self.at("formation", "motion", k):
                changes.append(self._change(change))
        # Of a motion with faults, which are noted, nothing else is said.
        if changes and len(changes) == len(spec.motion):
            formation = formation.moving(self.model, self.graph, changes)
        # Of all shapes, those of reshapes too.
        return Formation(formation.offsets, formation.motion, (*dict.fromkeys(self.remarks),))

    def _nearest(self, formation: Formation) -> Formation:
        """Return a formation whose places are exchanged by `assign: nearest`."""
        starts = self._starts()
        if not starts:
            raise FormationError(
                "`assign: nearest` needs `initial.states`: without them agents start about "
                "their own places."
            )
        n = len(self.model.state_names)
        whole = {agent: state for agent, state in starts.items() if len(state) == n}
        return formation.nearest(self.model, self.graph, whole)

    def _change(self, spec: MotionSpec) -> OffsetMotion | Reshape:
        if spec.rotate is not None:
            return Rotate(spec.rotate)
        if spec.scale is not None:
            return Scale(spec.scale, cast(float, spec.rate))
        if spec.reshape is None:
            return self._class(OffsetMotion, {}, None, spec.python, spec.parameters).create()
        horizon, at = self.scenario.simulation.horizon, cast(float, spec.at)
        if at >= horizon:
            raise FormationError(
                f"got a reshape at {at:g} s, allowed is a time before the horizon, {horizon:g} s."
            )
        offsets = self._shape(spec.reshape, spec.assign).offsets
        return Reshape(offsets, at, cast(float, spec.over), spec.assign == "nearest")

    def _shape(self, spec: ShapeKeys, assign: str) -> Formation:
        if spec.distances is not None:
            if assign == "nearest":
                raise FormationError(
                    "`assign: nearest` exchanges places, and `distances` are of agents by number."
                )
            n = len(self.model.state_names)
            axes, starts = list(self.model.position_indices()), self._starts()
            whole = [starts.get(k, ()) for k in range(self.graph.agents)]
            known = all(len(state) == n for state in whole)
            near = np.array(whole, float)[:, axes] if known else None
            found = Formation.from_distances(self.model, self.graph, spec.distances, near)
            self.remarks += found.remarks
            return found
        if spec.name is None:
            return Formation.from_offsets(self.model, self.graph, spec.offsets or {})
        make, sizes = getattr(Formation, spec.name), {"spacing": spec.spacing}
        return make(self.model, self.graph, **offered(make, {**sizes, "columns": spec.columns}))

    # ---- laws and gains ----

    def _gain(self, spec: GainSpec) -> Gain:
        if spec.file is not None:
            return load_gain(self.scenario.folder / spec.file, self.model, self.graph)
        part = self._class(Method, registry.METHODS, spec.method, spec.python, spec.arguments)
        method = part.create()
        with part.guard():
            return synthesize(self.model, self.graph, method)

    def _law_class(
        self, role: str, table: Mapping[str, registry.Entry], spec: LeaderSpec | FollowerSpec
    ) -> NamedClass:
        """Return the law of a role; keys that a class of the user does not take are noted."""
        law = spec.law
        if not isinstance(law, UserClass):
            return self._class(Law, table, law, None)
        part = self._class(Law, table, None, law.python, law.parameters)
        taken = accepted(part.cls)
        keys = (key for key in marked_keys(type(spec)) if key in spec.model_fields_set)
        for key in (key for key in keys if key not in taken):
            with self.at(role, key):
                raise ScenarioError(
                    f"got a key that the law `{part.name}` does not take, allowed are the "
                    "arguments of its class."
                )
        return part

    def _law(
        self, role: str, part: NamedClass, offers: dict[str, object], spec: GainSpec | None
    ) -> Law | None:
        """Return a law, completed and checked; None where its gain is noted as a fault."""
        if spec is not None and "gain" in accepted(part.cls):
            with self.at(role, "gain"):
                offers["gain"] = self._gain(spec)
            if "gain" not in offers:
                return None
        law = part.create(offers)
        with part.guard():
            return prepare_law(law, self.model, self.graph)

    def _follower(self) -> Law | None:
        spec, safety = self.scenario.follower, self.scenario.safety
        part = self._law_class("follower", registry.FOLLOWER_LAWS, spec)
        offers = law_arguments(spec)
        if safety is not None:
            with self.at("safety"):
                if "safety" not in accepted(part.cls):
                    raise ScenarioError(
                        f"got `safety`, but the law `{part.name}` moves agents by their states, "
                        "for which there is no proof; use `stopping-point`."
                    )
                offers["safety"] = Safety(**safety.model_dump())
        return self._law("follower", part, offers, spec.gain)

    def _leader(self, reaction: Gain | None) -> Law | None:
        spec, simulation = self.scenario.leader, self.scenario.simulation
        part = self._law_class("leader", registry.LEADER_LAWS, spec)
        if spec.reacts and "reaction" not in accepted(part.cls):
            raise ScenarioError(
                f"`reacts` is true, but the law `{part.name}` cannot react to neighbours; use "
                "`tracking`."
            )
        if spec.reacts and reaction is None:
            raise ScenarioError("`reacts` needs a follower law with a gain, but this law has none.")
        if self.reference is not None and "reference" not in accepted(part.cls):
            raise ScenarioError(f"got a `reference`, but the law `{part.name}` takes none.")
        offers = {
            "reference": self.reference,
            "reaction": reaction,
            "start_error": spec.start_error,
            "horizon": simulation.horizon,
            "limits": simulation.limits,
            **law_arguments(spec),
            # All agents have the same inner loop, unless the file says otherwise.
            **spec.inner_loop(self.scenario.follower),
        }
        return self._law("leader", part, offers, spec.gain)

    # ---- the world, and what happens ----

    def _world(self) -> World:
        scenario, model, simulation = self.scenario, self.model, self.scenario.simulation
        dt, horizon = simulation.dt, simulation.horizon
        plant, plants = self._plants()
        if (wind := scenario.disturbance) is not None:
            for key in ("constant", "rms", "input_rms"):
                with self.at("disturbance", key):
                    # Each alone, so that its fault is reported at its own line.
                    Disturbance(**{key: getattr(wind, key)}).prepared(model, dt, 0)
        if scenario.sensing is not None:
            with self.at("sensing", "noise"):
                model.per_state(scenario.sensing.noise)

        def checked(name: str, kind: type, *given: object, **changes: object) -> Any:
            """Return a part of the world whose numbers suit the run; None without its section."""

            def make() -> Any:
                part = kind(**spec.model_dump() | changes)
                part.prepared(*given)
                return part

            spec = getattr(scenario, name)
            return None if spec is None else self.part(make, name)

        network = scenario.network
        bursts = {} if network is None else {"bursts": Bursts(**network.bursts.model_dump())}
        air = {} if wind is None else {"air": wind.air or ()}
        return World(
            plant,
            checked("disturbance", Disturbance, model, dt, 0, **air),
            checked("network", Network, dt, horizon, scenario.seed, **bursts),
            checked("actuator", Actuator, model),
            checked("sensing", Sensing, model, dt, horizon, 0),
            plants,
            tuple(own for k, spec in enumerate(scenario.parts) for own in self._own_part(k, spec)),
        )

    def _own_part(self, k: int, spec: UserClass) -> Iterator[WorldPart]:
        """Yield a part of the user's, unless its fault is noted."""
        with self.at("parts", k):
            part = self._class(WorldPart, {}, None, spec.python, spec.parameters).create()
            for fault in part.faults(self.model, self.graph.agents):
                raise ScenarioError(fault)
            yield part

    def _plants(self) -> tuple[ControlAffine | None, dict[int, ControlAffine]]:
        """Return the agents that move, where they differ from the model: all, and single ones."""
        spec = self.scenario.plant
        if spec is None:
            return None, {}
        if isinstance(self.model, UnlikeAgents):
            with self.at("plant"):
                text = "`plant` is of agents of one model; give groups other `parameters`"
                raise ModelError(f"{text} under `agents`.")

        def varied(part: VariationSpec | PlantSpec) -> ControlAffine:
            plant = vary_parameters(self.model, part.parameters, part.scale)
            check_model(plant)
            check_plant(self.model, plant)
            return plant

        plants = {
            k: self.part(lambda part=part: varied(part), "plant", "agents", k)
            for k, part in spec.agents.items()
        }
        alike = spec.agents and not (spec.parameters or spec.scale)
        return (None if alike else self.part(lambda: varied(spec), "plant")), plants

    def _leadership(self) -> Leadership | None:
        spec, leadership = self.scenario.leadership, None
        if spec is not None:
            with self.at("leadership", "backups"):
                check_backups(self.graph, spec.backups)
                leadership = Leadership(**spec.model_dump())
            self.settle()
        return leadership

    def _events(self, leadership: Leadership | None) -> list[Event]:
        specs = enumerate(self.scenario.events)
        events = [self.part(lambda spec=spec: self._event(spec), "events", k) for k, spec in specs]
        self.settle()
        backups = () if leadership is None else leadership.backups
        for k, text in event_faults(self.graph, events, backups, self.scenario.simulation.horizon):
            with self.at("events", k):
                raise ScenarioError(f"{text}.")
        self.settle()
        return events

    def _event(self, spec: EventSpec) -> Event:
        if spec.cut is not None:
            return Cut(spec.cut, spec.at, spec.duration)
        if spec.join is not None:
            return Join(spec.join, spec.at)
        if spec.lose is not None:
            return Lose(spec.lose, spec.at)
        own = {"at": spec.at, **spec.parameters}
        return self._class(Event, {}, None, spec.python, own).create()


def _graph(spec: GraphSpec, folder: Path) -> Graph:
    if spec.file is not None:
        return Graph.read(folder / spec.file, spec.leaders, spec.directed or None)
    if spec.edges is not None:
        rest = spec.leaders, spec.agents, spec.directed
        if spec.schedule:
            return Graph.switching(spec.stretches, *rest, spec.period)
        return Graph.from_edges(spec.stretches[0][1], *rest)
    make = getattr(Graph, str(spec.name))
    graph = make(**offered(make, spec.model_dump(exclude_none=True)))
    return graph.one_way() if spec.directed and not graph.directed else graph


def _check_span(reference: LeaderPath, horizon: float) -> None:
    """Refuse a path of which nothing lies within the run."""
    first, last = reference.span()
    if first < horizon and last > 0.0:
        return
    when = f"begins at {first:.10g} s" if first > 0.0 else f"ends at {last:.10g} s"
    raise ReferenceError(
        f"the path {when}, and the run is from 0 to {horizon:g} s; for a path from a file give "
        "`begin: 0`, or the unit of its times, as in `t [ms]`."
    )


def _named_set(part: NamedClass, name: object, changes: Mapping[str, object]) -> ControlAffine:
    named = getattr(part.cls, "named", None)
    if named is None:
        raise ModelError(
            f"got the parameter set {quoted(name)}, but `{part.name}` has none; give a mapping."
        )
    check_names(part.cls, part.name, changes)
    with as_scenario_error(f"`{part.name}` refuses these parameters"):
        return named(name, **changes)


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
