"""What identifies a value: one digest of the classes and the bits of all that it is made of.

Values whose bits are equal are the same value, in whatever process; arrays may be changed in place,
so that who they are says nothing. A class that is not echelon's may be defined anew, or read what
changes, as long as a process runs: what holds one has no digest, only a key for this process.
"""

import dataclasses
import enum
import functools
import hashlib
import sys
from collections.abc import Hashable, Sequence
from types import FunctionType
from typing import Any, Final, final

_LARGE: Final = 4096
"""Bytes of an array that is hashed where it is, and not copied beside the rest first."""
_TRUSTED: Final = {"echelon", "builtins", "numpy", "jax"}
_PLAIN: Final = (bool, int, float, complex, str, bytes, type(None))


def digest(value: object) -> bytes | None:
    """Return what is equal for values of the same classes and bits alone, in every process.

    None where a part is of a class or function that is not echelon's own or below it.
    """
    walk = _Walk()
    walk.visit(value)
    return None if walk.foreign else walk.digest()


def process_key(value: object) -> Hashable | None:
    """Return what is equal for values of the same classes and bits alone, in this process.

    A user's class is the same as long as it is the same object; an object of no known kind is equal
    where it says so itself. None where such an object has no hash.
    """
    walk = _Walk()
    walk.visit(value)
    if not walk.foreign:
        return walk.digest()
    key = walk.digest(), *walk.foreign
    try:
        hash(key)
    except TypeError:
        return None
    return key


def array_bits(array: object) -> bytes:
    """Return the bits of an array of NumPy or JAX; of a large one, such as a graph's, a digest.

    Raises:
        ValueError: its entries are objects, whose bits are addresses; or it is traced, and has
            none.
    """
    # Here, since the command line opens its cache before it needs them.
    import numpy as np

    numbers = array if isinstance(array, np.ndarray) else np.asarray(_untraced(array))
    if numbers.dtype.hasobject:
        raise ValueError("got an array of objects or a traced one, allowed are numbers.")
    if numbers.nbytes < _LARGE:
        return numbers.tobytes()
    return hashlib.sha256(np.ascontiguousarray(numbers).data).digest()


def _untraced(array: object) -> object:
    """Return what NumPy can take of an array of JAX; None of a traced one."""
    import jax
    from jax.core import Tracer

    if isinstance(array, Tracer):
        return None
    # Keys of random numbers are no numbers of NumPy's.
    if isinstance(array, jax.Array) and jax.numpy.issubdtype(array.dtype, jax.dtypes.extended):
        return jax.random.key_data(array)
    return array


@functools.lru_cache(1024)
def _fields(kind: type) -> tuple[str, ...] | None:
    """Return the names of the fields of a dataclass; None of another class."""
    if not dataclasses.is_dataclass(kind):
        return None
    return tuple(field.name for field in dataclasses.fields(kind))


@final
class _Walk:
    """One walk through a tree of values, which collects its bits and what is foreign in it."""

    def __init__(self) -> None:
        self.foreign: list[Hashable] = []
        self._bits: list[bytes] = []

    def digest(self) -> bytes:
        """Return a digest of all bits."""
        # Each with its length, so that no two trees make one row of bytes.
        framed = [b"%d:" % len(part) + part for part in self._bits]
        return hashlib.sha256(b"".join(framed)).digest()

    def visit(self, value: object) -> None:
        """Collect what a value is made of, each part with its class."""
        kind = type(value)
        if kind in _PLAIN:
            # `repr` of a float has all its digits, and the sign of 0.
            self._bits.append(f"{kind.__name__} {value!r}".encode())
            return
        names = _fields(kind)
        if names is not None:
            # Equinox leaves out what is an attribute of the class.
            self._inner(kind, [getattr(value, name) for name in names])
        elif isinstance(value, tuple | list):
            self._inner(kind, value)
        elif isinstance(value, dict):
            self._inner(kind, [entry for pair in value.items() for entry in pair])
        else:
            self._leaf(value, kind)

    def _inner(self, kind: type, parts: Sequence[object]) -> None:
        self._name(kind)
        self._bits.append(b"%d" % len(parts))
        for part in parts:
            self.visit(part)

    def _leaf(self, value: object, kind: type) -> None:
        if isinstance(value, type | FunctionType):
            self._name(value)
        elif hasattr(value, "dtype") and hasattr(value, "shape"):
            self._array(value)
        elif isinstance(value, enum.Enum):
            self._name(kind)
            self._bits.append(value.name.encode())
        else:
            self._unknown(value)

    def _array(self, array: Any) -> None:
        try:
            bits = array_bits(array)
        except ValueError:
            self._unknown(array)
            return
        self._bits += [f"{type(array).__name__} {array.dtype}{array.shape}".encode(), bits]

    def _name(self, named: type | FunctionType) -> None:
        """Collect a class or function by the name under which echelon or a library has it."""
        home, name = named.__module__, named.__qualname__
        place: object = sys.modules.get(home)
        for part in name.split("."):
            place = getattr(place, part, None)
        # What cannot be found by its name, as a class that is made in a function, is nobody's.
        if home.partition(".")[0] in _TRUSTED and place is named:
            self._bits.append(f"{home}.{name}".encode())
        else:
            self._unknown(named)

    def _unknown(self, value: object) -> None:
        # The class too, since numbers of two classes may say that they are equal.
        self.foreign.append((type(value), value))
        self._bits.append(b"foreign")
