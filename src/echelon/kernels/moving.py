"""Numbers of agents from rows of blocks into arrays, and back, whoever stands where."""

from functools import cache
from pathlib import Path

import jax

from echelon.kernels.frame import loop
from echelon.kernels.native import Code
from echelon.kernels.vector_ir import Writer

MOVES = ("blocks", "agents", "values", "size", "count", "first", "last")
"""What it is called with: addresses of a row of the blocks, of who stands where, and of an array
(agents, count); how many numbers a block has; and which of the blocks are moved.
"""
_TYPES = {"f8": "double", "f4": "float", "i1": "i8"}


def moving(bits: int, lanes: int, kind: str, inward: bool) -> str:
    """Return code as text for LLVM that moves rows of blocks into arrays of a kind, or back.

    A block is read once, line by line of memory, and what is its agents' goes where these have it:
    the other way each agent would ask for as many lines as it has rows.
    """
    w = Writer(bits, lanes)
    w.label("entry")
    at = (w.put(f"getelementptr i64, ptr %slots, i64 {k}") for k in range(len(MOVES)))
    kinds = ["ptr"] * 3 + ["i64"] * 4
    blocks, agents, values, size, count, first, last = (
        w.put(f"load {name}, ptr {place}") for name, place in zip(kinds, at, strict=True)
    )
    with loop(w, first, last, []) as (block, _, _):
        begin, place = (w.put(f"mul i64 {block}, {n}") for n in (size, lanes))
        base = w.put(f"getelementptr {w.scalar}, ptr {blocks}, i64 {begin}")
        with loop(w, "0", str(lanes), []) as (lane, _, _):
            at = w.put(f"getelementptr i64, ptr {agents}, i64 {w.put(f'add i64 {place}, {lane}')}")
            far = w.put(f"mul i64 {w.put(f'load i64, ptr {at}')}, {count}")
            own = w.put(f"getelementptr {_TYPES[kind]}, ptr {values}, i64 {far}")
            column = w.put(f"getelementptr {w.scalar}, ptr {base}, i64 {lane}")
            with loop(w, "0", count, []) as (row, _, _):
                down = w.put(f"mul i64 {row}, {lanes}")
                here = w.put(f"getelementptr {w.scalar}, ptr {column}, i64 {down}")
                there = w.put(f"getelementptr {_TYPES[kind]}, ptr {own}, i64 {row}")
                ends = (w.scalar, here), (_TYPES[kind], there)
                _move(w, *(reversed(ends) if inward else ends))
    w.do("ret void")
    return "\n".join(
        [
            "define void @run(ptr noalias %slots) #0 {",
            *w.lines,
            "}",
            "attributes #0 = { nounwind }",
            "",
        ]
    )


def _move(w: Writer, one: tuple[str, str], other: tuple[str, str]) -> None:
    """Write that a number, of a type at an address, comes to another one."""
    (kind, here), (wanted, there) = one, other
    value = w.put(f"load {kind}, ptr {here}")
    if kind != wanted:
        names = {("float", "double"): "fpext", ("double", "float"): "fptrunc"}
        value = w.put(f"{names.get((kind, wanted), 'fptosi')} {kind} {value} to {wanted}")
    w.do(f"store {wanted} {value}, ptr {there}")


@cache
def mover(bits: int, lanes: int, kind: str, inward: bool) -> Code:
    """Return the code of `moving`, made once."""
    cache_folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    return Code(moving(bits, lanes, kind, inward), Path(cache_folder) if cache_folder else None)
