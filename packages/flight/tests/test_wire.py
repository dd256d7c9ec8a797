"""Datagrams: what was written is read, and nothing else is."""

import hmac
import math
import os
import random
import struct

import pytest

from echelon_flight import FlightError
from echelon_flight.mission import read_key
from echelon_flight.wire import GROUND, DatagramKind, Drop, Message, Report, Wire

KEY, FORMATION, AGENTS, SIZE = b"k" * 32, "ab" * 32, 4, 6
NOW, WALL, BOOT = 3.0, 1.8e9, 1_800_000_000_000
FLIGHT = BOOT + 5


def wire(number=1, key=KEY, formation=FORMATION, boot=BOOT, flight=FLIGHT):
    one = Wire(key, formation, number, AGENTS, SIZE, boot, 0)
    if flight:
        one.begin(flight)
    return one


def letter(time=NOW, sender=1):
    return Message(sender, (time, 1.0, 0.1, -0.2, 2.0**23, 1e-9))


def test_a_letter_is_read_as_it_was_written():
    sender, receiver = wire(1), wire(2)
    datagram = sender.letter(letter())
    opened = receiver.open(datagram, NOW, WALL)
    assert opened.body == letter() and (opened.sender, opened.boot) == (1, BOOT)
    assert len(datagram) == 40 + 8 * (SIZE - 1) + 16


def test_commands_and_reports_are_read_without_a_plan():
    ground, agent = wire(GROUND), wire(2, flight=None)
    ground.challenges[2] = agent.challenge
    assert agent.open(ground.start(WALL, WALL + 2.0, 2), None, WALL).body == WALL + 2.0
    assert agent.open(ground.stop(WALL, 2), None, WALL).kind is DatagramKind.STOP
    assert agent.open(wire(1).letter(letter()), None, WALL) is Drop.EARLY
    for sentence in ("the key is another one", "é" * 200, ""):
        opened = ground.open(agent.note(WALL, sentence), None, WALL)
        assert (opened.kind, opened.body) == (DatagramKind.NOTE, sentence[:120])
    counts = tuple(range(len(Drop)))
    watched = 2.5, 7, "an input is at a limit", "cflib://radio://0/80/2M/E7E7E7E701"
    report = Report(1, 2, 0, 0.5, 3.0, 1.0, 2.0, 3.0, 0.25, 0.5, 0.01, math.nan, counts, *watched)
    read = ground.open(agent.report(WALL, report), None, WALL).body
    assert read[:3] == report[:3] and math.isnan(read.battery)
    assert read[12:] == (counts, *watched)


def test_the_layout_is_the_one_that_is_documented():
    """Written by hand, so that programs in other languages find what docs/fly.md says."""
    datagram = wire(1).letter(letter())
    head = struct.unpack_from("<BB8sHQQId", datagram)
    assert head == (4, 1, bytes.fromhex("ab" * 8), 1, BOOT, FLIGHT, 1, NOW)
    assert struct.unpack_from("<5d", datagram, 40) == letter().row[1:]


def signed(
    body,
    kind=DatagramKind.LETTER,
    number=1,
    stamp=NOW,
    count=1,
    boot=BOOT,
    version=4,
    flight=FLIGHT,
):
    """A datagram of somebody who has the key and knows the format."""
    head = struct.pack("<BB8sHQQId", version, kind, b"\xab" * 8, number, boot, flight, count, stamp)
    return head + body + hmac.digest(KEY, head + body, "sha256")[:16]


def body_of(*numbers):
    return struct.pack("<5d", *numbers, *[0.0] * (5 - len(numbers)))


GOOD = signed(body_of())
BAD = {
    Drop.LENGTH: [
        b"",
        b"x",
        GOOD[:-1],
        GOOD + b"\0",
        signed(b""),
        signed(body_of(), DatagramKind.START),
    ],
    Drop.VERSION: [signed(body_of(), version=k) for k in (1, 2, 3)],
    Drop.FORMATION: [wire(formation="cd" * 32).letter(letter())],
    Drop.SIGNATURE: [
        wire(key=b"other" * 8).letter(letter()),
        GOOD[:-1] + bytes([GOOD[-1] ^ 1]),
        GOOD[:40] + bytes([GOOD[40] ^ 1]) + GOOD[41:],
    ],
    Drop.SENDER: [signed(body_of(), number=4), signed(body_of(), number=GROUND)],
    Drop.NOT_FINITE: [
        signed(body_of(math.nan)),
        signed(body_of(0.0, 0.0, 0.0, 0.0, math.inf)),
        signed(body_of(0.0, -math.inf)),
        signed(body_of(), stamp=math.nan),
    ],
    Drop.TOO_LARGE: [
        signed(body_of(0.0, 1.1e7)),
        signed(body_of(-2e7)),
    ],
    Drop.CLOCK: [
        signed(body_of(), stamp=NOW + 1.1),
        signed(body_of(), stamp=NOW - 1.1),
        signed(body_of(), boot=BOOT + 10_000),
    ],
}


