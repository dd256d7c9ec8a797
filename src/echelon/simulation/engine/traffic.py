"""What became of the messages of a run: how old they were, how many were sent, lost and late.

All that a network does depends on the seed, the graph and the times alone, and on no state. So it
is computed after a run, from its parts, and the steps of the run count nothing.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER, InFlight
from echelon.agents.network.hearing import edges_of
from echelon.core.compiled import cached_jit
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import channel_of, prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.leadership import NOBODY, leaders_of
from echelon.simulation.step.networks import LateNetwork, MessageRules, carries
from echelon.simulation.step.records import Messages, NetworkEstimate, Steps
from echelon.simulation.step.roster import Everybody, Links, roster_of
from echelon.simulation.step.settings import Settings


class Traffic(NamedTuple):
    """The messages of a run with T frames and E edges; of an end that receives nothing NaN and 0.

    Attributes:
        ages: (T, E, 2) of the newest message that each end of an edge has of the other, s; NaN
            before the first.
        losses: (T, E, 2) how many were lost since the frame before.
        sent, lost: how many messages, each counted for every agent that uses it.
        late: how many of them arrived after a newer one of the same sender.
        largest, mean: age of the messages in use, over all steps, s; NaN where there are none.
    """

    ages: Float[Array, "T E 2"]
    losses: Int[Array, "T E 2"]
    sent: int
    lost: int
    late: int
    largest: float
    mean: float

    def of_agents(
        self, edges: Int[Array, "E 2"], agents: int, presence: Bool[Array, "T N"] | None = None
    ) -> Float[Array, "T N"]:
        """Return the age (s) of each agent's oldest message; absent agents do not count."""
        ages = np.full((agents, len(self.ages)), -np.inf)
        both = True if presence is None else presence[:, edges].all(axis=2)
        for end in (0, 1):
            own = np.nan_to_num(np.where(both, self.ages[:, :, end], np.nan), nan=-np.inf)
            np.maximum.at(ages, edges[:, end], own.T)
        return np.where(ages > -np.inf, ages, np.nan).T


def traffic(parts: Parts, settings: Settings, times: Array, steps: int) -> Traffic | None:
    """Return what became of the messages of a run; None in the ideal network.

    Args:
        parts: of the run, with its drive completed.
        settings: of the run.
        times: (T,) of its frames, s.
        steps: that it took.
    """
    channel, graph = channel_of(parts, settings), parts.graph
    if channel is None:
        return None
    frames = np.rint(times / settings.dt).astype(np.int32)
    # One step more than there are, whose messages are those of the last frame, and do not count.
    ends = np.append(frames[1:], max(steps, *frames[-1:], 0) + 1)[: len(frames)]
    with precision("float64"):
        links = Links.of(graph, settings, parts.leaderward)
        place = edges_of(graph, links.exchange)
        receives = parts.receives[place]
        leadership = leaders_of(graph, parts.leadership)
        rules = MessageRules.of(channel, leadership, graph.agents)
        network, roster = LateNetwork(leadership, rules, channel), roster_of(graph, settings, False)
        if parts.world.parts:
            drive: Any = parts.drive
            problem = prepare(parts, settings).problem
            own = assemble(problem, drive.leader, drive.follower).network
            if not isinstance(own, LateNetwork):
                return None  # nothing is known of its messages
            network = own
        numbers = np.asarray(steps), np.asarray(settings.dt)
        radio = _Radio(network, links, roster, receives, *numbers)
        followed = _follow(radio, ends.astype(np.int32))
        stamps, losses, counted = jax.tree.map(np.asarray, followed)
    shape = len(times), len(graph.edges), 2
    ages, lost = np.full(shape, np.nan), np.zeros(shape, int)
    since = np.where(stamps == NEVER, np.nan, (frames[:, None] - stamps) * settings.dt)
    ages[:, *place] = np.where(receives, since, np.nan)
    lost[1:, *place] = losses[:-1]
    return Traffic(
        ages,
        lost,
        sent=int(counted.sent),
        lost=int(counted.lost),
        late=int(counted.late),
        largest=float(counted.largest) if counted.used else np.nan,
        mean=float(counted.total / counted.used) if counted.used else np.nan,
    )


class _Radio(NamedTuple):
    """The network of a run: who `receives` (K,) what, in a run of so many steps of dt (s)."""

    network: LateNetwork
    links: Links
    roster: Everybody
    receives: Bool[Array, " K"]
    steps: Array
    dt: Array


