"""JIT-compiled functions whose machine code is cached on disk by the command line."""

import contextlib
import functools
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, NamedTuple, TypeVar, final

import equinox as eqx
import jax
from jax.core import Tracer

from echelon.core import disk_cache
from echelon.core.identity import digest, foreign_key
from echelon.core.memoize import BoundedCache
from echelon.core.plain_format import decode, encode
from echelon.core.types import PyTree

_R = TypeVar("_R")
_LEAST, _NEVER = "jax_persistent_cache_min_compile_time_secs", 1e9
"""Option and value (compile time, s) that keep a program out of the disk cache of JAX."""
_MOST: Final = 256
"""Compiled programs cached per function."""
_COMPILING: Final = threading.Lock()
_OTHER: Final = b""
"""Stored for a program that JAX compiles itself."""


class _Place(NamedTuple):
    """Placeholder in a tree for one array of a list."""

    number: int


class _Compiled(NamedTuple):
    """A compiled program and the tree of its results."""

    run: Callable[..., Sequence[jax.Array]]
    tree: PyTree


class _CallArguments(NamedTuple):
    """The arguments of a call, as arrays and a tree with placeholders; and the settings of JAX."""

    arrays: Sequence[jax.Array]
    forms: tuple[object, ...]
    leaves: tuple[object, ...]
    tree: PyTree
    settings: tuple[str, ...]

    def digest(self) -> bytes | None:
        """Return a digest that is equal for calls of one program; None if there is none."""
        # Arrays are traced, so only their shape and type matter; other leaves count by value.
        arguments = jax.tree.unflatten(self.tree, self.leaves)
        return digest((arguments, self.forms, self.settings))

    def repeats(self, before: "_CallArguments") -> bool:
        """Return whether this is a call of the same program, as far as is seen at once."""
        if (self.forms, self.settings) != (before.forms, before.settings):
            return False
        pairs = zip(self.leaves, before.leaves, strict=False)
        if not all(a is b or isinstance(a, _Place) and isinstance(b, _Place) for a, b in pairs):
            return False
        try:
            return bool(self.tree == before.tree)
        except (TypeError, ValueError):  # arrays that are not traced have no single answer
            return False

    def arguments(self, arrays: Sequence[jax.Array]) -> PyTree:
        """Return the arguments with other arrays in place of their own."""
        return _filled(jax.tree.unflatten(self.tree, self.leaves), arrays)


@final
class CompiledFunction(Generic[_R]):
    """A function compiled once per shapes of its arguments, like `filter_jit`.

    With the disk cache open, later processes neither trace nor compile it again if all arguments
    are of echelon's own classes.
    """

    def __init__(self, function: Callable[..., _R], options: dict[str, Any] | None = None) -> None:
        """Wrap a module-level function; `options` are XLA's."""
        functools.update_wrapper(self, function)
        self._function, self._options = function, options
        self._plain = self._jitted(function)
        self._foreign = BoundedCache[Callable[..., _R]](_MOST)
        self._programs = BoundedCache[_Compiled | None](_MOST)
        self._last: tuple[_CallArguments, bytes | None] | None = None

    def __call__(self, *args: object, **named: object) -> _R:
        """Return what the function returns."""
        foreign = foreign_key((args, named))
        if foreign:
            # JAX knows classes, and not what their code reads: each has a function of its own.
            return self._foreign.get_or_make(foreign, self._renewed)(*args, **named)
        call = _call_of((args, named)) if disk_cache.is_open() else None
        key = None if call is None else self._key(call)
        if call is None or key is None:
            return self._plain(*args, **named)
        compiled = self._programs.get_or_make(key, lambda: self._load_or_compile(call, key))
        if compiled is None:
            return self._plain(*args, **named)
        return _filled(compiled.tree, compiled.run(*call.arrays))

    def _key(self, call: _CallArguments) -> bytes | None:
        """Return the digest of a call, without a walk through a loop that takes its next chunk."""
        last = self._last
        if last is not None and call.repeats(last[0]):
            return last[1]
        key = call.digest()
        self._last = call._replace(arrays=()), key
        return key

    def _renewed(self) -> Callable[..., _R]:
        """Return the function compiled as another one to JAX."""
        function = self._function
        renewed = functools.wraps(function)(lambda *a, **named: function(*a, **named))
        return self._jitted(renewed)

    def _jitted(self, function: Callable[..., _R]) -> Callable[..., _R]:
        named: dict[str, Any] = {"compiler_options": self._options}
        return eqx.filter_jit(function, **named)

    def _load_or_compile(self, call: _CallArguments, key: bytes) -> _Compiled | None:
        """Return what is stored for a call, or compile and store it; None if JAX compiles it."""
        name = f"{self._function.__module__}.{self._function.__qualname__}"
        file = disk_cache.file_for(name, key)
        if file is None:
            return None
        stored = disk_cache.read(file)
        if stored is not None:
            # An unreadable entry is compiled again.
            with contextlib.suppress(Exception):
                return None if stored == _OTHER else _load(stored, len(call.arrays))
        compiled, packed = _compile(self._function, call, self._options), _OTHER
        # A program that cannot be serialized is left to JAX from the next process on.
        with contextlib.suppress(Exception):
            packed = _OTHER if compiled is None else _packed(compiled)
        disk_cache.write_if_unchanged(file, packed)
        return compiled


