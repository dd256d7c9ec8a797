"""Measure flights with a process for each agent, with echelon's vehicles or MuJoCo's bodies.

Run `python benchmarks/fly.py [--speed 1] [--mujoco] [CASE ...]`. On a machine with other work a
`--speed` below 1 slows down the vehicles and the clock of the plan alike: errors and tilts are then
those of a machine that keeps up, and the times of a processor are measured as they are.
"""

import argparse
import contextlib
import math
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

FAST = [
    f"{role}.{key}"
    for role in ("leader", "follower")
    for key in ("roots=[5, 5.5, 6]", "observer={push: 24, scale: 2}")
]
CASES = {
    "lag": ("paper-radio", ["network.delay=0", "network.loss=0", "actuator.lag=0.03"], False),
    "radio": ("paper-radio", ["actuator.lag=0.03"], False),
    "everything": ("paper-everything", [], False),
    "fast-everything": ("paper-everything", FAST, False),
    "plain-everything": ("paper-everything", ["sensing.estimator=none"], False),
    "kills": ("paper-radio", ["actuator.lag=0.03"], True),
    "backup": ("paper-radio", ["actuator.lag=0.03", "leadership={backups: [1, 2]}"], False),
}
"""Case -> scenario, changes, and whether each process is killed and started again."""
HORIZON, DT, DEAD, APART = 15.0, 0.01, 0.5, 6.0


def prepare(case: str, folder: Path) -> None:
    """Write the flight of a case."""
    import echelon as ech
    from echelon.output.archive.flight_folder import flight_files, save_flight

    name, changes, _ = CASES[case]
    base = [f"simulation.dt={DT}", "network.rate=100"]
    scenario = ech.load_scenario(name, [*base, *changes])
    save_flight(flight_files(*ech.build(scenario), f"{name} {changes}"), folder)


def fly(folder: Path, options: argparse.Namespace, kills: bool) -> None:
    """Fly, and print what was measured."""
    from echelon_flight.local_flight import LocalFlight
    from echelon_flight.mission import Mission

    mission = Mission(folder)
    own = [str(Path(__file__).resolve()), "--plant", str(folder)] if options.mujoco else []
    seconds = 2.0 + APART * mission.agents if kills else HORIZON
    flight = LocalFlight(mission, seconds, options.speed, 47300, vehicles=own)
    falls, backup = list[float](), folder.name == "backup"
    with flight:
        ready = max(flight.ready.values())
        memory = max(flight.memory(k) for k in range(mission.agents))
        for k in range(mission.agents if kills else 0):
            wait(flight, 4.0 + APART * k)
            falls.append(flight.time())
            flight.kill(k)
            wait(flight, falls[-1] + DEAD)
            flight.start_agent(k)
        if backup:
            hand_over(flight)
            # From now on its place is what the others' are measured from.
            mission.facts["leader"] = 1
        wait(flight, seconds - 0.1)
        errors = flight.errors()
    print(f"  ready after {ready:.2f} s at most, {memory:.1f} MB at most; late {errors.late} times")
    followers = [k for k in range(backup, mission.agents) if k != mission.facts["leader"]]
    for k, fall in enumerate(falls):
        part = [row for t, row in zip(errors.times, errors.rows, strict=True) if fall <= t]
        far = max(row[j] for row in part[: round(APART / 0.011)] for j in followers)
        times = [t for t, row in zip(errors.times, errors.rows, strict=True)
                 if fall <= t < fall + APART and max(row[j] for j in followers) > 0.01]  # fmt: skip
        back = max(times, default=fall) - fall - DEAD
        print(
            f"  agent {k} killed: {far:.2f} m at most, all within 1 cm {back:.1f} s after restart"
        )
    if not kills:
        last = [r for t, r in zip(errors.times, errors.rows, strict=True) if t >= seconds - 4.0]
        worst = max(row[k] for row in last for k in followers)
        mean = max(math.sqrt(sum(row[k] ** 2 for row in last) / len(last)) for k in followers)
        print(f"  {1e3 * worst:.1f} mm at most in the last 4 s, {1e3 * mean:.1f} mm RMS")


def hand_over(flight: Any) -> None:
    """Kill the leader, and wait until a backup leader says that it leads."""
    wait(flight, 6.0)
    fall = flight.time()
    flight.kill(0)
    while (report := flight.ground.report(1)) is None or report.leader != 1:
        if flight.time() > fall + 3.0:
            print("  nobody took the lead")
            return
        time.sleep(0.005)
    # By its own clock, at the end of the tick in which it reported so.
    print(f"  leader killed: agent 1 leads after {report.time - fall:.2f} s at most")


def wait(flight: Any, t: float) -> None:
    """Wait until a time of the plan."""
    while flight.time() < t:
        time.sleep(0.005)


def simulate(folder: Path, speed: float, port: int) -> None:
    """Simulate the vehicles with MuJoCo's bodies."""
    import mujoco  # type: ignore[import-not-found]
    from mujoco_flight import bodies, place, state

    import echelon as ech
    from echelon_flight.mission import Mission
    from echelon_flight.simulated_vehicles import Vehicles

    mission = Mission(folder)
    facts, model = mission.facts["vehicles"], ech.models.Quadrotor.crazyflie()
    h = mission.facts["dt"] / facts["substeps"]
    plant = bodies(model, 1, h)
    data = mujoco.MjData(plant)
    keep = math.exp(-h / 0.03)

    def move(x: Any, u: Any, memory: Any, push: Any) -> Any:
        memory = [c + (a - c) * keep for a, c in zip(memory, u, strict=True)]
        place(data, 0, x)
        data.ctrl[:] = memory
        mujoco.mj_step(plant, data)
        after = state(data, 0).tolist()
        return [a + h * b for a, b in zip(after, push, strict=True)], memory

    Vehicles(mission, [move] * mission.agents, speed, port).run()


def main() -> None:
    """Fly the cases."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("cases", nargs="*", default=[*CASES], metavar="CASE")
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--mujoco", action="store_true")
    parser.add_argument("--folder", type=Path, help="keep prepared flights here")
    parser.add_argument("--plant", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--port", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.plant is not None:
        simulate(options.plant, options.speed, options.port)
        return
    with contextlib.ExitStack() as stack:
        base = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for case in options.cases:
            folder = base / case
            if not folder.is_dir():
                prepare(case, folder)
            print(f"{case}, load {os.getloadavg()[0]:.1f}:", flush=True)
            fly(folder, options, CASES[case][2])


if __name__ == "__main__":
    sys.exit(main())
