"""Whether a leader reaches everybody over a graph that switches, as T5 asks."""

import numpy as np

from echelon.agents.network.edges import name_agents
from echelon.agents.network.graph import Graph
from echelon.agents.network.reach import unreached
from echelon.core.digits import at_least
from echelon.core.statement import Hypothesis, Statement, fails, holds
from echelon.core.words import Kind


def switching_line(graph: Graph, leaderward: bool, left_out: str, rate: float) -> Statement:
    """Say along which edges the leader reaches everybody, of a graph as it runs in steps.

    `left_out` says why nothing is known of that, and `rate` is that of errors in the end, 1/s.
    """
    schedule, name = graph.schedule, Hypothesis.SWITCHING
    assert schedule is not None
    against = left_out or _left_behind(graph, leaderward)
    if against:
        remedy = "set `hears: all`, or add links" if leaderward else "add links"
        remedy = "switch at multiples of `simulation.dt`" if left_out else remedy
        return fails(name, Kind.PROOF, against, remedy=remedy, reason=against)
    since = at_least(schedule.starts[-1], 6)
    text = f"the leader reaches every agent along the edges from {since} s on"
    if schedule.period is not None:
        text = "the leader reaches every agent along the edges of any "
        text += f"{at_least(schedule.period, 6)} s together"
    text += ", and zeta' is received whatever edges are present"
    return holds(name, Kind.PROOF, text, rate)


def _left_behind(graph: Graph, leaderward: bool) -> str:
    """Return whom the leader does not reach along the edges that are heard; empty for nobody.

    Laws are made for a graph without its events, and nobody has asked this of a part of them yet.
    """
    schedule = graph.schedule
    assert schedule is not None
    since, lost = "in a period", np.array([], int)
    if schedule.period is None:
        since = f"from {schedule.starts[-1]:g} s on"
        lost = unreached(graph, schedule, -1)
    if leaderward:
        whole = graph.stretches(True)[-1 if schedule.period is None else 0 :]
        # Who is heard is nearer, and so on: the one of these that is nearest hears nobody.
        lost = np.array(graph.followers)[sum(L.diagonal() for L in whole) <= 0.0]
    along = " along neighbours that are nearer to it" if leaderward else ""
    return f"{name_agents(lost)} no path to the leader{along} {since}" if len(lost) else ""
