"""From a checked scenario to parts, and from parts to a run.

Names are looked up in the registry alone.
"""

import contextlib
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from echelon.core.errors import (
    EchelonError,
    MissingExtraError,
    ModelError,
    ScenarioError,
    did_you_mean,
    listing,
)
from echelon.core.numerics import precision
from echelon.core.provenance import versions
from echelon.engine.initial import initial_states
from echelon.engine.laws import Laws
from echelon.engine.parts import Parts
from echelon.engine.prepare import check_memory
from echelon.engine.record import Stretch
from echelon.engine.result import Result
from echelon.engine.settings import Settings
from echelon.engine.simulate import Keep, Progress, simulate
from echelon.gains.file import load_gain
from echelon.gains.gain import Gain, synthesize
from echelon.laws.law import Law
from echelon.models.check import check_model
from echelon.models.model import ControlAffine
from echelon.network.formation import Formation
from echelon.network.graph import Graph
from echelon.scenario import registry
from echelon.scenario.scenario import Fault, Scenario, refuse
from echelon.scenario.sections import GainSpec
from echelon.scenario.yaml import joined
from echelon.world.disturbance import Disturbance
from echelon.world.plant import check_plant, vary_parameters
from echelon.world.world import World


class Built(NamedTuple):
    """What `simulate` takes: the parts of a scenario, and how it is computed."""

    parts: Parts
    settings: Settings


class _Faults:
    """Collects the faults of parts, each with the place of the key that made it."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.found: list[Fault] = []

    @contextlib.contextmanager
    def at(self, *path: str | int) -> Iterator[None]:
        """Note an error that is raised inside, and go on."""
        try:
            yield
        except MissingExtraError:
            raise
        except EchelonError as error:
            self.found.append(Fault(self.scenario.place(*path), joined(path), str(error)))

    def settle(self) -> None:
        """Raise all that was noted, a line each."""
        if self.found:
            refuse(self.found)


def build(scenario: Scenario) -> Built:
    """Return the parts and the settings of a scenario.

    Raises:
        ScenarioError: one line for each part that cannot be made, with its place in the file.
    """
    faults = _Faults(scenario)
    with precision("float64"):
        model = graph = None
        with faults.at("simulation"):
            _settings(scenario).check()
        with faults.at("model"):
            model = _model(scenario)
            check_model(model)
        with faults.at("graph"):
            graph = _graph(scenario)
        reference = None
        with faults.at("reference"):
            reference = _reference(scenario)
        faults.settle()
        return _with_laws(
            scenario, faults, cast(ControlAffine, model), cast(Graph, graph), reference
        )


def _with_laws(
    scenario: Scenario, faults: _Faults, model: ControlAffine, graph: Graph, reference: Any
) -> Built:
    """Return all parts, with those that need a model and a graph, with these."""
    formation = leader = follower = plant = None
    with faults.at("plant"):
        plant = _plant(scenario, model)
    disturbance = _disturbance(scenario, faults, model)
    with faults.at("formation"):
        formation = _formation(scenario, model, graph)
    with faults.at("follower"):
        follower = _follower(scenario, faults, model, graph)
    with faults.at("leader"):
        reaction = getattr(follower, "gain", None) if scenario.leader.reacts else None
        leader = _leader(scenario, faults, model, graph, reference, reaction)
    for section, named in (
        (("initial", "spread"), scenario.initial.spread or {}),
        (("leader", "start_error"), scenario.leader.start_error),
    ):
        for name in named:
            with faults.at(*section, name):
                model.states_called(name)
    faults.settle()
    parts = Parts(
        model,
        graph,
        cast(Formation, formation),
        Laws(cast(Law, leader), cast(Law, follower)),
        initial=scenario.initial.states or scenario.initial.spread or {},
        start_error=scenario.leader.start_error,
        world=World(plant, disturbance),
    )
    with faults.at("initial"):
        initial_states(parts, scenario.seed)
    faults.settle()
    return Built(parts, _settings(scenario))


def check_size(scenario: Scenario, built: Built) -> None:
    """Check that what a run of a scenario stores has room; what only looks at it stores nothing.

    Raises:
        ScenarioError: it has not.
    """
    faults = _Faults(scenario)
    with faults.at("simulation"):
        check_memory(*built)
    faults.settle()


def run(
    scenario: Scenario,
    progress: Progress | None = None,
    built: Built | None = None,
    keep: Keep | None = None,
    before: Sequence[Stretch] = (),
) -> Result:
    """Simulate a scenario, built unless its parts are given, and note where the result comes from.

    `progress`, `keep` and `before` are those of `simulate`.

    Raises:
        ScenarioError: a part cannot be made.
    """
    parts = build(scenario) if built is None else built
    return note_origin(simulate(*parts, progress, keep, before), scenario)


def note_origin(result: Result, scenario: Scenario) -> Result:
    """Return a result with its scenario and the versions of what computed it."""
    told = {f"version_{name}": text for name, text in versions().items()}
    return result.with_provenance(scenario=scenario.name, scenario_text=scenario.text, **told)


# ---- parts --------------------------------------------------------------------------------------


def resolve(entry: registry.Entry) -> Any:
    """Return what a registry entry names."""
    module, _, name = entry.target.partition(":")
    return getattr(importlib.import_module(module), name)


def _accepted(make: Callable[..., Any]) -> list[str]:
    """Return the names of the parameters that a class or function takes."""
    return list(inspect.signature(make).parameters)


def _offered(make: Callable[..., Any], offers: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the offers that `make` takes."""
    return {name: offers[name] for name in _accepted(make) if name in offers}


