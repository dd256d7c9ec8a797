"""Classes in files of the user: loads `file.py:Class`, and reports what goes wrong in it."""

import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from echelon.core import cache
from echelon.core.errors import EchelonError, ScenarioError, did_you_mean, listing
from echelon.core.trace import error_summary

_T = TypeVar("_T")


def user_class(folder: Path, target: str, kind: type[_T]) -> type[_T]:
    """Return a class of a kind from a user's file.

    Args:
        folder: to which the file is relative.
        target: `file.py:Class`.
        kind: the base class, such as `Law`.

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
    classes = {key: value for key, value in vars(module).items() if _is_subclass(value, kind)}
    if name not in classes:
        has = f"it has {listing(classes)}" if classes else "it has none"
        raise ScenarioError(
            f"`{name}` in `{file}` is not a `{kind.__name__}` class; {has}"
            f"{did_you_mean(name, classes)}."
        )
    return classes[name]


def _is_subclass(value: object, kind: type) -> bool:
    return isinstance(value, type) and issubclass(value, kind) and value is not kind


def _imported(file: Path) -> Any:
    """Return the module in a file, executed anew."""
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
