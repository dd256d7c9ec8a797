"""The order in which blocks of agents take their steps.

Step by step, all of them; or, if all neighbours are near, tile by tile: so few blocks that they
stay in a processor's cache take many steps before the next ones. Each step a tile moves back by as
many blocks as neighbours are apart, so that what they show at this step is there: of blocks before
the tile it was left by the previous tile, and blocks behind are in the tile itself.
"""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import TASK

_CACHES = (600_000, 8_000_000)
"""Bytes of a tile and the blocks it moves over: less than most processors' second and third cache.
"""
_DEEP = 4
"""Steps of a tile from which on it uses the smaller of the two caches."""


class BlockReach(NamedTuple):
    """How far apart blocks are that depend on each other.

    Attributes:
        reach: the most blocks between neighbours, or between the ends of a block of edges.
        edges: (edge blocks,) the first block that each of them needs, ascending.
        bytes: of a block with all arrays that belong to it.
    """

    reach: int
    edges: Array
    bytes: int


def step_by_step(segments: Array, edges: int, steps: int, thread: int, threads: int) -> Array:
    """Return the tasks (T, 8) of a thread that takes its part of each level at each step.

    Args:
        segments: (levels + 1,) the first block of each level, and the end.
        edges: the number of blocks of edges.
        steps: the number of steps.
        thread: the index of the thread.
        threads: the number of threads; they wait for each other after each level.
    """
    sizes, levels = np.diff(segments), len(segments) - 1
    by_level = np.zeros((steps, levels, len(TASK)), np.int64)
    by_level[..., 0], by_level[..., 1] = np.arange(steps)[:, None], np.arange(levels)
    for k in (0, 1):
        by_level[..., 2 + k] = segments[:-1] + sizes * (thread + k) // threads
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
    for cache in _CACHES:
        if depth < _DEEP:
            window = max(1, cache // near.bytes)
            depth = max(1, window // (2 * near.reach))
    depth = min(steps, depth)
    return depth, max(1, window - depth * near.reach)


def tiles_pay(segments: Array, near: BlockReach, steps: int) -> bool:
    """Tell whether tiles are faster: each takes several steps, and there are several tiles."""
    depth, tile = tiles(near, steps)
    return depth > 1 and segments[2] > 3 * tile
