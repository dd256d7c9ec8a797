"""Identity of values: a digest of the classes and bits of all their parts.

Values with equal bits are the same in every process; object identity is useless, since arrays can
be changed in place. A foreign class may be redefined or read changing data while a process runs:
a value that contains one has no digest, only a key for this process. That key also covers what the
code reads beside its arguments, as far as Python shows it: globals, closures, defaults and class
attributes.
"""

import dataclasses
import enum
import functools
import hashlib
import sys
import sysconfig
from collections.abc import Hashable, Iterable, Iterator, Sequence
from fractions import Fraction
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, TypeAlias, final

_LARGE: Final = 4096
"""Arrays of at least this many bytes are hashed in place and not copied."""
_TRUSTED: Final = {
    *("echelon", "echelon_ranges"),
    *("builtins", "numpy", "jax", "jaxlib", "equinox", "scipy"),
}
_PLAIN: Final = (bool, int, float, complex, str, bytes, Fraction, type(None))
_SPECIAL: Final = {
    *("__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "__slots__"),
    "__signature__",  # follows from what is read, and takes long to hash
}
_LIBRARIES: Final = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "purelib", "platlib"))


Foreign: TypeAlias = list[tuple[type, object]]
"""The parts of foreign code in a value, each with its class."""


def identify(value: object) -> tuple[bytes, Foreign]:
    """Return a digest of what is known of a value, and its foreign parts, which it leaves out."""
    walk = _Walk()
    walk.visit(value)
    return walk.digest(), walk.foreign


def digest(value: object) -> bytes | None:
    """Return a digest, equal only for equal classes and bits; None if a part is foreign."""
    bits, foreign = identify(value)
    return None if foreign else bits


def process_key(value: object) -> Hashable | None:
    """Return a key, equal only for values of the same classes and bits, in this process.

    A user's class is compared by identity and by what its code reads, an object of unknown kind by
    its own equality. None if such an object has no hash.
    """
    bits, foreign = identify(value)
    key = (bits, *foreign) if foreign else bits
    try:
        hash(key)
    except TypeError:
        return None
    return key


def foreign_key(value: object) -> Hashable:
    """Return a key as `process_key` for values that contain foreign code, otherwise ().

    What has no hash is compared by its address, so the value must exist as long as the key.
    """
    return key_of_foreign(*identify(value))


def key_of_foreign(bits: bytes, foreign: Foreign) -> Hashable:
    """Return what `foreign_key` returns of a value that was identified."""
    kinds = [part if isinstance(part[1], Hashable) else id(part[1]) for part in foreign]
    return (bits, *kinds) if kinds else ()


def array_bits(array: object) -> bytes:
    """Return an array's bits, of a large one a digest; `ValueError` if of objects or traced."""
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
    if not dataclasses.is_dataclass(kind):
        return None
    return tuple(field.name for field in dataclasses.fields(kind))


@functools.lru_cache(1024)
def _has_dict(kind: type) -> bool:
    return any("__dict__" in vars(base) for base in kind.__mro__)


