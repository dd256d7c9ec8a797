"""What a user writes in Python: scenarios by name, changes, matrices, checked arguments."""

import jax.numpy as jnp
import numpy as np
import pytest

import echelon as ech
from echelon.agents.models.linearization import linearize
from echelon.experiments.scenario.scenario import as_scenario

SHORT = ["simulation.horizon=0.1"]


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


def test_a_sweep_takes_a_name_too():
    data = ech.sweep(ech.load_scenario("integrators", SHORT).data, {"seed": range(2)})
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
    matrix = matrix if directed else matrix + np.triu(matrix.T, 1) * (matrix.T != matrix)
    graph = ech.Graph.from_adjacency(matrix)
    assert graph.directed is directed
    np.testing.assert_array_equal(np.asarray(adjacency(graph)), matrix)


def adjacency(graph):
    """By its definition: A_ij is the weight with which i receives from j."""
    matrix = np.zeros((graph.agents, graph.agents))
    for (i, j), weight in zip(graph.edges, graph.weights, strict=True):
        matrix[j, i] = weight
        if not graph.directed:
            matrix[i, j] = weight
    return matrix


@pytest.mark.parametrize(
    ("matrix", "more", "sentence"),
    [
        ([[0, 1]], {}, r"has shape \(1, 2\), and must be a square matrix"),
        ("edges", {}, r"must be a square matrix"),
        ([[0, 1], [1]], {}, r"must be a square matrix .* with rows of one length"),
        ([[0, 1], [0, 0]], {"directed": False}, "is not symmetric"),
        ([[0, -1], [-1, 0]], {}, "weight"),
        ([[0, np.nan], [np.nan, 0]], {}, "entries that are NaN"),
        ([[1, 1], [1, 0]], {}, "itself"),
    ],
)
def test_what_is_no_adjacency_is_refused(matrix, more, sentence):
    with pytest.raises(ech.errors.GraphError, match=sentence):
        ech.Graph.from_adjacency(matrix, **more)


def test_nothing_is_no_graph_of_networkx():
    with pytest.raises(ech.errors.GraphError, match="`graph` is a `NoneType`, and must be a graph"):
        ech.Graph.from_networkx(None)


def test_the_feedback_of_a_gain_is_that_of_its_law():
    model, graph = ech.models.PlanarQuadrotor(), ech.Graph.path(3)
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    K, (x, _) = gain.K(model), model.trim
    z = np.random.default_rng(0).normal(size=len(model.state_names))
    v = np.asarray(gain.feedback(model, jnp.asarray(x, float), jnp.asarray(z)))
    np.testing.assert_allclose(np.asarray(model.input_scale) @ v, K @ z, rtol=2e-4)
    closed = (
        linearize(model).A - graph.spectrum().low * np.asarray(model.input_map(jnp.asarray(x))) @ K
    )
    assert np.linalg.eigvals(closed).real.max() < 0.0
    with pytest.raises(ech.errors.GainError, match="is of 6 states and 2 inputs"):
        gain.K(ech.models.Pendulum())


def test_a_formation_says_its_size():
    model = ech.models.SingleIntegrator(dimension=2)
    formation = ech.Formation.from_offsets(model, ech.Graph.path(3), {1: (1.5, 0.0)})
    assert repr(formation) == "Formation(3 agents, 2 states, offsets up to 1.5)"


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"horizon": -1}, "`horizon` is -1.0, and must be a positive finite number"),
        ({"dt": 0.3}, "must be a whole number of steps"),
        ({"seed": -1}, "`seed` is -1"),
        ({"engine": "jx"}, "did you mean `jax`"),
    ],
)
def test_settings_are_checked_when_they_are_made(changes, sentence):
    with pytest.raises(ech.errors.SimulationError, match=sentence):
        ech.Settings(**{"horizon": 1.0, "dt": 0.1} | changes)


@pytest.mark.parametrize("place", ["initial", "start_error"])
def test_parts_check_the_names_of_states_when_they_are_made(place):
    model, graph = ech.models.SingleIntegrator(), ech.Graph.path(2)
    formation = ech.Formation.from_offsets(model, graph, {})
    drive = ech.Laws(ech.laws.TrimInput(), ech.laws.TrimInput())
    with pytest.raises(ech.errors.ModelError, match="did you mean `position`"):
        ech.Parts(model, graph, formation, drive, **{place: {"positon": 1.0}})
