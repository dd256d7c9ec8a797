"""Fly a bundled scenario with MuJoCo's bodies as the plant and a plain queue as the network.

Run `python benchmarks/mujoco_flight.py [SCENARIO] [--set KEY=VALUE ...]` where `mujoco` is
installed. Four free bodies of the model's mass and inertia are pushed and turned in their own axes;
each is steered by an `Agent` that only receives messages from a queue with the scenario's rate and
delay. It prints the formation error of the worst follower over the last 4 s in mm, beside that of
`simulate`. Jitter and losses are left out, so that both have the same messages.
"""

import argparse
import heapq
import itertools
from typing import Any

import mujoco  # type: ignore[import-not-found]
import numpy as np

import echelon as ech

BODY = """
<body pos="0 0 0"><freejoint/><site name="s{k}"/>
<inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia}"/></body>"""
MOTOR = '<general site="s{k}" gear="{gear}"/>'
GEARS = ("0 0 1 0 0 0", "0 0 0 1 0 0", "0 0 0 0 1 0", "0 0 0 0 0 1")


def bodies(model: ech.models.Quadrotor, agents: int, step: float) -> Any:
    """Return MuJoCo's model of free bodies that are steered by thrust and torques."""
    inertia = " ".join(map(repr, model.inertia))
    world = "".join(BODY.format(k=k, mass=model.mass, inertia=inertia) for k in range(agents))
    motors = "".join(MOTOR.format(k=k, gear=gear) for k in range(agents) for gear in GEARS)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{step}" integrator="RK4" gravity="0 0 {-model.gravity}">'
        '<flag contact="disable"/></option>'
        f"<worldbody>{world}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def place(data: Any, k: int, x: np.ndarray) -> None:
    """Put body k at a state of the quadrotor."""
    half, quaternion = 0.5 * np.asarray(x[6:9]), np.array([1.0, 0.0, 0.0, 0.0])
    for axis in (2, 1, 0):  # yaw, then pitch, then roll about the body's axes
        turn = np.zeros(4)
        turn[0], turn[1 + axis] = np.cos(half[axis]), np.sin(half[axis])
        result = np.zeros(4)
        mujoco.mju_mulQuat(result, quaternion, turn)
        quaternion = result
    data.qpos[7 * k : 7 * k + 7] = [*x[:3], *quaternion]
    data.qvel[6 * k : 6 * k + 6] = [*x[3:6], *x[9:]]


def state(data: Any, k: int) -> np.ndarray:
    """Return the quadrotor's state of body k."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, data.qpos[7 * k + 3 : 7 * k + 7])
    m = matrix.reshape(3, 3)
    angles = np.arctan2(m[2, 1], m[2, 2]), -np.arcsin(m[2, 0]), np.arctan2(m[1, 0], m[0, 0])
    v = data.qvel[6 * k : 6 * k + 6]
    return np.array([*data.qpos[7 * k : 7 * k + 3], *v[:3], *angles, *v[3:]])


def fly(parts: ech.Parts, settings: ech.Settings, starts: np.ndarray) -> np.ndarray:
    """Return positions (T, N, 3) of a flight from states (N, 12)."""
    agents = [ech.Agent(parts, k, settings.dt) for k in range(len(starts))]
    plant = bodies(parts.model, len(agents), settings.dt / 5)
    data = mujoco.MjData(plant)
    for k, x in enumerate(starts):
        place(data, k, x)
    network, order, queue = parts.world.network, itertools.count(), []
    every, late = (round(x / settings.dt) for x in (1.0 / network.rate, network.delay))
    positions = []
    for n in range(round(settings.horizon / settings.dt)):
        while queue and queue[0][0] <= n:
            _, _, receiver, message = heapq.heappop(queue)
            agents[receiver].receive(message)
        positions.append([state(data, k)[:3] for k in range(len(agents))])
        for k, agent in enumerate(agents):
            data.ctrl[4 * k : 4 * k + 4], message = agent.step(n * settings.dt, state(data, k))
            if n % every == 0 and message is not None:
                for other in agents:
                    # Agents that keep apart regard all others, whatever the graph.
                    if k in other.neighbours or (k != other.number and parts.drive.safety):
                        heapq.heappush(queue, (n + late, next(order), other.number, message))
        for _ in range(5):
            mujoco.mj_step(plant, data)
    return np.array(positions)


def main() -> None:
    """Fly both and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenario", nargs="?", default="paper-radio")
    parser.add_argument("--set", nargs="*", default=[])
    arguments = parser.parse_args()
    plain = ["network.jitter=0", "network.loss=0", *arguments.set]
    parts, settings = ech.build(ech.load_scenario(arguments.scenario, plain))
    result = ech.simulate(parts, settings)
    flown = fly(parts, settings, result.states[0])
    offsets = np.asarray(result.formation.offsets)[:, :3]
    errors = np.linalg.norm(flown - flown[:, :1] - (offsets - offsets[0]), axis=2)
    last = errors[-round(4.0 / settings.dt) :].max()
    simulated = result.formation_errors[result.times > settings.horizon - 4.0].max()
    print(f"MuJoCo {1e3 * last:.4g} mm, simulate {1e3 * simulated:.4g} mm")


if __name__ == "__main__":
    main()
