"""Theorem T9: whether it covers a run's network, and what it then says."""

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from echelon.agents.network.channel import Network
from echelon.agents.network.graph import Graph
from echelon.core.digits import at_least, at_most
from echelon.core.types import Array, JsonObject
from echelon.core.words import MessageContent, NeighbourChoice, Prediction
from echelon.guarantees.messages.late_agreement import LateRate, late_rates, longest_ways
from echelon.guarantees.messages.message_ages import AgeLimits, ages_of

_ONE_WAY = (
    "With one-way edges, or `follower.hears: leaderward`, messages of any age would cost a delay "
    "alone"
)
OFF_PLAN = 0.01
"""Of a leader's speed against its plan, in units of an output per second, for an example."""


class Uncovered(NamedTuple):
    """Why T9 does not cover a network, and what would help.

    Attributes:
        text: the reason.
        remedy: what to change.
        lost: whether no formation comes together, or not at its goals.
    """

    text: str
    remedy: str
    lost: bool


class Following(NamedTuple):
    """What T9 asks of a run beside its network.

    Attributes:
        graph: who receives from whom.
        leaderward: whether followers' law hears only those nearer to a leader.
        coupling: c.
        speed: s of followers, the smallest of all outputs.
        still: whether the leader is where it stays from the start on.
        apart: whether leaders start apart.
        avoiding: whether followers keep away from each other.
    """

    graph: Graph
    leaderward: bool
    coupling: float
    speed: float
    still: bool
    apart: bool
    avoiding: bool = False


class LateMessages(NamedTuple):
    """What T9 says of stopping points over a network.

    Attributes:
        ages: of messages.
        rate: at which stopping points agree in the end whatever is lost, 1/s.
        ways: (F,) links of the longest way to each follower, where all hear one way; else None.
        weights: (F,) of followers where all hear one way: w with m' = -sigma(c m) / max w.
        rates: where some hear each other: at which, and weights, all but a few runs agree.
        sums: (K,) d_i, the sums of weights that followers hear.
        spread: max w, w = L_g^-1 1.
        coupling: c.
        speed: s of followers, the smallest of all outputs; 0 without one leader that has a plan.
        leaderward: whether neighbours with fewer hops alone are heard.
    """

    ages: AgeLimits
    rate: float
    ways: Array | None
    weights: Array
    rates: tuple[LateRate, ...]
    sums: Array
    spread: float
    coupling: float
    speed: float
    leaderward: bool = False

    @property
    def age(self) -> float:
        """The age (s) that no message in use passes, in all but a few runs."""
        return self.ages.oldest * self.ages.dt

    @property
    def quick(self) -> float | None:
        """The rate (1/s) while no message is older than those of all but a few runs; else None."""
        faster = bool(self.rates) and self.rates[0].rate > self.rate
        return self.rates[0].rate if faster else None

    @property
    def off_plan(self) -> float | None:
        """How far (in units of an output) followers end off a leader that leaves its plan.

        None where packets may be of any age.
        """
        packet, d = self.ages.first_packet, OFF_PLAN
        if packet is None or self.speed <= d:
            return None
        pull = d / math.sqrt(1.0 - (d / self.speed) ** 2) / self.coupling
        return self.spread * (pull + float(self.sums.max()) * d * packet)

    def as_mapping(self) -> JsonObject:
        """Return it ready for JSON."""
        ages, v = self.ages, self.rates[0].weights if self.rates else None
        return {
            "theorem": "T9",
            "lost_in_a_row": ages.lost,
            "age": self.age,
            "age_when_forgotten": ages.forgotten * ages.dt,
            "mean_age": ages.mean,
            "packet_by": ages.first_packet,
            "rate": self.rate,
            "rate_below_age": self.quick,
            "off_plan": {"speed": OFF_PLAN, "distance": self.off_plan},
            "one_way": self.ways is not None,
            "longest_way": None if self.ways is None else int(self.ways.max()),
            "weight_ratio": None if v is None else float(v.max() / v.min()),
        }

    def faster(self) -> str:
        """Return at what rate all but a few runs agree, as the end of a sentence."""
        if self.ways is None and not self.ages.lost:
            return f", as no message in use is older than {at_least(1e3 * self.age)} ms"
        if self.quick is None:
            return ""
        text = f", and at {at_most(self.quick)} 1/s while no message in use is older than "
        return f"{text}{at_most(1e3 * self.age)} ms"

    def sentence(self, arrival: float | None) -> str:
        """Return what is guaranteed beside rates, in sentences; the arrival (s) where known."""
        ages, text = self.ages, "Once everybody has a packet no stopping point moves farther from "
        text += "the leader's than the farthest one was"
        if ages.first_packet is None:
            return f"{text}. A link may lose all messages of a run"
        few = f"In all but one run in a million no link loses more than {ages.lost} in a row, e"
        text += f". {few if ages.lost else 'E'}verybody has a packet"
        text += " and knows its hops" * self.leaderward + f" after {at_least(ages.first_packet)} s"
        late = 0.0 if self.ways is None else float(self.ways.max() - 1) * self.age
        text += f"; messages then cost a delay of {at_least(late)} s at most" * bool(late)
        if arrival is not None:
            text += f", and from these starts all stay within 1 cm after {at_least(arrival)} s"
        # Without ages agreement is at least as fast as c / max w.
        slow = self.ways is None and 2.0 * self.rate < self.coupling / self.spread
        return f"{text}. {_ONE_WAY}" if slow else text


