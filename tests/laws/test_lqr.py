"""Time-varying LQR for leaders along feasible paths of states and inputs."""

import textwrap

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from runs import simulate
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import echelon as ech
from echelon.agents.models import DoubleIntegrator, Pendulum, Quadrotor, Unicycle
from echelon.agents.references import Circle, FigureEight, Hover, StatePath
from echelon.agents.references.flatness import reference_demand, reference_warnings
from echelon.core.errors import LawError, ReferenceError
from echelon.core.numerics import precision
from echelon.core.words import Verdict
from echelon.laws.path_leader import sweep

PAIR = ech.Graph.path(2)


def swept(model, reference, horizon):
    with precision("float64"):
        return sweep(model, reference, horizon)


@eqx.filter_jit
def slopes(model, reference, t):
    """A and B of the deviation, by central differences."""
    x, u = reference.follow(model, t)
    h, unit = 1e-6, np.eye(len(model.state_names))
    A = [(model.velocity(x + h * e, u) - model.velocity(x - h * e, u)) / (2.0 * h) for e in unit]
    return jnp.stack(A, axis=1), model.input_map(x) @ jnp.array(model.input_scale)


def sloped(model, reference, t):
    with precision("float64"):
        return [np.asarray(part) for part in slopes(model, reference, jnp.asarray(float(t)))]


@pytest.mark.parametrize("model", [DoubleIntegrator(2), Quadrotor()])
def test_at_rest_the_gain_is_the_one_of_the_algebraic_equation(model):
    K, decay = swept(model, Hover(), 1.0)
    A, B = sloped(model, Hover(), 0.0)
    Q, R = (np.diag(part) for part in model.weights)
    wanted = np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R))
    assert np.abs(K - wanted).max() < 1e-7 * np.abs(wanted).max()
    closed = np.linalg.eigvals(A - B @ wanted).real.max()
    # V' = -e'We knows no faster a decay than the slowest mode's.
    assert closed <= float(decay) + 1e-9 < 0.0


def test_along_a_path_the_gain_obeys_the_riccati_equation():
    model, path, end = Unicycle(), FigureEight(rate=0.7), 2.0
    Q, R = (np.diag(part) for part in model.weights)

    def rate(s, flat):
        # From the end backward, at s = end - t.
        A, B = sloped(model, path, min(end, end - s))
        P = flat.reshape(3, 3)
        return (A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q).ravel()

    A, B = sloped(model, path, end)
    steady = solve_continuous_are(A, B, Q, R).ravel()
    found = solve_ivp(rate, (0.0, end), steady, rtol=1e-7, atol=1e-9, t_eval=[0.0, 0.7, 1.4, 2.0])
    K, _ = swept(model, path, end)
    for s, flat in zip(found.t, found.y.T, strict=True):
        wanted = np.linalg.solve(R, sloped(model, path, end - s)[1].T @ flat.reshape(3, 3))
        # The middle of an interval stands for all of it: (rate * 0.02 s)^2.
        assert K[round((end - s) / 0.02)] == pytest.approx(wanted, abs=2e-4)


def test_it_leads_a_unicycle_which_no_gain_holds_at_its_trim():
    model, path = Unicycle(), Circle(radius=2.0, rate=0.6)
    with pytest.raises(ech.EchelonError):
        simulate_leader(model, ech.laws.Tracking(path))
    law = ech.laws.PathLQR(path, 8.0)
    result = simulate_leader(model, law, start_error={"x": 0.3, "heading": 0.4})
    away = np.linalg.norm((result.states[:, 0] - result.reference)[:, :2], axis=1)
    assert away[0] == pytest.approx(0.3) and away[-1] < 2e-3
    other = StatePath([0.0, 1.0], [[0.0], [1.0]], [[1.0], [1.0]])
    with pytest.raises(LawError, match="has 1 states, and `Unicycle` has 3"):
        simulate_leader(model, ech.laws.PathLQR(other, 1.0))


def simulate_leader(model, law, **more):
    formation = ech.Formation(np.zeros((2, len(model.state_names))))
    run = {"horizon": 8.0, "dt": 0.01, "leader": law, "follower": ech.laws.TrimInput()}
    return simulate(model, PAIR, formation, **run, **more)


PENDULUM = Pendulum()


def swing(knots, length=6.0):
    """A pendulum under a known torque, integrated by SciPy: times, states, inputs."""
    times = np.linspace(0.0, length, knots)
    torque = 6.0 * np.sin(1.3 * times)

    def rate(t, x):
        pull = PENDULUM.stiffness * np.sin(x[0]) + PENDULUM.damping * x[1]
        return x[1], 6.0 * np.sin(1.3 * t) - pull

    found = solve_ivp(rate, (0.0, length), np.zeros(2), t_eval=times, rtol=1e-9, atol=1e-11)
    return times, found.y.T, torque[:, None]


def test_a_path_of_states_leads_a_model_without_flat_outputs():
    path = StatePath(*swing(61))
    on = simulate_leader(PENDULUM, ech.laws.PathLQR(path, 8.0))
    # An input that is held for 0.01 s while it changes by 7.8 1/s is off by 0.04 on the whole.
    assert np.abs(on.states[:600, 0] - on.reference[:600]).max() < 0.02
    # It goes far beyond what is linear at the trim.
    assert np.abs(on.reference[:, 0]).max() > 1.0
    off = simulate_leader(PENDULUM, ech.laws.PathLQR(path, 8.0), start_error={"angle": 0.5})
    apart = np.abs(off.states[:600, 0] - on.states[:600, 0]).max(axis=1)
    # Its own damping alone leaves 0.5 exp(-0.25 * 5.5) = 0.13.
    assert apart[0] == 0.5 and apart[-50:].max() < 0.08


