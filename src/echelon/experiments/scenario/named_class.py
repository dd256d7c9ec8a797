"""A class that a scenario names: by a name of the registry, or in a file of the user."""

import contextlib
import contextvars
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

from echelon.core import cache
from echelon.core.errors import EchelonError, ScenarioError, did_you_mean, listing
from echelon.core.trace import error_summary
from echelon.experiments.scenario import registry

_T = TypeVar("_T")
NOTHING: Mapping[str, object] = MappingProxyType({})


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
        by_user: whether it is in a file of the user.
    """

    cls: Callable[..., Any]
    name: str
    arguments: Mapping[str, object]
    by_user: bool

    def create(self, offers: Mapping[str, object] = NOTHING) -> Any:
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


# ---- files of the user ---------------------------------------------------------------------------


def user_class(folder: Path, target: str, kind: type[_T]) -> type[_T]:
    """Return a class of a kind from a user's file.

    `target` is `file.py:Class`, its file relative to `folder`.

    Raises:
        ScenarioError: there is no such file, it does not import, or it has no such class.
    """
    path, _, name = target.rpartition(":")
    file = (folder / path).resolve()
    if not file.is_file():
        raise ScenarioError(
            f"the file `{file}` does not exist; a `python` path is relative to the scenario file, "
            "and on the command line to the working folder."
        )
    module = _imported(file)
    own = ((key, value) for key, value in vars(module).items() if isinstance(value, type))
    classes = {key: cls for key, cls in own if issubclass(cls, kind) and cls is not kind}
    if name not in classes:
        has = f"it has {listing(classes)}" if classes else "it has none"
        raise ScenarioError(
            f"`{name}` in `{file}` is not a `{kind.__name__}` class; {has}"
            f"{did_you_mean(name, classes)}."
        )
    return classes[name]


_KEPT = contextvars.ContextVar[dict[Path, Any] | None]("modules that are kept", default=None)


@contextlib.contextmanager
def modules_kept() -> Iterator[None]:
    """Execute each file of the user once: of a class that is made anew, all is compiled anew."""
    token = _KEPT.set({})
    try:
        yield
    finally:
        _KEPT.reset(token)


def _imported(file: Path) -> Any:
    """Return the module in a file, executed anew unless modules are kept."""
    kept = _KEPT.get()
    if kept is None:
        return _executed(file)
    return kept[file] if file in kept else kept.setdefault(file, _executed(file))


def _executed(file: Path) -> Any:
    # By its path and not by `import`: the folder need not be on `sys.path`, and a file that was
    # changed since must be read again.
    spec = importlib.util.spec_from_file_location(f"echelon_user_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise ScenarioError(f"the file `{file}` is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    # Before it is executed, as `import` does: dataclasses look up their module there.
    sys.modules[spec.name] = module
    # The file may change anything, and its text does not identify the values that it computes.
    cache.close()
    with as_scenario_error(f"the file `{file}` does not import"):
        spec.loader.exec_module(module)
    return module


@contextlib.contextmanager
def as_scenario_error(what: str) -> Iterator[None]:
    """Raise whatever the user's code raises as a `ScenarioError` that begins with `what`.

    Raises:
        ScenarioError: the user's code raised an error; the message has its class and first line.
    """
    try:
        yield
    except EchelonError:
        raise
    # A file that exits is faulty too, and must not end echelon with exit code 0.
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"{what}: {error_summary(error)}.") from error
