"""Write the folder of a flight by hand: two points that hover, the second beside the first.

Run `python two_points.py FOLDER`, then `python -m echelon_flight FOLDER --all`. A point is a
vehicle whose inputs are accelerations. The leader flies a circle at 1 m, and at the end both land.
For vehicles of your own, `echelon fly SCENARIO --out FOLDER` writes such a folder.
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

DT, SUBSTEPS, HORIZON = 0.02, 2, 8.0
OFFSETS = [0.0, 0.0, 0.0], [0.0, 0.6, 0.0]
STATES = {"x": "m", "y": "m", "z": "m", "vx": "m/s", "vy": "m/s", "vz": "m/s"}
INPUTS = {"ax": "m/s^2", "ay": "m/s^2", "az": "m/s^2"}
LETTER = {"time": 1, "hops": 1, "signal": 3, "leader": 1, "said": 1, "content": 3}
"""The parts of a letter, and how many numbers each has."""

LAW = '''"""The law of agent {agent}. Signals are stopping points: where it would come to rest."""

import math

K, GAIN = 4.0, 2.0
OFFSET = {offset}


def plan(t):
    """Where the leader's stopping point should be at t (s), and its velocity."""
    cos, sin = math.cos(0.5 * t), math.sin(0.5 * t)
    return [0.5 * cos, 0.5 * sin, 1.0], [-0.25 * sin, 0.25 * cos, 0.0]


def begin(x):
    """The memory of an agent that begins in the state x."""
    return []


def step(t, x, received, memory):
    """A step at t (s) with the last letter of the other agent, NaN for none.

    It returns the input, the memory, its own letter, and whether all of it is valid. A letter has
    time, hops to the leader, the sender's deviation from where it expects the leader, and what the
    leader last said: its number, when, and its deviation from the plan.
    """
    place, rate = plan(t)
    signal = [p + v / K - b for p, v, b in zip(x[:3], x[3:], OFFSET)]
    off = [a - b for a, b in zip(signal, place)]
    if {leads}:
        gap, letter = off, [t, 0.0, 0.0, 0.0, 0.0, 0.0, t, *off]
    else:
        # Where the leader is expected; without a letter of it, where the plan has it.
        heard = not math.isnan(received[0])
        gap = [a - b for a, b in zip(off, received[7:] if heard else [0.0] * 3)]
        letter = [t if heard else math.nan, 1.0, *gap, *received[5:]]
    u = [K * (r - GAIN * e - v) for r, e, v in zip(rate, gap, x[3:])]
    return u, memory, letter, all(map(math.isfinite, u))
'''

VEHICLE = '''"""The motion of a simulated point in a part of a step."""

H = {h}


def move(x, u, memory, push):
    """The state a part of a step later, and what actuators remember."""
    a = [b + c for b, c in zip(u, push[3:])]
    places = [p + H * v + 0.5 * H * H * b for p, v, b in zip(x[:3], x[3:], a)]
    return [*places, *(v + H * b for v, b in zip(x[3:], a))], memory
'''


def law_files(agent: int) -> tuple[str, dict[str, Any]]:
    """Return law.py and the content of law.json."""
    text = LAW.format(agent=agent, offset=OFFSETS[agent], leads=agent == 0)
    return text, {
        "agent": agent, "dt": DT, "leads": agent == 0, "hears": [1 - agent],
        "states": STATES, "inputs": INPUTS, "trim": dict.fromkeys(INPUTS, 0.0),
        "message": LETTER, "network": {"period": 0.04, "leaders": [0]},
        "sha256": {"law.py": hashlib.sha256(text.encode()).hexdigest()},
    }  # fmt: skip


def flight_facts() -> dict[str, Any]:
    """Return the content of flight.json, but for the mark of the formation."""
    zeros, sinking = [0.0] * 6, [0.0] * 5 + [-0.5]
    vehicles = {
        "files": ["vehicle-0.py"] * 2, "substeps": SUBSTEPS, "memory": [], "seed": 0,
        "starts": [[0.6, -0.1, 1.0, 0.0, 0.0, 0.0], [0.4, 0.9, 0.8, 0.0, 0.0, 0.0]],
        # An autopilot alone: u = trim - levelling (x - rest), or (x - sinking) where it descends.
        "trim": [[0.0] * 3] * 2, "rest": zeros, "sinking": sinking,
        "levelling": [zeros, zeros, [0.0] * 5 + [4.0]], "height": 2, "place": [0, 1, 2],
        # No wind, no gusts, no noise.
        "constant": zeros, "rms": zeros, "fade": 0.0, "noise": zeros,
    }  # fmt: skip
    return {
        "agents": 2, "dt": DT, "horizon": HORIZON, "message": LETTER, "leader": 0,
        "leadership": None, "weather": {"delay": 0.0, "jitter": 0.0, "loss": 0.0},
        "position": [0, 1, 2], "velocity": [3, 4, 5], "tilt": [],
        "fence": {"low": [-2.0, -2.0, -0.1], "high": [2.0, 2.0, 2.0], "speed": 3.0},
        "offsets": {"every": HORIZON, "rows": [OFFSETS]}, "vehicles": vehicles,
    }  # fmt: skip


def write(folder: Path) -> None:
    """Write the files into a folder."""
    laws, facts = [law_files(agent) for agent in range(2)], flight_facts()
    # All agents of one formation, and nobody else, have its mark.
    mark = hashlib.sha256(json.dumps([laws, facts]).encode()).hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "flight.json").write_text(json.dumps(facts | {"formation": mark}), "utf-8")
    (folder / "vehicle-0.py").write_text(VEHICLE.format(h=DT / SUBSTEPS), "utf-8")
    for agent, (text, law) in enumerate(laws):
        own = folder / f"law-{agent}"
        own.mkdir(exist_ok=True)
        (own / "law.py").write_text(text, "utf-8")
        (own / "law.json").write_text(json.dumps(law | {"formation": mark}), "utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