def late_messages_of(
    network: Network | None, following: Following, dt: float, horizon: float, steps: int
) -> LateMessages | Uncovered | None:
    """Return what T9 says of a run over a network, or why nothing; None for the ideal network.

    Args:
        network: of the run.
        following: who follows how.
        dt: a step, s.
        horizon: of the run, s.
        steps: their number.
    """
    if network is None:
        return None
    obstacle = _uncovered(network, following)
    if obstacle is not None:
        return obstacle
    graph, c = following.graph, following.coupling
    # Of several leaders each may leave its plan, and without a plan its rate misleads too.
    planned = network.prediction is Prediction.PREVIEW and len(graph.leaders) == 1
    law = c, following.speed if planned else 0.0
    channel, links = network.prepared(dt, horizon, 0), graph.exchange(following.leaderward)
    hops = int(graph.depths().max())
    ages = ages_of(channel, dt, steps, len(links.receivers), hops)
    leaderward = network.hears is NeighbourChoice.LEADERWARD
    if leaderward and c * dt > 1.0 + 1e-12:
        # A mean has weights of sum 1, however small those of the graph are.
        text = (
            f"with `hears: leaderward` weights count as 1, and c dt = {at_least(c * dt)} is above 1"
        )
        return Uncovered(text, f"lower `follower.coupling` to {at_most(1.0 / dt, 4)}", True)
    if leaderward and not ages.hops_last:
        return _UNSETTLED
    if leaderward:
        # Of any part of the neighbours nearer to the leader the mean is taken.
        ways = graph.depths()[list(graph.followers)]
        one = np.ones(1)
        return LateMessages(ages, c, ways, ways.astype(float), (), one, float(hops), *law, True)
    [L] = graph.stretches(following.leaderward)
    ways, w = longest_ways(L), spla.splu(sp.csc_array(L)).solve(np.ones(len(graph.followers)))
    sums, spread = np.unique(L.diagonal()), float(w.max())
    if ways is not None:
        rate = c * float(L.diagonal().min())
        return LateMessages(ages, rate, ways, w, (), sums, spread, *law)
    dt_exact = Fraction(dt)
    rates = late_rates(L, c, ages.oldest * dt_exact)
    slow = rates
    if ages.lost != 0 and ages.oldest < ages.forgotten:
        slow = late_rates(L, c, ages.forgotten * dt_exact)
    if not slow:
        return _UNPROVED
    return LateMessages(ages, slow[0].rate, None, w, rates, sums, spread, *law)


_UNSETTLED = Uncovered(
    "hop counts may be forgotten between two messages of a link",
    "raise `forget` of the network, or set `hears: all`",
    False,
)
_UNPROVED = Uncovered(
    "no rate is proved for messages of this age", "lower `forget` of the network", False
)


def _uncovered(network: Network, following: Following) -> Uncovered | None:
    """Return why T9 does not cover a network, whatever its ages."""
    if network.loss >= 1.0:
        return Uncovered("no message arrives", "set `loss` of the network below 1", True)
    if network.messages is MessageContent.STATE:
        text = "messages contain stopping points that are out of date when they arrive"
        return Uncovered(text, "set `messages: deviation`", True)
    if network.prediction is not Prediction.PREVIEW and not following.still:
        text = "without a plan of the leader followers lag behind it"
        return Uncovered(text, "set `prediction: preview`", True)
    if following.apart:
        return Uncovered("the leaders start apart", "start the leaders alike", False)
    if following.avoiding:
        text = "agents that keep apart do not always move as their messages ask"
        return Uncovered(text, "remove `safety` to see what is guaranteed without it", False)
    if following.graph.schedule is not None:
        return Uncovered(
            "the graph switches, and late messages are covered for one graph only",
            "use a graph that does not switch",
            False,
        )
    return None
