"""In which order blocks of agents take their steps.

Step by step, all of them; or, where each hears others near it alone, tile by tile: so few blocks
that they stay in a processor's cache take many steps before the next ones. A tile moves back by as
many blocks a step as neighbours are apart, so that it finds what they show of this step: those
before it were left there by the last tile, and those behind it are done in its own.
"""

from typing import NamedTuple

import numpy as np

from echelon.core.types import Array
from echelon.simulation.codegen import TURN

_CACHES = (600_000, 8_000_000)
"""Bytes of a tile and what it moves over: less than the second and third cache of most processors.
"""
_DEEP = 4
"""Steps of a tile that are worth to stay in the nearer of them."""


class BlockReach(NamedTuple):
    """How far blocks reach.

    Attributes:
        reach: blocks between agents that hear each other, or that an edge measures, at most.
        edges: (edge blocks,) the first block that each of them needs, ascending.
        bytes: of a block with all that belongs to it.
    """

    reach: int
    edges: Array
    bytes: int


def step_by_step(segments: Array, edges: int, steps: int, thread: int, threads: int) -> Array:
    """Return the turns (T, 8) of a thread that takes its part of each level at each step.

    Args:
        segments: (levels + 1,) the first block of each level, and the end.
        edges: how many blocks of edges there are.
        steps: how many steps are taken.
        thread: which of them.
        threads: how many there are; they wait for each other after each level.
    """
    sizes, levels = np.diff(segments), len(segments) - 1
    found = np.zeros((steps, levels, len(TURN)), np.int64)
    found[..., 0], found[..., 1] = np.arange(steps)[:, None], np.arange(levels)
    for k in (0, 1):
        found[..., 2 + k] = segments[:-1] + sizes * (thread + k) // threads
        found[:, -1, 4 + k] = edges * (thread + k) // threads
    turns = found.reshape(-1, len(TURN))
    turns[:, 6:] = np.arange(len(turns))[:, None]
    return turns


def tile_by_tile(segments: Array, near: BlockReach, steps: int, thread: int, threads: int) -> Array:
    """Return the turns (T, 8) of a thread that takes each so many-th tile.

    The leaders are ahead of all others. The arguments are those of `step_by_step`.
    """
    leaders = np.zeros((steps, len(TURN)), np.int64)
    leaders[:, 0], leaders[:, 3] = np.arange(steps), segments[1] * (thread == 0)
    depth, tile = tiles(near, steps)
    blocks, found, count = segments[2] - segments[1], [leaders], steps
    # One pass over all blocks after the other.
    for done in range(0, steps, depth):
        passed = np.arange(min(depth, steps - done))
        needed = -(-(blocks + passed[-1] * near.reach) // tile)
        mine = np.arange(-(-needed // threads))[:, None] * threads + thread
        turn = count + np.arange(mine.size * len(passed)).reshape(len(mine), -1)
        part = np.zeros((*turn.shape, len(TURN)), np.int64)
        part[..., 0], part[..., 1] = done + passed, 1
        for k in (0, 1):
            place = (mine + k) * tile - passed * near.reach
            part[..., 2 + k] = segments[1] + place.clip(0, blocks)
            part[..., 4 + k] = np.searchsorted(near.edges, part[..., 2 + k])
        # The tile before has come as far: of a thread before it this turn, of one behind it the
        # turn of its last tile, or the end of the pass before.
        part[..., 6], part[..., 7] = turn + 1, np.maximum(turn - len(passed) + 1, count)
        found.append(part.reshape(-1, len(TURN)))
        count += turn.size
    return np.concatenate(found)


def tiles(near: BlockReach, steps: int) -> tuple[int, int]:
    """Return how many steps a tile takes, and how many blocks it has."""
    depth, window = 1, 1
    for cache in _CACHES:
        if depth < _DEEP:
            window = max(1, cache // near.bytes)
            depth = max(1, window // (2 * near.reach))
    depth = min(steps, depth)
    return depth, max(1, window - depth * near.reach)


def pays(segments: Array, near: BlockReach, steps: int) -> bool:
    """Tell whether tiles pay: they take several steps, and all blocks are several tiles."""
    depth, tile = tiles(near, steps)
    return depth > 1 and segments[2] > 3 * tile
