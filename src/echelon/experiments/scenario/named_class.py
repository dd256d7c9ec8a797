"""A class that a scenario names: by a name of the registry, or in a file of the user."""

import contextlib
import importlib
import inspect
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from echelon.core.errors import ScenarioError, did_you_mean, listing
from echelon.experiments.scenario import registry
from echelon.experiments.scenario.law_sections import UserClass
from echelon.experiments.scenario.scenario import Scenario
from echelon.experiments.scenario.user_code import as_scenario_error, user_class
from echelon.laws.law import Law

_NOTHING: Mapping[str, object] = MappingProxyType({})


def resolve(entry: registry.Entry) -> Any:
    """Return what a registry entry names."""
    module, _, name = entry.target.partition(":")
    return getattr(importlib.import_module(module), name)


def accepted(make: Callable[..., Any]) -> list[str]:
    """Return the names of the parameters that a class or function takes."""
    return list(inspect.signature(make).parameters)


def offered(make: Callable[..., Any], offers: Mapping[str, object]) -> dict[str, object]:
    """Return those of the offers that `make` takes."""
    return {name: offers[name] for name in accepted(make) if name in offers}


def check_names(make: Callable[..., Any], what: str, arguments: Mapping[str, object]) -> None:
    """Check that `make` takes each of the arguments."""
    allowed = inspect.signature(make).parameters
    for name in arguments:
        if name not in allowed:
            verb = "is" if len(allowed) == 1 else "are"
            taken = f"allowed {verb} {listing(allowed)}" if allowed else "it takes none"
            raise ScenarioError(
                f"got the parameter `{name}` of `{what}`, {taken}{did_you_mean(name, allowed)}."
            )


class NamedClass(NamedTuple):
    """A class that a scenario names, with its arguments there.

    Attributes:
        cls: the class, or a function that returns an instance.
        name: what messages call it.
        arguments: those that the scenario gives.
        by_user: whether it is in a file of the user.
    """

    cls: Callable[..., Any]
    name: str
    arguments: Mapping[str, object]
    by_user: bool

    def create(self, offers: Mapping[str, object] = _NOTHING) -> Any:
        """Return an instance, from the arguments and from those of the offers that it takes.

        Raises:
            ScenarioError: an argument is unknown or missing, or the class refuses a value.
        """
        arguments = {**offered(self.cls, offers), **self.arguments}
        check_names(self.cls, self.name, arguments)
        for name, parameter in inspect.signature(self.cls).parameters.items():
            if parameter.default is inspect.Parameter.empty and name not in arguments:
                raise ScenarioError(
                    f"`{self.name}` needs the parameter `{name}`, which is missing."
                )
        with as_scenario_error(f"`{self.name}` refuses these parameters"):
            return self.cls(**arguments)

    def guard(self) -> contextlib.AbstractContextManager[None]:
        """Return a context in which errors of the user's code are a `ScenarioError`."""
        if self.by_user:
            return as_scenario_error(f"`{self.name}` fails")
        return contextlib.nullcontext()


def named_class(
    scenario: Scenario,
    kind: type,
    table: Mapping[str, registry.Entry],
    name: str | None,
    python: str | None,
    arguments: Mapping[str, object] = _NOTHING,
) -> NamedClass:
    """Return what a scenario names: a member of a table, or a class in a file of the user."""
    if python is not None:
        cls = user_class(scenario.folder, python, kind)
        return NamedClass(cls, python, arguments, by_user=True)
    return NamedClass(resolve(table[str(name)]), str(name), arguments, by_user=False)


def law_class(
    scenario: Scenario, table: Mapping[str, registry.Entry], law: str | UserClass
) -> NamedClass:
    """Return the law that a scenario names, a member of a table or a class of the user."""
    if isinstance(law, UserClass):
        return named_class(scenario, Law, table, None, law.python, law.parameters)
    return named_class(scenario, Law, table, law, None)
