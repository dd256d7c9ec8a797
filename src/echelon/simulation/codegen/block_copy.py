"""Numbers of agents from rows of blocks into arrays, and back, whoever stands where."""

from functools import cache
from pathlib import Path
from threading import Lock

import jax
import numpy as np

from echelon.simulation.codegen.ir_blocks import loop
from echelon.simulation.codegen.machine_code import Code
from echelon.simulation.codegen.vector_ir import Writer

_ONE = Lock()
"""Threads ask for the same code at once, and a cache alone would make it for each."""
_SLOTS = ("blocks", "agents", "values", "way", "size", "count", "first", "last")


def _ways(bits: int) -> list[tuple[int, bool]]:
    """Return the bits of the numbers of an array, and whether it is read, of each way to move."""
    return [(bits, True), (bits, False), *([(64, False)] if bits == 32 else [])]


def moving(bits: int, lanes: int) -> str:
    """Return code as text for LLVM that moves rows of blocks into arrays, or back.

    A block is read once, line by line of memory, and what is its agents' goes where these have it:
    the other way each agent would ask for as many lines as it has rows.
    """
    w, slots = Writer(bits, lanes), dict[str, str]()
    w.label("entry")
    for k, name in enumerate(_SLOTS):
        at = w.put(f"getelementptr i64, ptr %slots, i64 {k}")
        slots[name] = w.put(f"load {'ptr' if k < 3 else 'i64'}, ptr {at}")
    ways = [w.fresh("way") for _ in _ways(bits)]
    listed = " ".join(f"i64 {k}, label %{way}" for k, way in enumerate(ways))
    w.do(f"switch i64 {slots['way']}, label %{ways[0]} [{listed}]")
    for label, (other, inward) in zip(ways, _ways(bits), strict=True):
        w.label(label)
        _move_all(w, slots, "double" if other == 64 else "float", inward)
        w.do("ret void")
    return "\n".join(["define void @run(ptr noalias %slots) nounwind {", *w.lines, "}", ""])


def _move_all(w: Writer, slots: dict[str, str], kind: str, inward: bool) -> None:
    """Write the loops over blocks, their lanes and the rows of each."""
    with loop(w, slots["first"], slots["last"], []) as (block, _, _):
        begin, place = (w.put(f"mul i64 {block}, {n}") for n in (slots["size"], w.lanes))
        base = w.put(f"getelementptr {w.scalar}, ptr {slots['blocks']}, i64 {begin}")
        with loop(w, "0", str(w.lanes), []) as (lane, _, _):
            stands = w.put(f"add i64 {place}, {lane}")
            agent = w.put(f"getelementptr i64, ptr {slots['agents']}, i64 {stands}")
            far = w.put(f"mul i64 {w.put(f'load i64, ptr {agent}')}, {slots['count']}")
            own = w.put(f"getelementptr {kind}, ptr {slots['values']}, i64 {far}")
            column = w.put(f"getelementptr {w.scalar}, ptr {base}, i64 {lane}")
            with loop(w, "0", slots["count"], []) as (row, _, _):
                down = w.put(f"mul i64 {row}, {w.lanes}")
                here = w.put(f"getelementptr {w.scalar}, ptr {column}, i64 {down}")
                there = w.put(f"getelementptr {kind}, ptr {own}, i64 {row}")
                ends = (w.scalar, here), (kind, there)
                _move(w, *(ends[::-1] if inward else ends))


def _move(w: Writer, one: tuple[str, str], other: tuple[str, str]) -> None:
    """Write that a number, of a type at an address, comes to another one."""
    (kind, here), (wanted, there) = one, other
    value = w.put(f"load {kind}, ptr {here}")
    if kind != wanted:
        value = w.put(f"fpext {kind} {value} to {wanted}")
    w.do(f"store {wanted} {value}, ptr {there}")


@cache
def _mover(bits: int, lanes: int) -> Code:
    """Return the code of `moving`, made once."""
    folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    return Code(moving(bits, lanes), Path(folder) if folder else None)


def move(
    rows: np.ndarray, agents: np.ndarray, values: np.ndarray, inward: bool, first: int, last: int
) -> None:
    """Read rows of some blocks into the values of the agents there, or write them (`inward`).

    Args:
        rows: (blocks, count, lanes) of whole blocks, of which they are a part.
        agents: (positions,) int64, who stands there.
        values: (agents, count), contiguous, of the precision of the rows, or float64 to read into.
        inward: whether they go into the blocks.
        first: of the blocks that are meant.
        last: the one after these.

    Raises:
        ValueError: an array is laid out in another way, or its numbers are others.
    """
    _check_layout(rows, agents, values, first, last)
    (_, count, lanes), bits = rows.shape, 8 * rows.itemsize
    way = _ways(bits).index((8 * values.itemsize, inward))
    places = [array.ctypes.data for array in (rows, agents, values)]
    size = rows.strides[0] // rows.itemsize
    slots = np.array([*places, way, size, count, first, last], np.int64)
    with _ONE:
        code = _mover(bits, lanes)
    code.call(slots)


def _check_layout(
    rows: np.ndarray, agents: np.ndarray, values: np.ndarray, first: int, last: int
) -> None:
    """Check what native code, which is given addresses alone, takes for granted."""
    (blocks, count, lanes), size = rows.shape, rows.itemsize
    right = {
        "rows": rows.dtype.kind == "f" and rows.strides[1:] == (lanes * size, size),
        "agents": agents.dtype == np.int64 and agents.flags.c_contiguous,
        "values": values.dtype.kind == "f" and values.flags.c_contiguous,
        "count": values.shape[1:] == (count,),
        "last": 0 <= first <= last <= blocks and last * lanes <= len(agents),
    }
    for name, holds in right.items():
        if not holds:
            raise ValueError(f"`{name}` does not fit what is moved.")
