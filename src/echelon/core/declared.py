"""The base of the classes that users derive from: equinox's modules, with a clear error."""

import abc
import dataclasses
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from echelon.core.errors import EchelonError


class Declared(eqx.Module, abc.ABC):
    """An immutable object whose parameters are annotated fields."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign a field in `__init__`.

        Raises:
            EchelonError: there is no such field, or the object is complete.
        """
        try:
            super().__setattr__(name, value)
        except dataclasses.FrozenInstanceError as error:
            own, code = type(self).__name__, sys._getframe(1)
            place = f"{Path(code.f_code.co_filename).name}:{code.f_lineno}"
            if any(field.name == name for field in dataclasses.fields(self)):
                text = f"`{name}` of a `{own}` cannot be changed; make a new `{own}`"
            else:
                kind = "jax.Array" if isinstance(value, jax.Array) else type(value).__name__
                text = f"parameters are annotated fields; declare `{name}: {kind}` in `{own}`"
            raise EchelonError(f"{place}: {text}.") from error
