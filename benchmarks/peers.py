"""How fast peers step quadrotors on a processor, and echelon beside them, in one run, turn by turn.

Run `python benchmarks/peers.py`. Each peer gets an environment of its own under build/peers (or
`--envs FOLDER`), made by pip where it is not there; one that cannot be made is said and left out.
All workers are started first; then each in its turn steps for about a second on one core, and CPU
time is counted, five times over. What counts are the ratios.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import venv
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TURNS, AGENTS = 5, 10_000
Turn = Callable[[], int]
"""Steps all agents some times, and returns the agent-steps."""

# ---- what a worker does; each import stands where its environment has it ------------------------


def echelon(bits: int, integrator: str) -> Turn:
    """2,500 formations of 4 with leader, consensus, motor limits, RK4 or Euler, and all sums."""
    sys.path[:0] = [str(ROOT / "src"), str(ROOT / "benchmarks")]
    from steppers import FORMATIONS, formations

    from echelon.core.numerics import precision

    steps = 2_000
    stepper, reference = formations(bits, own=False, integrator=integrator, steps=steps)
    import numpy as np

    with precision(f"float{bits}"):  # type: ignore[arg-type]
        start = stepper.start()

    def turn() -> int:
        with precision(f"float{bits}"):  # type: ignore[arg-type]
            stepper.advance(start, np.array([steps], np.int32), reference)
        return 4 * FORMATIONS * steps

    return turn


def crazyflow(control: str) -> Turn:
    """10,000 worlds of one drone, first principles, Euler, 2 ms, float32: its own defaults."""
    import jax
    import numpy as np
    from crazyflow import Control, Sim

    sim = Sim(n_worlds=AGENTS, n_drones=1, control=Control(control))
    sim.reset()
    if control == "rotor_vel":
        sim.rotor_vel_control(np.full((AGENTS, 1, 4), 15_000.0, np.float32))
    else:
        wanted = np.zeros((AGENTS, 1, 16), np.float32)
        wanted[..., 2], wanted[..., 12] = 1.0, 1.0  # a metre up, upright
        sim.state_control(wanted)

    def turn() -> int:
        sim.step(200)
        jax.block_until_ready(sim.data)
        return AGENTS * 200

    return turn


def rotorpy() -> Turn:
    """10,000 drones in a batch, RK4, motor speeds given, no aerodynamics, float64."""
    import torch
    from rotorpy.vehicles.crazyflie_params import quad_params
    from rotorpy.vehicles.multirotor import BatchedMultirotor, BatchedMultirotorParams

    torch.set_num_threads(1)
    count, device = AGENTS, torch.device("cpu")
    zeros = torch.zeros(count, 3, dtype=torch.float64)
    upright = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64).repeat(count, 1)
    speeds = torch.full((count, 4), 1788.53, dtype=torch.float64)
    state = {"x": zeros, "v": zeros.clone(), "q": upright, "w": zeros.clone()}
    state |= {"wind": zeros.clone(), "rotor_speeds": speeds}
    params = BatchedMultirotorParams([quad_params] * count, count, device)
    fleet = BatchedMultirotor(params, count, state, device, aero=False, integrator="rk4")
    control = {"cmd_motor_speeds": speeds.clone()}

    def turn() -> int:
        now = state
        for _ in range(3):
            now = fleet.step(now, control, 0.005)
        return count * 3

    return turn


def vmas() -> Turn:
    """10,000 environments of the debug scenario with one drone, RK4, float32."""
    import torch
    from vmas import make_env

    torch.set_num_threads(1)
    env = make_env(scenario="drone", num_envs=AGENTS, device="cpu", seed=0, n_agents=1)
    hover = [torch.zeros(AGENTS, env.get_agent_action_size(a)) for a in env.agents]

    def turn() -> int:
        for _ in range(10):
            env.step(hover)
        return AGENTS * 10

    return turn


def numpy_and_scipy() -> Turn:
    """10,000 quadrotors on a ring as users write it: vectorized RK4, sparse Laplacian, float64."""
    import numpy as np
    import scipy.sparse as sp

    mass, gravity, inertia = 0.028, 9.81, np.array([1.66e-5, 1.66e-5, 2.93e-5])
    ring = sp.diags([1.0, 1.0], [1, -1], shape=(AGENTS, AGENTS)).tolil()
    ring[0, -1] = ring[-1, 0] = 1.0
    laplacian = (2.0 * sp.eye(AGENTS) - ring.tocsr()).tocsr()
    feedback = 0.01 * np.random.default_rng(0).standard_normal((12, 4))

    def rate(x: Any, u: Any) -> Any:
        v, (roll, pitch, yaw), w = x[:, 3:6], x[:, 6:9].T, x[:, 9:]
        sr, cr, sp_, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
        sy, cy = np.sin(yaw), np.cos(yaw)
        up = np.stack([cr * sp_ * cy + sr * sy, cr * sp_ * sy - sr * cy, cr * cp], axis=1)
        force = up * ((mass * gravity + u[:, :1]) / mass) - [0.0, 0.0, gravity]
        p, q, r = w.T
        turn = np.stack(
            [p + (q * sr + r * cr) * sp_ / cp, q * cr - r * sr, (q * sr + r * cr) / cp], axis=1
        )
        spin = (1e-4 * u[:, 1:] - np.cross(w, w * inertia)) / inertia
        return np.concatenate([v, force, turn, spin], axis=1)

    start = 0.02 * np.random.default_rng(1).standard_normal((AGENTS, 12))

    def turn() -> int:
        x, dt = start, 1e-4
        for _ in range(30):
            u = -(laplacian @ x) @ feedback
            k1 = rate(x, u)
            k2 = rate(x + 0.5 * dt * k1, u)
            k3 = rate(x + 0.5 * dt * k2, u)
            x = x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(x + dt * k3, u))
        assert np.isfinite(x).all()
        return AGENTS * 30

    return turn


# Its name, the packages of its environment (none: this one's), and what it steps.
WORKERS: dict[str, tuple[tuple[str, ...], Callable[[], Turn]]] = {
    "echelon, float32, RK4": ((), lambda: echelon(32, "rk4")),
    "echelon, float32, Euler": ((), lambda: echelon(32, "euler")),
    "echelon, float64, RK4": ((), lambda: echelon(64, "rk4")),
    "crazyflow, bare plant": (("crazyflow",), lambda: crazyflow("rotor_vel")),
    "crazyflow, its controller": (("crazyflow",), lambda: crazyflow("state")),
    "rotorpy, batched": (("rotorpy", "torch", "torchdiffeq", "roma"), rotorpy),
    "VMAS, drone": (("vmas",), vmas),
    "numpy and scipy": ((), numpy_and_scipy),
}


def work(name: str) -> None:
    """Step once for each line that is read, and print agent-steps per second of CPU time."""
    turn = WORKERS[name][1]()
    turn()  # compiles
    print("ready", flush=True)
    for _ in sys.stdin:
        begin, done = time.process_time(), 0
        while time.process_time() - begin < 1.0:
            done += turn()
        print(json.dumps(done / (time.process_time() - begin)), flush=True)


# ---- what asks them ------------------------------------------------------------------------------


def python_of(packages: tuple[str, ...], envs: Path) -> str:
    """Return the Python of an environment with packages, made where it is not there."""
    if not packages:
        return sys.executable
    place = envs / packages[0]
    python = place / "bin" / "python"
    if not python.exists():
        venv.create(place, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    return str(python)


def start(name: str, envs: Path) -> "subprocess.Popen[str] | None":
    """Return a worker that is ready; None, with a sentence, where there can be none."""
    one = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    try:
        python = python_of(WORKERS[name][0], envs)
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"{name}: its environment cannot be made: {error}", file=sys.stderr)
        return None
    command = [python, __file__, "--worker", name]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    worker = subprocess.Popen(command, env={**os.environ, **one}, **pipes)
    assert worker.stdout is not None
    for line in worker.stdout:
        if line == "ready\n":
            return worker
    print(f"{name}: ended before it was ready; what stands above says why", file=sys.stderr)
    return None


def ask(worker: "subprocess.Popen[str]") -> float:
    """Return the rate of one turn."""
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write("\n")
    worker.stdin.flush()
    return float(json.loads(worker.stdout.readline()))


def main() -> None:
    """Ask each worker in turn, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worker", choices=[*WORKERS], help=argparse.SUPPRESS)
    parser.add_argument("--only", nargs="*", choices=[*WORKERS], help="beside echelon's first line")
    parser.add_argument("--envs", type=Path, default=ROOT / "build" / "peers")
    asked = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if asked.worker is not None:
        return work(asked.worker)
    names = WORKERS if asked.only is None else dict.fromkeys([next(iter(WORKERS)), *asked.only])
    started = {name: start(name, asked.envs) for name in names}
    workers = {name: worker for name, worker in started.items() if worker is not None}
    rates: dict[str, list[float]] = {name: [] for name in workers}
    for _ in range(TURNS):
        for name, worker in workers.items():
            rates[name].append(ask(worker))
    for worker in workers.values():
        worker.communicate()
    table(rates)


def table(rates: dict[str, list[float]]) -> None:
    """Print the best rate of each, and the median of echelon's ratio to it over the turns."""
    ours = rates["echelon, float32, RK4"]
    print("| what | M agent-steps/s | echelon's float32 RK4 to it |\n|---|---|---|")
    for name, found in rates.items():
        ratio = statistics.median(a / b for a, b in zip(ours, found, strict=True))
        print(f"| {name} | {max(found) / 1e6:.3g} | {ratio:.3g} |")


if __name__ == "__main__":
    main()
