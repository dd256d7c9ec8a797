"""Size limits of experiments, checked before anything is allocated.

Each function returns why something is too large and what would fit, or None. The caller adds the
subject and the full stop.
"""

import math
import os
from pathlib import Path
from typing import Final

LARGEST: Final = 1e75
"""Of a number that is given: the square of a product of two is a float."""
MOST_STEPS: Final = 2**31 - 1
"""The compiled loop counts steps in 32-bit integers."""
MOST_AGENTS: Final = 1_000_000
MOST_EDGES: Final = 10_000_000
MOST_RUNS: Final = 10_000_000
"""Runs of a sweep."""
MOST_STATES: Final = 300
"""States of one agent: time grows with the cube, memory with the square of them."""

_ROUNDING: Final = 1e-6
"""Fraction of a step: rounding of 2^31 steps is smaller."""
_COPIES: Final = 6
"""Copies in memory: chunks, joined, errors, dataset, and two while its file is written."""
_UNKNOWN: Final = 8 * 2**30
"""Memory in bytes if the system does not report it."""


def excess_agents(agents: int) -> str | None:
    """Return why a graph has too many agents."""
    return _most(agents, MOST_AGENTS, "agents")


def excess_edges(edges: float) -> str | None:
    """Return why a graph has too many edges."""
    return _most(edges, MOST_EDGES, "edges")


def excess_states(states: int) -> str | None:
    """Return why an agent has too many states."""
    return _most(states, MOST_STATES, "states of an agent")


def excess_runs(runs: int, numbers: int = 0) -> str | None:
    """Return why a sweep has too many runs, each with `numbers` stored numbers."""
    most = _most(runs, MOST_RUNS, "runs")
    size, room = 8 * _COPIES * runs * numbers, memory() // 2
    if most is not None or size <= room:
        return most
    return (
        f"{runs} runs are asked for, whose findings need {_bytes(size)} of memory, and "
        f"{_bytes(room)} fit: {runs * room // size} runs"
    )


def horizon_fault(horizon: float, dt: float) -> str | None:
    """Return what is wrong with a horizon (s), unless it is a whole number of few enough steps."""
    if horizon < dt:
        return f"must be at least one step `dt` = {dt:g} s"
    steps = horizon / dt
    if steps > MOST_STEPS + _ROUNDING:
        size = math.log10(horizon) - math.log10(dt)
        shown = f"1e{size:+.0f}" if steps == math.inf else f"{steps:.3g}"
        return f"has {shown} steps of {dt:g} s, and must be at most {MOST_STEPS * dt:.6g} s"
    # 0.3 / 0.1 is slightly less than 3: rounding must not count as a part of a step.
    if abs(steps - round(steps)) <= _ROUNDING:
        return None
    near = " or ".join(f"{k * dt:.12g}" for k in (math.floor(steps), math.ceil(steps)))
    return f"must be a whole number of steps `dt` = {dt:g} s, such as {near} s"


def excess_frames(frames: int, numbers: int, every: int) -> str | None:
    """Return why frames of `numbers` numbers, one each `every` steps, exceed half of memory."""
    size, room = 8 * _COPIES * frames * numbers, memory() // 2
    if size <= room:
        return None
    spacing = every * -(-size // room)
    return (
        f"stores {frames} frames, which need {_bytes(size)} of memory, and {_bytes(room)} fit: "
        f"a `store_every` of {spacing}, or a horizon {size / room:.3g} times shorter"
    )


def excess_rows(rows: int, columns: int) -> str | None:
    """Return why a table of numbers does not fit in memory, of which it may use a quarter."""
    size, room = 8 * rows * columns, memory() // 4
    if size <= room:
        return None
    return f"{rows} rows of {columns} columns need {_bytes(size)}, and {_bytes(room)} fit"


def memory() -> int:
    """Return the memory in bytes that this process may use."""
    result = [limit for limit in (_machine(), _group()) if limit is not None]
    return min(result, default=_UNKNOWN)


def _machine() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows has no such call
        return None


def _group() -> int | None:
    """Return the memory limit of a container under Linux."""
    try:
        return int(Path("/sys/fs/cgroup/memory.max").read_text())
    except (OSError, ValueError):  # no container, or `max`
        return None


def _most(asked: float, most: int, what: str) -> str | None:
    # Shortened, since a user may enter a number of a hundred digits.
    shown = str(asked) if isinstance(asked, int) and asked < 10**12 else f"{asked:.3g}"
    return None if asked <= most else f"{shown} {what} are asked for, and {most} fit"


def _bytes(count: int) -> str:
    return f"{count / 2**30:.3g} GiB"
