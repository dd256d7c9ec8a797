"""Measure the log in a flight: time of a tick, bytes a minute, and ticks during a sync of the disk.

Run `python benchmarks/flight_log.py FLIGHT [SPEED]` with a folder that `echelon fly SCENARIO --out
FLIGHT` wrote. All agents fly with simulated vehicles, in processes that time their own logs.
"""

import os
import sys
import time
from pathlib import Path
from typing import Any

from echelon_flight import flight_log
from echelon_flight.flight_log import FlightLog
from echelon_flight.local_flight import LocalFlight
from echelon_flight.mission import Mission

SECONDS = 8.0


def inside() -> None:
    """Fly one agent as `python -m echelon_flight` does, and print what its log took."""
    from echelon_flight.__main__ import main

    spent, during = [0.0], list[float]()
    syncing, real = [0.0, 0.0], os.fsync

    def fsync(descriptor: int) -> None:
        began = syncing[0] = time.perf_counter()
        real(descriptor)
        syncing[0], syncing[1] = 0.0, max(syncing[1], time.perf_counter() - began)

    def timed(method: Any, last: bool) -> Any:
        def call(*arguments: Any) -> None:
            busy, began = syncing[0], time.perf_counter()
            method(*arguments)
            spent[-1] += time.perf_counter() - began
            if last:
                during.extend([spent[-1]] * bool(busy or syncing[0]))
                spent.append(0.0)

        return call

    flight_log.os.fsync = fsync
    FlightLog.receive = timed(FlightLog.receive, False)
    FlightLog.tick = timed(FlightLog.tick, True)
    try:
        main()
    finally:
        spent.sort()
        texts = ", ".join(f"{1e6 * spent[len(spent) * k // 100]:.1f}" for k in (50, 90, 99))
        print(f"  a tick: {texts} us (50, 90, 99 %), {1e6 * spent[-1]:.0f} us at most")
        stall = 1e6 * max(during, default=0.0)
        print(f"  {len(during)} ticks during a sync: {stall:.0f} us at most; "
              f"longest sync {1e3 * syncing[1]:.1f} ms", flush=True)  # fmt: skip


def fly(folder: Path, speed: float) -> None:
    """Fly all agents, and print how large their logs are."""
    begin = LocalFlight._begin

    def watched(self: LocalFlight, name: str, words: Any) -> None:
        words = [*words]
        if name.startswith("agent"):
            words = [__file__, "--inside", *words[2:]]
        begin(self, name, words)

    LocalFlight._begin = watched
    flight = LocalFlight(Mission(folder), SECONDS, speed, 47700)
    print(f"load {os.getloadavg()[0]:.1f}")
    with flight:
        flight.wait_until_down()
    for number, files in flight_log.find_logs(folder).items():
        for file in files:
            log = flight_log.read_log(file)
            span = log.ticks[-1].time - log.ticks[0].time
            rate, size = len(log.ticks) / span, file.stat().st_size
            per = size / len(log.ticks) * 100.0 * 60.0 / 1e6
            print(f"flight {number}, {file.name}: {rate:.0f} Hz, {per:.2f} MB/min at 100 Hz")


if __name__ == "__main__":
    if sys.argv[1] == "--inside":
        del sys.argv[1]
        inside()
    else:
        fly(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 1.0)
