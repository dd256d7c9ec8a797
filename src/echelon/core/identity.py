"""Identity of values: a digest of the classes and bits of all their parts.

Values with equal bits are the same in every process; object identity is useless, since arrays can
be changed in place. A foreign class may be redefined or read changing data while a process runs:
a value that contains one has no digest, only a key for this process, which has what its code reads.
"""

import dataclasses
import enum
import functools
import hashlib
import sys
from collections.abc import Hashable, Sequence
from fractions import Fraction
from types import FunctionType
from typing import Any, Final, final

from echelon.core.reads import is_installed, reads

_LARGE: Final = 4096
"""Arrays of at least this many bytes are hashed in place and not copied."""
_TRUSTED: Final = {"echelon", "builtins", "numpy", "jax", "jaxlib", "equinox", "scipy"}
_PLAIN: Final = (bool, int, float, complex, str, bytes, Fraction, type(None))


def digest(value: object) -> bytes | None:
    """Return a digest, equal only for values of the same classes and bits, in every process.

    None if a part is of a class or function outside echelon and its dependencies.
    """
    walk = _Walk()
    walk.visit(value)
    return None if walk.foreign else walk.digest()


def process_key(value: object) -> Hashable | None:
    """Return a key, equal only for values of the same classes and bits, in this process.

    A user's class is compared by identity and by what its code reads, an object of unknown kind by
    its own equality. None if such an object has no hash.
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


def foreign_key(value: object) -> Hashable:
    """Return a key of all foreign code in a value and of what it reads; empty without any."""
    walk = _Walk(code_alone=True)
    walk.visit(value)
    if not walk.foreign:
        return ()
    kinds = [part if isinstance(part[1], Hashable) else id(part[1]) for part in walk.foreign]
    return walk.digest(), *kinds


def array_bits(array: object) -> bytes:
    """Return the bits of an array of NumPy or JAX; of a large one, such as a graph's, a digest.

    Raises:
        ValueError: its entries are objects, whose bits are addresses; or it is traced.
    """
    # Imported here, since the command line opens its cache before it needs them.
    import numpy as np

    numbers = array if isinstance(array, np.ndarray) else np.asarray(_untraced(array))
    if numbers.dtype.hasobject:
        raise ValueError("the array contains objects or is traced, and must contain numbers.")
    if numbers.nbytes < _LARGE:
        return numbers.tobytes()
    return hashlib.sha256(np.ascontiguousarray(numbers).data).digest()


def _untraced(array: object) -> object:
    """Return an array of JAX as NumPy can read it; None if it is traced."""
    import jax
    from jax.core import Tracer

    if isinstance(array, Tracer):
        return None
    # Random keys have a type that NumPy cannot read.
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
    """A walk through a tree of values that collects its bits and its foreign parts."""

    def __init__(self, code_alone: bool = False) -> None:
        self.foreign: list[tuple[type, object]] = []
        self._bits: list[bytes] = []
        self._collects, self._inside, self._seen = not code_alone, False, set[int]()

    @property
    def _counts(self) -> bool:
        """Whether values count: all of them, or those that foreign code reads."""
        return self._collects or self._inside

    def digest(self) -> bytes:
        """Return a digest of all bits."""
        # Each with its length, so that different trees cannot give the same bytes.
        framed = [b"%d:" % len(part) + part for part in self._bits]
        return hashlib.sha256(b"".join(framed)).digest()

    def visit(self, value: object) -> None:
        """Collect the parts of a value, each with its class."""
        kind = type(value)
        if kind in _PLAIN:
            if not self._counts:
                return
            # `repr` of a float keeps all digits and the sign of 0.
            self._bits.append(f"{kind.__name__} {value!r}".encode())
            return
        names = _fields(kind)
        if names is not None:
            # By attribute: Equinox may store a field on the class only.
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
            if self._counts:
                self._array(value)
        elif isinstance(value, enum.Enum):
            self._name(kind)
            self._bits.append(value.name.encode())
        elif isinstance(value, functools.partial):
            self._inner(kind, [value.func, value.args, value.keywords])
        else:
            self._object(value, kind)

    def _object(self, value: object, kind: type) -> None:
        """Collect an object of unknown kind, and of a stranger's what its class reads."""
        ours = kind.__module__.partition(".")[0] in _TRUSTED or is_installed(kind.__module__)
        if not ours and id(value) not in self._seen:
            self._seen.add(id(value))
            self._name(kind)
            before, self._inside = self._inside, True
            self.visit(getattr(value, "__dict__", {}))
            self._inside = before
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
        # Code that `exec` ran without a `__name__` belongs to no module.
        home, name = named.__module__ or "", named.__qualname__
        place: object = sys.modules.get(home)
        for part in name.split("."):
            place = getattr(place, part, None)
        ours = home.partition(".")[0] in _TRUSTED
        # A class that cannot be found by its name (defined in a function) counts as foreign.
        if ours and place is named:
            self._bits.append(f"{home}.{name}".encode())
        elif self._collects or not ours:
            self.foreign.append((type(named), named))
            self._bits.append(b"foreign")
            self._code(named)

    def _code(self, named: type | FunctionType) -> None:
        """Collect what foreign code reads, once."""
        # Of what a stranger's code reads, what is installed does not change.
        if id(named) in self._seen or self._inside and is_installed(named.__module__):
            return
        self._seen.add(id(named))
        before, self._inside = self._inside, True
        for value in reads(named):
            self.visit(value)
        self._inside = before

    def _unknown(self, value: object) -> None:
        if not self._counts:
            return
        # With the class, since numbers of different classes may compare equal.
        self.foreign.append((type(value), value))
        self._bits.append(b"foreign")
