"""Builds the parts of a checked scenario, and runs them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import check_model
from echelon.agents.network.graph import Graph
from echelon.agents.references.reference import Guide, Reference, check_reference
from echelon.agents.world.world import World
from echelon.core.errors import ModelError, ScenarioError, did_you_mean, listing
from echelon.core.files import versions
from echelon.core.numerics import precision
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.checks import ROLES, section
from echelon.experiments.scenario.fault_list import FaultList
from echelon.experiments.scenario.formation_parts import formation_of
from echelon.experiments.scenario.law_sections import GainSpec, law_arguments
from echelon.experiments.scenario.named_class import (
    NamedClass,
    accepted,
    check_names,
    law_class,
    named_class,
    offered,
)
from echelon.experiments.scenario.scenario import Scenario, ScenarioLike, as_scenario
from echelon.experiments.scenario.self_contained import self_contained
from echelon.experiments.scenario.user_code import as_scenario_error
from echelon.experiments.scenario.values import marked_keys
from echelon.experiments.scenario.world_parts import (
    actuator_of,
    check_world,
    disturbance_of,
    events_of,
    leadership_of,
    network_of,
    plants_of,
    sensing_of,
)
from echelon.experiments.scenario.yaml import quoted
from echelon.laws.law import Law
from echelon.laws.law_check import prepare_law
from echelon.laws.safety import Safety
from echelon.simulation.engine.law_drive import Laws
from echelon.simulation.engine.parts import Parts, initial_states
from echelon.simulation.engine.prepare import check_engine, check_memory
from echelon.simulation.engine.record import Stretch
from echelon.simulation.engine.result import Result
from echelon.simulation.engine.simulate import Keep, Progress, simulate
from echelon.simulation.step.settings import Settings
from echelon.synthesis.gains.gain import Gain, Method, synthesize
from echelon.synthesis.gains.gain_file import load_gain


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
    faults = FaultList(scenario)
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
    scenario: Scenario, faults: FaultList, model: ControlAffine, graph: Graph, settings: Settings
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
    faults: FaultList,
    model: ControlAffine,
    graph: Graph,
    reference: Guide | None,
) -> Parts:
    """Return all parts, from the model, the graph and the reference."""
    plant, plants = plants_of(scenario, faults, model)
    disturbance = disturbance_of(scenario, faults, model)
    leadership = leadership_of(scenario, faults, graph)
    events = events_of(scenario, faults, graph, leadership)
    formation = faults.part(lambda: formation_of(scenario, faults, model, graph), "formation")
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
            network_of(scenario, faults),
            actuator_of(scenario, faults, model),
            sensing_of(scenario, faults, model),
            plants,
        ),
        events=events,
        leadership=leadership,
    )
    faults.settle()
    check_world(faults, parts, scenario.simulation.dt)
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
    scenario: Scenario, faults: FaultList, model: ControlAffine, graph: Graph
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


def _safety(scenario: Scenario, faults: FaultList, part: NamedClass) -> dict[str, Safety]:
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


def _check_keys(scenario: Scenario, faults: FaultList, role: str, part: NamedClass) -> None:
    """Note the keys of a role that its law, a class of the user, does not take."""
    taken = accepted(part.cls)
    for key in marked_keys(ROLES[role][0]):
        if key in section(scenario.data, role) and key not in taken:
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
    faults: FaultList,
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


def _settings(scenario: Scenario) -> Settings:
    numbers, window = scenario.simulation.model_dump(), scenario.report.steady_window
    return Settings(**numbers, seed=scenario.seed, steady_window=window)
