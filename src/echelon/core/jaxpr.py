"""Equations of a trace by JAX that only call, move entries about or add them up.

They mean the same for entries of any kind: numbers, polynomials, symbols of a solver. Entries that
are no plain numbers stand in NumPy arrays of objects.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

Move: TypeAlias = Callable[..., np.ndarray]
"""(parameters of the primitive, operands) -> result."""

INLINED = {
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
    "remat",
    "remat2",
    "checkpoint",
}
PLACED = {
    "split",
    "rev",
    "pad",
    "gather",
    "scatter",
    "dynamic_slice",
    "dynamic_update_slice",
    "expand_dims",
    "tile",
}
"""What `placed` knows."""

ADDED = {"scatter-add", "scatter_add", "cumsum"}
"""What `added` knows."""


def called(equation: Any) -> Any:
    """Return what an equation of an `INLINED` primitive calls."""
    return next(
        equation.params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in equation.params
    )


def each(function: Callable[..., object], *arrays: np.ndarray) -> np.ndarray:
    """Return a function of one entry of each array, entry by entry."""
    return np.asarray(np.frompyfunc(function, len(arrays), 1)(*arrays), dtype=object)


def bound(equation: Any, operands: Sequence[Any]) -> list[np.ndarray]:
    """Return the results of a primitive for numbers."""
    results = equation.primitive.bind(*(jnp.asarray(a) for a in operands), **equation.params)
    return [np.asarray(r) for r in (results if equation.primitive.multiple_results else [results])]


def placed(
    equation: Any, operands: Sequence[np.ndarray], outside: Callable[[], object]
) -> list[np.ndarray]:
    """Return the results of a primitive that copies entries: JAX moves their places about.

    `outside` makes the entry that is read from outside of an array.
    """
    pool, places = _labelled(operands)

    def entry(place: float) -> object:
        return pool[int(place)] if 0.0 <= place < len(pool) else outside()

    return [each(entry, r) for r in bound(equation, places)]


def added(
    equation: Any, operands: Sequence[np.ndarray], number: Callable[[float], Any]
) -> np.ndarray:
    """Return the result of a primitive that adds entries, by what it does to unit vectors."""
    pool, places = _labelled(operands)

    def result(unit: jax.Array) -> jax.Array:
        data = [unit[a.astype(int)] if a.dtype == float else jnp.asarray(a) for a in places]
        return equation.primitive.bind(*data, **equation.params)

    weights = np.asarray(jax.vmap(result)(jnp.eye(len(pool))))
    total = np.full(weights.shape[1:], number(0.0), object)
    for entry, weight in zip(pool, weights, strict=True):
        total = total + each(lambda w, p=entry: number(w) * p if w else number(0.0), weight)
    return total


def _labelled(operands: Sequence[np.ndarray]) -> tuple[list[Any], list[np.ndarray]]:
    """Return all data entries in a row, and the operands with each entry's place in that row."""
    pool: list[Any] = []
    places = []
    for a in operands:
        if a.dtype.kind in "iu":
            places.append(a)
            continue
        places.append(np.arange(len(pool), len(pool) + a.size, dtype=float).reshape(a.shape))
        pool += list(a.flat)
    return pool, places


def dot(params: Mapping[str, Any], a: np.ndarray, b: np.ndarray, zero: Any) -> np.ndarray:
    """Return the sum of products over contracted axes, batch axes first."""
    (contract_a, contract_b), (batch_a, batch_b) = params["dimension_numbers"]
    left, batch, rows = _matrix_form(a, batch_a, contract_a)
    right, _, columns = _matrix_form(b, batch_b, contract_b)
    found = np.empty((left.shape[0], left.shape[1], right.shape[1]), object)
    for i, j, k in np.ndindex(*found.shape):
        products = (p * q for p, q in zip(left[i, j], right[i, k], strict=True))
        found[i, j, k] = sum(products, start=zero)
    return found.reshape(batch + rows + columns)


def _matrix_form(
    x: np.ndarray, batch: Sequence[int], contracted: Sequence[int]
) -> tuple[np.ndarray, tuple[int, ...], tuple[int, ...]]:
    """Return x as (batch, free, contracted), with the shapes of the first two."""
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *contracted)]
    batch_shape = tuple(x.shape[axis] for axis in batch)
    free_shape = tuple(x.shape[axis] for axis in free)
    inner = math.prod(x.shape[axis] for axis in contracted)
    moved = x.transpose([*batch, *free, *contracted])
    return (
        moved.reshape(math.prod(batch_shape), math.prod(free_shape), inner),
        batch_shape,
        free_shape,
    )


def _broadcast(params: Mapping[str, Any], x: np.ndarray, *_: Any) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    starts, ends = params["start_indices"], params["limit_indices"]
    steps = params["strides"] or [1] * x.ndim
    return x[tuple(slice(*cut) for cut in zip(starts, ends, steps, strict=True))]


MOVES: dict[str, Move] = {
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
    "concatenate": lambda params, *xs: np.concatenate(xs, axis=params["dimension"]),
    "stack": lambda params, *xs: np.stack(xs, axis=params["axis"]),
    **{
        name: lambda params, x: x
        for name in ("copy", "copy_p", "reduce_precision", "stop_gradient")
    },
}
"""What NumPy does to entries of any kind."""
