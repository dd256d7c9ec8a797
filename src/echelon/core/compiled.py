"""JIT-compiled functions whose machine code is cached on disk by the command line."""

import contextlib
import functools
import pickle
import threading
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, NamedTuple, TypeAlias, TypeVar, final

import equinox as eqx
import jax
from jax.core import Tracer

from echelon.core.cache import MOST, BoundedCache, is_open, jax_settings, load_or_compute
from echelon.core.identity import identify, key_of_foreign
from echelon.core.types import PyTree

_R = TypeVar("_R")
_Program: TypeAlias = tuple[Callable[..., Sequence[jax.Array]], PyTree]
"""Compiled code, and the tree of its results with placeholders for arrays."""
_LEAST, _NEVER = "jax_persistent_cache_min_compile_time_secs", 1e9
"""Option and value (compile time, s) that keep a program out of the disk cache of JAX."""
_COMPILING: Final = threading.Lock()


class Placeholder(NamedTuple):
    """Stands in a tree for one array of a list, and for its shape and type."""

    number: int
    form: object = None


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
        self._jitted = BoundedCache[Callable[..., _R]](MOST)
        self._programs = BoundedCache[_Program | None](MOST)

    def __call__(self, *args: object, **named: object) -> _R:
        """Return what the function returns."""
        arrays, call = _split((args, named), _form)
        bits, foreign = identify(call)
        program = None
        # A trace includes the call.
        if is_open() and not foreign and not any(isinstance(array, Tracer) for array in arrays):
            key = bits, jax_settings()
            program = self._programs.get_or_make(key, lambda: self._load(arrays, call, bits))
        if program is not None:
            return _joined(program[1], program[0](*arrays))
        # JAX knows classes, and not what their code reads: each has a function of its own.
        jitted = self._jitted.get_or_make(key_of_foreign(bits, foreign), self._new_jit)
        return jitted(*args, **named)

    def _new_jit(self) -> Callable[..., _R]:
        """Return the function compiled as another one to JAX."""
        function, named = self._function, dict[str, Any](compiler_options=self._options)
        return eqx.filter_jit(
            functools.wraps(function)(lambda *a, **named: function(*a, **named)), **named
        )

    def _load(self, arrays: Sequence[jax.Array], call: PyTree, bits: bytes) -> _Program | None:
        """Return the program of a call from the disk, or compile it; None if JAX compiles it."""

        def unpack(stored: bytes) -> _Program | None:
            # Imported here, since only the command line stores programs.
            from jax.experimental.serialize_executable import deserialize_and_load

            code, count, tree = pickle.loads(stored)
            if code is None:
                return None
            before = jax.tree.structure(((0,) * len(arrays), {}))
            return deserialize_and_load(code, before, jax.tree.structure([0] * count)), tree

        name = f"{self._function.__module__}.{self._function.__qualname__}"
        return load_or_compute(
            lambda: compile_call(self._function, arrays, call, self._options),
            name,
            bits,
            unpack=unpack,
            pack=_packed,
        )


def cached_jit(function: Callable[..., _R]) -> Callable[..., _R]:
    """Return a function compiled by JAX; its arrays may be of JAX or NumPy."""
    return CompiledFunction(function)


def compiled_for_one_call(function: Callable[..., _R]) -> Callable[..., _R]:
    """Return the same for a function whose programs run once, which takes less than compiling them.

    They are compiled without LLVM's optimizer, in little more than half of the time.
    """
    return CompiledFunction(function, {"xla_backend_optimization_level": 0})


def _split(
    tree: PyTree, form: Callable[[jax.Array], object] = lambda _: None
) -> tuple[list[jax.Array], PyTree]:
    leaves, structure = jax.tree.flatten(tree)
    arrays = list[jax.Array]()
    for k, leaf in enumerate(leaves):
        if eqx.is_array(leaf):
            leaves[k] = Placeholder(len(arrays), form(leaf))
            arrays.append(leaf)
    return arrays, jax.tree.unflatten(structure, leaves)


def _joined(tree: PyTree, arrays: Sequence[jax.Array]) -> PyTree:
    return jax.tree.map(
        lambda leaf: arrays[leaf.number] if isinstance(leaf, Placeholder) else leaf,
        tree,
        is_leaf=lambda leaf: isinstance(leaf, Placeholder),
    )


def _form(array: jax.Array) -> tuple[tuple[int, ...], str, bool]:
    """Return the shape and type of an array as JAX reads it in the current precision."""
    kind = jax.dtypes.canonicalize_dtype(array.dtype, allow_extended_dtype=True)
    return array.shape, _name(kind), getattr(array, "weak_type", False)


_name = functools.lru_cache(str)


def compile_call(
    function: Callable[..., PyTree],
    arrays: Sequence[jax.Array],
    call: PyTree,
    options: dict[str, Any] | None,
) -> _Program | None:
    """Return a function compiled for a call; None if it calls foreign code such as LAPACK."""
    trees = list[PyTree]()

    def flat(*arrays: jax.Array) -> list[jax.Array]:
        args, named = _joined(call, arrays)
        outputs, tree = _split(function(*args, **named))
        trees.append(tree)
        return outputs

    # A program that JAX loads from its own disk cache cannot be serialized again. Under this name
    # it has none.
    flat.__name__ = f"{function.__name__}_stored_by_echelon"
    lowered = jax.jit(flat, keep_unused=True, compiler_options=options).lower(*arrays)
    if "custom_call" in lowered.as_text():
        return None
    # The option is shared by all threads.
    with _COMPILING:
        least = jax.config.values[_LEAST]
        jax.config.update(_LEAST, _NEVER)
        try:
            return lowered.compile(), trees[-1]
        finally:
            jax.config.update(_LEAST, least)


def _packed(program: _Program | None) -> bytes:
    """Return compiled code and its tree as bytes; those of None for what cannot be serialized."""
    from jax.experimental.serialize_executable import serialize

    # JAX compiles that from the next process on. Foreign code, such as LAPACK, exists only in the
    # process that compiled it, and would crash another one.
    if program is not None and "custom-call" not in program[0].as_text():  # type: ignore[attr-defined]
        with contextlib.suppress(Exception):
            code, _, back = serialize(program[0])  # type: ignore[arg-type]
            return pickle.dumps((code, back.num_leaves, program[1]))
    return pickle.dumps((None, 0, None))