def cached_jit(function: Callable[..., _R]) -> Callable[..., _R]:
    """Return a function compiled by JAX; its arrays may be of JAX or NumPy."""
    return CompiledFunction(function)


def compiled_for_one_call(function: Callable[..., _R]) -> Callable[..., _R]:
    """Return the same for a function whose programs run once, which takes less than compiling them.

    They are compiled without LLVM's optimizer, in little more than half of the time.
    """
    return CompiledFunction(function, {"xla_backend_optimization_level": 0})


def _call_of(arguments: PyTree) -> _CallArguments | None:
    """Return a call as arrays and placeholders; None inside a trace, which includes the call."""
    leaves, tree = jax.tree.flatten(arguments)
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return None
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    places = map(_Place, range(len(arrays)))
    return _CallArguments(
        arrays,
        tuple(map(_form, arrays)),
        tuple(next(places) if eqx.is_array(x) else x for x in leaves),
        tree,
        disk_cache.jax_settings(),
    )


def _filled(tree: PyTree, arrays: Sequence[jax.Array]) -> PyTree:
    """Return a tree with its placeholders replaced by arrays."""

    def at(leaf: object) -> object:
        return arrays[leaf.number] if isinstance(leaf, _Place) else leaf

    return jax.tree.map(at, tree, is_leaf=lambda leaf: isinstance(leaf, _Place))


def _form(array: jax.Array) -> tuple[tuple[int, ...], str, bool]:
    """Return the shape and type of an array as JAX reads it in the current precision."""
    kind = jax.dtypes.canonicalize_dtype(array.dtype, allow_extended_dtype=True)
    return array.shape, str(kind), getattr(array, "weak_type", False)


# ---- compiled code -------------------------------------------------------------------------------


def _compile(
    function: Callable[..., PyTree], call: _CallArguments, options: dict[str, Any] | None
) -> _Compiled | None:
    """Return a function compiled for a call; None if it calls foreign code such as LAPACK."""
    trees = list[PyTree]()

    def flat(*arrays: jax.Array) -> list[jax.Array]:
        args, named = call.arguments(arrays)
        leaves, tree = jax.tree.flatten(function(*args, **named))
        outputs = [leaf for leaf in leaves if eqx.is_array(leaf)]
        places = map(_Place, range(len(outputs)))
        leaves = [next(places) if eqx.is_array(leaf) else leaf for leaf in leaves]
        trees.append(jax.tree.unflatten(tree, leaves))
        return outputs

    # A program that JAX loads from its own disk cache cannot be serialized again. A unique name
    # prevents such a load.
    flat.__name__ = f"{function.__name__}_{os.urandom(8).hex()}"
    lowered = jax.jit(flat, keep_unused=True, compiler_options=options).lower(*call.arrays)
    if "custom_call" in lowered.as_text():
        return None
    # The option is shared by all threads.
    with _COMPILING:
        least = jax.config.values[_LEAST]
        jax.config.update(_LEAST, _NEVER)
        try:
            compiled = lowered.compile()
        finally:
            jax.config.update(_LEAST, least)
    return _Compiled(compiled, trees[-1])


def _packed(made: _Compiled) -> bytes:
    """Return compiled code and its tree as bytes.

    Raises:
        ValueError: the code calls functions that exist only in the process that compiled it.
    """
    # Imported here, since only the command line stores programs.
    from jax.experimental.serialize_executable import serialize

    # Such as LAPACK: the loaded program would crash the process.
    if "custom-call" in made.run.as_text():  # type: ignore[attr-defined]
        raise ValueError("the program calls foreign code, which cannot be stored.")
    code, _, back = serialize(made.run)  # type: ignore[arg-type]
    return encode((code, back.num_leaves, made.tree))


def _load(stored: bytes, given: int) -> _Compiled:
    """Return compiled code that takes `given` arrays, from bytes."""
    from jax.experimental.serialize_executable import deserialize_and_load

    code, count, tree = decode(stored)
    before = jax.tree.structure(((0,) * given, {}))
    return _Compiled(deserialize_and_load(code, before, jax.tree.structure([0] * count)), tree)
