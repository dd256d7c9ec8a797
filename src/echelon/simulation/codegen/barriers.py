"""How threads that share the steps of a kernel wait for each other."""

from echelon.simulation.codegen.ir_blocks import loop, only_if
from echelon.simulation.codegen.vector_ir import Writer

_SPINS = 1_000
"""Rounds that a thread waits before it yields the processor, which the other may need."""
_APART = 8
"""Numbers between two counts: each has its own cache line, because another thread writes it."""


def wait(w: Writer, slots: dict[str, str], before: str, after: str) -> None:
    """Write that a thread waits until the others have finished so many tasks."""
    several = w.put(f"icmp sgt i64 {slots['threads']}, 1")
    with only_if(w, w.put(f"zext i1 {several} to i64")):
        with loop(w, "0", slots["threads"]) as (other, _, _):
            lower = w.put(f"icmp slt i64 {other}, {slots['thread']}")
            count = w.put(f"select i1 {lower}, i64 {before}, i64 {after}")
            itself = w.put(f"icmp eq i64 {other}, {slots['thread']}")
            # It need not wait for itself.
            _wait_for(w, slots, other, w.put(f"select i1 {itself}, i64 0, i64 {count}"))


def _wait_for(w: Writer, slots: dict[str, str], other: str, count: str) -> None:
    """Write that a thread waits for another."""
    at = w.part(slots["progress"], other, _APART, "i64")
    start, turn, here = (w.fresh(stem) for stem in ("start", "turn", "here"))
    w.do(f"br label %{start}")
    w.label(start)
    w.do(f"br label %{turn}")
    spins, more = "%" + w.fresh("t"), "%" + w.fresh("t")
    w.label(turn)
    rested = w.fresh("rested")
    w.do(f"{spins} = phi i64 [ 0, %{start} ], [ {more}, %{rested} ]")
    w.do(f"{more} = add i64 {spins}, 1")
    finished = w.put(f"load atomic i64, ptr {at} acquire, align 8")
    enough = w.put(f"icmp sge i64 {finished}, {count}")
    again, rest = w.fresh("wait"), w.fresh("rest")
    w.do(f"br i1 {enough}, label %{here}, label %{again}")
    w.label(again)
    long = w.put(f"icmp sgt i64 {spins}, {_SPINS}")
    w.do(f"br i1 {long}, label %{rest}, label %{rested}")
    w.label(rest)
    w.put(f"call i32 {slots['yield_processor']}()")
    w.do(f"br label %{rested}")
    w.label(rested)
    w.do(f"br label %{turn}")
    w.label(here)


def announce(w: Writer, slots: dict[str, str], task: str) -> None:
    """Write that a thread lets the others know that it has finished a task."""
    several = w.put(f"icmp sgt i64 {slots['threads']}, 1")
    with only_if(w, w.put(f"zext i1 {several} to i64")):
        at = w.part(slots["progress"], slots["thread"], _APART, "i64")
        count = w.put(f"add i64 {task}, 1")
        w.do(f"store atomic i64 {count}, ptr {at} release, align 8")
