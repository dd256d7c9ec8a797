"""Copies numbers of agents from rows of blocks into arrays, and back, in any order of agents."""

from functools import cache
from threading import Lock

import numpy as np

from echelon.simulation.codegen.machine_code import Code
from echelon.simulation.codegen.vector_ir import Writer, loop

_LOCK = Lock()
"""Threads ask for the same code at once, and a cache alone would compile it for each."""
_SLOTS = ("blocks", "agents", "values", "way", "size", "count", "first", "last")


def _ways(bits: int) -> list[tuple[int, bool]]:
    """Return the bits of an array's numbers, and whether it is read, of each way to copy."""
    return [(bits, True), (bits, False), *([(64, False)] if bits == 32 else [])]


def copy_text(bits: int, lanes: int) -> str:
    """Return code as text for LLVM that copies rows of blocks into arrays, or back.

    A block is read once, one cache line after the other, and each number goes to its agent: agent
    by agent, each would read as many cache lines as it has rows.
    """
    w, slots = Writer(bits, lanes), dict[str, str]()
    w.label("entry")
    for k, name in enumerate(_SLOTS):
        slots[name] = w.load("ptr" if k < 3 else "i64", w.at("i64", "%slots", k))
    ways = [w.fresh("way") for _ in _ways(bits)]
    cases = " ".join(f"i64 {k}, label %{way}" for k, way in enumerate(ways))
    w.do(f"switch i64 {slots['way']}, label %{ways[0]} [{cases}]")
    for label, (other, inward) in zip(ways, _ways(bits), strict=True):
        w.label(label)
        _copy_all(w, slots, "double" if other == 64 else "float", inward)
        w.do("ret void")
    return "\n".join(["define void @run(ptr noalias %slots) nounwind {", *w.lines, "}", ""])


def _copy_all(w: Writer, slots: dict[str, str], kind: str, inward: bool) -> None:
    with loop(w, slots["first"], slots["last"]) as (block, _, _):
        begin, place = (w.put(f"mul i64 {block}, {n}") for n in (slots["size"], w.lanes))
        base = w.at(w.scalar, slots["blocks"], begin)
        with loop(w, "0", str(w.lanes)) as (lane, _, _):
            position = w.put(f"add i64 {place}, {lane}")
            agent = w.load("i64", slots["agents"], position)
            numbers = w.part(slots["values"], agent, slots["count"], kind)
            column = w.at(w.scalar, base, lane)
            with loop(w, "0", slots["count"]) as (row, _, _):
                ends = (w.scalar, w.part(column, row, w.lanes)), (kind, w.at(kind, numbers, row))
                _copy(w, *(ends[::-1] if inward else ends))


def _copy(w: Writer, source: tuple[str, str], target: tuple[str, str]) -> None:
    (kind, here), (other, there) = source, target
    value = w.load(kind, here)
    if kind != other:
        value = w.put(f"fpext {kind} {value} to {other}")
    w.store(other, value, there)


@cache
def _copier(bits: int, lanes: int) -> Code:
    return Code(copy_text(bits, lanes))


def copy_rows(
    rows: np.ndarray, agents: np.ndarray, values: np.ndarray, inward: bool, first: int, last: int
) -> None:
    """Read rows of some blocks into the values of the agents there, or write them (`inward`).

    Args:
        rows: (blocks, count, lanes), some rows of whole blocks.
        agents: (positions,) int64, the agent at each position.
        values: (agents, count), contiguous, of the precision of the rows, or float64 to read into.
        inward: whether the values are written into the blocks.
        first: the first block.
        last: the block after the last one.

    Raises:
        ValueError: an array has another layout or another type of numbers.
    """
    _check_layout(rows, agents, values, first, last)
    (_, count, lanes), bits = rows.shape, 8 * rows.itemsize
    way = _ways(bits).index((8 * values.itemsize, inward))
    places = [array.ctypes.data for array in (rows, agents, values)]
    size = rows.strides[0] // rows.itemsize
    slots = np.array([*places, way, size, count, first, last], np.int64)
    with _LOCK:
        code = _copier(bits, lanes)
    code.call(slots)


def _check_layout(
    rows: np.ndarray, agents: np.ndarray, values: np.ndarray, first: int, last: int
) -> None:
    """Check what native code, which receives only addresses, assumes."""
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
            raise ValueError(f"`{name}` does not fit the blocks to copy.")
