"""Rules of gains that one line each keeps: reachable graphs, equal models, branches, weights."""

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import echelon as ech
from echelon import load_gain, save_gain
from echelon.agents.models.linearization import linearize
from echelon.core.errors import GainError
from echelon.synthesis.certificates.margins import ClosedLoop, string_gain
from echelon.synthesis.gains.riccati import weights_of
from echelon.synthesis.gains.strings import string_growth

CHAIN = ech.models.Linear([[0.0, 1.0], [0.0, -0.5]], [[0.0], [1.0]])
PATH = ech.Graph.path(3, leaders=[0])


@pytest.mark.parametrize(
    ("then", "lost"),
    [
        ([(0, 1), (1, 2)], ""),
        ([(0, 2), (2, 1)], ""),
        ([(0, 1)], "agent 2 has no path to a leader"),
        ([(1, 2)], "agents 1, 2 have no path to a leader"),
    ],
)
def test_a_gain_is_of_graphs_in_which_leaders_reach_all_agents_at_all_times(then, lost):
    graph = ech.Graph.switching([(0.0, [(0, 1), (1, 2)]), (1.0, then)], agents=3, period=2.0)
    sentence = f"leaders reach all agents at all times, and {lost}"
    with pytest.raises(GainError, match=sentence) if lost else contextlib.nullcontext():
        assert ech.synthesize(CHAIN, graph, ech.gains.Riccati()).coupling > 0.0


@pytest.mark.parametrize("what", ["A", "B", "input_scale", "trim"])
def test_a_gain_file_fits_models_that_agree_to_nine_digits(tmp_path, what):
    model = ech.models.Linear([[0.0, 8.0], [0.0, -0.5]], [[0.0], [100.0]])
    file = tmp_path / "gain.json"
    gain = ech.synthesize(model, PATH, ech.gains.Riccati())
    save_gain(gain, model, PATH, file)
    text = file.read_text()

    def differ(off):
        stored = json.loads(text)
        place = stored["model"]["trim"][1:] if what == "trim" else stored["model"][what]
        # Of the largest number of each; a trim of 0 allows next to nothing.
        place[0][0] += off * max(np.abs(place).max(), 1e-12)
        if what == "trim":
            stored["model"]["trim"][1:] = place
        file.write_text(json.dumps(stored))
        return load_gain(file, model, PATH)

    for off in (0.0, 5e-10):
        assert differ(off).coupling == gain.coupling
    with pytest.raises(GainError, match="was made for another `Linear`: .* differs by"):
        differ(2e-9)
    # A gap that is no number fits no model.
    with pytest.raises(GainError):
        differ(float("nan"))


GAIN = ech.synthesize(CHAIN, ech.Graph.path(8, leaders=[0]), ech.gains.Riccati(coupling=4.0))


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 10**6), arrows=st.booleans())
def test_a_branch_amplifies_by_the_product_of_its_links(seed, arrows):
    rng = np.random.default_rng(seed)
    # A tree whose numbers say nothing about who is nearer to the leader.
    name = [0, *rng.permutation(range(1, 6)).tolist()]
    parents = {name[k]: name[int(rng.integers(k))] for k in range(1, 6)}
    weights = {k: float(rng.choice([1.0, 2.0])) for k in parents}
    pairs = [(parents[k], k) if arrows or rng.random() < 0.5 else (k, parents[k]) for k in parents]
    edges = [(*pair, weights[k]) for pair, k in zip(pairs, parents, strict=True)]
    graph = ech.Graph(edges, leaders=[0], directed=arrows)
    A, B = linearize(CHAIN)
    link = {
        w: string_gain(
            ClosedLoop(A, B, GAIN.P, GAIN.R, GAIN.coupling * w, np.unique([*weights.values()]))
        )
        for w in {*weights.values()}
    }
    growth = {0: 1.0}
    for k in name[1:]:
        growth[k] = growth[parents[k]] * link[weights[k]].gain
    [sentence] = string_growth(GAIN, CHAIN, graph)
    assert f"||T|| = {max(x.gain for x in link.values()):.3g}, and the" in sentence
    assert f"by up to {max(growth.values()):.3g}; a stronger" in sentence


@pytest.mark.parametrize(
    ("Q", "fine"),
    [
        ([[1.0, 0.5], [0.5, 1.0]], True),
        ([[1.0, 0.5], [0.5 * (1.0 + 5e-10), 1.0]], True),
        ([[1.0, 0.5], [0.5 * (1.0 + 1e-8), 1.0]], False),
        ([[1.0, 0.0], [1e-9, 1.0]], False),
        ([[np.nan, 0.0], [0.0, 1.0]], False),
        ([[np.inf, 0.0], [0.0, 1.0]], False),
    ],
)
def test_a_weight_is_symmetric_and_finite(Q, fine):
    refused = pytest.raises(GainError, match="`Q` must be a symmetric matrix of finite numbers")
    with contextlib.nullcontext() if fine else refused:
        assert (weights_of(CHAIN, Q)[0] == np.array(Q)).all()
