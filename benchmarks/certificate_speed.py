"""Time of the local certificate, by the kind of graph and the number of agents.

    python benchmarks/certificate_speed.py --agents 1000 --repeats 3

Prints CPU seconds of this process, all its threads together: of the first time, in which programs
are compiled, and the least of the later ones. Without `--model` agents are quadrotors.
"""

import argparse
import math
import os
import time

# As the command line has it: more threads wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402

import echelon as ech  # noqa: E402
from echelon.core.numerics import precision  # noqa: E402
from echelon.guarantees.local.local_certificate import (  # noqa: E402
    LocalCertificate,
    local_certificate,
)
from echelon.simulation.engine.prepare import prepare  # noqa: E402

_NEIGHBOURS = 2.0
"""Of the connectivity threshold, so that random graphs are connected."""


def random_links(agents: int, seed: int) -> list[tuple[int, int]]:
    """Return the edges of an Erdos-Renyi graph, with a random tree that connects it."""
    random = np.random.default_rng(seed)
    p = _NEIGHBOURS * math.log(agents) / agents
    i, j = np.triu_indices(agents, 1)
    drawn = random.random(len(i)) < p
    tree = {(int(random.integers(k)), k) for k in range(1, agents)}
    return sorted(tree | set(zip(i[drawn].tolist(), j[drawn].tolist(), strict=True)))


def geometric(agents: int, seed: int) -> ech.Graph:
    """Return a random geometric graph."""
    radius = math.sqrt(_NEIGHBOURS * math.log(agents) / (math.pi * agents))
    return ech.Graph.geometric(agents, radius, seed=seed)


def erdos_renyi(agents: int, seed: int) -> ech.Graph:
    """Return a random undirected graph."""
    return ech.Graph(random_links(agents, seed), [0], agents)


def directed(agents: int, seed: int) -> ech.Graph:
    """Return a random directed graph, rings included, behind one leader."""
    random = np.random.default_rng(seed)
    links = random_links(agents, seed)
    back = [(j, i) for i, j in links if i and random.random() < 0.5]
    return ech.Graph([*links, *back], [0], agents, directed=True)


def changing(agents: int, seed: int) -> ech.Graph:
    """Return random graphs, of which the last one stays."""
    rows = [(0.5 * k, random_links(agents, seed + k)) for k in range(3)]
    return ech.Graph.switching(rows, [0], agents)


def tree(agents: int, seed: int) -> ech.Graph:
    """Return a random tree behind one leader, on which followers are sent their parents' inputs."""
    random = np.random.default_rng(seed)
    links = [(int(random.integers(k)), k) for k in range(1, agents)]
    return ech.Graph(links, [0], agents, directed=True)


GRAPHS = geometric, erdos_renyi, directed, changing, tree
MODELS = {"quadrotor": ech.models.Quadrotor, "double-integrator": ech.models.DoubleIntegrator}


def certificate(graph: ech.Graph, model: ech.ControlAffine) -> tuple[LocalCertificate, float]:
    """Return the certificate of agents behind a leader at rest, and the CPU time (s) of it."""
    feedforward = "parent" if len(graph.edges) == graph.agents - 1 else "relay"
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    laws = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward=feedforward))
    formation = ech.Formation(np.zeros((graph.agents, len(model.state_names))))
    parts = ech.Parts(model, graph, formation, laws)
    with precision("float64"):
        prepared = prepare(parts, ech.Settings(horizon=1.0, dt=0.005, precision="float64"))
        began = time.process_time()
        found = local_certificate(prepared)
        return found, time.process_time() - began


def main() -> None:
    """Print a line for each kind of graph."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agents", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--model", choices=[*MODELS], default="quadrotor")
    parser.add_argument("--only", default="", help="part of a name of a graph")
    chosen = parser.parse_args()
    model = MODELS[chosen.model]()
    print(f"{chosen.agents} agents, CPU s: first, then the least of {chosen.repeats} more")
    for make in GRAPHS:
        if chosen.only not in make.__name__:
            continue
        graph = make(chosen.agents, 1)
        found, first = certificate(graph, model)
        more = min(certificate(graph, model)[1] for _ in range(chosen.repeats))
        print(
            f"{make.__name__:12} {first:6.2f} {more:6.2f}   "
            f"radius {found.radius}, {found.modes} modes, split {found.split}",
            flush=True,
        )


if __name__ == "__main__":
    main()
