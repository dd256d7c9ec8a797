"""The letterbox follows the rules of simulated messages: both receive the same letters."""

import math
import random

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.network.channel import NEVER, Network
from echelon.agents.network.exchange import Exchange
from echelon.agents.network.inbox import LateInbox, Message, NamedValues, Received
from echelon.simulation.step.leadership import FixedLeaders
from echelon.simulation.step.networks import MessageRules
from echelon.simulation.step.records import LeaderPackets, Messages
from echelon_flight import wire
from echelon_flight.pilot import Letterbox
from echelon_flight.wire import Drop, LeaderPacket

HEARS, LEADERS, NAMES = (0, 1, 3), (0, 1), ("x", "y")
SAME = {
    None: Received.TAKEN,
    Drop.SENDER: Received.NOT_HEARD,
    Drop.PACKET: Received.NO_MESSAGE,
    Drop.AHEAD: Received.AHEAD,
    Drop.OLD: Received.LATE,
}


def draw(draws, clock):
    time = clock + draws.choice((draws.uniform(-2.0, 0.2), -0.5, 0.0))
    said = time + draws.choice((draws.uniform(-1.0, 0.2), -0.25))
    leader = draws.choice((0, 0, 1, 2))
    # A leader says one thing at a time.
    packet = LeaderPacket(leader, said, (math.sin(said), float(leader)))
    packet = draws.choice((packet, packet, packet, packet._replace(term=1), None))
    value = draws.random(), draws.random()
    return wire.Message(
        draws.choice((0, 1, 2, 3)), time, draws.choice((0, 1, 2, 0xFFFF)), value, packet
    )


def as_message(letter):
    values = NamedValues(NAMES, np.array(letter.value))
    return Message(letter.sender, values, None, letter.time, letter.hops, letter.packet)


def test_both_take_and_keep_the_same():
    links = Exchange(np.zeros(3, int), np.arange(3), np.ones(3))
    for own in (None, 0, 1):
        draws, answers = random.Random(f"{own}"), set()
        box = Letterbox(HEARS, LEADERS, own)
        inbox = LateInbox(HEARS, 0, NAMES, NAMES, LEADERS, 2, True, False)
        leaders = FixedLeaders(np.array([own is not None]))
        rules = MessageRules.of(Network().prepared(0.02, 1.0, 0), leaders, 4)
        take = jax.jit(
            lambda mail, sent, stamp: rules.take(mail, sent, stamp != NEVER, stamp, links)
        )
        with jax.enable_x64(True):
            mail = rules.begin(jnp.array([2 if own is None else own]), 3, jnp.zeros((1, 2)), 2)
            packet = mail.packet._replace(stamp=mail.packet.stamp.astype(float))
            mail = mail._replace(stamp=mail.stamp.astype(float), packet=packet)
        for k in range(1_000):
            inbox.clock = clock = 0.01 * k
            letter = draw(draws, clock)
            why = box.receive(letter, clock)
            answers.add(why)
            assert SAME[why] is inbox.receive(as_message(letter)), letter
            if why is not None:
                continue
            kept = list(box.letters.values())
            times = [NEVER if x is None else x.time for x in kept]
            assert times == inbox.time.tolist()
            assert [x.hops for x in kept if x] == [h for h in inbox.hops.tolist() if h < 2**30]
            rows = [[math.nan] * 2 if x is None else x.value for x in kept]
            np.testing.assert_array_equal(inbox.signals, rows)
            packets = LeaderPackets(inbox.leader, inbox.said, inbox.content, ())
            with jax.enable_x64(True):
                mail = take(mail, Messages(inbox.signals, inbox.hops, packets), inbox.time)
            said = jax.tree.map(lambda row: np.asarray(row)[0].tolist(), mail.packet)
            # Its own packets come back to a leader, and say nothing new.
            assert (box.packet is None) == (said.stamp == NEVER or said.leader == own)
            assert box.packet is None or box.packet[:2] == (said.leader, said.stamp)
            assert box.packet is None or list(box.packet.content) == said.content
        assert answers == {*SAME}