def test_a_path_of_states_goes_through_its_knots_with_the_model_s_slopes():
    times, states, inputs = swing(31)
    path = StatePath(times, states, inputs)
    with precision("float64"):
        for k in (0, 7, 30):
            t = jnp.asarray(times[k])
            (x, u), (slope, _) = jax.jvp(lambda t: path.follow(PENDULUM, t), (t,), (jnp.ones(()),))
            assert np.asarray(x) == pytest.approx(states[k], abs=1e-13)
            assert np.asarray(u) == pytest.approx(inputs[k], abs=1e-13)
            moved = np.asarray(PENDULUM.velocity(x, u))
            assert k in (0, 30) or np.asarray(slope) == pytest.approx(moved, abs=1e-9)
    # An angle may be given within one turn.
    rows = np.pad([[3.0], [3.1], [3.2 - 2.0 * np.pi], [3.3 - 2.0 * np.pi]], ((0, 0), (2, 0)))
    path = StatePath(np.arange(4.0), rows, np.tile([0.0, 0.1], (4, 1)))
    with precision("float64"):
        x, _ = path.follow(Unicycle(), jnp.asarray(1.5))
    assert float(x[2]) == pytest.approx(3.15)


def test_how_far_a_path_is_from_a_motion_is_said_with_its_number():
    times, states, inputs = swing(61)
    path = StatePath(times, states, inputs)
    assert reference_demand(PENDULUM, path, 6.0).defect < 0.02
    # A path that ends on the way is held where nothing would hold it.
    assert not reference_demand(PENDULUM, path, 8.0).feasible
    # Without its torque the rate is off by the torque, where it is largest.
    still = StatePath(times, states, 0.0 * inputs)
    found = reference_demand(PENDULUM, still, 6.0)
    assert found.off[0] == 1 and found.off[1] > 5.0 and not found.feasible
    (told,) = reference_warnings(PENDULUM, still, 6.0)
    assert "the reference `StatePath` is no motion of `Pendulum`: at t = " in told
    assert f"the rate of `rate` is {found.off[1]:.3g} off f + g u" in told


@pytest.mark.slow
def test_a_check_says_what_the_reference_asks(tmp_path, echelon):
    file = write_swing(tmp_path)
    assert "reference, what it asks" in echelon("check", file)[1]
    drift = "reference={name: line, velocity: [250, 0, 0]}"
    checked = ech.check(*ech.build(ech.load_scenario("paper", [drift])))
    (line,) = [line for line in checked.lines if line.name == "reference, what it asks"]
    assert line.verdict is Verdict.HOLDS
    assert line.number_text.startswith("250 m/s, 0 m/s^2, 0 % of the")


SCENARIO = """
    name: swing
    model: {name: pendulum}
    graph: {name: path, agents: 3}
    reference: {name: states, file: swing.csv}
    leader: {law: lqr}
    simulation: {horizon: 2.0, dt: 0.02}
"""


def write_swing(folder, order=(2, 0, 1, 3)):
    times, states, inputs = swing(31)
    table = np.column_stack([times, states, inputs])[:, order]
    names = np.array(["t", *PENDULUM.state_names, *PENDULUM.input_names])[list(order)]
    rows = [",".join(map(repr, map(float, row))) for row in table]
    (folder / "swing.csv").write_text("\n".join([", ".join(names), *rows, ""]), "utf-8")
    (folder / "swing.yaml").write_text(textwrap.dedent(SCENARIO), "utf-8")
    return folder / "swing.yaml"


def test_a_scenario_names_a_path_of_states_by_its_file(tmp_path):
    result = ech.run(ech.load_scenario(write_swing(tmp_path)))
    assert np.abs(result.states[:, 0] - result.reference).max() < 0.04
    assert np.abs(result.states[-1, 2] - result.states[-1, 0]).max() < 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("reference.file=none.csv", "none.csv` cannot be read"),
        ("reference={name: circle, file: swing.csv}", "`circle` does not read files"),
        (
            "model={name: van-der-pol}",
            "lacks `position`, `velocity`, `force`: it names `rate`, `t`, `angle`, `torque`",
        ),
        ("reference={name: states, times: [0, 0], states: [[0]], inputs: [[0]]}", "increasing"),
        ("leader={law: lqr, reacts: true}", "the law `lqr` cannot react to neighbours"),
        ("reference={name: states, file: swing.csv, times: [0, 1]}", "got `file` and `times`"),
    ],
)
def test_faults_of_a_path_are_told(tmp_path, change, said):
    with pytest.raises(ech.EchelonError) as found:
        ech.build(ech.load_scenario(write_swing(tmp_path), [change]))
    assert said in str(found.value)


def test_inputs_of_a_path_are_as_many_as_its_states():
    with pytest.raises(ReferenceError, match=r"`inputs` of `StatePath` has shape \(1, 1\)"):
        StatePath([0.0, 1.0], [[0.0], [1.0]], [[1.0]])
