"""Theorem T9: whether it covers a run's network, and what it then says.

The ages of messages, the rate of agreement over them, what is guaranteed, and the lines of a check.
"""

import math
from fractions import Fraction
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from echelon.agents.models.model import position_unit
from echelon.agents.network.channel import Channel, Network
from echelon.agents.network.graph import Graph
from echelon.core.claim import Number, Rounding
from echelon.core.digits import about, at_least, at_most
from echelon.core.numerics import precision
from echelon.core.statement import Hypothesis, Statement, fails, holds
from echelon.core.types import Array, JsonObject
from echelon.core.words import Kind, MessageContent, NeighbourChoice, Prediction
from echelon.laws.law import Travels
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.networks import HOP_LIFE
from echelon.simulation.step.settings import Settings
from echelon_ranges import ELEMENTARY, point

# ---- ages of messages ----------------------------------------------------------------------------
# A message that arrives is never replaced by an older one. So if a link loses at most L messages in
# a row, the newest one that arrived was sent at most delay + jitter + (L + 1) periods ago.

RARE = 1e-6
"""The share of runs in which a link may lose more messages in a row."""
_GRID = 2.0**-23
"""Of the draws, which are floats of 24 bits: so much more is lost at most."""


class AgeLimits(NamedTuple):
    """Ages in control steps, of messages while they are in use; an input is held for one more.

    Attributes:
        lost: how many messages a link loses in a row at most; None where a link may lose all of a
            run.
        arrived: of the newest message on a link; None likewise.
        forgotten: from which on a deviation is not used.
        hops: how far the farthest agent is from a leader.
        dt: a step, s.
        mean: of the newest message, s, on average.
    """

    lost: int | None
    arrived: int | None
    forgotten: int
    hops: int
    dt: float
    mean: float

    @property
    def oldest(self) -> int:
        """The age beyond which no deviation is used, in steps."""
        return self.forgotten if self.arrived is None else min(self.arrived, self.forgotten)

    @property
    def first_packet(self) -> float | None:
        """The time (s) after which everybody has a packet, none older than this; None for never."""
        return None if self.arrived is None else self.hops * self.arrived * self.dt

    @property
    def hop_life(self) -> int:
        """The age, in steps, to which hop counts are used."""
        return HOP_LIFE * (self.forgotten - 1)


