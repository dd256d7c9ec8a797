"""How threads that share a kernel's steps wait for each other."""

from echelon.simulation.codegen.ir_blocks import loop, only_if
from echelon.simulation.codegen.vector_ir import Writer

_TURNS = 1_000
"""That a thread waits before it leaves the processor: another may need it to come here."""
_APART = 8
"""Numbers between two counts: each has a line of memory, since another thread writes it."""


def wait(w: Writer, slots: dict[str, str], before: str, after: str) -> None:
    """Write that a thread waits until the others have done so many turns."""
    several = w.put(f"icmp sgt i64 {slots['threads']}, 1")
    with only_if(w, w.put(f"zext i1 {several} to i64")):
        with loop(w, "0", slots["threads"], []) as (other, _, _):
            lower = w.put(f"icmp slt i64 {other}, {slots['thread']}")
            wanted = w.put(f"select i1 {lower}, i64 {before}, i64 {after}")
            own = w.put(f"icmp eq i64 {other}, {slots['thread']}")
            # It need not wait for itself.
            _wait_for(w, slots, other, w.put(f"select i1 {own}, i64 0, i64 {wanted}"))


def _wait_for(w: Writer, slots: dict[str, str], other: str, wanted: str) -> None:
    """Write that a thread waits for another."""
    at = _count(w, slots, other)
    start, turn, here = (w.fresh(stem) for stem in ("start", "turn", "here"))
    w.do(f"br label %{start}")
    w.label(start)
    w.do(f"br label %{turn}")
    turns, more = "%" + w.fresh("t"), "%" + w.fresh("t")
    w.label(turn)
    rested = w.fresh("rested")
    w.do(f"{turns} = phi i64 [ 0, %{start} ], [ {more}, %{rested} ]")
    w.do(f"{more} = add i64 {turns}, 1")
    seen = w.put(f"load atomic i64, ptr {at} acquire, align 8")
    all_ = w.put(f"icmp sge i64 {seen}, {wanted}")
    tired, rest = w.fresh("wait"), w.fresh("rest")
    w.do(f"br i1 {all_}, label %{here}, label %{tired}")
    w.label(tired)
    long = w.put(f"icmp sgt i64 {turns}, {_TURNS}")
    w.do(f"br i1 {long}, label %{rest}, label %{rested}")
    w.label(rest)
    w.put(f"call i32 {slots['rest']}()")
    w.do(f"br label %{rested}")
    w.label(rested)
    w.do(f"br label %{turn}")
    w.label(here)


def tell_done(w: Writer, slots: dict[str, str], turn: str) -> None:
    """Write that a thread tells the others that it has done a turn."""
    several = w.put(f"icmp sgt i64 {slots['threads']}, 1")
    with only_if(w, w.put(f"zext i1 {several} to i64")):
        at = _count(w, slots, slots["thread"])
        done = w.put(f"add i64 {turn}, 1")
        w.do(f"store atomic i64 {done}, ptr {at} release, align 8")


def _count(w: Writer, slots: dict[str, str], thread: str) -> str:
    far = w.put(f"mul i64 {thread}, {_APART}")
    return w.put(f"getelementptr i64, ptr {slots['done']}, i64 {far}")
