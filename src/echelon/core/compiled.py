"""Functions that JAX compiles; the command line finds them compiled by the run before."""

import contextlib
import functools
import os
import pickle
import threading
from collections.abc import Callable, Sequence
from typing import Final, Generic, NamedTuple, TypeVar, final

import equinox as eqx
import jax
from jax.core import Tracer

from echelon.core import disk_cache
from echelon.core.identity import digest
from echelon.core.memoize import BoundedCache
from echelon.core.types import PyTree

_R = TypeVar("_R")
_LEAST, _NEVER = "jax_persistent_cache_min_compile_time_secs", 1e9
"""Of compiling, s, from which on JAX keeps what it compiles."""
_MOST: Final = 256
"""Compiled programs held of each function."""
_COMPILING: Final = threading.Lock()
_OTHER: Final = b""
"""Is kept where a program is left to JAX."""


class _Place(NamedTuple):
    """Stands in a tree for one of some arrays."""

    number: int


class _Compiled(NamedTuple):
    """What runs on arrays, and the tree of what comes back."""

    run: Callable[..., Sequence[jax.Array]]
    tree: PyTree


class _CallArguments(NamedTuple):
    """The arguments of a call: their arrays, and the tree in which these stand."""

    arrays: Sequence[jax.Array]
    leaves: tuple[object, ...]
    tree: PyTree

    def digest(self) -> bytes | None:
        """Return what is equal for calls of one program; None where JAX alone can tell."""
        # Places stand for what is traced; other arrays are known by their numbers.
        arguments = jax.tree.unflatten(self.tree, self.leaves)
        return digest((arguments, tuple(map(_form, self.arrays)), disk_cache.jax_settings()))

    def arguments(self, arrays: Sequence[jax.Array]) -> PyTree:
        """Return the arguments with other arrays in the places of theirs."""
        return _filled(jax.tree.unflatten(self.tree, self.leaves), arrays)


@final
class CompiledFunction(Generic[_R]):
    """A function that is compiled once for all arguments of the same shapes, as by `filter_jit`.

    Where compiled code is kept, neither is it traced again in the next process for arguments of
    echelon's own classes.
    """

    def __init__(self, function: Callable[..., _R]) -> None:
        """Wrap a function of a module."""
        functools.update_wrapper(self, function)
        self._function, self._plain = function, eqx.filter_jit(function)
        self._programs = BoundedCache[_Compiled | None](_MOST)

    def __call__(self, *args: object, **named: object) -> _R:
        """Return what the function returns."""
        call = _call_of((args, named)) if disk_cache.is_open() else None
        key = None if call is None else call.digest()
        if call is None or key is None:
            return self._plain(*args, **named)
        compiled = self._programs.get_or_make(key, lambda: self._load_or_compile(call, key))
        if compiled is None:
            return self._plain(*args, **named)
        return _filled(compiled.tree, compiled.run(*call.arrays))

    def _load_or_compile(self, call: _CallArguments, key: bytes) -> _Compiled | None:
        """Return what is stored for a call, or compile and store it; None where JAX is to do it."""
        name = f"{self._function.__module__}.{self._function.__qualname__}"
        file = disk_cache.file_for(name, key)
        if file is None:
            return None
        stored = disk_cache.read(file)
        if stored is not None:
            # What cannot be read is made again.
            with contextlib.suppress(Exception):
                return None if stored == _OTHER else _load(stored, len(call.arrays))
        compiled, packed = _compile(self._function, call), _OTHER
        # What cannot be written down is for JAX to keep from the next process on.
        with contextlib.suppress(Exception):
            packed = _OTHER if compiled is None else _packed(compiled)
        disk_cache.write_if_unchanged(file, packed)
        return compiled


def cached_jit(function: Callable[..., _R]) -> Callable[..., _R]:
    """Return a function that JAX compiles, of arrays of JAX's or of NumPy's."""
    return CompiledFunction(function)


def _call_of(arguments: PyTree) -> _CallArguments | None:
    """Return a call as its arrays and their places; None within a trace, of which it is a part."""
    leaves, tree = jax.tree.flatten(arguments)
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return None
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    places = map(_Place, range(len(arrays)))
    return _CallArguments(
        arrays, tuple(next(places) if eqx.is_array(x) else x for x in leaves), tree
    )


def _filled(tree: PyTree, arrays: Sequence[jax.Array]) -> PyTree:
    """Return a tree with arrays in their places."""

    def at(leaf: object) -> object:
        return arrays[leaf.number] if isinstance(leaf, _Place) else leaf

    return jax.tree.map(at, tree, is_leaf=lambda leaf: isinstance(leaf, _Place))


def _form(array: jax.Array) -> tuple[tuple[int, ...], str, bool]:
    """Return the shape and type of an array, as JAX takes it in the precision that is on."""
    kind = jax.dtypes.canonicalize_dtype(array.dtype, allow_extended_dtype=True)
    return array.shape, str(kind), getattr(array, "weak_type", False)


# ---- compiled code -------------------------------------------------------------------------------


def _compile(function: Callable[..., PyTree], call: _CallArguments) -> _Compiled | None:
    """Return a function compiled for a call; None where it calls what is not JAX's, as LAPACK."""
    trees = list[PyTree]()

    def flat(*arrays: jax.Array) -> list[jax.Array]:
        args, named = call.arguments(arrays)
        leaves, tree = jax.tree.flatten(function(*args, **named))
        outputs = [leaf for leaf in leaves if eqx.is_array(leaf)]
        places = map(_Place, range(len(outputs)))
        leaves = [next(places) if eqx.is_array(leaf) else leaf for leaf in leaves]
        trees.append(jax.tree.unflatten(tree, leaves))
        return outputs

    # What JAX has read from its own disk cache cannot be written down again: it lacks its code.
    # Under a name of its own it is not found there, nor is it kept there as well.
    flat.__name__ = f"{function.__name__}_{os.urandom(8).hex()}"
    lowered = jax.jit(flat, keep_unused=True).lower(*call.arrays)
    if "custom_call" in lowered.as_text():
        return None
    # The setting is that of all threads.
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
        ValueError: it calls what is in the process only where JAX has made it anew.
    """
    # Here, since the library as such keeps nothing.
    from jax.experimental.serialize_executable import serialize

    # Such as LAPACK: without it the process would end.
    if "custom-call" in made.run.as_text():  # type: ignore[attr-defined]
        raise ValueError("got a call of other code, allowed is none.")
    code, _, back = serialize(made.run)  # type: ignore[arg-type]
    return pickle.dumps((code, back.num_leaves, made.tree))


def _load(stored: bytes, given: int) -> _Compiled:
    """Return compiled code that takes so many arrays, from bytes."""
    from jax.experimental.serialize_executable import deserialize_and_load

    code, count, tree = pickle.loads(stored)
    before = jax.tree.structure(((0,) * given, {}))
    return _Compiled(deserialize_and_load(code, before, jax.tree.structure([0] * count)), tree)
