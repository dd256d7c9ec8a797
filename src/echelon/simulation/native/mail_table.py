"""Letters of a kernel: what the network decides of them, some steps ahead, and their numbers."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias, final

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.network.channel import Channel
from echelon.core.compiled import cached_jit
from echelon.core.types import Array, PyTree
from echelon.simulation.codegen import Letters, aligned
from echelon.simulation.native.blocks import FormationBlocks, Places, link_slots
from echelon.simulation.native.network_table import NetworkTable, stacked
from echelon.simulation.step.deliveries import Empty, Radio, deliver, empty
from echelon.simulation.step.loop import Loop
from echelon.simulation.step.networks import LateNetwork
from echelon.simulation.step.records import Messages

_AHEAD, _AT_ONCE = 64, 4_000_000
"""Steps that are decided at once, and numbers of them at most."""


class _Decided(NamedTuple):
    """What is decided of F formations in a step.

    Attributes:
        links, packets: places (F, K) and (F, N) in the ring of what comes by each link, and of what
            brings each agent a newer packet; -1 for none.
        leads: who leads (F, N), as `BlockRows.lead`, if anybody takes the lead.
        weights: of links (F, K), and behind them which agents (F, N) use none, if agents choose.
    """

    links: jax.Array
    packets: jax.Array
    leads: jax.Array
    weights: jax.Array


_Step: TypeAlias = Callable[[Empty, jax.Array], tuple[Empty, _Decided]]


@final
class MailTable(NetworkTable):
    """The letters in flight and those that were received, of F formations.

    Args:
        loops: of the formations.
        places: of the agents.
        letters: what they send.
        dtype: of the numbers.
    """

    def __init__(
        self, loops: Sequence[Loop], places: Places, letters: Letters, dtype: np.dtype
    ) -> None:
        self.places, self.letters, self.count = places, letters, len(loops)
        self.loop, exchange = loops[0], loops[0].graph.exchange
        network = self.loop.network
        assert isinstance(network, LateNetwork)
        self.medium: Channel = network.medium
        self.forget(loops)
        self._lay_out(len(exchange.receivers), dtype)
        self.clear()

    def _lay_out(self, links: int, dtype: np.dtype) -> None:
        places, letters = self.places, self.letters
        one = self.one = places.swarm if isinstance(places, FormationBlocks) else places
        self.slots, self.links = link_slots(self.loop, one), links
        self.lanes, self.blocks = places.lanes, places.blocks // places.groups
        agents, rows = self.loop.agents, letters.slots * self.blocks
        self.ahead = max(1, min(_AHEAD, _AT_ONCE // (self.count * (self.links + agents))))
        self._reserve(rows, dtype)
        # Agent and row of each letter in the ring, and where an agent's is in a row.
        grid = one.agents.reshape(self.blocks, -1)
        self.senders = (np.arange(letters.slots)[:, None, None] * agents + grid).reshape(rows, -1)
        block, lane = np.divmod(one.position, one.lanes)
        self.place = (block * letters.size * self.lanes + lane).astype(np.int32)
        # Where in the blocks each number of all is.
        row = np.arange(letters.slots)[:, None] * len(one.agents)
        self.there = (row + one.position).reshape(-1)
        self.link_place = np.zeros(links, int)
        self.link_place[self.slots[self.slots >= 0]] = np.flatnonzero(self.slots >= 0)

    def _reserve(self, rows: int, dtype: np.dtype) -> None:
        ahead, groups, lanes, letters = self.ahead, self.places.groups, self.lanes, self.letters
        slots = len(self.slots)
        many = slots + self.blocks
        self.arrivals = aligned((ahead, groups, many, lanes), np.int32)
        # Of no numbers where weights stay.
        self.weights = aligned((ahead, groups, many * letters.chosen, lanes), dtype)
        self.ring = aligned((groups, rows, letters.size, lanes), dtype)
        self.mail = aligned((groups, slots, len(letters.kept), lanes), dtype)
        self.changing = self.ring, self.mail
        self.sends = np.empty(ahead, np.int64)

    def clear(self) -> None:
        """Begin before the first message."""
        self.now = self.after = self.start()
        self.first = self.until = 0
        self.ring[:], self.mail[:] = 0.0, 0.0

    def forget(self, loops: Sequence[Loop]) -> None:
        """Continue with loops that may have other numbers."""
        loop, parts = loops[0], [(each.network, each.roster) for each in loops]
        (network, roster), (axes, of_roster) = stacked(parts)
        self.radio = Radio(network, loop.graph, roster, np.asarray(loop.motion.dt))
        self.axes = Radio(axes, None, of_roster, None)  # type: ignore[arg-type]

    # ---- what is decided ----

    def start(self) -> Empty:
        """Return the messages before the first one."""
        one = jax.tree.map(np.asarray, empty(self.loop.network, self.links))  # type: ignore[arg-type]
        return jax.tree.map(lambda leaf: np.repeat(leaf[None], self.count, axis=0), one)

    def left(self, step: int) -> int:
        """Return for how many steps from one on it is decided what arrives, with the same leaders.

        An agent takes the lead in one step.
        """
        if step >= self.until:
            self._decide(step)
        later = self.changes[self.changes > step]
        return int(later[0] if len(later) else self.until) - step

    def rows(self, step: int) -> dict[str, Array]:
        """Return of each agent whether it leads, if that changes."""
        self.left(step)
        lead = self.leads[:, step - self.first]
        return {"lead": lead.reshape(self.count * self.loop.agents, -1)}

    def _decide(self, step: int) -> None:
        # What is in flight at the first step is kept, so that a moment can be had at any later one.
        self.now, self.first, self.until = self.at(step), step, step + self.ahead
        far = self.blocks * self.letters.size * self.lanes
        numbers = np.asarray(step, np.int32), self.place, np.asarray(far, np.int32)
        self.after, decided = _decided(self.radio, self.axes, self.now, *numbers, self.ahead)
        links, packets, self.leads, weights = (np.asarray(part).swapaxes(0, 1) for part in decided)
        changed = (np.diff(self.leads, axis=1) != 0).any(axis=(0, 2))
        self.changes = step + 1 + np.flatnonzero(changed)
        slots = len(self.slots)
        self.arrivals[:, :, :slots] = self._placed(links, self.slots)
        agents = self.one.agents.reshape(self.blocks, -1)
        self.arrivals[:, :, slots:] = self._placed(packets, agents)
        if self.letters.chosen:
            of_links, alone = np.split(weights, [self.links], axis=2)
            of_links = self._in_steps(of_links, self.slots)
            self.weights[:, :, :slots] = np.where(self.slots >= 0, of_links, 0.0)
            self.weights[:, :, slots:] = self._in_steps(alone, agents)
        medium, steps = self.medium, step + np.arange(self.ahead)
        number, every = steps // int(medium.every), int(medium.every)
        self.sends[:] = np.where(steps % every == 0, number % medium.slots, -1)

    def _placed(self, values: Array, which: Array) -> Array:
        """Return places (F, T, X) in the ring of some of them, (T, groups, B, lanes)."""
        blocks = self._in_steps(values, which)
        if not self.places.batched:
            return np.where(which >= 0, blocks, -1)
        return np.where(blocks >= 0, blocks + np.arange(self.lanes, dtype=np.int32), blocks)

    def _in_steps(self, values: Array, which: Array) -> Array:
        """Return some of values (F, T, X) in blocks of each step, (T, groups, B, lanes)."""
        return self._to_blocks(values.swapaxes(1, 2), which).transpose(2, 0, 1, 3)

    def arguments(self, step: int) -> tuple[dict[str, Array], dict[str, int]]:
        """Return the letters, which arrive, which are sent, and the weights of links."""
        self.left(step)
        passed = step - self.first
        arrays = {"ring": self.ring, "mail": self.mail, "arrivals": self.arrivals[passed]}
        values = {
            "sends": self.sends[passed:].ctypes.data,
            "arrivals_step": arrays["arrivals"].size,
        }
        if self.letters.chosen:
            arrays["weights"] = self.weights[passed]
            values["weights_step"] = self.weights[passed].size
        return arrays, values

    def at(self, step: int) -> Empty:
        """Return the messages at a step, which say nothing."""
        if step in (self.first, self.until):
            return self.now if step == self.first else self.after
        numbers = (np.asarray(x, np.int32) for x in (self.first, step - self.first))
        return jax.tree.map(np.asarray, _passed(self.radio, self.axes, self.now, *numbers))

    # ---- what messages say ----

    def _to_blocks(self, values: Array, which: Array) -> Array:
        """Return some of numbers (F, X, k), which (B, lanes), in blocks (groups, B, k, lanes)."""
        if not self.places.batched:
            return values[0][which].swapaxes(1, 2)[None]
        shape = self.places.groups, self.lanes
        # The last formation fills its group.
        formation = np.minimum(np.arange(np.prod(shape)), self.count - 1).reshape(shape)
        return values[formation][:, :, which[:, 0]].transpose(0, 2, 3, 1)

    def _from_blocks(self, blocks: Array, where: Array) -> Array:
        """Return numbers (F, X, k) from where (X,) they are in blocks."""
        if not self.places.batched:
            rows = blocks[0].swapaxes(1, 2)
            return rows.reshape(-1, rows.shape[-1])[where][None]
        rows = blocks.transpose(0, 3, 1, 2)
        return rows.reshape(-1, *rows.shape[2:])[: self.count][:, where]

    def load(self, step: int, memory: PyTree) -> Array:
        """Take the memory of the network at a step; return the rows of packets (F N, p + 1)."""
        memory = jax.tree.map(np.asarray, memory)
        in_flight, mail = memory if self.count > 1 else jax.tree.map(lambda x: x[None], memory)
        self.now, self.first, self.until = _of_silence(in_flight, mail), step, step
        medium, content = self.medium, in_flight.content
        last, rows = (step - 1) // int(medium.every), np.arange(medium.slots)
        stamps = (last - (last - rows) % medium.slots) * int(medium.every)
        packet = content.packet
        sent = np.broadcast_to(stamps[None, :, None], packet.stamp.shape)
        parts = content.value, packet.content, packet.stamp[..., None], sent[..., None]
        letters = np.concatenate(parts, axis=-1)
        letters = letters.reshape(self.count, -1, letters.shape[-1])
        self.ring[:] = self._to_blocks(letters, self.senders)
        kept = np.concatenate([mail.value, mail.stamp[..., None]], axis=-1)
        self.mail[:] = self._to_blocks(kept, self.slots)
        packet = np.concatenate([mail.packet.content, mail.packet.stamp[..., None]], axis=-1)
        return packet.reshape(-1, packet.shape[-1])

    def memory(self, step: int, packets: Array) -> PyTree:
        """Return the memory of the network at a step, with the rows of packets (F N, p + 1)."""
        in_flight, mail = self.at(step)
        s, size = self.letters.value, self.letters.size
        letters = self._from_blocks(self.ring, self.there)
        letters = letters.reshape(self.count, self.letters.slots, -1, size)
        content, kept = in_flight.content, self._from_blocks(self.mail, self.link_place)
        packet = content.packet._replace(content=letters[..., s:-2])
        in_flight = in_flight._replace(
            content=content._replace(value=letters[..., :s], packet=packet)
        )
        own = packets[:, :-1].reshape(self.count, -1, packets.shape[1] - 1)
        mail = mail._replace(value=kept[..., :s], packet=mail.packet._replace(content=own))
        both = in_flight, mail
        return both if self.count > 1 else jax.tree.map(lambda x: x[0], both)


def _of_silence(in_flight: Any, mail: Messages) -> Empty:
    """Return messages without what they say."""

    def silent(messages: Messages) -> Messages:
        packet, nothing = messages.packet, np.zeros((*messages.packet.stamp.shape, 1))
        value = np.zeros((*messages.hops.shape, 0))
        return messages._replace(value=value, packet=packet._replace(content=nothing))

    return Empty(in_flight._replace(content=silent(in_flight.content)), silent(mail))


@cached_jit
def _decided(
    radio: Radio,
    axes: PyTree,
    now: Empty,
    first: jax.Array,
    place: jax.Array,
    row: jax.Array,
    steps: int,
) -> tuple[Empty, _Decided]:
    """Return the messages after some steps, and what is decided in each.

    An agent's letter is at its `place` in a row, of so many numbers.
    """
    one = _step(radio, axes, place, row)
    return jax.lax.scan(one, now, first + jnp.arange(steps, dtype=jnp.int32))


@cached_jit
def _passed(radio: Radio, axes: PyTree, now: Empty, first: jax.Array, count: jax.Array) -> Empty:
    """Return the messages of all formations after some steps."""
    one = _step(radio, axes, jnp.zeros(radio.network.rules.agents, jnp.int32), jnp.int32(0))
    return jax.lax.fori_loop(0, count, lambda k, now: one(now, first + k)[0], now)


def _nothing(count: int, links: int, agents: int) -> _Decided:
    """Return that nothing comes."""
    none = jnp.zeros((count, 0))
    places = (jnp.full((count, size), -1, jnp.int32) for size in (links, agents))
    return _Decided(*places, leads=none.astype(jnp.int32), weights=none)


def _step(radio: Radio, axes: PyTree, place: jax.Array, row: jax.Array) -> _Step:
    """Return what takes a step of all formations, with what comes."""
    links, network = len(radio.links.exchange.senders), radio.network
    one = jax.vmap(partial(_of_one, place, row), (axes, 0, None))

    def all_(now: Empty, step: jax.Array) -> tuple[Empty, _Decided]:
        nothing = _nothing(len(now.mail.stamp), links, len(place))
        # Where nothing arrives or is sent, time changes nothing.
        busy = step % jnp.max(jnp.asarray(network.medium.every)) == 0
        busy |= (now.in_flight.arrival == step).any()
        return jax.lax.cond(busy, lambda: one(radio, now, step), lambda: (now, nothing))

    # But who takes the lead, and what is too old to be used.
    always = network.leadership.changes or network.rules.neighbours.chooses
    return partial(one, radio) if always else all_


def _of_one(
    place: jax.Array, row: jax.Array, radio: Radio, now: Empty, step: jax.Array
) -> tuple[Empty, _Decided]:
    """Return the messages of one formation after a step, and what is decided in it."""
    senders, network = jnp.asarray(radio.links.exchange.senders), radio.network
    led = now.mail.packet.leader == jnp.arange(len(place))
    now, decided = deliver(radio, now, step)
    letter = decided.slot.astype(jnp.int32) * row + place[senders]
    packet = jnp.where(decided.place >= 0, letter[decided.place.astype(jnp.int32)], -1)
    leads = jnp.where(decided.leads, 2 - led, 0).astype(jnp.int32)
    leads = leads[: len(place) * network.leadership.changes]
    weights = jnp.append(decided.weights, decided.alone)
    weights = weights[: len(weights) * network.rules.neighbours.chooses]
    return now, _Decided(jnp.where(decided.new, letter, -1), packet, leads, weights)