def ages_of(channel: Channel, dt: float, steps: int, links: int, hops: int) -> AgeLimits:
    """Return the ages on a number of links in a run of so many steps (dt in s)."""
    every, delay, jitter = (int(x) for x in (channel.every, channel.delay, channel.jitter))
    lost = losses_in_a_row(channel, links, -(-steps // every))
    arrived = None if lost is None else delay + jitter + every * (lost + 1)
    starts, step = _outages(channel)
    # One for each number of messages that are lost in a row at the end.
    rest = np.eye(2) - step
    # What is lost for good is as old as the run, as in an outage that does not end.
    ends = channel.loss < 1.0 and step[1, 1] < 1.0
    again = float((starts[0] @ np.linalg.inv(rest)).sum()) if ends else steps / every
    mean = dt * (delay + 0.5 * jitter + 0.5 * (every - 1) + every * again)
    return AgeLimits(lost, arrived, int(channel.forget) + 1, hops, dt, mean)


def losses_in_a_row(channel: Channel, links: int, messages: int) -> int | None:
    """Return how many messages a link loses in a row at most, in all but `RARE` of runs.

    With pi the shares of a link that works or is out, P the chances of its next message and D the
    chances that one is lost, L + 1 given messages are lost with probability pi'D (P D)^L 1, and
    there are fewer places for them than messages on all links.
    """
    starts, step = _outages(channel)

    def fits(more: int) -> bool:
        chance = (starts @ np.linalg.matrix_power(step, more)).sum(axis=1).max()
        return links * messages * float(chance) <= RARE

    # What can be lost is, now and then, however seldom.
    low, high = -1 + bool(channel.loss > 0.0 or channel.bursty), messages - 1
    if not fits(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def _outages(channel: Channel) -> tuple[Array, Array]:
    """Return pi'D (2, 2), a row for each of two moments, and P D (2, 2) of the same."""
    numbers = channel.loss, channel.share, channel.begins, channel.ends
    loss, share, begins, ends = map(float, numbers)
    if not channel.bursty:
        begins, share, ends = 0.0, 0.0, 1.0
    loss, stays = min(1.0, loss + _GRID * (loss > 0.0)), min(1.0, 1.0 - ends + _GRID)
    begins = min(1.0, begins + _GRID * (begins > 0.0))
    step = np.array([[1.0 - begins, begins], [1.0 - stays, stays]]) @ np.diag([loss, 1.0])
    # The share of links that are out ends between its first two values, or at the first.
    later = (1.0 - share) * begins + share * stays
    return np.array([[1.0 - out, out] for out in (share, later)]) * [loss, 1.0], step


# ---- agreement over messages of any age (T9.2, T9.3) ---------------------------------------------
# Let v > 0 and rho >= 0 with rho v_i <= c (d_i v_i - e^(rho tau) sum_j a_ij v_j) for all followers
# i, d_i the sums of what they hear. While no message in use is older than tau, |zeta~_i| <= v_i
# m(t) with m' = -rho m / sqrt(1 + (rho m max v / s)^2).

_NEAR, _HALVINGS = 1e-5, 60
"""Relative distance to the best rate at which the search ends, and after how many steps at most."""
_SHARES, _MANY = (0.999, 0.9, 0.6), 1000
"""Of the best rate: the nearer to it, the larger the weights of some agents against others. Of so
many followers one rate is enough."""


class LateRate(NamedTuple):
    """A rate rho, 1/s, and weights v (F,) of followers, of which the inequality is proved."""

    rate: float
    weights: Array


def late_rates(L: sp.csr_array, c: float, age: Fraction) -> tuple[LateRate, ...]:
    """Return rates at which stopping points agree, the fastest first; none where none is proved.

    `L` is the grounded Laplacian of the followers, `age` is tau in s.
    """
    L, ones = sp.csr_array(L), np.ones_like(L.diagonal())
    own = sp.diags_array(L.diagonal())

    def weights(rate: float) -> Array | None:
        # Of a matrix without positive entries off its diagonal: v > 0 exactly if it is an M-matrix.
        grown = own + float(np.exp(min(rate * float(age), 300.0))) * (L - own)
        K = sp.csc_array(c * sp.csr_array(grown) - rate * sp.diags_array(ones))
        try:
            v = spla.splu(K).solve(ones)
        except RuntimeError:
            return None
        fits = np.isfinite(v).all() and (v > 0.0).all() and (K @ v > 0.0).all()
        return v / v.max() if fits else None

    best, high = 0.0, c * float(L.diagonal().min())
    for _ in range(_HALVINGS):
        middle = 0.5 * (best + high)
        best, high = (best, middle) if weights(middle) is None else (middle, high)
        if high - best <= _NEAR * best:
            break
    shares = _SHARES if len(ones) <= _MANY else _SHARES[:1]
    pairs = ((best * share, weights(best * share)) for share in shares)
    drafts = (LateRate(rate, v) for rate, v in pairs if v is not None)
    return tuple(each for each in drafts if is_proved(each, L, c, age))


def is_proved(late: LateRate, L: sp.csr_array, c: float, age: Fraction) -> bool:
    """Tell whether the inequality holds in rationals, with e^(rho tau) from above."""
    rate, coupling = Fraction(late.rate), Fraction(c)
    factor = ELEMENTARY["exp"].range(point(rate * age)).hi
    v = [Fraction(x) for x in late.weights.tolist()]
    rows = sp.coo_array(L)
    sums = [-rate * x / coupling for x in v]
    for i, j, a in zip(rows.row.tolist(), rows.col.tolist(), rows.data.tolist(), strict=True):
        sums[i] += Fraction(a) * v[j] * (1 if i == j else factor)
    return rate >= 0 and min(v) > 0 and min(sums) >= 0


def longest_ways(L: sp.csr_array) -> Array | None:
    """Return how many links the longest way to each follower has, (F,); None if some hear in rings.

    Followers that hear leaders alone have one.
    """
    heard = sp.coo_array(L - sp.diags_array(L.diagonal()))
    used = heard.data != 0.0
    i, j, count = heard.row[used], heard.col[used], len(L.diagonal())
    rings, _ = csgraph.connected_components(
        sp.coo_array((np.ones(len(i)), (i, j)), (count, count)), connection="strong"
    )
    if rings < count:
        return None
    ways = np.ones(count, int)
    while True:
        longer = ways.copy()
        np.maximum.at(longer, i, ways[j] + 1)
        if (longer == ways).all():
            return ways
        ways = longer


# ---- the theorem ---------------------------------------------------------------------------------

_ONE_WAY = (
    "with one-way edges, or `follower.hears: leaderward`, messages of any age would cost a delay "
    "alone"
)
OFF_PLAN = 0.01
"""Of a leader's speed against its plan, in units of an output per second, for an example."""


class Uncovered(NamedTuple):
    """Why T9 does not cover a network, and what would help.

    Attributes:
        lost: whether no formation comes together, or not at its goals.
    """

    text: str
    remedy: str
    lost: bool


class Following(NamedTuple):
    """What T9 asks of a run beside its network.

    Attributes:
        leaderward: whether followers' law hears only those nearer to a leader.
        speed: s of followers, the smallest of all outputs.
        still: whether the leader is where it stays from the start on.
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
        rate: at which stopping points agree in the end whatever is lost, 1/s.
        ways: (F,) links of the longest way to each follower, where all hear one way; else None.
        weights: (F,) of followers where all hear one way: w with m' = -sigma(c m) / max w.
        rates: where some hear each other: at which, and weights, all but a few runs agree.
        sums: (K,) d_i, the sums of weights that followers hear.
        spread: max w, w = L_g^-1 1.
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

    def numbers(self) -> dict[str, Number]:
        """Return what is known of the messages of all but one run in a million."""
        ages, numbers = self.ages, dict[str, Number]()
        if self.ways is None and not ages.lost:
            numbers["message_age"] = Number(1e3 * self.age, "ms", Rounding.UP)
        elif self.quick is not None:
            numbers["message_age"] = Number(1e3 * self.age, "ms", Rounding.DOWN)
            numbers["quick_rate"] = Number(self.quick, "1/s", Rounding.DOWN)
        if ages.first_packet is None:
            return numbers
        numbers["first_packet"] = Number(ages.first_packet, "s", Rounding.UP)
        numbers["lost_in_a_row"] = Number(float(ages.lost or 0))
        late = 0.0 if self.ways is None else float(self.ways.max() - 1) * self.age
        return numbers | ({"delay": Number(late, "s", Rounding.UP)} if late else {})

    def notes(self) -> tuple[str, ...]:
        """Return what else is known, a phrase each."""
        text = "with a packet no stopping point moves farther from the leader's than any was before"
        if self.ages.first_packet is None:
            return text, "a link may lose all messages of a run"
        # Without ages agreement is at least as fast as c / max w.
        slow = self.ways is None and 2.0 * self.rate < self.coupling / self.spread
        return (text, *[_ONE_WAY] * slow)


def late_messages_of(
    network: Network | None, following: Following, dt: float, horizon: float, steps: int
) -> LateMessages | Uncovered | None:
    """Return what T9 says of a run over a network, or why nothing; None for the ideal network."""
    if network is None:
        return None
    text, remedy = network.uncovered(following.still)
    obstacle = Uncovered(text, remedy, True) if text else _beyond(following)
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
        text = "with `hears: leaderward` weights count as 1, "
        text += f"and c dt = {at_least(c * dt)} is above 1"
        return Uncovered(text, f"lower `follower.coupling` to {at_most(1.0 / dt, 4)}", True)
    if leaderward and (ages.arrived is None or ages.arrived > ages.hop_life):
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


def _beyond(following: Following) -> Uncovered | None:
    if following.apart:
        return Uncovered("the leaders start apart", "start the leaders alike", False)
    if following.avoiding:
        text = "agents that keep apart do not always move as their messages ask"
        return Uncovered(text, "remove `safety` to see what is guaranteed without it", False)
    if following.graph.schedule is not None:
        text = "the graph switches, and late messages are covered for one graph only"
        return Uncovered(text, "use a graph that does not switch", False)
    return None


# ---- lines of a check ----------------------------------------------------------------------------

_TIMES = 2001
"""Of the leader's path, of which the mean speed is taken."""
_MUCH = 0.01
"""m of a bias that is pointed out."""


class Bias(NamedTuple):
    """How far followers lag that receive states of a mean age (s) at a mean speed."""

    age: float
    speed: float
    size: float
    unit: str

    @property
    def shown(self) -> str:
        """The size with its unit."""
        metres = self.unit == "m"
        return f"{about(1e3 * self.size)} mm" if metres else f"{about(self.size)} {self.unit}"

    def sentence(self) -> str:
        """Return it in words."""
        age, speed, size = about(1e3 * self.age), about(self.speed), about(self.size)
        return (
            f"messages contain states: at a mean age of {age} ms and a mean speed of {speed} "
            f"{self.unit}/s followers lag by {size} {self.unit}"
        )


def bias_of(parts: Parts, settings: Settings) -> Bias | None:
    """Return by how much followers lag whose messages contain states; None where they do not.

    Signals that are tau old, of a leader at a speed v, leave tau v L_g^-1 d, d the sums of weights
    that followers hear.
    """
    world, graph, follower = parts.world, parts.graph, getattr(parts.drive, "follower", None)
    network, leader = world.network, getattr(parts.drive, "leader", None)
    position = list(parts.model.position_indices())
    late = network is not None and network.messages is MessageContent.STATE
    if not late or network is None or leader is None or follower is None or not position:
        return None
    if graph.schedule is not None:
        return None
    times = np.linspace(0.0, settings.horizon, _TIMES)
    with precision("float64"):
        path = Travels.of(leader).reference_states(parts.model, jnp.asarray(times))
    if path is None:
        return None
    moved = np.linalg.norm(np.diff(np.asarray(path)[:, position], axis=0), axis=1).sum()
    channel = network.prepared(settings.dt, settings.horizon, 0)
    links = graph.exchange(follower.leaderward)
    age = ages_of(channel, settings.dt, settings.steps, len(links.receivers), 1).mean
    [L] = graph.stretches(follower.leaderward)
    most = float(spla.splu(sp.csc_array(L)).solve(L.diagonal()).max())
    if network.hears is NeighbourChoice.LEADERWARD:
        most = float(graph.depths().max())
    speed = float(moved) / settings.horizon
    return Bias(age, speed, age * speed * most, position_unit(parts.model) or "1")


def bias_line(parts: Parts, settings: Settings) -> Statement | None:
    """Return what late messages do under a law of states; None where no bound of it is known."""
    bias = bias_of(parts, settings)
    if bias is None or bias.size < _MUCH:
        return _swinging_line(parts)
    remedy = "set `messages: deviation`"
    number = bias.size, bias.shown
    return fails(Hypothesis.MESSAGES, Kind.LINEARIZATION, bias.sentence(), *number, remedy=remedy)


def _swinging_line(parts: Parts) -> Statement | None:
    lag, graph = parts.world.effects.lag, parts.graph
    if parts.world.network is None or not lag or graph.directed:
        return None
    text = "agents with motors that lag hear each other late and both ways, and may swing up"
    remedy = "set `graph.directed: true`, or use the law `stopping-point`"
    shown = f"lag {about(1e3 * lag)} ms"
    return fails(Hypothesis.MESSAGES, Kind.LINEARIZATION, text, lag, shown, remedy=remedy)


def messages_line(
    parts: Parts, settings: Settings, late: LateMessages | Uncovered | None
) -> Statement | None:
    """Return whether T9 covers the network of a run; None for the ideal one."""
    if late is None:
        return None
    name = Hypothesis.MESSAGES
    if isinstance(late, Uncovered):
        bias = bias_of(parts, settings)
        text = late.text if bias is None else bias.sentence()
        number = (None, "") if bias is None else (bias.size, bias.shown)
        reason = text if late.lost else ""
        return fails(name, Kind.PROOF, text, *number, remedy=late.remedy, reason=reason)
    ages = late.ages
    text = f"T9: no deviation in use is older than {at_least(1e3 * late.age)} ms"
    if ages.lost and ages.oldest < ages.forgotten:
        text += f", in all but one run in a million, with up to {ages.lost} losses in a row"
    elif ages.oldest == ages.forgotten:
        text += ", when it is forgotten"
    if late.off_plan is not None:
        text += f"; behind a leader that leaves its plan at {OFF_PLAN:g}/s in an output, followers "
        text += f"end within {at_least(late.off_plan)} of it"
    return holds(name, Kind.PROOF, text, late.age, f"{at_least(1e3 * late.age)} ms")
