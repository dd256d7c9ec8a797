"""The letterbox follows the rules of the simulated channel: both receive the same letters."""

import math
import random

import numpy as np

from echelon.agents.network.inbox import Inbox, Message, NamedValues, Received, Stamps
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
    packet = LeaderPacket(draws.choice((0, 0, 1, 2)), said, (draws.random(), 0.0))
    packet = draws.choice((packet, packet, packet, packet._replace(term=1), None))
    value = draws.random(), draws.random()
    return wire.Message(
        draws.choice((0, 1, 2, 3)), time, draws.choice((0, 1, 2, 0xFFFF)), value, packet
    )


def as_message(letter):
    values = NamedValues(NAMES, np.array(letter.value))
    return Message(letter.sender, values, None, letter.time, letter.hops, letter.packet)


def test_both_take_and_keep_the_same():
    for own in (None, 0, 1):
        draws, answers = random.Random(f"{own}"), set()
        stamps = Stamps(len(HEARS), LEADERS, 2, own, True)
        box, inbox = Letterbox(HEARS, LEADERS, own), Inbox(HEARS, 0, NAMES, NAMES, stamps)
        for k in range(1_000):
            stamps.clock = clock = 0.01 * k
            letter = draw(draws, clock)
            why = box.receive(letter, clock)
            answers.add(why)
            assert SAME[why] is inbox.receive(as_message(letter)), letter
            kept = list(box.letters.values())
            times = [-math.inf if x is None else x.time for x in kept]
            assert times == stamps.time.tolist()
            assert [x.hops for x in kept if x] == [h for h in stamps.hops.tolist() if h < 2**30]
            rows = [[math.nan] * 2 if x is None else x.value for x in kept]
            np.testing.assert_array_equal(inbox.signals, rows)
            assert (box.packet is None) == (stamps.packet is None)
            assert box.packet is None or tuple(box.packet) == tuple(stamps.packet)
        assert answers == {*SAME}
