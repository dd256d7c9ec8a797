"""Graphs that take turns in held steps: what is guaranteed holds for every order, by NumPy."""

import sys
from pathlib import Path

import numpy as np
import pytest

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import Verdict

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
from held_loops import drawn_graphs, whole_steps, worst_growth  # noqa: E402


def switching(graphs, dt, directed):
    stretches = [(k * dt, edges) for k, edges in enumerate(graphs)]
    return ech.Graph.switching(stretches, directed=directed, period=dt * len(graphs))


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
    graphs, laplacians, agents = drawn_graphs(rng, directed)
    A, B = agent(rng)
    model = ech.models.Linear(A, B)

    def guarantee(dt):
        graph = switching(graphs, dt, directed)
        gain = ech.synthesize(model, graph, ech.gains.Riccati())
        drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
        goals = ech.Formation(np.zeros((agents, len(A))))
        settings = ech.Settings(40 * dt, dt)
        return ech.guarantee(ech.Parts(model, graph, goals, drive), settings), gain, settings

    try:
        found, gain, settings = guarantee(1e-3)
    except ech.EchelonError:
        return  # no one sum falls on these graphs
    longest = found.longest_step(settings)
    K = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
    for share in (0.5, 0.8, 0.99):
        maps = whole_steps(A, B, K, laplacians, share * longest)
        assert worst_growth(maps, 6) < 1.0
        found, *_ = guarantee(share * longest)
        assert found.promised
        assert worst_growth(maps, 6) <= np.exp(-found.rate * share * longest) * (1.0 + 1e-9)
        root = np.linalg.cholesky(gain.P).T
        whole = np.kron(np.eye(agents - 1), root)
        norms = [np.linalg.norm(whole @ M @ np.linalg.inv(whole), 2) for M in maps]
        assert max(norms) <= 1.0 + 1e-12
    found, *_ = guarantee(1.01 * longest)
    assert found.hypotheses[Hypothesis.SAMPLING].verdict is Verdict.FAILS
    maps = whole_steps(A, B, K, laplacians, 1.01 * longest)
    whole = np.kron(np.eye(agents - 1), np.linalg.cholesky(gain.P).T)
    assert max(np.linalg.norm(whole @ M @ np.linalg.inv(whole), 2) for M in maps) > 1.0
