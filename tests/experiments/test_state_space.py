"""The closed loop as a linear system, and linear agents from MATLAB's files."""

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from scipy.io import loadmat, savemat

import echelon as ech
from echelon.core.numerics import precision

OSCILLATOR = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.array([[0.0], [1.5]])
EDGES = [(0, 1), (1, 2), (1, 3)]


def led_by(model, path, initial=None, **law):
    """Four agents behind a leader that tracks a path."""
    graph = ech.Graph.from_edges(EDGES, leaders=[0])
    offsets = {k: (0.5 * k, -0.2) for k in (1, 2, 3)} if model.position else {}
    formation = ech.Formation.from_offsets(model, graph, offsets)
    follower = ech.laws.Consensus(ech.synthesize(model, graph, ech.gains.Riccati()), **law)
    drive = ech.Laws(ech.laws.Tracking(path), follower)
    return ech.Parts(model, graph, formation, drive, initial=initial)


@pytest.mark.parametrize("feedforward", ["none", "relay"])
def test_the_linear_system_answers_as_the_simulation(feedforward):
    """For linear agents exactly: an independent solver and the nonlinear loop, side by side."""
    path = ech.references.FigureEight(center=(0.3, 0.1, 0.0), rate=0.9)
    model = ech.models.DoubleIntegrator(2)
    starts = {1: [0.9, 0.1, 0.2, 0.0], 2: [1.0, -1.0, 0.0, 0.1], 3: [1.5, -0.6, 0.0, 0.0]}
    parts = led_by(model, path, starts, feedforward=feedforward)
    run = ech.simulate(parts, ech.Settings(horizon=4.0, dt=1e-3, store_every=10))
    A, B, C, D = ech.state_space(parts)
    assert A.shape == (16, 16) and B.shape == D.shape == (16, 6) and C.shape == (16, 16)
    times = np.arange(0.0, 4.0005, 1e-3)
    with precision("float64"):
        x, u = jax.vmap(lambda t: path.follow(model, t))(jnp.asarray(times))
    first = (run.states[0] - parts.formation.offsets).ravel()
    w = np.concatenate([x, u], axis=1)
    _, y, _ = scipy.signal.lsim((A, B, C, D), w, times, first)
    y = y[::10].reshape(-1, 4, 4)
    # Inputs are held over 1 ms in the simulation, and continuous in the linear system.
    goals = run.states - parts.formation.offsets
    assert np.abs(y[:, 1:] - (goals[:, 1:] - goals[:, :1])).max() < 3e-3
    assert np.abs(y[:, 0] - (goals[:, 0] - np.asarray(x)[::10])).max() < 3e-3
    assert np.abs(y[0]).max() > 0.5
    if feedforward == "none":
        assert np.abs(y[-1, 1:, :2]).max() > 0.02


def test_near_rest_a_quadrotor_moves_as_its_linear_system():
    model, graph = ech.models.PlanarQuadrotor(), ech.Graph.path(3, leaders=[0])
    hover = ech.references.Hover(position=(0.0, 0.0, 0.0))
    gain = ech.synthesize(model, graph, ech.gains.Riccati())
    drive = ech.Laws(ech.laws.Tracking(hover), ech.laws.Consensus(gain))
    formation = ech.Formation.from_offsets(model, graph, {1: (1.0, 0.0), 2: (2.0, 0.0)})
    off = 1e-4 * np.random.default_rng(1).normal(size=(3, 6)) * [[0.0], [1.0], [1.0]]
    parts = ech.Parts(model, graph, formation, drive, initial=off + formation.offsets)
    run = ech.simulate(parts, ech.Settings(horizon=1.0, dt=5e-4, store_every=400))
    A, _, C, _ = ech.state_space(parts)
    for t, x in zip(run.times, run.states, strict=True):
        linear = C @ scipy.linalg.expm(A * t) @ off.ravel()
        goals = x - formation.offsets
        assert np.abs(linear[6:] - (goals[1:] - goals[:1]).ravel()).max() < 2e-2 * np.abs(off).max()
    assert np.linalg.eigvals(A).real.max() < 0.0


def test_the_system_is_written_with_its_names(tmp_path):
    parts = led_by(ech.models.DoubleIntegrator(2), ech.references.Circle())
    system = ech.state_space(parts, tmp_path / "loop.mat")
    content = loadmat(tmp_path / "loop.mat")
    for name, matrix in zip("ABCD", system, strict=True):
        assert (content[name] == matrix).all()
    first = [content[name][0, 0][0] for name in ("states", "inputs", "outputs")]
    assert first == ["x_0", "path_x", "error_x_0"]
    assert len(content["inputs"]) == 6
    # Without a path nothing comes in.
    passive = ech.Laws(ech.laws.TrimInput(), parts.drive.follower)
    alone = ech.Parts(parts.model, parts.graph, parts.formation, passive)
    assert ech.state_space(alone).B.shape == (16, 0)


def test_what_is_no_linear_system_is_refused():
    large = "graph={name: path, agents: 500}"
    for name, changes, said in (
        ("paper-global", [], "`StoppingLeader` has a memory"),
        ("line-10", [large], "have 6000 states, and at most 2000"),
    ):
        with pytest.raises(ech.EchelonError, match=said):
            ech.state_space(ech.build(ech.load_scenario(name, changes)).parts)


