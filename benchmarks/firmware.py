"""Fly Crazyflies whose controllers are those of their firmware, by unmodified cflib.

Run `python benchmarks/firmware.py --bindings DIR [--controller mellinger] [--speed 1]`, where DIR
holds `cffirmware`, the firmware's Python bindings, which Bitcraze's documentation explains how to
build ("Python bindings" of crazyflie-firmware). It needs the extra `crazyflie` too.

The firmware's attitude controller and its distribution of power to four motors act on the rigid
bodies of `fake_vehicles.py`, behind the packets of `fake_crazyflie.py`, both in
`packages/flight/tests/`. Radio, estimator, battery and scheduler are not the firmware's. Four fly
in formation as in `tests/flight/test_autopilots_in_flight.py`, and the last 8 s count.
"""

import argparse
import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "packages" / "flight" / "tests"), str(ROOT / "tests" / "flight")]

FULL, MOTOR, MASS, LAG = 0.48, 0.12, 0.029, 0.03
"""N of all motors and of one, kg, s: of a Crazyflie 2.1+, with batteries compensated."""
PORT, GOAL = 19900, 15.0  # mm
CONTROLLERS = ("mellinger", "pid", "lee")
LAWS = ("consensus", "stopping")


class Firmware:
    """The firmware's controller of one vehicle: `controllerPid` has one memory a process."""

    def __init__(self, bindings: Any, name: str) -> None:
        """Begin at rest."""
        self._cf, self._ticks = bindings, 0
        self._control, self._setpoint = bindings.control_t(), bindings.setpoint_t()
        self._state, self._sensors = bindings.state_t(), bindings.sensorData_t()
        self._uncapped = bindings.motors_thrust_uncapped_t()
        self._capped = bindings.motors_thrust_pwm_t()
        own = {"mellinger": "controllerMellinger", "lee": "controllerLee"}.get(name)
        if own is None:
            bindings.controllerPidInit()
            self._run, self._own = bindings.controllerPid, []
            return
        self._run, self._own = getattr(bindings, own), [getattr(bindings, f"{own}_t")()]
        getattr(bindings, f"{own}Init")(*self._own)

    def __call__(self, vehicles: Any) -> np.ndarray:
        """Return the forces (1, 4) that it asks of the motors, N; called every 2 ms."""
        self._command(*vehicles.command[0])
        self._measure(vehicles)
        parts = self._control, self._setpoint, self._sensors, self._state
        self._run(*self._own, *parts, self._ticks)
        self._ticks += 2
        self._cf.powerDistribution(self._control, self._uncapped)
        self._cf.powerDistributionCap(self._uncapped, self._capped)
        motors = self._capped.motors
        # The firmware counts clockwise from the front right, the bodies from the front left.
        numbers = [motors.m4, motors.m3, motors.m2, motors.m1]
        return np.array([numbers]) / 65535.0 * MOTOR

    def _command(self, roll: float, pitch: float, yaw_rate: float, thrust: float) -> None:
        """Take a command (rad, rad/s, N) as the decoder of manual setpoints does."""
        setpoint, cf = self._setpoint, self._cf
        setpoint.mode.roll = setpoint.mode.pitch = cf.modeAbs
        setpoint.mode.yaw = cf.modeVelocity
        setpoint.attitude.roll = math.degrees(roll)
        setpoint.attitude.pitch = -math.degrees(pitch)
        setpoint.attitudeRate.yaw = math.degrees(yaw_rate)
        setpoint.thrust = int(thrust / FULL * 65535.0)

    def _measure(self, vehicles: Any) -> None:
        """Take the state of the body for that of the estimator."""
        from fake_vehicles import angles

        state, gyro = self._state, self._sensors.gyro
        roll, pitch, yaw = np.degrees(angles(vehicles.q)[0]).tolist()
        state.attitude.roll, state.attitude.pitch, state.attitude.yaw = roll, -pitch, yaw
        turn = state.attitudeQuaternion
        turn.w, turn.x, turn.y, turn.z = vehicles.q[0].tolist()
        gyro.x, gyro.y, gyro.z = np.degrees(vehicles.w[0]).tolist()
        for part, values in ((state.position, vehicles.p), (state.velocity, vehicles.v)):
            part.x, part.y, part.z = values[0].tolist()


def load_bindings(folder: Path) -> Any:
    """Return the module `cffirmware` of a folder; without one the program ends."""
    sys.path.insert(0, str(folder))
    try:
        import cffirmware  # type: ignore[import-not-found]
    except ImportError as error:
        raise SystemExit(
            f"`{folder}` holds no Python bindings of the firmware ({error}); build them as the "
            "documentation of crazyflie-firmware describes, and name their folder by `--bindings`."
        ) from None
    return cffirmware