@pytest.mark.parametrize("why", BAD)
def test_what_is_in_doubt_is_dropped_and_counted(why):
    receiver = wire(2)
    assert [receiver.open(each, NOW, WALL) for each in BAD[why]] == [why] * len(BAD[why])
    assert receiver.dropped == {why: len(BAD[why])}
    # None of them keeps a good one out.
    assert receiver.open(GOOD, NOW, WALL).sender == 1


def test_replays_are_old_and_a_restarted_process_is_not():
    receiver = wire(2)
    first, second = (signed(body_of(), count=k) for k in (1, 2))
    assert receiver.open(second, NOW, WALL).sender == 1
    assert receiver.open(first, NOW, WALL) is receiver.open(second, NOW, WALL) is Drop.OLD
    assert receiver.open(signed(body_of(), boot=BOOT + 1), NOW, WALL).sender == 1
    assert receiver.open(signed(body_of(), count=9), NOW, WALL) is Drop.OLD


def test_own_datagrams_that_return_hide_no_other_process_with_the_same_number():
    elder, newer = wire(1), wire(1, boot=BOOT + 1)
    assert newer.open(newer.note(WALL, "here"), None, WALL).boot == BOOT + 1
    datagram = elder.note(WALL, "here too")
    assert newer.open(datagram, None, WALL).boot == BOOT
    assert newer.open(datagram, None, WALL) is Drop.OLD


def test_only_the_ground_starts_a_plan():
    agent = wire(2)
    assert agent.open(wire(1).start(WALL, WALL), None, WALL) is Drop.SENDER
    assert agent.open(wire(1).stop(WALL), None, WALL).kind is DatagramKind.STOP


def test_no_forged_datagram_is_used():
    draws, receiver = random.Random(0), wire(2)
    good = [signed(body_of(), count=k) for k in range(1, 50)]
    for each in good:
        receiver.open(each, NOW, WALL)
    for k in range(3_000):
        source = bytearray(draws.choice(good))
        source[draws.randrange(len(source))] ^= 1 << draws.randrange(8)
        value = [draws.choice((math.nan, math.inf, -math.inf, 2e7, -1e300)) for _ in range(4)]
        far = NOW + draws.choice((-1, 1)) * draws.uniform(1.001, 1e9)
        forged = draws.choice((
            bytes(source),
            draws.choice(good),
            draws.randbytes(draws.randrange(300)),
            GOOD[: draws.randrange(len(GOOD))],
            signed(body_of(*value), count=100 + k),
            signed(body_of(), stamp=far, count=100 + k),
            wire(1, key=draws.randbytes(32)).letter(letter()),
            wire(1, formation=draws.randbytes(8).hex()).letter(letter()),
            signed(draws.randbytes(40), count=100 + k, number=draws.randrange(4, 1000)),
            GOOD[:10] + draws.randbytes(len(GOOD) - 10),
        ))  # fmt: skip
        assert isinstance(receiver.open(forged, NOW, WALL), Drop)
    assert sum(receiver.dropped.values()) == 3_000


def test_a_key_is_read_only_from_a_file_of_its_owner(tmp_path):
    file = tmp_path / "key"
    with pytest.raises(FlightError, match=r"cannot be read \(no such file or directory\); make"):
        read_key(file)
    file.write_bytes(os.urandom(32))
    file.chmod(0o640)
    with pytest.raises(FlightError, match="has mode 0640, and others may read it"):
        read_key(file)
    file.chmod(0o600)
    assert len(read_key(file)) == 32
    file.write_bytes(b"short")
    with pytest.raises(FlightError, match="has 5 bytes, and must have at least 16"):
        read_key(file)


def test_a_letter_that_would_be_split_is_refused():
    with pytest.raises(FlightError, match="a letter of 61 numbers has 536 bytes"):
        Wire(KEY, FORMATION, 0, 4, 61, BOOT)
