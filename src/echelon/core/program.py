"""Functions that JAX compiles; the command line finds them compiled by the run before."""

import contextlib
import functools
import pickle
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from echelon.core import store

_P = ParamSpec("_P")
_R = TypeVar("_R")


class _Place(NamedTuple):
    """Stands in a tree for one of some arrays."""

    number: int


class _Compiled(NamedTuple):
    """What runs on arrays, and the tree of what comes back."""

    run: Callable[..., Sequence[jax.Array]]
    tree: Any


class _Call(NamedTuple):
    """The arguments of a call: their arrays, and the tree in which these stand."""

    arrays: Sequence[jax.Array]
    leaves: tuple[Any, ...]
    tree: Any

    def key(self) -> Hashable:
        """Return what is equal for calls of one program."""
        kinds = tuple(map(type, self.leaves))
        shapes = tuple((a.shape, a.dtype, a.weak_type) for a in self.arrays)
        return self.tree, self.leaves, kinds, shapes, _precision()

    def arguments(self, arrays: Sequence[Any]) -> Any:
        """Return the arguments with other arrays in the places of theirs."""
        return _filled(jax.tree.unflatten(self.tree, self.leaves), arrays)


@final
class Program(Generic[_P, _R]):
    """A function that is compiled once for all arguments of the same shapes, as by `filter_jit`.

    Where compiled code is kept, neither is it traced again in the next process for arguments of
    echelon's own classes.
    """

    def __init__(self, function: Callable[_P, _R]) -> None:
        """Wrap a function of a module."""
        functools.update_wrapper(self, function)
        self._function, self._plain = function, eqx.filter_jit(function)
        self._made: dict[Hashable, _Compiled | None] = {}

    def __call__(self, *args: _P.args, **named: _P.kwargs) -> _R:
        """Return what the function returns."""
        call = _call_of((args, named)) if store.is_open() else None
        if call is None:
            return self._plain(*args, **named)
        key = call.key()
        if key not in self._made:
            self._made[key] = self._make(call)
        made = self._made[key]
        if made is None:
            return self._plain(*args, **named)
        return _filled(made.tree, made.run(*call.arrays))

    def _make(self, call: _Call) -> _Compiled | None:
        """Return what is kept for a call, or compile and keep it; None for a stranger's classes."""
        name = f"{self._function.__module__}.{self._function.__qualname__}"
        given = call.arguments(call.arrays)
        file = store.place_of(name, _precision(), given, arrays=_shape)
        if file is None:
            return None
        stored = store.read(file)
        if stored is not None:
            # What cannot be read is made again.
            with contextlib.suppress(Exception):
                return _load(stored, len(call.arrays))
        made = _compile(self._function, call)
        # What cannot be written down is not kept.
        with contextlib.suppress(Exception):
            store.keep(file, _packed(made))
        return made


def program(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function that JAX compiles, a `Program`."""
    return Program(function)


def _call_of(arguments: Any) -> _Call | None:
    """Return a call as its arrays and their places; None within a trace, of which it is a part."""
    leaves, tree = jax.tree.flatten(arguments)
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return None
    arrays = [jnp.asarray(leaf) for leaf in leaves if eqx.is_array(leaf)]
    places = map(_Place, range(len(arrays)))
    return _Call(arrays, tuple(next(places) if eqx.is_array(x) else x for x in leaves), tree)


def _filled(tree: Any, arrays: Sequence[Any]) -> Any:
    """Return a tree with arrays in their places."""

    def at(leaf: Any) -> Any:
        return arrays[leaf.number] if isinstance(leaf, _Place) else leaf

    return jax.tree.map(at, tree, is_leaf=lambda leaf: isinstance(leaf, _Place))


def _precision() -> str:
    """Return in what precision JAX computes here."""
    return str(jax.dtypes.canonicalize_dtype(np.float64))


def _shape(array: Any) -> Iterator[bytes]:
    """Yield what is known of an array before it has numbers; all of a number that is none."""
    if not eqx.is_array(array):
        yield from store.bits(array)
        return
    yield f"{array.shape}{array.dtype}{array.weak_type}".encode()


# ---- compiled code -------------------------------------------------------------------------------


def _compile(function: Callable[..., Any], call: _Call) -> _Compiled:
    """Return a function compiled for a call."""
    trees = list[Any]()

    def flat(*arrays: jax.Array) -> list[Any]:
        args, named = call.arguments(arrays)
        leaves, tree = jax.tree.flatten(function(*args, **named))
        made = [leaf for leaf in leaves if eqx.is_array(leaf)]
        places = map(_Place, range(len(made)))
        leaves = [next(places) if eqx.is_array(leaf) else leaf for leaf in leaves]
        trees.append(jax.tree.unflatten(tree, leaves))
        return made

    flat.__name__ = function.__name__
    compiled = jax.jit(flat, keep_unused=True).lower(*call.arrays).compile()
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

    code, made, tree = pickle.loads(stored)
    before = jax.tree.structure(((0,) * given, {}))
    return _Compiled(deserialize_and_load(code, before, jax.tree.structure([0] * made)), tree)
