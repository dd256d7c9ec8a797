"""Graphs that take turns in held steps: what is guaranteed holds for every order, by NumPy."""

import numpy as np
import pytest
from held_loops import drawn_graphs, whole_steps, worst_growth

import echelon as ech
from echelon.core.statement import Hypothesis
from echelon.core.words import Verdict


def agent(rng):
    order = int(rng.integers(1, 4))
    A = np.eye(order, k=1) + (rng.normal(size=(order, order)) if rng.integers(2) else 0.0)
    return A, np.eye(order)[:, -1:]


@pytest.mark.parametrize("seed", range(16))
def test_held_steps_fall_on_all_graphs_in_any_order(seed):
    rng, directed = np.random.default_rng(seed), bool(seed % 2)
    graphs, laplacians, agents = drawn_graphs(rng, directed)
    A, B = agent(rng)
    model = ech.models.Linear(A, B)

    def guarantee(dt):
        stretches, period = [(k * dt, x) for k, x in enumerate(graphs)], dt * len(graphs)
        graph = ech.Graph.switching(stretches, directed=directed, period=period)
        gain = ech.synthesize(model, graph, ech.gains.Riccati())
        drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
        goals, settings = ech.Formation(np.zeros((agents, len(A)))), ech.Settings(40 * dt, dt)
        return ech.guarantee(ech.Parts(model, graph, goals, drive), settings), gain, settings

    try:
        found, gain, settings = guarantee(1e-3)
    except ech.EchelonError:
        return  # no one sum falls on these graphs
    longest = found.longest_step(settings)
    K = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
    whole = np.kron(np.eye(agents - 1), np.linalg.cholesky(gain.P).T)

    def norm(maps):
        return max(np.linalg.norm(whole @ M @ np.linalg.inv(whole), 2) for M in maps)

    for share in (0.5, 0.99):
        maps = whole_steps(A, B, K, laplacians, share * longest)
        found, *_ = guarantee(share * longest)
        assert found.promised and norm(maps) <= 1.0 + 1e-12
        most = np.exp(-found.rate * share * longest) * (1.0 + 1e-9)
        assert worst_growth(maps, 6) < min(most, 1.0)
    found, *_ = guarantee(1.01 * longest)
    assert found.hypotheses[Hypothesis.SAMPLING].verdict is Verdict.FAILS
    assert norm(whole_steps(A, B, K, laplacians, 1.01 * longest)) > 1.0
