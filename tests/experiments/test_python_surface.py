"""What a user writes in Python: scenarios by name, changes, matrices, checked arguments."""

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.models.linearization import linearize
from echelon.experiments.scenario.scenario import as_scenario

SHORT = ["simulation.horizon=0.1"]


@pytest.mark.slow
def test_a_run_takes_a_name_a_file_a_folder_and_a_mapping(here):
    scenario = ech.load_scenario("integrators", SHORT)
    whole = ech.run(scenario)
    (here / "mine.yaml").write_text(scenario.text)
    ech.save_run(whole, "folder", figures=False)
    for source in (scenario, "mine.yaml", here / "mine.yaml", "folder", scenario.data):
        np.testing.assert_array_equal(ech.run(source).states, whole.states)
    assert as_scenario("integrators").name == "integrators"
    with pytest.raises(ech.errors.ScenarioError, match="did you mean `integrators`"):
        ech.run("integrator")
    data = ech.sweep(scenario.data, {"seed": range(2)})
    assert dict(data.sizes) == {"seed": 2, "agent": 4}


def test_a_scenario_changes_as_on_the_command_line():
    first = ech.load_scenario("paper")
    changed = first.with_("simulation.horizon=20", seed=3, follower__gain__coupling=2.5)
    texts = ["simulation.horizon=20", "seed=3", "follower.gain.coupling=2.5"]
    assert changed == ech.load_scenario("paper", texts)
    assert (changed.seed, changed.simulation.horizon) == (3, 20.0) and first.seed == 0
    array = first.with_(**{"formation.offsets": {1: np.array([1.0, 0.0, 0.5])}})
    assert array.data["formation"]["offsets"] == {1: [1.0, 0.0, 0.5]}
    with pytest.raises(ech.errors.ScenarioError, match=r"^sed=3: .*did you mean `seed`"):
        first.with_(sed=3)


@pytest.mark.parametrize("directed", [False, True])
def test_a_graph_of_an_adjacency_matrix_has_that_matrix(directed):
    matrix = np.array([[0, 0, 0], [2.0, 0, 0.5], [0, 0.5, 0]])
    matrix[0, 1] = 0.0 if directed else 2.0
    graph, found = ech.Graph.from_adjacency(matrix), np.zeros((3, 3))
    assert graph.directed is directed
    # By its definition: A_ij is the weight with which i receives from j.
    for (i, j), weight in zip(graph.edges, graph.weights, strict=True):
        found[j, i] = weight
        found[i, j] = found[i, j] if directed else weight
    np.testing.assert_array_equal(found, matrix)


def test_what_is_no_adjacency_is_refused():
    for matrix, more, sentence in (
        ([[0, 1]], {}, r"has shape \(1, 2\), and must be a square matrix"),
        ("edges", {}, r"must be a square matrix"),
        ([[0, 1], [1]], {}, r"must be a square matrix .* with rows of one length"),
        ([[0, 1], [0, 0]], {"directed": False}, "is not symmetric"),
        ([[0, -1], [-1, 0]], {}, "weight"),
        ([[1, 1], [1, 0]], {}, "itself"),
    ):
        with pytest.raises(ech.errors.GraphError, match=sentence):
            ech.Graph.from_adjacency(matrix, **more)
    with pytest.raises(ech.errors.GraphError, match="is a `NoneType`, and must be a graph"):
        ech.Graph.from_networkx(None)


def test_the_feedback_of_a_gain_is_that_of_its_law():
    model, graph = ech.models.PlanarQuadrotor(), ech.Graph.path(3)
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    K, x = gain.K(model), jnp.asarray(model.trim[0], float)
    z = np.random.default_rng(0).normal(size=len(model.state_names))
    v = np.asarray(gain.feedback(model, x, jnp.asarray(z)))
    np.testing.assert_allclose(np.asarray(model.input_scale) @ v, K @ z, rtol=2e-4)
    closed = linearize(model).A - graph.spectrum().low * np.asarray(model.input_map(x)) @ K
    assert np.linalg.eigvals(closed).real.max() < 0.0
    with pytest.raises(ech.errors.GainError, match="is of 6 states and 2 inputs"):
        gain.K(ech.models.Pendulum())


def test_settings_are_checked_when_they_are_made():
    for changes, sentence in (
        ({"dt": 0.3}, "must be a whole number of steps"),
        ({"engine": "jx"}, "did you mean `jax`"),
    ):
        with pytest.raises(ech.errors.SimulationError, match=sentence):
            ech.Settings(**{"horizon": 1.0, "dt": 0.1} | changes)
