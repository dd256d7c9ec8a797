"""Threads that run a kernel, and the order in which blocks of agents take their steps.

Each thread steps some groups of formations, or a part of one swarm. A swarm is stepped step by
step; or, if all neighbours are near, tile by tile: so few blocks that they stay in a processor's
cache take many steps before the next ones. Each step a tile moves back by as many blocks as
neighbours are apart, so that what they show at this step is there: of blocks before the tile it was
left by the previous tile, and blocks behind are in the tile itself.
"""

import ctypes
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from functools import cache
from threading import Event
from typing import Any, TypeVar, final

import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import ANNOUNCE, PRIOR, SLOTS, TASK, Code, aligned, copy_rows
from echelon.simulation.native.blocks import BlockReach, Places

_SHARED, _WORTH = 20_000, 100_000
"""Agents of a swarm from which on threads share its steps, and agent steps of formations from which
on they share those: to wake threads takes as long as fewer.
"""

_Part = TypeVar("_Part")


@cache
def _yield_processor() -> Any:
    if sys.platform == "win32":
        return ctypes.WinDLL("kernel32").SwitchToThread
    return ctypes.CDLL(None).sched_yield


def processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@final
class ThreadPool:
    """Runs a kernel on threads; results do not depend on their number.

    Args:
        places: of the agents.
        pool: threads for groups of formations; None for the caller's only.
        threads: for a swarm; by default one per processor for a large one.
    """

    def __init__(self, places: Places, pool: Executor | None, threads: int | None) -> None:
        self.places, self.pool = places, pool
        large = len(places.agents) >= _SHARED
        self.threads = 1 if places.batched else threads or (processors() if large else 1)
        self._workers = ThreadPoolExecutor(self.threads) if self.threads > 1 else None
        self._schedules: dict[tuple[int, int], Array] = {}

    def run(
        self, code: Code, values: dict[str, int], firsts: dict[str, Array], uniform_values: Array
    ) -> None:
        """Run a kernel.

        Args:
            code: of the kernel.
            values: of its slots, except for those that differ between threads.
            firsts: arrays whose parts follow each other group by group.
            uniform_values: memory for the numbers that are the same for all agents at each step.
        """
        if self._workers is not None:
            self._run_swarm(code, values, firsts, uniform_values)
            return
        groups, schedule = np.arange(self.places.groups), self._schedule(values["steps"], 0)

        def run_groups(some: Array) -> None:
            arrays = {
                name: array[len(array) // len(groups) * some[0] :] for name, array in firsts.items()
            }
            whole = len(some) == len(groups)
            arrays["uniform_values"] = uniform_values if whole else np.empty_like(uniform_values)
            numbers = {"groups": len(some), "threads": 1, "count": len(schedule)}
            call(code, values | numbers, arrays | {"schedule": schedule})

        steps = values["steps"] * len(self.places.agents)
        if self.pool is None or len(groups) < 2 or steps < _WORTH:
            run_groups(groups)
            return
        # More parts than threads, because another process may take a processor from one of them.
        share(self.pool, run_groups, np.array_split(groups, min(len(groups), 8)))

    def copy(self, blocks: Array, rows: range, values: Array, inward: bool = False) -> None:
        """Read rows of blocks into (N, rows), of their precision or float64; `inward` writes."""
        count, part = len(blocks), blocks[:, rows.start : rows.stop]
        pool = self._workers or self.pool

        def copy_some(ends: tuple[int, int]) -> None:
            copy_rows(part, self.places.agents, values, inward, *ends)

        if pool is None or part.size < _SHARED * len(rows):
            if part.size:
                copy_some((0, count))
            return
        ends = np.linspace(0, count, 9, dtype=int).tolist()
        share(pool, copy_some, zip(ends[:-1], ends[1:], strict=True))

    def _run_swarm(
        self, code: Code, values: dict[str, int], firsts: dict[str, Array], uniform_values: Array
    ) -> None:
        assert self._workers is not None
        # Each count has its own cache line.
        progress = aligned((self.threads, 8), np.int64)
        yield_processor = ctypes.cast(_yield_processor(), ctypes.c_void_p).value or 0

        # All memory before any thread begins: others would wait for one that failed.
        schedules = [self._schedule(values["steps"], k) for k in range(self.threads)]
        uniform = [uniform_values, *(np.empty_like(uniform_values) for _ in schedules[1:])]

        def run_thread(k: int) -> None:
            numbers = {"groups": 1, "threads": self.threads, "thread": k}
            numbers |= {"yield_processor": yield_processor, "count": len(schedules[k])}
            arrays = {"uniform_values": uniform[k], "progress": progress, "schedule": schedules[k]}
            call(code, values | numbers, firsts | arrays)

        # One part each, because they wait for each other.
        share(self._workers, run_thread, range(self.threads))

    def _schedule(self, steps: int, thread: int) -> Array:
        if (steps, thread) not in self._schedules:
            if len(self._schedules) > 8 * self.threads:
                self._schedules.clear()
            segments, reach = self.places.segments, self.places.reach
            if reach is not None and tiles_pay(segments, reach, steps):
                tasks = tile_by_tile(segments, reach, steps, thread, self.threads)
            else:
                edges = self.places.edge_blocks
                prior = self.places.listens_first, self.places.announces
                tasks = step_by_step(segments, edges, steps, thread, self.threads, *prior)
            self._schedules[steps, thread] = tasks
        return self._schedules[steps, thread]


def share(pool: Executor, act: Callable[[_Part], None], parts: Iterable[_Part]) -> None:
    """Let all threads act, or none if Ctrl-C comes before: some would wait for the others."""
    gate, all_submitted, futures = Event(), list[bool](), list[Future[None]]()

    def begin(part: _Part) -> None:
        gate.wait()
        if all_submitted:
            act(part)

    try:
        futures += [pool.submit(begin, part) for part in parts]
        all_submitted.append(True)
        gate.set()
        wait(futures)
    finally:
        gate.set()
        # The memory that they write to must exist until they end, also after Ctrl-C.
        wait(futures)
    for future in futures:
        future.result()


def call(code: Code, values: dict[str, int], arrays: Mapping[str, Array]) -> None:
    """Call a kernel; its arrays exist until it returns."""
    slots = values | {name: array.ctypes.data for name, array in arrays.items()}
    code.call(np.array([slots.get(name, 0) for name in SLOTS], np.int64))


# ---- which blocks take which step ----------------------------------------------------------------


_CACHES = (600_000, 8_000_000)
"""Bytes of a tile and the blocks it moves over: less than most processors' second and third cache.
"""
_DEEP = 4
"""Steps of a tile from which on it uses the smaller of the two caches."""


def step_by_step(
    segments: Array,
    edges: int,
    steps: int,
    thread: int,
    threads: int,
    prior: bool = False,
    announces: bool = False,
) -> Array:
    """Return the tasks (T, 8) of a thread that takes its part of each level at each step.

    Args:
        segments: (levels + 1,) the first block of each level, and the end.
        edges: the number of blocks of edges.
        steps: the number of steps.
        thread: the index of the thread.
        threads: the number of threads; they wait for each other after each level.
        prior: whether all blocks first do what is before any agent acts.
        announces: whether leaders then announce what they do.
    """
    before = [(PRIOR, 0, segments[-1])] * prior + [(ANNOUNCE, 0, segments[1])] * announces
    count = len(segments) - 1
    rows = np.array(before, int).reshape(-1, 3), np.c_[:count, segments[:-1], segments[1:]]
    levels, *ends = np.concatenate(rows).T
    by_level = np.zeros((steps, len(levels), len(TASK)), np.int64)
    by_level[..., 0], by_level[..., 1] = np.arange(steps)[:, None], levels
    for k in (0, 1):
        by_level[..., 2 + k] = ends[0] + (ends[1] - ends[0]) * (thread + k) // threads
        by_level[:, -1, 4 + k] = edges * (thread + k) // threads
    tasks = by_level.reshape(-1, len(TASK))
    tasks[:, 6:] = np.arange(len(tasks))[:, None]
    return tasks


def tile_by_tile(segments: Array, near: BlockReach, steps: int, thread: int, threads: int) -> Array:
    """Return the tasks (T, 8) of a thread that takes one tile in `threads`.

    The leaders are ahead of all others. The arguments are those of `step_by_step`.
    """
    leaders = np.zeros((steps, len(TASK)), np.int64)
    leaders[:, 0], leaders[:, 3] = np.arange(steps), segments[1] * (thread == 0)
    depth, tile = tiles(near, steps)
    blocks, parts, count = segments[2] - segments[1], [leaders], steps
    # One pass over all blocks after the other.
    for done in range(0, steps, depth):
        passed = np.arange(min(depth, steps - done))
        needed = -(-(blocks + passed[-1] * near.reach) // tile)
        mine = np.arange(-(-needed // threads))[:, None] * threads + thread
        number = count + np.arange(mine.size * len(passed)).reshape(len(mine), -1)
        part = np.zeros((*number.shape, len(TASK)), np.int64)
        part[..., 0], part[..., 1] = done + passed, 1
        for k in (0, 1):
            place = (mine + k) * tile - passed * near.reach
            part[..., 2 + k] = segments[1] + place.clip(0, blocks)
            part[..., 4 + k] = np.searchsorted(near.edges, part[..., 2 + k])
        # The previous tile must be as far: a thread with a lower index at this task, one with a
        # higher index at the task of its previous tile, or at the end of the previous pass.
        part[..., 6], part[..., 7] = number + 1, np.maximum(number - len(passed) + 1, count)
        parts.append(part.reshape(-1, len(TASK)))
        count += number.size
    return np.concatenate(parts)


def tiles(near: BlockReach, steps: int) -> tuple[int, int]:
    """Return the number of steps of a tile, and its number of blocks."""
    depth, window = 1, 1
    for size in _CACHES:
        if depth < _DEEP:
            window = max(1, size // near.bytes)
            depth = max(1, window // (2 * near.reach))
    depth = min(steps, depth)
    return depth, max(1, window - depth * near.reach)


def tiles_pay(segments: Array, near: BlockReach, steps: int) -> bool:
    """Tell whether tiles are faster: each takes several steps, and there are several tiles."""
    depth, tile = tiles(near, steps)
    return depth > 1 and segments[2] > 3 * tile
