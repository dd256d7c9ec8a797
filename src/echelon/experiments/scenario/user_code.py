"""Classes of the user's own: from `file.py:Class` to the class, a sentence for each fault."""

import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from echelon.core import disk_cache
from echelon.core.errors import EchelonError, ScenarioError, did_you_mean, listing
from echelon.core.trace import error_summary

_T = TypeVar("_T")


def own_class(folder: Path, target: str, kind: type[_T]) -> type[_T]:
    """Return a class of a kind from a user's file.

    Args:
        folder: to which the file is relative.
        target: `file.py:Class`.
        kind: what it must be made from, such as `Law`.

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
    classes = {key: value for key, value in vars(module).items() if _is_own(value, kind)}
    if name not in classes:
        has = f"it has {listing(classes)}" if classes else "it has none"
        raise ScenarioError(
            f"`{name}` in `{file}` is no `{kind.__name__}` class; {has}"
            f"{did_you_mean(name, classes)}."
        )
    return classes[name]


def _is_own(value: object, kind: type) -> bool:
    return isinstance(value, type) and issubclass(value, kind) and value is not kind


def _imported(file: Path) -> Any:
    """Return the module in a file, run anew."""
    # By its place and not by `import`: the folder need not be on the path, and a file that was
    # changed since must be read again.
    spec = importlib.util.spec_from_file_location(f"echelon_user_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise ScenarioError(f"the file `{file}` is no Python file.")
    module = importlib.util.module_from_spec(spec)
    # Before it runs, as `import` does: dataclasses look up their own module there.
    sys.modules[spec.name] = module
    # It may change anything, and what it makes is not known by its text.
    disk_cache.close()
    with own_code(f"the file `{file}` does not import"):
        spec.loader.exec_module(module)
    return module


@contextlib.contextmanager
def own_code(what: str) -> Iterator[None]:
    """Turn whatever the user's own code raises into a sentence, which begins with `what`.

    Raises:
        ScenarioError: it has raised something; its class and first line are told.
    """
    try:
        yield
    except EchelonError:
        raise
    # A program that leaves is a fault of the file too, and must not end echelon as if all were
    # well.
    except (Exception, SystemExit) as error:
        raise ScenarioError(f"{what}: {error_summary(error)}.") from error
