"""What became of the messages of a run: how old they were, how many were sent, lost and late.

All that a network does depends on the seed, the graph and the times alone, and on no state. So it
is computed after a run, from its parts, and the steps of the run count nothing.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from echelon.agents.network.channel import NEVER
from echelon.agents.network.hearing import edges_of
from echelon.core.compiled import cached_jit
from echelon.core.numerics import precision
from echelon.core.types import Array
from echelon.simulation.engine.parts import Parts
from echelon.simulation.engine.prepare import channel_of, prepare
from echelon.simulation.step.assembly import assemble
from echelon.simulation.step.deliveries import Empty, Radio, deliver, empty
from echelon.simulation.step.leadership import leaders_of
from echelon.simulation.step.networks import LateNetwork, MessageRules
from echelon.simulation.step.roster import Links, roster_of
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
        radio = Radio(network, links, roster, np.asarray(settings.dt))
        followed = _follow(radio, receives, np.asarray(steps), ends.astype(np.int32))
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
    messages: Empty
    stamps: Int[jax.Array, " K"]
    losses: Int[jax.Array, " K"]
    counts: _Counts


@cached_jit
def _follow(
    radio: Radio, receives: Bool[Array, " K"], steps: Array, ends: Int[Array, " T"]
) -> tuple[Int[jax.Array, "T K"], Int[jax.Array, "T K"], _Counts]:
    """Return the newest stamps at each frame, the losses after it, and the counts of all steps.

    Counts are of those who receive, in a run of so many steps.
    """

    def frame(now: _Carry, end: jax.Array) -> tuple[_Carry, tuple[jax.Array, jax.Array]]:
        now, first = now._replace(losses=jnp.zeros_like(now.losses)), now.step

        def one(_: jax.Array, now: _Carry) -> _Carry:
            return _step(radio, receives, steps, first, now)

        now = jax.lax.fori_loop(first, end, one, now)
        return now, (now.stamps, now.losses)

    zero, none = jnp.zeros((), int), jnp.zeros(len(receives), int)
    counts = _Counts(zero, zero, zero, zero, jnp.zeros(()), jnp.zeros(()))
    messages = empty(radio.network, len(receives))
    start = _Carry(jnp.zeros((), jnp.int32), messages, messages.mail.stamp, none, counts)
    now, (stamps, losses) = jax.lax.scan(frame, start, jnp.asarray(ends))
    return stamps, losses, now.counts


def _step(
    radio: Radio, receives: Bool[Array, " K"], steps: Array, first: jax.Array, now: _Carry
) -> _Carry:
    """Take a step; frames are stored at the step `first`."""
    channel, before = radio.network.medium, now.messages
    messages, decided = deliver(radio, before, now.step)
    sent = decided.sends & (now.step % channel.every == 0)
    slot = (now.step // channel.every) % channel.slots
    lost = sent & (messages.in_flight.arrival[slot] == NEVER)
    # All that arrives now but for the newest message, where it is newer than the last one.
    newer = messages.mail.stamp > before.mail.stamp
    late = (before.in_flight.arrival == now.step).sum(axis=0) - newer
    whole = ((x * receives).sum() for x in (sent, lost, late, decided.used))
    old = jnp.where(decided.used & receives, decided.ages, 0.0)
    counts = _Counts(*whole, total=old.sum(), largest=old.max())
    counts = jax.tree.map(lambda x: jnp.where(now.step < steps, x, 0), counts)
    stamps = jnp.where(now.step == first, messages.mail.stamp, now.stamps)
    losses = now.losses + lost * receives
    return _Carry(now.step + 1, messages, stamps, losses, now.counts.plus(counts))
