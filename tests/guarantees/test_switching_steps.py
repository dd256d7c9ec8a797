"""Graphs that take turns in held steps: the product over a period decides, by NumPy."""

import numpy as np
import pytest
from held_loops import drawn_graphs, whole_steps
from in_words import in_words

import echelon as ech


def agent(rng):
    order = int(rng.integers(1, 4))
    A = np.eye(order, k=1) + (rng.normal(size=(order, order)) if rng.integers(2) else 0.0)
    return A, np.eye(order)[:, -1:]


@pytest.mark.parametrize("seed", range(6))
def test_the_product_over_a_period_decides(seed):
    rng, directed = np.random.default_rng(seed), bool(seed % 2)
    graphs, laplacians, agents = drawn_graphs(rng, directed)
    A, B = agent(rng)
    model = ech.models.Linear(A, B)
    for dt in (1e-3, 0.1, 0.4):
        stretches, period = [(k * dt, x) for k, x in enumerate(graphs)], dt * len(graphs)
        graph = ech.Graph.switching(stretches, directed=directed, period=period)
        try:
            gain = ech.synthesize(model, graph, ech.gains.Riccati())
        except ech.EchelonError:
            return  # no one sum falls on these graphs, and there is no default coupling
        drive = ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay"))
        goals, settings = ech.Formation(np.zeros((agents, len(A)))), ech.Settings(40 * dt, dt)
        found = ech.guarantee(ech.Parts(model, graph, goals, drive), settings)
        K = gain.coupling * np.linalg.solve(gain.R, B.T @ gain.P)
        maps = whole_steps(A, B, K, laplacians, dt)
        radius = np.abs(np.linalg.eigvals(np.linalg.multi_dot([*maps[::-1], np.eye(len(maps[0]))])))
        step = float(radius.max() ** (1.0 / len(maps)))
        assert found.claimed is (step < 1.0), (dt, step, in_words(found))
        # A leader that falls by itself does not stay at its trim, and only the run can show it.
        falls = np.linalg.eigvals(A).real.max() > 0.0
        assert not (found.promised and falls), (dt, in_words(found))
        assert found.slowest == pytest.approx(np.log(step) / dt, rel=1e-6, abs=1e-9 / dt)
