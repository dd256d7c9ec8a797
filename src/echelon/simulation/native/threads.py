"""Threads that run a kernel together: each some groups of formations, or a part of one swarm."""

import ctypes
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from functools import cache
from threading import Event
from typing import Any, final

import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import SLOTS, Code, aligned, move
from echelon.simulation.native.blocks import Places
from echelon.simulation.native.schedule import pays, step_by_step, tile_by_tile

_SHARED, _WORTH = 20_000, 100_000
"""Agents of a swarm from which on threads share its steps, where they wait for each other, and
steps of one agent of formations: what wakes threads takes as long as fewer.
"""


@cache
def _rest() -> Any:
    """Return a function of the system by which a thread leaves its processor to others."""
    if sys.platform == "win32":
        return ctypes.WinDLL("kernel32").SwitchToThread
    return ctypes.CDLL(None).sched_yield


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@final
class ThreadPool:
    """Runs a kernel on threads; no number depends on how many there are.

    Args:
        places: of the agents.
        pool: threads for groups of formations; None for the caller's alone.
        threads: for a swarm; as many as there are processors for a large one when left out.
    """

    def __init__(self, places: Places, pool: Executor | None, threads: int | None) -> None:
        """Begin with no thread of its own."""
        self.places, self.pool = places, pool
        large = len(places.agents) >= _SHARED
        self.threads = 1 if places.together else threads or (processors() if large else 1)
        self._own = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._known: dict[tuple[int, int], Array] = {}

    def run(
        self, code: Code, values: dict[str, int], firsts: dict[str, Array], common: Array
    ) -> None:
        """Run a kernel.

        Args:
            code: of the kernel.
            values: of its slots, those apart that differ between threads.
            firsts: arrays whose parts follow each other group by group.
            common: room for what all agents have in common at each step.
        """
        if self._own is not None:
            self._swarm(code, values, firsts, common)
            return
        groups, turns = np.arange(self.places.groups), self._turns(values["steps"], 0)

        def fly(some: Array) -> None:
            own = {
                name: array[len(array) // len(groups) * some[0] :] for name, array in firsts.items()
            }
            room = common if len(some) == len(groups) else np.empty_like(common)
            told = {"groups": len(some), "threads": 1, "count": len(turns)}
            _call(code, values | told, own | {"common": room, "turns": turns})

        steps = values["steps"] * len(self.places.agents)
        if self.pool is None or len(groups) < 2 or steps < _WORTH:
            fly(groups)
            return
        # More parts than threads, since another process may take a processor from one of them.
        share(self.pool, fly, np.array_split(groups, min(len(groups), 8)))

    def move(self, blocks: Array, rows: range, values: Array, inward: bool = False) -> None:
        """Read rows of blocks into values of the agents (N, rows), or write them there (`inward`).

        The values are contiguous and of the precision of the blocks, or float64 to read into.
        """
        count, part = len(blocks), blocks[:, rows.start : rows.stop]
        pool = self._own or self.pool

        def some(ends: tuple[int, int]) -> None:
            move(part, self.places.agents, values, inward, *ends)

        if pool is None or part.size < _SHARED * len(rows):
            if part.size:
                some((0, count))
            return
        ends = np.linspace(0, count, 9, dtype=int).tolist()
        share(pool, some, zip(ends[:-1], ends[1:], strict=True))

    def _swarm(
        self, code: Code, values: dict[str, int], firsts: dict[str, Array], common: Array
    ) -> None:
        """Let each thread take its turns."""
        assert self._own is not None
        # Each counts on a line of memory of its own.
        done = aligned((self.threads, 8), np.int64)
        rest = ctypes.cast(_rest(), ctypes.c_void_p).value or 0

        # What needs memory before any thread begins: others would wait for one that failed.
        turns = [self._turns(values["steps"], k) for k in range(self.threads)]
        rooms = [common, *(np.empty_like(common) for _ in turns[1:])]

        def fly(k: int) -> None:
            told = {"groups": 1, "threads": self.threads, "thread": k, "rest": rest}
            parts = {"common": rooms[k], "done": done, "turns": turns[k]}
            _call(code, values | told | {"count": len(turns[k])}, firsts | parts)

        # A thread each, since they wait for each other.
        share(self._own, fly, range(self.threads))

    def _turns(self, steps: int, thread: int) -> Array:
        """Return the turns of a thread."""
        if (steps, thread) not in self._known:
            if len(self._known) > 8 * self.threads:
                self._known.clear()
            segments, near = self.places.segments, self.places.near
            if near is not None and pays(segments, near, steps):
                found = tile_by_tile(segments, near, steps, thread, self.threads)
            else:
                edges = self.places.edge_blocks
                found = step_by_step(segments, edges, steps, thread, self.threads)
            self._known[steps, thread] = found
        return self._known[steps, thread]


def share(pool: Executor, act: Callable[[Any], None], parts: Iterable[Any]) -> None:
    """Let threads act on a part each, all of them or, where Ctrl-C falls between, none.

    Those that began would else wait for ever for those that did not.
    """
    gate, whole, begun = Event(), list[bool](), list[Future[None]]()

    def begin(part: Any) -> None:
        gate.wait()
        if whole:
            act(part)

    try:
        begun += [pool.submit(begin, part) for part in parts]
        whole.append(True)
        gate.set()
        wait(begun)
    finally:
        gate.set()
        # The memory that they write to must live until they end, also after Ctrl-C.
        wait(begun)
    for each in begun:
        each.result()


def _call(code: Code, values: dict[str, int], arrays: Mapping[str, Array]) -> None:
    """Call a kernel; its arrays live until it returns."""
    told = dict(values) | {name: array.ctypes.data for name, array in arrays.items()}
    code.call(np.array([told.get(name, 0) for name in SLOTS], np.int64))
