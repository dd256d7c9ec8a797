"""Formations to which things happen at random times: who remains must converge, and nobody diverge.

Six carts on a circle lose their leader or a follower, have a link cut for some time, and are joined
by a seventh, in the ideal network and over a radio; draws that would cut somebody off for good are
drawn again. Run it with `python benchmarks/events.py [DRAWS]`, of each kind.
"""

import sys

import numpy as np

import echelon as ech

CART = ech.models.DoubleIntegrator()
AGENTS, HORIZON = 7, 16.0
EDGES = [(i, j) for i in range(AGENTS) for j in range(i + 1, AGENTS) if (i + j) % 3 or j == i + 1]
GRAPH = ech.Graph(EDGES)
PLACES = {k: [np.cos(k), np.sin(k)] for k in range(1, AGENTS)}
LAWS = ech.Laws(
    ech.laws.StoppingLeader(reference=ech.references.Circle(radius=2.0, rate=0.7)),
    ech.laws.StoppingPoint(),
)
RADIO = {"rate": 25.0, "delay": 0.04, "jitter": 0.04, "loss": 0.2}
KINDS = {
    "ideal": None,
    "radio, preview": ech.Network(**RADIO),
    "radio, packet": ech.Network(**RADIO, prediction="packet"),
}


def happenings(random: np.random.Generator) -> list[ech.network.Lose | ech.network.Cut]:
    """Draw four events: the leader and a follower are lost, one joins, and a link is cut."""
    at = np.round(random.uniform(1.0, 10.0, 4), 2)
    follower, joins = random.choice(np.arange(1, AGENTS), 2, replace=False).tolist()
    link = EDGES[int(random.integers(len(EDGES)))]
    span = float(np.round(random.uniform(0.2, 3.0), 2))
    return [
        ech.network.Lose(0, float(at[0])),
        ech.network.Lose(follower, float(at[1])),
        ech.network.Join(joins, float(at[2])),
        ech.network.Cut(link, float(at[3]), span),
    ]


def drawn(network: ech.Network | None, seed: int) -> tuple[ech.Parts, int]:
    """Return a formation with events that leave all a path to the leader, and how many draws."""
    random, count = np.random.default_rng(seed), 0
    while True:
        count += 1
        backups = tuple(random.permutation(np.arange(1, AGENTS))[:3].tolist())
        try:
            return (
                ech.Parts(
                    CART,
                    GRAPH,
                    ech.Formation.from_offsets(CART, GRAPH, PLACES),
                    LAWS,
                    {"position": 1.0, "velocity": 0.3},
                    world=ech.World(network=network),
                    events=happenings(random),
                    leadership=ech.Leadership(backups),
                ),
                count,
            )
        except ech.EchelonError:
            continue


def main(draws: int) -> int:
    """Print how the runs of each kind ended; return 1 if somebody did not converge."""
    failed = 0
    for name, network in KINDS.items():
        last, backups, again = list[float](), list[float](), 0
        for seed in range(draws):
            parts, count = drawn(network, seed)
            run = ech.simulate(parts, ech.Settings(horizon=HORIZON, dt=0.02, seed=seed))
            again += count - 1
            # At the end, when nothing has happened for some seconds.
            leader = int(run.nearest_then[-1, 0])
            path = run.states[-1, leader] - run.reference[-1] - run.offsets[leader]
            last.append(float(run.formation_errors[-1].max()) if run.outcome.reached else np.inf)
            backups.append(float(np.abs(path[list(run.measured)]).max()))
        worst, off = max(last), max(backups)
        failed += sum(error > 0.01 for error in last)
        print(
            f"{name}: {draws} runs, {again} drawn again; at the end the largest error of a "
            f"follower is {1e3 * worst:.3g} mm, and of a leader {1e3 * off:.3g} mm",
            flush=True,
        )
    print(f"not within 1 cm: {failed}")
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 70))
