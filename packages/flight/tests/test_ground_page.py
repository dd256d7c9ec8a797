"""The page of the ground station in a real browser, beside agents that this test plays."""

import math
import time

import pytest
from browser import chromium, until
from free_port import free_port

from echelon_flight.datagram_socket import LOOPBACK, DatagramSocket
from echelon_flight.ground import Ground, page_of
from echelon_flight.supervisor import Fault
from echelon_flight.wire import GROUND, DatagramKind, Drop, Opened, Report, Wire

SIZES = {"desktop": (1280, 720), "phone": (390, 844)}


@pytest.fixture(scope="module")
def browser():
    with chromium() as one:
        yield one


def wire(number, key=b"k" * 32):
    return Wire(key, "ab" * 32, number, 3, 2, time.time_ns() // 1_000_000)


def report(leader, fault=Fault.NONE, amount=0.0):
    dropped = tuple(12 * (why is Drop.OLD) for why in Drop)
    number, mode = list(Fault).index(fault), 1 + (fault is not Fault.NONE)
    place = 1.0, -0.25, math.nan
    rest = 4.2, *place, 0.03, 2e-4, 0.01, 0.5
    kept = (1.25, 3, "an input is at a limit") if fault is Fault.FENCE else (math.inf, 0, "")
    return Report(mode, number, leader, amount, *rest, dropped, *kept, "cflib://radio://0/80/2M")


SHOWN = (
    "the plan, and leads",
    "agent 0",
    "descends: the vehicle is 0.50 m outside its fence",
    "Dropped here: a datagram of agent 0 is signed with another key: 1.",
    "not heard yet. the address is in use",
    "12 × is not newer than the last one from its sender",
    "1, -0.25, ?",
    "50 %",
    "kept",
    "lost at 1.25 s: an input is at a limit",
    "cflib://radio://0/80/2M: 3 setpoints late",
)
"""Of the page, once all has arrived."""


@pytest.mark.parametrize("size", SIZES)
def test_the_page_shows_agents_and_stops_all_of_them(browser, size):
    ways = [(LOOPBACK, free_port()) for _ in range(2)]
    agents = DatagramSocket(ways[0], [ways[1]])
    ground = Ground(DatagramSocket(ways[1], [ways[0]]), wire(GROUND), 3)
    ground.listen()
    width, height = SIZES[size]
    page = browser.new_page(viewport={"width": width, "height": height})
    try:
        with page_of(ground).serving() as address:
            page.goto(address)
            for number, said in ((0, report(0)), (1, report(0, Fault.FENCE, 0.5))):
                agents.send(wire(number).report(time.time(), said))
            agents.send(wire(0, b"other" * 8).stop(time.time()))
            agents.send(wire(2).note(time.time(), "the address is in use"))
            until(lambda: all(part in page.inner_text("body") for part in SHOWN))
            # Nothing has to be scrolled sideways, and the stop is always in sight.
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            page.evaluate("window.scrollTo(0, 1e6)")
            assert 0.0 <= page.locator("#stop").bounding_box()["y"] < 0.5 * height
            until(lambda: "silent" in page.inner_text("table"))
            page.click("#stop")
            until(lambda: page.inner_text("#note").startswith("Stop was sent."))
            receiver, kinds = wire(1), []
            receiver.begin(1)
            for datagram in agents.receive():
                opened = receiver.open(datagram, None, time.time())
                kinds += [opened.kind] * isinstance(opened, Opened)
            assert DatagramKind.STOP in kinds and page.is_disabled("#start")
            page.context.set_offline(True)
            until(lambda: "can stop nobody" in page.inner_text("#note"))
    finally:
        page.close()
        ground.close()
        agents.close()
