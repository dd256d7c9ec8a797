"""Measure how exactly formations that change with time are followed.

Run `python benchmarks/moving_formations.py` (some two minutes on two cores). Printed is the largest
error of a follower against its moving goal, after the starts have decayed. The figures stand on the
page of formations.
"""

import numpy as np

import echelon as ech
from echelon.agents.network import OffsetMotion, Reshape, Rotate, Scale

MODEL = ech.models.Quadrotor.crazyflie()
GRAPH = ech.Graph.from_edges([[0, 1], [1, 2], [1, 3]])
PLACES = {1: (1.0, 0.0, 0.0), 2: (1.0, 0.8, 0.0), 3: (1.0, -0.8, 0.0)}
PATH = ech.references.Lemniscate(center=(0.25, 0.25, 1.0), amplitude=(1.25, 3.54), rate=0.646)
DECAYED = 8.0  # s


def formation() -> ech.Formation:
    """Return that of the paper."""
    return ech.Formation.from_offsets(MODEL, GRAPH, PLACES)


def two_metres() -> Reshape:
    """Return a reshape that moves each follower by 2 m in 3 s."""
    offsets = formation().offsets.copy()
    offsets[1:, 0] -= 2.0
    return Reshape(offsets, DECAYED + 0.5, 3.0)


CASES: dict[str, list[OffsetMotion | Reshape]] = {
    "rotate 0.5 rad/s": [Rotate(0.5)],
    "scale +-40 % at 0.7 rad/s": [Scale(0.4, 0.7)],
    "reshape 2 m in 3 s": [two_metres()],
}


def laws(name: str) -> ech.Laws:
    """Return the leader's and the followers' laws."""
    if name == "stopping-point":
        return ech.Laws(ech.laws.StoppingLeader(reference=PATH), ech.laws.StoppingPoint())
    gain = ech.synthesize(MODEL, GRAPH, ech.gains.Riccati())
    follower = ech.laws.Consensus(gain, feedforward="relay")
    return ech.Laws(ech.laws.Tracking(PATH), follower)


def largest_error(name: str, changes: list[OffsetMotion | Reshape], dt: float) -> float:
    """Return the largest error of a follower from `DECAYED` on, m."""
    moving = formation().moving(MODEL, GRAPH, changes)
    parts = ech.Parts(MODEL, GRAPH, moving, laws(name), initial={"position": 0.5})
    result = ech.simulate(parts, ech.Settings(horizon=DECAYED + 6.0, dt=dt))
    return float(np.max(result.formation_errors[result.times >= DECAYED]))


def main() -> None:
    """Print the table."""
    for name, dt in (("stopping-point", 0.005), ("stopping-point", 0.0025), ("consensus", 0.005)):
        for case, changes in CASES.items():
            error = 1000.0 * largest_error(name, changes, dt)
            print(f"{name:16} {1.0 / dt:4.0f} Hz  {case:28} {error:10.4f} mm", flush=True)


if __name__ == "__main__":
    main()
