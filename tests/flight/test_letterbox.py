"""The letterbox takes and keeps what the inbox of `Agent` does: both receive the same letters."""

import math
import random

import numpy as np
import pytest

from echelon.agents.network.inbox import LateInbox, LeaderPacket, Message, NamedValues, Received
from echelon_flight import wire
from echelon_flight.pilot import Letterbox
from echelon_flight.wire import Drop

HEARS, LEADERS, NAMES = (0, 1, 3), (0, 1), ("x", "y")
PARTS = {"time": 1, "hops": 1, "signal": 2, "leader": 1, "said": 1, "content": 2}
FACTS = {"hears": HEARS, "message": PARTS, "network": {"leaders": LEADERS}}
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
    leader, hops = draws.choice((0, 0, 1, 2)), draws.choice((0, 1, 2, 2**23))
    row = time, hops, draws.random(), draws.random(), leader, said, math.sin(said), leader
    return wire.Message(draws.choice((0, 1, 2, 3)), tuple(map(float, row)))


def as_message(letter):
    time, hops, *value, leader, said = letter.row[:6]
    packet = LeaderPacket(int(leader), said, letter.row[6:])
    values = NamedValues(NAMES, np.array(value))
    return Message(letter.sender, values, None, time, int(hops), packet)


def test_both_take_and_keep_the_same():
    draws, answers = random.Random(0), set()
    box, inbox = Letterbox(FACTS), LateInbox(HEARS, 0, NAMES, NAMES, LEADERS, 2, True, False)
    for k in range(2_000):
        inbox.clock = clock = 0.01 * k
        letter = draw(draws, clock)
        why = box.receive(letter, clock)
        answers.add(why)
        expected = inbox.receive(as_message(letter))
        # The inbox looks at a packet's leader before it looks at times.
        assert SAME[why] is expected or {why, expected} == {Drop.AHEAD, Received.NO_MESSAGE}
        for j, row in enumerate(np.reshape(box.rows, (len(HEARS), -1))):
            if math.isnan(row[0]):
                assert inbox.time[j] < -1e6 and np.isnan(row).all()
                continue
            packet = inbox.leader[j], inbox.said[j], *inbox.content[j]
            kept = inbox.time[j], inbox.hops[j], *inbox.signals[j], *packet
            np.testing.assert_array_equal(row, kept)
    assert answers == {*SAME}


@pytest.mark.parametrize(("leader", "term", "taken"), [
    *[(0, 0.0, True), (0, 1.0, False), (1, 0.0, False), (1, 1.0, True), (1, 7.0, True)],
    *[(1, 0.5, False), (1, -1.0, False), (2, 1.0, False)],
])  # fmt: skip
def test_a_later_term_is_of_a_backup_leader_and_of_nobody_else(leader, term, taken):
    facts = FACTS | {"message": PARTS | {"term": 1}}
    box = Letterbox(facts, backups=[1])
    row = 1.0, 1.0, 0.0, 0.0, float(leader), 0.9, 0.0, 0.0, term
    assert (box.receive(wire.Message(3, row), 1.0) is None) == taken


def test_ages_are_those_of_the_newest_letters():
    box, row = Letterbox(FACTS), (1.0, 1.0, 0.0, 0.0, 0.0, 0.9, 0.0, 0.0)
    assert box.receive(wire.Message(1, row), 1.0) is None
    assert box.ages(1.5) == [math.inf, 0.5, math.inf]
