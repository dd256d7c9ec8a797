"""Count which starts converge when a parent's input is fed forward instead of the leader's.

Run `python benchmarks/parents.py` (about ten minutes on two cores); `--seeds 4` is quicker. The
table stands in docs/theory/consensus.md, under T4.
"""

import argparse

import numpy as np

import echelon as ech
from echelon.agents.models.linearization import linearize
from echelon.synthesis.certificates.margins import ClosedLoop, string_gain

MODEL = ech.models.Quadrotor()
LAWS = [("relay", None), ("parent", 1.0), ("parent", 2.5), ("parent", 10.0)]


def converged(followers: int, feedforward: str, coupling: float | None, seeds: int) -> int:
    """Return how many starts bring every follower of a line within 1 cm by 60 s."""
    graph = ech.Graph.path(followers + 1)
    gain = ech.synthesize(MODEL, graph, ech.gains.Riccati(coupling=coupling))
    count = 0
    for seed in range(seeds):
        run = ech.simulate(
            ech.Parts(
                MODEL,
                graph,
                ech.Formation.line(MODEL, graph),
                ech.Laws(
                    ech.laws.Tracking(ech.references.Lemniscate()),
                    ech.laws.Consensus(gain, feedforward=feedforward),
                ),
                initial={"position": 1.0, "attitude": 0.3},
            ),
            ech.Settings(horizon=60.0, dt=0.005, store_every=200, seed=seed),
        )
        done = run.outcome is ech.Outcome.COMPLETED
        count += bool(done and np.all(run.formation_errors[-1] < 0.01))
    return count


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    gain = ech.synthesize(MODEL, ech.Graph.path(2), ech.gains.Riccati(coupling=1.0))
    A, B = linearize(MODEL)
    lines = (3, 10, 20)
    print("| feed-forward | c | ‖T‖ |", " | ".join(f"N = {n}" for n in lines), "|")
    print("|---" * (3 + len(lines)) + "|")
    for feedforward, c in LAWS:
        size = (
            ""
            if c is None
            else f"{string_gain(ClosedLoop(A, B, gain.P, gain.R, c, np.ones(1))).gain:.2f}"
        )
        counts = [f"{converged(n, feedforward, c, seeds)} of {seeds}" for n in lines]
        cells = [feedforward, "1/λ_min" if c is None else f"{c:g}", size, *counts]
        print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
