"""Time a step of the law `stopping-point` beside one of the Riccati law, turn by turn.

Run `python benchmarks/stopping_cost.py` (a minute). Both drive the paper's quadrotors on a ring by
native code, all sums included; what is printed are ratios of processor time, the best of each.
"""

import argparse
import time

import echelon as ech

MODEL = ech.models.Quadrotor()


def experiment(law: str, agents: int, steps: int) -> tuple[ech.Parts, ech.Settings]:
    """Return a ring of quadrotors under a law."""
    graph = ech.Graph.ring(agents)
    path = ech.references.Lemniscate()
    if law == "riccati":
        gain = ech.synthesize(MODEL, graph, ech.gains.Riccati(coupling=2.0))
        drive = ech.Laws(ech.laws.Tracking(path), ech.laws.Consensus(gain))
    else:
        watched = law == "stopping-point"
        leader = ech.laws.StoppingLeader(reference=path, observer=watched)
        drive = ech.Laws(leader, ech.laws.StoppingPoint(observer=watched))
    formation = ech.Formation.line(MODEL, graph)
    parts = ech.Parts(MODEL, graph, formation, drive, initial={"position": 0.1})
    horizon = 0.005 * steps
    return parts, ech.Settings(horizon=horizon, dt=0.005, store_every=steps, engine="native")


def spent(parts: ech.Parts, settings: ech.Settings) -> float:
    """Return the processor time of a run, s."""
    began = time.process_time()
    ech.simulate(parts, settings)
    return time.process_time() - began


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agents", type=int, default=200)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--turns", type=int, default=5)
    asked = parser.parse_args()
    laws = ("riccati", "stopping-point, no observer", "stopping-point")
    short = {law: experiment(law, asked.agents, asked.steps // 10) for law in laws}
    long = {law: experiment(law, asked.agents, asked.steps) for law in laws}
    best = {law: [float("inf"), float("inf")] for law in laws}
    for turn in range(asked.turns + 1):
        for law in laws:
            found = spent(*short[law]), spent(*long[law])
            # The first one compiles.
            if turn:
                best[law] = list(map(min, best[law], found))
    # What a run costs beside its steps is in both.
    cost = {law: long - short for law, (short, long) in best.items()}
    steps = 0.9 * asked.agents * asked.steps
    for law in laws:
        rate, ratio = steps / cost[law] / 1e6, cost[law] / cost["riccati"]
        print(f"{law}: {rate:.3g} M steps of an agent a second, {ratio:.3g} of the Riccati law's")


if __name__ == "__main__":
    main()