class _Counts(NamedTuple):
    """Of messages, over steps: see `Traffic`; `used` and the `total` age of those in use."""

    sent: jax.Array
    lost: jax.Array
    late: jax.Array
    used: jax.Array
    total: jax.Array
    largest: jax.Array

    def plus(self, more: "_Counts") -> "_Counts":
        """Return the counts of two stretches of a run."""
        total = _Counts(*(a + b for a, b in zip(self, more, strict=True)))
        return total._replace(largest=jnp.maximum(self.largest, more.largest))


class _Carry(NamedTuple):
    """What a network remembers; stamps at the last frame, losses since then, and the counts."""

    step: jax.Array
    posts: InFlight
    mail: Messages
    stamps: Int[jax.Array, " K"]
    losses: Int[jax.Array, " K"]
    counts: _Counts


@cached_jit
def _follow(
    radio: _Radio, ends: Int[Array, " T"]
) -> tuple[Int[jax.Array, "T K"], Int[jax.Array, "T K"], _Counts]:
    """Return the newest stamps at each frame, the losses after it, and the counts of all steps."""

    def frame(now: _Carry, end: jax.Array) -> tuple[_Carry, tuple[jax.Array, jax.Array]]:
        now, first = now._replace(losses=jnp.zeros_like(now.losses)), now.step
        now = jax.lax.fori_loop(first, end, lambda _, now: _step(radio, first, now), now)
        return now, (now.stamps, now.losses)

    rules, links = radio.network.rules, len(radio.receives)
    nothing = jnp.zeros((rules.agents, 0))
    mail = rules.begin(jnp.arange(rules.agents, dtype=jnp.int32), links, nothing, 0)
    sent = Messages(nothing, jnp.full(rules.agents, NOBODY, jnp.int32), mail.packet)
    zero, none = jnp.zeros((), int), jnp.zeros(links, int)
    counts = _Counts(zero, zero, zero, zero, jnp.zeros(()), jnp.zeros(()))
    posts = radio.network.medium.begin(sent, links)
    start = _Carry(jnp.zeros((), jnp.int32), posts, mail, mail.stamp, none, counts)
    now, (stamps, losses) = jax.lax.scan(frame, start, jnp.asarray(ends))
    return stamps, losses, now.counts


def _step(radio: _Radio, first: jax.Array, now: _Carry) -> _Carry:
    """Take a step of messages that say nothing; frames are stored at the step `first`."""
    network, rules, channel = radio.network, radio.network.rules, radio.network.medium
    clock, links = Steps(now.step, radio.dt), radio.links.at(now.step)
    number = jnp.arange(rules.agents, dtype=jnp.int32)
    here, since = radio.roster.here(now.step), radio.roster.since(now.step)
    mail = network.delivered(now.posts, now.mail, number, clock, since, links, here)
    leads = network.leadership.leads(mail.packet, number)
    ages = clock.age(mail.stamp)
    hops = rules.hops(mail, ages, leads, links, clock.dt)
    used = rules.used(mail, ages, hops, links, clock.dt)
    nothing = jnp.zeros((rules.agents, 0))
    heard = NetworkEstimate(nothing, leads, nothing, nothing, hops)
    rows = mail, heard, number, clock.now, nothing, nothing, jnp.subtract
    messages, sends = rules.write(*rows)
    posts = network.posted(now.posts, now.step, messages, sends, links)
    sent = carries(links, sends) & (now.step % channel.every == 0)
    lost = sent & (posts.arrival[(now.step // channel.every) % channel.slots] == NEVER)
    # All that arrives now but for the newest message, where it is newer than the last one.
    late = (now.posts.arrival == now.step).sum(axis=0) - (mail.stamp > now.mail.stamp)
    whole = ((x * radio.receives).sum() for x in (sent, lost, late, used))
    old = jnp.where(used & radio.receives, ages, 0.0)
    counts = _Counts(*whole, total=old.sum(), largest=old.max())
    counts = jax.tree.map(lambda x: jnp.where(now.step < radio.steps, x, 0), counts)
    stamps = jnp.where(now.step == first, mail.stamp, now.stamps)
    losses = now.losses + lost * radio.receives
    return _Carry(now.step + 1, posts, mail, stamps, losses, now.counts.plus(counts))
