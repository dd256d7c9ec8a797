"""Graphs that take turns in held steps: what is guaranteed holds for every order, by NumPy."""

import itertools

import numpy as np
import pytest

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import Verdict


def drawn(rng, directed):
    """Two drawn graphs of as many agents, and their grounded Laplacians."""
    agents = int(rng.integers(3, 7))
    graphs, laplacians = [], []
    for _ in range(2):
        order = 1 + rng.permutation(agents - 1)
        tree = [(int(rng.choice([0, *order[:k]])), int(j)) for k, j in enumerate(order)]
        more = [tuple(map(int, rng.permutation(agents)[:2])) for _ in range(rng.integers(0, 4))]
        more = [(i, j) for i, j in more if j and (i or not directed)]
        pairs = {(i, j) if directed else (min(i, j), max(i, j)) for i, j in [*tree, *more]}
        edges = [(i, j, float(rng.uniform(0.5, 5.0))) for i, j in sorted(pairs)]
        A = np.zeros((agents, agents))
        for i, j, weight in edges:
            A[j, i] = weight
            if not directed:
                A[i, j] = weight
        graphs.append(edges)
        laplacians.append((np.diag(A.sum(axis=1)) - A)[1:, 1:])
    return graphs, laplacians, agents


def switching(graphs, dt, directed):
    stretches = [(k * dt, edges) for k, edges in enumerate(graphs)]
    return ech.Graph.switching(stretches, directed=directed, period=dt * len(graphs))


def steps(A, B, K, laplacians, dt):
    """The whole network's held step of RK4 under each graph."""
    n, one = len(A), np.eye(len(A))
    M = A * dt
    F = one + M @ (one + M @ (one + M @ (one + M / 4.0) / 3.0) / 2.0)
    G = dt * (one + M @ (one / 2.0 + M @ (one / 6.0 + M / 24.0))) @ B
    return [np.kron(np.eye(len(L)), F) - np.kron(L, G @ K) for L in laplacians], n


def worst_growth(maps, length=8):
    """The largest growth rate a step over all orders of the graphs of some lengths."""
    worst = 0.0
    for size in range(1, length + 1):
        for order in itertools.product(maps, repeat=size):
            product = np.linalg.multi_dot(order) if size > 1 else order[0]
            worst = max(worst, np.abs(np.linalg.eigvals(product)).max() ** (1.0 / size))
    return worst


def agent(rng):
    order = int(rng.integers(1, 4))
    A = np.eye(order, k=1) + (rng.normal(size=(order, order)) if rng.integers(2) else 0.0)
    B = np.zeros((order, 1))
    B[-1] = 1.0
    return A, B


@pytest.mark.parametrize("seed", range(25))
def test_held_steps_fall_on_all_graphs_in_any_order(seed):
    rng = np.random.default_rng(seed)
    directed = bool(seed % 2)
    graphs, laplacians, agents = drawn(rng, directed)
    A, B = agent(rng)
    model = ech.models.Linear(A, B)

    def promise(dt):
        graph = switching(graphs, dt, directed)
        gain = ech.synthesize(model, graph, ech.gains.Riccati())
        drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
        goals = ech.Formation(np.zeros((agents, len(A))))
        settings = ech.Settings(40 * dt, dt)
        return ech.promise(ech.Parts(model, graph, goals, drive), settings), gain, settings

    try:
        found, gain, settings = promise(1e-3)
    except ech.EchelonError:
        return  # no one sum falls on these graphs
    longest = found.longest_step(settings)
    K = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
    for share in (0.5, 0.8, 0.99):
        maps, _ = steps(A, B, K, laplacians, share * longest)
        assert worst_growth(maps, 6) < 1.0
        found, *_ = promise(share * longest)
        assert found.promised
        assert worst_growth(maps, 6) <= np.exp(-found.rate * share * longest) * (1.0 + 1e-9)
        root = np.linalg.cholesky(gain.P).T
        whole = np.kron(np.eye(agents - 1), root)
        norms = [np.linalg.norm(whole @ M @ np.linalg.inv(whole), 2) for M in maps]
        assert max(norms) <= 1.0 + 1e-12
    found, *_ = promise(1.01 * longest)
    assert found.hypotheses[Hypothesis.SAMPLING].verdict is Verdict.FAILS
    maps, _ = steps(A, B, K, laplacians, 1.01 * longest)
    whole = np.kron(np.eye(agents - 1), np.linalg.cholesky(gain.P).T)
    assert max(np.linalg.norm(whole @ M @ np.linalg.inv(whole), 2) for M in maps) > 1.0