FLOW = scipy.linalg.expm(0.1 * np.block([[*OSCILLATOR], [np.zeros((1, 3))]]))[:2]


def test_a_discrete_model_is_repeated_at_its_samples():
    model = ech.models.Linear.discrete(FLOW[:, :2], FLOW[:, 2:], 0.1)
    assert model.A == pytest.approx(OSCILLATOR[0], abs=1e-12)
    assert model.B == pytest.approx(OSCILLATOR[1], abs=1e-12)
    # An integrator, whose eigenvalue 1 is repeated.
    model = ech.models.Linear.discrete([[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]], 0.2)
    assert model.A == pytest.approx(np.array([[0.0, 1.0], [0.0, 0.0]]), abs=1e-12)
    assert model.B == pytest.approx(np.array([[0.0], [1.0]]), abs=1e-12)


def test_a_run_repeats_a_sampled_loop_by_its_own_recursion(tmp_path):
    savemat(tmp_path / "plant.mat", {"A": FLOW[:, :2], "B": FLOW[:, 2:], "Ts": 0.1})
    scenario = {
        "name": "sampled",
        "model": {"name": "linear", "file": "plant.mat"},
        "graph": {"name": "path", "agents": 3},
        "follower": {"gain": {"method": "riccati", "coupling": 1.2}},
        "initial": {"spread": {"x1": 1.0, "x2": 1.0}},
        "simulation": {"horizon": 3.0, "dt": 0.1, "substeps": 8},
    }
    result = ech.run(ech.scenario_from_mapping(scenario, tmp_path))
    gain = result.drive.gain
    K = gain.coupling * np.linalg.inv(gain.R) @ OSCILLATOR[1].T @ gain.P
    x, laplacian = result.states[0], result.graph.laplacian().toarray()
    for row in result.states[1:]:
        u = -(laplacian @ x) @ K.T
        u[0] = 0.0
        x = x @ FLOW[:, :2].T + u @ FLOW[:, 2:].T
        assert row == pytest.approx(x, abs=1e-8)


def test_a_wrong_file_is_refused_in_one_sentence(tmp_path):
    file, two = tmp_path / "plant.mat", {"A": np.eye(2), "B": np.eye(2)}
    for content, said in (
        (None, "cannot be read: No such file"),
        (b"no matrices at all, but a text", "is not a MATLAB file that can be read"),
        ({"B": np.eye(2)}, "lacks `A` and holds `B`; save the matrices by themselves"),
        (two | {"D": np.eye(2)}, "`D` of `"),
        (two | {"B": np.eye(3)}, "the shapes of `Linear` are A (2, 2), B (3, 3)"),
        ({"A": np.array([["a"]]), "B": np.eye(1)}, "`A` of `Linear` "),
        (two | {"A": np.diag([0.5, -0.5]), "Ts": 0.1}, "A has the eigenvalue -0.5"),
        (two | {"Ts": -1.0}, "plant.mat` is -1.0, and must be one step"),
        (two | {"Ts": [0.1, 0.2]}, "plant.mat` is 0.1 0.2, and must be"),
        (two | {"A": 1j * np.eye(2)}, "`A` of `Linear` "),
    ):
        if isinstance(content, bytes):
            file.write_bytes(content)
        elif content is not None:
            savemat(file, content)
        with pytest.raises(ech.errors.ModelError) as error:
            ech.models.Linear.read(file)
        assert said in str(error.value) and "\n" not in str(error.value)


def test_a_state_space_of_scipy_is_the_model_in_both_kinds_of_time():
    A, B = OSCILLATOR
    system = scipy.signal.StateSpace(A, B, np.eye(2), np.zeros((2, 1)))
    for given in (system, system.to_discrete(0.1)):
        model = ech.models.Linear.from_control(given, ["angle", "rate"])
        assert model.A == pytest.approx(A, abs=1e-9) and model.B == pytest.approx(B, abs=1e-9)
        assert model.state_names == ("angle", "rate")
    # As python-control says that a step is not specified.
    unknown = SimpleNamespace(A=A, B=B, C=np.eye(2), D=np.zeros((2, 1)), dt=True)
    direct = scipy.signal.StateSpace(A, B, np.eye(2), np.ones((2, 1)))
    for given, said in (
        (unknown, "`Ts` of the state space is -1.0, and must be one step"),
        (direct, "`D` of the state space is not zero"),
        (scipy.signal.TransferFunction([1.0], [1.0, 1.0]), "and must be a `StateSpace` with A, B"),
    ):
        with pytest.raises(ech.errors.ModelError, match=said):
            ech.models.Linear.from_control(given)


def test_python_control_receives_the_matrices_and_their_names(monkeypatch):
    system = ech.state_space(led_by(ech.models.DoubleIntegrator(2), ech.references.Circle()))
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(ech.errors.MissingExtraError, match="install '.\\[control\\]'") as error:
        system.to_control()
    assert error.value.exit_code == 4
    taken = SimpleNamespace(StateSpace=lambda *matrices, **names: (matrices, names))
    monkeypatch.setitem(sys.modules, "control", taken)
    matrices, names = system.to_control()
    assert [*matrices] == [*system] and names.pop("remove_useless_states") is False
    assert {key: len(value) for key, value in names.items()} == {
        "states": len(matrices[0]),
        "inputs": matrices[1].shape[1],
        "outputs": len(matrices[2]),
    }
