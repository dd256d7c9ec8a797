"""A process between agents that delays and loses what they send, by a seed."""

import heapq
import itertools
import random
import select
import time
from collections.abc import Sequence
from typing import NamedTuple

from echelon.flight.air import Address, bound
from echelon.flight.wire import sender_of


class Weather(NamedTuple):
    """What happens to datagrams: delay and largest additional delay (s), loss, and the seed."""

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    seed: int = 0


def carry(port: int, to: Sequence[Address], weather: Weather, speed: float = 1.0) -> None:
    """Carry datagrams to all but their sender until the process ends.

    Args:
        port: of this machine, where agents send to.
        to: where agent k listens, and last the ground station.
        weather: what happens on the way.
        speed: seconds of the plan in one of this machine.
    """
    draws, order = random.Random(weather.seed), itertools.count()
    queue = list[tuple[float, int, bytes, Address]]()
    with bound(port) as air:
        while True:
            wait = max(0.0, queue[0][0] - time.monotonic()) if queue else None
            if select.select([air], [], [], wait)[0]:
                datagram, now = air.recv(2048), time.monotonic()
                own = sender_of(datagram)
                for k, address in enumerate(to):
                    late = weather.delay + weather.jitter * draws.random()
                    if k != own and draws.random() >= weather.loss:
                        item = now + late / speed, next(order), datagram, address
                        heapq.heappush(queue, item)
            while queue and queue[0][0] <= time.monotonic():
                _, _, datagram, address = heapq.heappop(queue)
                try:
                    air.sendto(datagram, address)
                except OSError:
                    continue