def _checked(make: Callable[..., Any], what: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the given parameters, after checking that `make` takes each and has all it needs."""
    allowed = inspect.signature(make).parameters
    for name in given:
        if name not in allowed:
            verb = "is" if len(allowed) == 1 else "are"
            taken = f"allowed {verb} {listing(allowed)}" if allowed else "it takes none"
            raise ScenarioError(
                f"got the parameter `{name}` of `{what}`, {taken}{did_you_mean(name, allowed)}."
            )
    for name, parameter in allowed.items():
        if parameter.default is inspect.Parameter.empty and name not in given:
            raise ScenarioError(f"`{what}` needs the parameter `{name}`, which is missing.")
    return dict(given)


def _model(scenario: Scenario) -> ControlAffine:
    spec = scenario.model
    if spec.python:
        cls, what = _user_class(scenario.folder, spec.python), spec.python
    else:
        cls, what = resolve(registry.MODELS[str(spec.name)]), str(spec.name)
    extra = {"allow_unphysical": True} if spec.allow_unphysical else {}
    if extra and "allow_unphysical" not in _accepted(cls):
        raise ModelError(
            f"`allow_unphysical` has no meaning for `{what}`, which has no such parameter."
        )
    if isinstance(spec.parameters, str):
        named = getattr(cls, "named", None)
        if named is None:
            raise ModelError(
                f"`{what}` has no named parameter sets, and got `{spec.parameters}`; "
                "give a mapping."
            )
        return named(spec.parameters, **extra)
    try:
        return cls(**_checked(cls, what, {**(spec.parameters or {}), **extra}))
    except (TypeError, ValueError) as error:
        raise ModelError(
            f"`{what}` cannot be made with these parameters: {_first_line(error)}."
        ) from error


def _user_class(folder: Path, target: str) -> type[ControlAffine]:
    """Return a model class from a user's file, `file.py:Class`."""
    path, _, name = target.rpartition(":")
    file = (folder / path).resolve()
    if not file.is_file():
        raise ModelError(
            f"the file `{file}` does not exist; a `python` path is relative to the scenario file."
        )
    spec = importlib.util.spec_from_file_location(f"echelon_user_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise ModelError(f"the file `{file}` is no Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    # `sys.exit()` in it would end the program, with the exit code of a run that went well.
    except (Exception, SystemExit) as error:
        raise ModelError(
            f"the file `{file}` does not import: {type(error).__name__}: {_first_line(error)}."
        ) from error
    models = [key for key, value in vars(module).items() if _is_model(value)]
    found = getattr(module, name, None)
    if not _is_model(found):
        has = f"it has {listing(models)}" if models else "it has none"
        raise ModelError(
            f"`{name}` in `{file}` is no `ControlAffine` class; {has}{did_you_mean(name, models)}."
        )
    return cast(type[ControlAffine], found)


def _is_model(value: object) -> bool:
    return (
        isinstance(value, type) and issubclass(value, ControlAffine) and value is not ControlAffine
    )


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or ["no message"])[0].rstrip(".")


def _plant(scenario: Scenario, model: ControlAffine) -> ControlAffine | None:
    spec = scenario.plant
    if spec is None:
        return None
    plant = vary_parameters(model, spec.parameters, spec.scale)
    check_model(plant)
    check_plant(model, plant)
    return plant


def _disturbance(scenario: Scenario, faults: _Faults, model: ControlAffine) -> Disturbance | None:
    spec = scenario.disturbance
    if spec is None:
        return None
    for key in ("constant", "rms", "input_rms"):
        with faults.at("disturbance", key):
            Disturbance(**{key: getattr(spec, key)}).prepared(model, scenario.simulation.dt, 0)
    return Disturbance(**spec.model_dump())


def _graph(scenario: Scenario) -> Graph:
    spec = scenario.graph
    if spec.edges is not None:
        return Graph.from_edges(spec.edges, spec.leaders, spec.agents)
    make = getattr(Graph, str(spec.name))
    given = {key: value for key, value in spec.model_dump().items() if value is not None}
    return make(**_offered(make, given))


def _reference(scenario: Scenario) -> Any:
    spec = scenario.reference
    if spec is None:
        return None
    cls = resolve(registry.REFERENCES[spec.name])
    return cls(**_checked(cls, spec.name, spec.parameters))


def _formation(scenario: Scenario, model: ControlAffine, graph: Graph) -> Formation:
    spec = scenario.formation
    if spec.name is None:
        return Formation.from_offsets(model, graph, spec.offsets or {})
    make = getattr(Formation, spec.name)
    return make(model, graph, **_offered(make, {"spacing": spec.spacing, "columns": spec.columns}))


def _gain(model: ControlAffine, graph: Graph, spec: GainSpec, folder: Path) -> Gain:
    if spec.file is not None:
        return load_gain(folder / spec.file, model, graph)
    cls = resolve(registry.METHODS[spec.method])
    return synthesize(model, graph, cls(**_checked(cls, spec.method, spec.arguments)))


def _follower(
    scenario: Scenario, faults: _Faults, model: ControlAffine, graph: Graph
) -> Law | None:
    spec = scenario.follower
    cls = resolve(registry.FOLLOWER_LAWS[spec.law])
    offers: dict[str, Any] = {"feedforward": spec.feedforward, "trim": spec.trim}
    if "gain" in _accepted(cls):
        with faults.at("follower", "gain"):
            offers["gain"] = _gain(model, graph, spec.gain, scenario.folder)
        if "gain" not in offers:
            return None
    return cls(**_offered(cls, offers)).prepared(model, graph)


def _leader(
    scenario: Scenario,
    faults: _Faults,
    model: ControlAffine,
    graph: Graph,
    reference: Any,
    reaction: Gain | None,
) -> Law | None:
    spec = scenario.leader
    cls = resolve(registry.LEADER_LAWS[spec.law])
    if spec.reacts and "reaction" not in _accepted(cls):
        raise ScenarioError(
            f"`reacts` is true, and the law `{spec.law}` cannot be told to react; use `tracking`."
        )
    if spec.reacts and reaction is None:
        raise ScenarioError(
            f"`reacts` needs a follower law with a gain, and `{scenario.follower.law}` has none."
        )
    offers: dict[str, Any] = {
        "reference": reference,
        "reaction": reaction,
        "start_error": spec.start_error,
        "horizon": scenario.simulation.horizon,
        "limits": scenario.simulation.limits,
    }
    if spec.gain is not None:
        with faults.at("leader", "gain"):
            offers["gain"] = _gain(model, graph, spec.gain, scenario.folder)
        if "gain" not in offers:
            return None
    return cls(**_offered(cls, offers)).prepared(model, graph)


def _settings(scenario: Scenario) -> Settings:
    return Settings(
        **scenario.simulation.model_dump(),
        seed=scenario.seed,
        steady_window=scenario.report.steady_window,
    )