def serve_one(settings: dict[str, Any]) -> None:
    """Serve one vehicle until the standard input ends."""
    from fake_crazyflie import serve

    controller = Firmware(load_bindings(settings.pop("bindings")), settings.pop("controller"))
    serve(mass=MASS, gain=1.0, lag=LAG, controller=controller, **settings)


@contextlib.contextmanager
def served(options: argparse.Namespace, folder: str) -> Iterator[list[str]]:
    """Serve four vehicles, each by a process of its own; yields the files of their flights."""
    from test_autopilots_in_flight import starts

    files = [f"{folder}/{k}.npz" for k in range(4)]
    shared = {"bindings": str(options.bindings), "controller": options.controller}
    settings = [
        {**shared, "port": PORT + k, "starts": [start], "file": files[k], "speed": options.speed}
        for k, start in enumerate(starts())
    ]
    command = [sys.executable, __file__, "--serve"]
    processes = [
        subprocess.Popen([*command, json.dumps(each)], stdin=-1, stdout=-1, text=True)
        for each in settings
    ]
    try:
        for process in processes:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
        yield files
    finally:
        for process in processes:
            process.communicate()


def fly(options: argparse.Namespace, law: str) -> None:
    """Fly four by cflib's `Swarm`, and print their errors."""
    import cflib.crtp  # type: ignore[import-not-found]
    import test_autopilots_in_flight as study
    from cflib.crazyflie.swarm import Swarm  # type: ignore[import-not-found]

    from echelon.agents.models import CrazyflieAttitude
    from echelon_flight.links.crazyflie import CflibLink

    cflib.crtp.CLASSES or cflib.crtp.init_drivers()
    model = CrazyflieAttitude.named("firmware")
    parts = study.formation(model, getattr(study, law))
    uris = [f"udp://127.0.0.1:{PORT + k}" for k in range(4)]
    with tempfile.TemporaryDirectory() as folder:
        with served(options, folder) as files, Swarm(uris) as swarm:
            swarm.parallel_safe(lambda each: each.wait_for_params())
            each = [swarm._cfs[uri].cf for uri in uris]
            links = [CflibLink("", study.facts(model, k), each[k]) for k in range(4)]
            begin = study.fly(parts, links)
        print_errors(f"{options.controller}, {law}", files, begin)


def print_errors(name: str, files: list[str], begin: float) -> None:
    """Print the errors of each agent: of the leader from its path, of others from their places."""
    import test_autopilots_in_flight as study

    times = np.arange(study.SETTLED, study.SECONDS - 0.1, study.DT)
    flown = [read(file, begin, study.SPEED, times) for file in files]
    circle = [0.6 * np.cos(0.8 * times), 0.6 * np.sin(0.8 * times), np.ones_like(times)]
    goals = [np.stack(circle, 1), *(flown[0] + np.array(study.OFFSETS[k]) for k in (1, 2, 3))]
    gaps = [1e3 * np.linalg.norm(x - goal, axis=1) for x, goal in zip(flown, goals, strict=True)]
    roots = [math.sqrt(np.mean(gap**2)) for gap in gaps]
    print(f"{name}, load {os.getloadavg()[0]:.1f}: the leader {roots[0]:.1f} mm RMS from its path")
    for k in (1, 2, 3):
        verdict = "within" if roots[k] <= GOAL else "beyond"
        print(
            f"  agent {k}: {roots[k]:.1f} mm RMS from its place, {gaps[k].max():.1f} mm at most; "
            f"{verdict} {GOAL:g} mm RMS",
            flush=True,
        )


def read(file: str, begin: float, speed: float, times: np.ndarray) -> np.ndarray:
    """Return the places (T, 3) of a flight at times of the plan (s)."""
    flown = np.load(file)
    t, places = (flown["times"] - begin) * speed, flown["places"][:, 0]
    return np.stack([np.interp(times, t, places[:, axis]) for axis in range(3)], 1)


def main() -> None:
    """Fly each law."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--bindings", type=Path, help="folder of the module `cffirmware`")
    parser.add_argument("--controller", choices=CONTROLLERS, default="mellinger")
    parser.add_argument("--law", choices=LAWS, help="default: both, one after the other")
    parser.add_argument("--speed", type=float, default=1.0, help="below 1 on a machine in use")
    parser.add_argument("--serve", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve is not None:
        serve_one(options.serve)
        return
    if options.bindings is None:
        parser.error("give `--bindings` with the folder of the module `cffirmware`.")
    load_bindings(options.bindings)
    os.environ["FLIGHT_SPEED"] = repr(options.speed)
    for law in (options.law,) if options.law else LAWS:
        fly(options, law)


if __name__ == "__main__":
    main()
