"""What equations of a trace do to arrays of NumPy: moves of any entries, arithmetic of numbers.

To the bit what JAX makes of them, without compiling each shape anew, which takes it up to 100 ms.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

Params: TypeAlias = Mapping[str, Any]
"""The parameters of a primitive; each primitive has its own names and types."""

Rule: TypeAlias = Callable[..., np.ndarray]
"""(parameters of the primitive, operands) -> result, of which operands may be plain numbers."""


def _broadcast(params: Params, x: np.ndarray, *_: np.ndarray) -> np.ndarray:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(params: Params, x: np.ndarray) -> np.ndarray:
    starts, ends = params["start_indices"], params["limit_indices"]
    # JAX leaves strides out where all of them are 1.
    steps = params["strides"] or [1] * x.ndim
    return x[tuple(slice(*cut) for cut in zip(starts, ends, steps, strict=True))]


MOVES: dict[str, Rule] = {
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "reshape": lambda params, x: x.reshape(params["new_sizes"]),
    "squeeze": lambda params, x: np.squeeze(x, tuple(params["dimensions"])),
    "transpose": lambda params, x: x.transpose(params["permutation"]),
    "concatenate": lambda params, *xs: np.concatenate(xs, axis=params["dimension"]),
    "stack": lambda params, *xs: np.stack(xs, axis=params["axis"]),
}
"""Primitives that only move entries, which may be of any kind."""


def _window(
    shape: Sequence[int],
    indices: np.ndarray,
    sizes: Sequence[int],
    axes: Sequence[int],
    batches: tuple[Sequence[int], Sequence[int]],
) -> tuple[list[np.ndarray], bool]:
    """Return the places that windows of an array cover, and whether one was not within it.

    Args:
        shape: of the array, k axes.
        indices: (..., i), where each window begins along `axes`.
        sizes: of a window along each axis.
        axes: those that the indices are of.
        batches: axes of the array that go along with axes of the indices.

    Returns:
        The places along each axis, which broadcast to (..., *sizes), clipped into the array.
    """
    before, k = indices.shape[:-1], len(shape)
    starts = np.zeros((k, *before), int)
    starts[list(axes)] = np.moveaxis(indices, -1, 0)
    for axis, along in zip(*batches, strict=True):
        rows = [-1 if j == along else 1 for j in range(len(before))]
        starts[axis] = np.arange(shape[axis]).reshape(rows)
    last = (np.array(shape) - np.array(sizes)).reshape(-1, *(1 for _ in before))
    outside = bool(((starts < 0) | (starts > last)).any())
    places = []
    for axis, start in enumerate(np.clip(starts, 0, last)):
        along = np.arange(sizes[axis]).reshape([-1 if j == axis else 1 for j in range(k)])
        places.append(start.reshape(*before, *(1 for _ in shape)) + along)
    return places, outside


def _is_filled(params: Params) -> bool:
    return "FILL_OR_DROP" in str(params["mode"])


def _gather(params: Params, x: np.ndarray, indices: np.ndarray) -> np.ndarray | None:
    """Return windows of an array."""
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    batches = numbers.operand_batching_dims, numbers.start_indices_batching_dims
    places, outside = _window(x.shape, indices, sizes, numbers.start_index_map, batches)
    before = indices.ndim - 1
    gone = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    if outside and _is_filled(params):
        return None
    read = x[tuple(places)].squeeze(tuple(before + axis for axis in gone))
    offsets = numbers.offset_dims
    return np.moveaxis(read, range(before, before + len(offsets)), offsets)


def _scatter(
    params: Params, x: np.ndarray, indices: np.ndarray, updates: np.ndarray
) -> np.ndarray | None:
    """Return an array with windows of it replaced."""
    result = x.copy()
    if params["update_jaxpr"] is not None:
        return None
    places = _scattered(params, x, indices, updates)
    if places is None:
        return None
    result[places[0]] = places[1]
    return result


def scatter_add(
    params: Params, x: np.ndarray, indices: np.ndarray, updates: np.ndarray
) -> np.ndarray | None:
    """Return an array with entries of any kind added to windows of it; None if one is outside."""
    places, result = _scattered(params, x, indices, updates), x.copy()
    if places is not None:
        np.add.at(result, *places)
    return None if places is None else result


def _scattered(
    params: Params, x: np.ndarray, indices: np.ndarray, updates: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray] | None:
    """Return the places that windows cover and the updates, alike in shape; None if outside."""
    numbers, before = params["dimension_numbers"], indices.ndim - 1
    alone = sorted((*numbers.inserted_window_dims, *numbers.operand_batching_dims))
    windows = numbers.update_window_dims
    updates = np.moveaxis(updates, windows, range(before, before + len(windows)))
    updates = np.expand_dims(updates, [before + axis for axis in alone])
    batches = numbers.operand_batching_dims, numbers.scatter_indices_batching_dims
    places, outside = _window(
        x.shape, indices, updates.shape[before:], numbers.scatter_dims_to_operand_dims, batches
    )
    return None if outside else (tuple(np.broadcast_arrays(*places)), updates)


def _pad(params: Params, x: np.ndarray, value: np.ndarray) -> np.ndarray | None:
    config = params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        return None
    return np.pad(x, [(low, high) for low, high, _ in config], constant_values=value)


def _numeric(name: str) -> Rule:
    return lambda params, *arrays: getattr(np, name)(*arrays)


def _quotient(params: Params, x: np.ndarray, y: np.ndarray) -> np.ndarray | None:
    with np.errstate(all="ignore"):
        return None if x.dtype.kind != "f" else _unless_tiny(x / y, x, y)


def _integer_power(params: Params, x: np.ndarray) -> np.ndarray | None:
    """Return a power by the products of JAX, in its order."""
    if x.dtype.kind != "f" or params["y"] == 0:
        return None
    rest, square, power, parts = abs(params["y"]), x, None, [x]
    with np.errstate(all="ignore"):
        while rest:
            if rest & 1:
                power = square if power is None else power * square
                parts.append(power)
            rest >>= 1
            square = square * square if rest else square
            parts.append(square)
        assert power is not None
        result = power if params["y"] > 0 else np.ones((), x.dtype) / power
    return _unless_tiny(result, *parts)


def _unless_tiny(result: np.ndarray, *parts: np.ndarray) -> np.ndarray | None:
    """Return a result, but None where a number has so few digits that JAX takes it for 0."""
    least = np.finfo(result.dtype).tiny
    tiny = any(((a != 0.0) & (np.abs(a) < least)).any() for a in (result, *parts))
    return None if tiny else result


NUMERIC: dict[str, Callable[..., np.ndarray | None]] = {
    **MOVES,
    **{
        name: _numeric(full)
        for name, full in {
            **{"add": "add", "sub": "subtract", "mul": "multiply", "neg": "negative"},
            **{"add_any": "add", "not": "invert"},
            **{"lt": "less", "le": "less_equal", "gt": "greater", "ge": "greater_equal"},
            **{"eq": "equal", "ne": "not_equal", "max": "maximum", "min": "minimum"},
            **{"and": "bitwise_and", "or": "bitwise_or", "abs": "abs"},
        }.items()
    },
    "copy": lambda params, x: x,
    "div": _quotient,
    "integer_pow": _integer_power,
    "gather": _gather,
    "scatter": _scatter,
    "pad": _pad,
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
    "convert_element_type": lambda params, x: x.astype(params["new_dtype"]),
    "reduce_or": lambda params, x: np.bitwise_or.reduce(x, params["axes"]),
    "reduce_and": lambda params, x: np.bitwise_and.reduce(x, params["axes"]),
    "iota": lambda params: np.broadcast_to(
        np.arange(params["shape"][params["dimension"]], dtype=params["dtype"]).reshape(
            [-1 if k == params["dimension"] else 1 for k in range(len(params["shape"]))]
        ),
        params["shape"],
    ),
}
"""Rules for plain numbers; where one returns None, JAX computes."""
