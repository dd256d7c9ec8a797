"""A class that a scenario names, by a name of the registry or in a file of the user's own."""

import importlib
import inspect
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from echelon.core.errors import ScenarioError, did_you_mean, listing
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.law_sections import UserClass
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.user_code import own_class, own_code
from echelon.laws.law import Law


def resolve(entry: registry.Entry) -> Any:
    """Return what a registry entry names."""
    module, _, name = entry.target.partition(":")
    return getattr(importlib.import_module(module), name)


def accepted(make: Callable[..., Any]) -> list[str]:
    """Return the names of the parameters that a class or function takes."""
    return list(inspect.signature(make).parameters)


def offered(make: Callable[..., Any], offers: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the offers that `make` takes."""
    return {name: offers[name] for name in accepted(make) if name in offers}


def _checked(make: Callable[..., Any], what: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the given parameters, after checking that `make` takes each and has all it needs."""
    allowed = inspect.signature(make).parameters
    known(make, what, given)
    for name, parameter in allowed.items():
        if parameter.default is inspect.Parameter.empty and name not in given:
            raise ScenarioError(f"`{what}` needs the parameter `{name}`, which is missing.")
    return dict(given)


def known(make: Callable[..., Any], what: str, given: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the given parameters, after checking that `make` takes each."""
    allowed = inspect.signature(make).parameters
    for name in given:
        if name not in allowed:
            verb = "is" if len(allowed) == 1 else "are"
            taken = f"allowed {verb} {listing(allowed)}" if allowed else "it takes none"
            raise ScenarioError(
                f"got the parameter `{name}` of `{what}`, {taken}{did_you_mean(name, allowed)}."
            )
    return given


class Part(NamedTuple):
    """A class that a scenario names, what messages call it, and its own keys there."""

    cls: Callable[..., Any]
    what: str
    given: Mapping[str, Any]
    own: bool

    def made(self, offers: Mapping[str, Any] = MappingProxyType({})) -> Any:
        """Return an instance made of the keys and of those offers that it takes.

        Raises:
            ScenarioError: a key is unknown or missing, or the class refuses a value.
        """
        given = _checked(self.cls, self.what, {**offered(self.cls, offers), **self.given})
        with own_code(f"`{self.what}` cannot be made with these parameters"):
            return self.cls(**given)


def part_of(
    scenario: Scenario,
    kind: type,
    table: Mapping[str, registry.Entry],
    name: str | None,
    python: str | None,
    given: Mapping[str, Any] = MappingProxyType({}),
) -> Part:
    """Return what a scenario names: a member of a table, or a class in a file of the user's."""
    if python is not None:
        return Part(own_class(scenario.folder, python, kind), python, given, own=True)
    return Part(resolve(table[str(name)]), str(name), given, own=False)


def law_part(scenario: Scenario, table: Mapping[str, registry.Entry], law: str | UserClass) -> Part:
    """Return the law that a scenario names, a member of a table or a class of the user's."""
    if isinstance(law, UserClass):
        return part_of(scenario, Law, table, None, law.python, law.parameters)
    return part_of(scenario, Law, table, law, None)
