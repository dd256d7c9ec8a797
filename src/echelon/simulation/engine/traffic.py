"""What became of the messages of a run: how old they were, how many were sent, lost and late.

All that a network does depends on the seed, the graph and the times alone, and on no state. So it
is computed after a run, from its parts, and the steps of the run count nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER, Channel, InFlight
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.hearing import edges_of
from echelon.core.compiled import cached_jit
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.core.words import NeighbourChoice
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import channel_of
from echelon.simulation.step.knowledge import (
    NOBODY,
    Knowledge,
    Letters,
    Mail,
    Readers,
    count_hops,
    hop_life,
    no_mail,
    usable_age,
    write,
)
from echelon.simulation.step.leadership import Failover
from echelon.simulation.step.loop import ActiveAgents, Switches, exchange_at
from echelon.simulation.step.messages import (
    age_of,
    all_readers,
    led_by_backups,
    links_with,
    take,
)
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
        exchange = graph.exchange(parts.leaderward)
        place = edges_of(graph, exchange)
        receives = parts.receives[place]
        readers = all_readers(graph.agents, np.array(graph.leaders))
        switches = Switches.of(graph, settings)
        numbers = np.asarray(steps), np.asarray(settings.dt)
        cast = ActiveAgents.of(graph), Failover.of(graph, parts.leadership)
        radio = _Radio(channel, exchange, switches, readers, receives, *numbers, *cast)
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

    channel: Channel
    exchange: Exchange
    switches: Switches | None
    readers: Readers
    receives: Bool[Array, " K"]
    steps: Array
    dt: Array
    presence: ActiveAgents | None
    succession: Failover | None


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
    mail: Mail
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

    agents, links = len(radio.readers.number), len(radio.receives)
    mail = no_mail(radio.readers, links, jnp.zeros((agents, 0)), 0, radio.succession is not None)
    letters = Letters(jnp.zeros((agents, 0)), jnp.full(agents, NOBODY, jnp.int32), mail.packet)
    zero, none = jnp.zeros((), int), jnp.zeros(links, int)
    counts = _Counts(zero, zero, zero, zero, jnp.zeros(()), jnp.zeros(()))
    posts = radio.channel.begin(letters, links)
    start = _Carry(jnp.zeros((), jnp.int32), posts, mail, mail.stamp, none, counts)
    now, (stamps, losses) = jax.lax.scan(frame, start, jnp.asarray(ends))
    return stamps, losses, now.counts


def _step(radio: _Radio, first: jax.Array, now: _Carry) -> _Carry:
    """Take a step of messages that say nothing; frames are stored at the step `first`."""
    channel, readers = radio.channel, radio.readers
    exchange = exchange_at(radio.exchange, radio.switches, now.step)
    mail = take(channel, exchange, now.step, now.posts, now.mail)
    if radio.succession is not None:
        packet = led_by_backups(radio, now.step, mail.packet, radio.dt)
        mail = mail._replace(packet=packet)
        readers = readers._replace(leads=packet.leader == readers.number)
    ages = age_of(now.step, mail.stamp, radio.dt)
    lasting = ages <= hop_life(channel, radio.dt)
    hops = count_hops(exchange, readers, mail.hops, lasting, len(readers.number))
    used = (jnp.asarray(exchange.weights) > 0.0) & (ages <= usable_age(channel, radio.dt))
    if channel.hears is NeighbourChoice.LEADERWARD:
        used = used & (mail.hops < hops[jnp.asarray(exchange.receivers)])
    nothing = jnp.zeros((len(readers.number), 0))
    knowledge = Knowledge(nothing, nothing, nothing, hops)
    rows = mail, knowledge, nothing, jnp.subtract, nothing
    letters, sends = write(channel, readers, now.step, *rows)
    sent = links_with(exchange, sends) & (now.step % channel.every == 0)
    posts = channel.post(now.posts, now.step, letters, sent, exchange.receivers, exchange.senders)
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
