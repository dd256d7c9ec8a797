"""Names, colours and lines of agents, the same in every figure."""

import bisect
from collections.abc import Iterable
from typing import Any

from echelon.core.types import Array
from echelon.experiments.results.recording import Recording
from echelon.output.plots import style as draw

# Broad and pale, so that it stays visible under the thin line of its leader.
REFERENCE = {"color": draw.REFERENCE, "linestyle": (0, (1.6, 0.9)), "linewidth": 3.0, "zorder": 2}

MOST = 2000
"""Agents that a figure draws one by one; more would hide each other and take minutes."""


def name_of(run: Recording, agent: int, short: bool = False) -> str | None:
    """Return an agent's name; with `short`, None for all of a large swarm but its first leader."""
    leaders, few = run.leaders, run.agents <= draw.NAMED
    if agent in leaders:
        if not short or few or len(leaders) <= draw.NAMED:
            return f"leader {agent}"
        return f"{len(leaders)} leaders" if agent == leaders[0] else None
    if few or not short:
        return f"follower {agent}"
    return f"{len(run.followers)} followers" if agent == run.followers[0] else None


def pen_of(run: Recording, agent: int) -> dict[str, Any]:
    """Return the look of an agent's lines."""
    leads = agent in run.leaders
    place = bisect.bisect_left(run.leaders if leads else run.followers, agent)
    return (draw.leader_pen if leads else draw.pen)(place, run.agents)


def leaders_first(run: Recording, agents: Iterable[int]) -> list[int]:
    """Return agents in the order in which they are drawn."""
    # The order of drawing is that of the legend; `zorder` decides which line is on top.
    return sorted(agents, key=lambda agent: agent not in run.leaders)


def drawn(run: Recording) -> list[int]:
    """Return the agents that are drawn: all, or evenly spread ones of a huge swarm."""
    step = -(-run.agents // MOST)
    return leaders_first(run, sorted({*range(0, run.agents, step), *run.leaders[:MOST]}))


def count_title(run: Recording, count: int) -> str:
    """Return the number of agents that are drawn, if that is not all of them."""
    return "" if count == run.agents else f"{count:,} of {run.agents:,} agents"


def label(run: Recording, k: int) -> str:
    """Return the label of a state's axis."""
    return draw.label(run.state_names[k], run.state_units[k])


def reference_of(run: Recording, leader: int) -> Array | None:
    """Return the desired states (T, n) of a leader; None without a reference."""
    return None if run.reference is None else run.reference + run.offsets_in()[..., leader, :]
