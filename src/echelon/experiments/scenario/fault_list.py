"""Collects the faults of a scenario's parts, so that all of them are reported at once."""

import contextlib
from collections.abc import Callable, Iterator
from typing import TypeVar, cast, final

from echelon.core.errors import EchelonError, MissingExtraError
from echelon.experiments.scenario.scenario import Scenario, ScenarioFault, refuse
from echelon.experiments.scenario.yaml import joined

_Part = TypeVar("_Part")


@final
class FaultList:
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
