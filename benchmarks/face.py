"""How quick the face is: each figure beside the one that is asked for.

Run `python benchmarks/face.py`, or with names (`live-4`, `live-1000`, `replay-4`, `replay-1000`,
`video-4`, `video-1000`) only some of it. Pages are drawn by a real Chromium by software, which
needs a core of its own: the load of the machine is printed, and with a load above 1 the figures
tell of the neighbours.
"""

import argparse
import contextlib
import json
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import echelon as ech
from echelon.apps.live.server import live, live_page
from echelon.experiments.results.recording import recording_of
from echelon.experiments.scenario.scenario import Scenario, scenario_from_mapping
from echelon.output.archive.run_folder import load
from echelon.output.plots.video import save_video
from echelon.output.viewer.replay import replay_page

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

_SECONDS, _TURNS = 10.0, 15
_CLUSTERS, _EACH, _APART = 40, 25, 3.0


def flock() -> Scenario:
    """Return 40 leaders on a circle's motion, 24 quadrotors about each on rings."""
    edges, offsets = [], {}
    for k in range(_CLUSTERS):
        first = _EACH * k
        # Leaders hear nobody here, but a graph is of one piece.
        edges += [[first - _EACH, first]] if k else []
        middle = _APART * np.array([k % 8, k // 8])
        offsets[first] = [*middle.tolist(), 0.0]
        for i in range(1, _EACH):
            edges += [[first, first + i], [first + i, first + 1 + i % (_EACH - 1)]]
            angle, far = 2.0 * np.pi * i / (_EACH - 1), 0.7 + 0.4 * (i % 2)
            place = middle + far * np.array([np.cos(angle), np.sin(angle)])
            offsets[first + i] = [*place.tolist(), 0.0]
    return scenario_from_mapping(
        {
            "name": "flock",
            "model": {"name": "quadrotor"},
            "graph": {"edges": edges, "leaders": [_EACH * k for k in range(_CLUSTERS)]},
            "formation": {"offsets": offsets},
            "reference": {"name": "circle", "radius": 1.0, "rate": 0.5},
            "follower": {"law": "consensus", "gain": {"method": "riccati", "coupling": 1.5}},
            "initial": {"spread": {"position": 0.3}},
            "simulation": {"horizon": 20.0, "dt": 0.005, "store_every": 8},
        }
    )


def scenario(agents: int) -> Scenario:
    """Return the paper's four quadrotors, or the flock."""
    return flock() if agents > 4 else ech.load_scenario("paper")


def told(name: str, figure: float, asked: float, unit: str, least: bool = False) -> None:
    """Print a figure beside the one that is asked for."""
    well = figure >= asked if least else figure <= asked
    sign = ">=" if least else "<="
    print(f"{name:44} {figure:8.3g} {unit:12} asked {sign} {asked:g}{'' if well else '   MISSED'}")


# ---- pages ---------------------------------------------------------------------------------------


@contextlib.contextmanager
def drawn(address: str) -> Iterator[Any]:
    """Yield a page in Chromium."""
    from browser import chromium, opened

    with chromium() as browser, opened(browser, address) as page:
        yield page


_COUNT = """(seconds) => new Promise((done) => {
  const began = performance.now(), first = [echelon.pictures, echelon.time];
  let drawn = 0, last = -1;
  const look = () => {
    if (echelon.pictures !== last) (last = echelon.pictures), drawn++;
    const passed = (performance.now() - began) / 1000;
    if (passed < seconds) return requestAnimationFrame(look);
    done([drawn / passed, (echelon.time - first[1]) / passed]);
  };
  requestAnimationFrame(look);
})"""

_ANSWER = """(wind) => new Promise((done) => {
  const began = performance.now();
  echelon.ask("wind", wind);
  const look = () => Math.abs(echelon.numbers.wind - wind) < 1e-6
    ? requestAnimationFrame(() => done(performance.now() - began)) : setTimeout(look, 1);
  look();
})"""


def measure_live(agents: int) -> None:
    """Tell how the loop keeps time, how many pictures are drawn, and how soon a knob is seen."""
    from browser import until

    began = time.perf_counter()
    session, html = live(scenario(agents))
    print(f"ready after {time.perf_counter() - began:.1f} s, {session.swarm.engine}")
    session.start()
    try:
        with live_page(session, html).serving(0) as address, drawn(address) as page:
            until(lambda: page.evaluate("echelon.pictures") > 50, 120.0)
            pictures, clock = page.evaluate(_COUNT, _SECONDS)
            waits = []
            for k in range(_TURNS):
                waits.append(page.evaluate(_ANSWER, 0.01 * (k + 1)))
                time.sleep(0.3)
            stepping = _stepping(session)
    finally:
        session.end()
    few = agents <= 4
    told(f"live, {agents} agents: pictures drawn", pictures, 25 if few else 20, "1/s", least=True)
    told(f"live, {agents} agents: of real time", clock, 0.99, "", least=True)
    told(
        f"live, {agents} agents: knob to picture",
        statistics.median(waits),
        150 if few else 200,
        "ms",
    )
    told(f"live, {agents} agents: a picture's steps", 1e3 * stepping, 40.0, "ms")


def _stepping(session: Any) -> float:
    """Return the seconds that the steps of a picture take, beside all the rest."""
    found = []
    session.paused = True
    time.sleep(0.2)
    for _ in range(30):
        began = time.perf_counter()
        session.swarm.advance()
        found.append(time.perf_counter() - began)
    return statistics.median(found)


_SCRUB = """(seconds) => new Promise((done) => {
  const began = performance.now();
  let drawn = 0;
  const next = () => {
    const passed = (performance.now() - began) / 1000;
    if (passed > seconds) return done(drawn / passed);
    echelon.seek((7 * drawn++) % echelon.last);
    requestAnimationFrame(next);
  };
  next();
})"""


def stored(agents: int, folder: Path) -> Path:
    """Return the folder of a run of a minute, or of 20 s of the flock."""
    from echelon.output.archive.run_folder import save_run

    seconds = 60 if agents <= 4 else 20
    own = scenario(agents)
    data = {**own.data, "simulation": {**own.data["simulation"], "horizon": float(seconds)}}
    save_run(ech.run(scenario_from_mapping(data, own.folder)), folder / str(agents), figures=False)
    return folder / str(agents)


def measure_replay(agents: int, run: Path) -> None:
    """Tell how large a page is, how long it takes to be made, and how it scrubs."""
    result = load(run)
    began = time.perf_counter()
    html = replay_page(recording_of(result))
    took = time.perf_counter() - began
    file = run / "page.html"
    file.write_text(html, "utf-8")
    with drawn(file.as_uri()) as page:
        rate = page.evaluate(_SCRUB, 5.0)
    few = agents <= 4
    told(f"replay, {agents} agents: size", len(html) / 1e6, 0.5 if few else 3.0, "MB")
    told(f"replay, {agents} agents: made in", took, 4.0, "s")
    told(f"replay, {agents} agents: scrubbing", rate, 40 if few else 20, "frames/s", least=True)


def measure_video(agents: int, run: Path) -> None:
    """Tell how long a picture of a video takes, drawing and encoding."""
    result = load(run)
    began, used = time.perf_counter(), time.process_time()
    pictures = save_video(result, run / "run.mp4", 1.0 if agents <= 4 else 2.0)
    took = time.perf_counter() - began
    told(f"video, {agents} agents: a picture", 1e3 * took / pictures, 200.0, "ms")
    print(
        f"{'':44} {1e3 * (time.process_time() - used) / pictures:8.3g} ms of it are of this process"
    )


def main() -> None:
    """Measure what is named, or all."""
    every = [f"{what}-{n}" for n in (4, 1000) for what in ("live", "replay", "video")]
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(every)}")
    names = parser.parse_args().names or every
    if unknown := set(names) - {*every}:
        parser.error(f"{', '.join(sorted(unknown))} is none of {', '.join(every)}")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.2f}; {json.dumps(names)}")
    folder, made = Path(tempfile.mkdtemp()), dict[int, Path]()
    for name in names:
        what, count = name.split("-")
        agents = int(count)
        if what == "live":
            measure_live(agents)
            continue
        if agents not in made:
            made[agents] = stored(agents, folder)
        (measure_replay if what == "replay" else measure_video)(agents, made[agents])
    print(f"load at the end {os.getloadavg()[0]:.2f}")
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