@final
class _Walk:
    def __init__(self) -> None:
        self.foreign: list[tuple[type, object]] = []
        self._bits: list[bytes] = []
        self._inside, self._seen = False, set[int]()

    def digest(self) -> bytes:
        """Return a digest of all bits."""
        # Each with its length, so that different trees cannot give the same bytes.
        framed = [b"%d:" % len(part) + part for part in self._bits]
        return hashlib.sha256(b"".join(framed)).digest()

    def visit(self, value: object) -> None:
        """Collect the parts of a value, each with its class."""
        kind = type(value)
        if kind in _PLAIN:
            # `repr` of a float keeps all digits and the sign of 0.
            self._bits.append(f"{kind.__name__} {value!r}".encode())
            return
        names = _fields(kind)
        if names is not None:
            # Equinox may store a field on the class only, and its own access is slow.
            own = object.__getattribute__(value, "__dict__") if _has_dict(kind) else {}
            self._inner(kind, [own[n] if n in own else getattr(value, n) for n in names])
        elif isinstance(value, tuple | list):
            self._inner(kind, value)
        elif isinstance(value, dict):
            self._inner(kind, [entry for pair in value.items() for entry in pair])
        elif isinstance(value, type | FunctionType):
            self._name(value)
        elif hasattr(value, "dtype") and hasattr(value, "shape"):
            self._array(value)
        elif isinstance(value, enum.Enum):
            self._name(kind)
            self._bits.append(value.name.encode())
        elif isinstance(value, functools.partial):
            self._inner(kind, [value.func, value.args, value.keywords])
        else:
            self._object(value, kind)

    def _inner(self, kind: type, parts: Sequence[object]) -> None:
        self._name(kind)
        self._bits.append(b"%d" % len(parts))
        for part in parts:
            self.visit(part)

    def _object(self, value: object, kind: type) -> None:
        ours = kind.__module__.partition(".")[0] in _TRUSTED or _is_installed(kind.__module__)
        if not ours and id(value) not in self._seen:
            self._seen.add(id(value))
            self._name(kind)
            self._read([getattr(value, "__dict__", {})])
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
        # A class that cannot be found by its name (defined in a function) counts as foreign.
        if place is named and home.partition(".")[0] in _TRUSTED:
            self._bits.append(f"{home}.{name}".encode())
            return
        self._unknown(named)
        # Installed code does not change, so what it reads does not count inside other code.
        if id(named) not in self._seen and not (self._inside and _is_installed(home)):
            self._seen.add(id(named))
            self._read(_reads(named))

    def _read(self, values: Iterable[object]) -> None:
        before, self._inside = self._inside, True
        for value in values:
            self.visit(value)
        self._inside = before

    def _unknown(self, value: object) -> None:
        # With the class, since numbers of different classes may compare equal.
        self.foreign.append((type(value), value))
        self._bits.append(b"foreign")


# ---- what code reads beside its arguments --------------------------------------------------------


def _is_installed(home: str) -> bool:
    """Return whether a module is of Python or of an installed package, and so does not change."""
    package = home.partition(".")[0]
    return package in _TRUSTED or _is_installed_package(package, id(sys.modules.get(home)))


@functools.lru_cache(1024)
def _is_installed_package(package: str, _: int) -> bool:
    file = getattr(sys.modules.get(package), "__file__", None)
    return package in sys.stdlib_module_names - {"__main__"} or bool(
        file and file.startswith(_LIBRARIES)
    )


def _reads(named: type | FunctionType) -> Iterator[object]:
    """Yield what the code of a class or function reads, each value with its name before it."""
    if isinstance(named, type):
        for base in named.__mro__:
            if base is named or not (_is_installed(base.__module__) or base is object):
                yield from _attributes(base)
    else:
        yield from _of_function(named)


def _attributes(kind: type) -> Iterator[object]:
    for name, value in vars(kind).items():
        if name in _SPECIAL or name.startswith(("__dataclass", "_abc", "__abstract", "__jax")):
            continue
        functions = list(_functions(value))
        for function in functions:
            yield from _of_function(function)
        # What calls nothing is a value that code may read.
        if not functions and not callable(value):
            yield name
            yield value


def _functions(value: object) -> Iterator[FunctionType]:
    """Yield the functions behind a method, a property, or a wrapper of one."""
    if isinstance(value, FunctionType):
        yield value
        value = getattr(value, "__wrapped__", None)
    for name in ("__func__", "__wrapped__", "method", "fget", "func"):
        inner = getattr(value, name, None)
        if isinstance(inner, FunctionType):
            yield inner


def _of_function(function: FunctionType) -> Iterator[object]:
    yield from (function.__qualname__, function.__defaults__, function.__kwdefaults__)
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:
            # Not yet filled.
            continue
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        yield code.co_code
        codes += [const for const in code.co_consts if isinstance(const, CodeType)]
        yield from (const for const in code.co_consts if not isinstance(const, CodeType))
        for name in code.co_names:
            if name in function.__globals__:
                yield name
                yield from _global(function.__globals__[name], code.co_names)


def _global(value: object, names: tuple[str, ...]) -> Iterator[object]:
    """Yield a global, or of somebody's own module what the code may read of it."""
    if not isinstance(value, ModuleType):
        yield value
    elif not _is_installed(value.__name__):
        for name in names:
            if name in vars(value):
                yield name
                yield vars(value)[name]
