"""The closed loop: independent implementations, orders of convergence, invariances of a run."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from oracles import (
    adjacency,
    disagreements,
    held_input_run,
    laplacian,
    newton_euler,
    quadrotor_input_map,
    relabelled,
)
from runs import simulate
from scipy.integrate import solve_ivp

import echelon as ech
from echelon import Formation, Graph, Outcome, Settings, metrics, synthesize
from echelon.agents.models import DoubleIntegrator, Linear, Pendulum, SingleIntegrator, VanDerPol
from echelon.agents.references import Circle, Hover, Line
from echelon.laws import Agreement, Consensus, Tracking, TrimInput
from echelon.simulation.engine import jax_stepper
from echelon.simulation.step.drive import Stopped
from echelon.synthesis.gains import FixedGain, Riccati

QUAD = ech.models.Quadrotor()
TREE = Graph.from_edges([(0, 1), (1, 2), (1, 3)])
CHAIN = Graph.path(4)
DRAWN = Formation.from_offsets(QUAD, TREE, {1: (1, 0, 0), 2: (1, 0.8, 0), 3: (1, -0.8, 0)})


def closed(model, graph, follower, leader=None, offsets=None, **options):
    """Run agents under laws; all goals are at one place and the leader rests unless it is told."""
    formation = Formation.from_offsets(model, graph, offsets or {})
    laws = {"leader": leader or TrimInput(), "follower": follower}
    return simulate(model, graph, formation, **laws, **options)


def consensus(model, graph, method=None, feedforward="none"):
    return Consensus(synthesize(model, graph, method or Riccati()), feedforward)


def alone(model, x0, **options):
    """Two agents that do nothing but fall from the same start."""
    return closed(model, Graph.path(2), TrimInput(), initial=np.tile(x0, (2, 1)), **options)


@pytest.fixture(scope="module")
def flight():
    """A weighted formation of quadrotors behind a leader that tracks a line and reacts."""
    graph = Graph([(0, 1, 1.0), (1, 2, 0.5), (1, 3, 2.0)])
    gain = synthesize(QUAD, graph, Riccati())
    spread = np.repeat([0.2, 0.1, 0.05, 0.05], 3)
    start = DRAWN.offsets + spread * np.random.default_rng(0).uniform(-1.0, 1.0, (4, 12))

    def fly(graph=graph, start=start, formation=DRAWN, **options):
        settings = {"horizon": 5.0, "dt": 0.005, "limits": False} | options
        return simulate(
            QUAD,
            graph,
            formation,
            leader=Tracking(Line((0, 0, 0), (0.5, 0.2, -0.1)), reaction=gain),
            follower=Consensus(gain, feedforward="relay"),
            initial=start,
            **settings,
        )

    return graph, gain, start, fly


@pytest.mark.slow
def test_rk4_agrees_with_dop853_on_a_formation_of_quadrotors(flight):
    graph, gain, start, fly = flight
    run = fly()
    A = adjacency(4, graph.edges, graph.weights)
    track = synthesize(QUAD, graph, Riccati()).P
    S = np.diag([QUAD.mass, *QUAD.inertia])
    R, c = gain.R, gain.coupling

    def pull(P, x, error):
        g = quadrotor_input_map(x, QUAD.mass, QUAD.inertia) @ S
        return np.linalg.solve(R, g.T @ P @ error)

    def control(t, x):
        z = disagreements(A, x, DRAWN.offsets)
        # A line at constant speed is flown level, with the trim.
        wanted = np.concatenate([t * np.array([0.5, 0.2, -0.1]), [0.5, 0.2, -0.1], np.zeros(6)])
        leader = -pull(track, x[0], x[0] - wanted) - c * pull(gain.P, x[0], z[0])
        followers = [leader - c * pull(gain.P, x[k], z[k]) for k in (1, 2, 3)]
        return np.array([leader, *followers]) @ S + [QUAD.mass * 9.81, 0.0, 0.0, 0.0]

    states = held_input_run(
        lambda x, u: newton_euler(x, u, QUAD.mass, QUAD.inertia), control, start, 0.005, 1000
    )
    assert run.outcome is Outcome.COMPLETED and run.states.shape == (1001, 4, 12)
    assert np.abs(run.states - states).max() <= 1e-9
    assert np.ptp(states[:, :, 6:9], axis=0).max() > 0.1, "they do tilt"
    u = np.array([control(t, x) for t, x in zip(run.times[:50], run.states[:50], strict=True)])
    assert run.inputs[:50] == pytest.approx(u, rel=1e-9, abs=1e-12)
    assert not run.saturated.any()


@pytest.mark.slow
def test_renaming_agents_permutes_the_run(flight):
    graph, _, start, fly = flight
    order = [2, 0, 3, 1]
    offsets, there = np.empty_like(start), np.empty_like(start)
    offsets[order], there[order] = DRAWN.offsets, start
    first = fly()
    second = fly(relabelled(graph, order), there, Formation(offsets))
    assert second.graph.leaders == (2,)
    assert np.abs(second.states[:, order] - first.states).max() <= 1e-12
    assert second.errors[:, order] == pytest.approx(first.errors, abs=1e-12)


def test_linear_agents_with_held_inputs_follow_the_matrix_exponential():
    rng = np.random.default_rng(5)
    A, B = np.array([[0.0, 1.0], [-2.0, 0.3]]), np.array([[0.0], [1.5]])
    # Runge-Kutta leaves dt^5 / 120 |A|^5 a step and dt^4 in all: 1e-11 at this dt.
    model, dt = Linear(A, B), 0.0025
    law, start = consensus(model, TREE), rng.normal(size=(4, 2))
    run, gain = closed(model, TREE, law, initial=start, horizon=3.0, dt=dt), law.gain
    step = scipy.linalg.expm(dt * np.block([[A, B], [np.zeros((1, 3))]]))
    Ad, Bd = step[:2, :2], step[:2, 2:]
    K = gain.coupling * gain.R_inverse @ B.T @ gain.P
    grounded = laplacian(4, TREE.edges)
    grounded[0] = 0.0
    once = np.kron(np.eye(4), Ad) - np.kron(grounded, Bd @ K)
    exact = [start.ravel()]
    for _ in range(1200):
        exact.append(once @ exact[-1])
    assert np.abs(run.states.reshape(1201, 8) - exact).max() <= 1e-10
    leader = scipy.linalg.expm(3.0 * A) @ start[0]
    assert run.states[-1, 0] == pytest.approx(leader, abs=1e-10)


EQUATIONS = [
    (VanDerPol(), lambda t, x: [x[1], (1 - x[0] ** 2) * x[1] - x[0]]),
    (Pendulum(0.1), lambda t, x: [x[1], -9.81 * np.sin(x[0]) - 0.1 * x[1]]),
]


@pytest.mark.parametrize(
    ("integrator", "steps", "least", "most"),
    [("rk4", [0.04, 0.02, 0.01], 3.8, 4.4), ("euler", [0.01, 0.005, 0.0025], 0.9, 1.1)],
    ids=["rk4", "euler"],
)
@pytest.mark.parametrize(("model", "equation"), EQUATIONS, ids=["van der pol", "pendulum"])
def test_measured_order_of_the_integrators(model, equation, integrator, steps, least, most):
    x0, times = np.array([1.0, 0.5]), {"horizon": 2.0, "store_every": 10**6}
    solved = solve_ivp(equation, (0.0, 2.0), x0, "DOP853", rtol=1e-13, atol=1e-13)
    runs = [alone(model, x0, dt=dt, integrator=integrator, **times) for dt in steps]
    errors = [np.abs(run.states[-1, 0] - solved.y[:, -1]).max() for run in runs]
    order, _ = np.polyfit(np.log(steps), np.log(errors), 1)
    assert least <= order <= most


def carts(graph=TREE, start=None, path=None, **options):
    model = DoubleIntegrator(2, drag=0.2)
    law, leader = consensus(model, graph, feedforward="relay"), path or Circle((0, 0, 0), 2.0, 0.4)
    settings = {"horizon": 3.0, "dt": 0.01} | options
    start = {"position": 1.0} if start is None else start
    offsets = {1: (1, 0), 2: (1, 0.8), 3: (1, -0.8)}
    return closed(model, graph, law, Tracking(leader), offsets, initial=start, **settings)


def test_moving_the_start_and_the_reference_moves_the_run():
    here = carts(path=Circle((0, 0, 0), 2.0, 0.4))
    there = carts(path=Circle((5, -3, 0), 2.0, 0.4))
    shift = np.array([5.0, -3.0, 0.0, 0.0])
    assert np.abs(there.states - shift - here.states).max() <= 1e-12
    assert there.inputs == pytest.approx(here.inputs, abs=1e-12)


def test_agents_that_are_alike_and_start_alike_stay_alike():
    model, graph, start = DoubleIntegrator(2), Graph.star(4), [1, 2, 3, 4]
    law, settings = consensus(model, graph), {"horizon": 2.0, "dt": 0.01}
    starts = {1: start, 2: start, 3: start}
    run = closed(model, graph, law, Tracking(Circle()), initial=starts, **settings)
    assert np.array_equal(run.states[:, 1], run.states[:, 2])
    assert np.array_equal(run.states[:, 1], run.states[:, 3])
    assert np.ptp(run.states[:, 1], axis=0).min() > 0.1


def test_a_follower_behind_its_leader_s_input_stays_on_its_goal():
    run = carts(start={"position": 0.0}, path=Circle((1, 1, 0), 1.0, 0.7))
    assert np.abs(run.errors).max() <= 1e-13


def test_each_follower_hears_its_own_leader():
    """Two leaders, far apart and driven alike; the middle of the path hears both as neighbours."""
    model, graph = SingleIntegrator(1), Graph.path(5, leaders=[0, 4])
    law, leader = (
        consensus(model, graph, FixedGain(), "relay"),
        Tracking(Line((0, 0, 0), (1, 0, 0))),
    )
    row = {k: (float(k),) for k in range(5)}
    times = {"horizon": 40.0, "dt": 0.02, "store_every": 100}
    run = closed(model, graph, law, leader, row, initial={"x": 0.5}, **times)
    assert run.states[-1].ravel() == pytest.approx(40.0 + np.arange(5), abs=1e-9)


def chain(**options):
    """Single integrators on the chain L-1-2-3 under the paper's law with P = 1."""
    model = SingleIntegrator(1)
    law = consensus(model, CHAIN, FixedGain())
    return closed(model, CHAIN, law, initial={"x": 1.0}, **options)


def test_integrators_behind_a_moving_leader_lag_three_five_and_six_metres():
    leader = Tracking(Line((0, 0, 0), (1, 0, 0)))
    run = chain(leader=leader, horizon=150.0, dt=0.02, store_every=100)
    lag = -run.errors[-1, 1:, 0]
    assert lag == pytest.approx([3.0, 5.0, 6.0], abs=1e-9)
    assert lag == pytest.approx(CHAIN.inverse_grounded() @ np.ones(3), abs=1e-9)


def test_algorithm_1_as_printed_grows_by_its_spectral_radius():
    run = chain(leader=TrimInput(), horizon=40.0, dt=1.0, integrator="printed")
    states, L = run.states[:, 1:, 0], CHAIN.grounded_laplacian().toarray()
    # x <- f + g u = -L x: the state itself is lost, only the input remains.
    assert states[1:] == pytest.approx(-states[:-1] @ L, rel=1e-12)
    growth = np.linalg.norm(states[-1]) / np.linalg.norm(states[-2])
    assert growth == pytest.approx(np.linalg.eigvalsh(L)[-1], rel=1e-6)
    assert growth == pytest.approx(3.247, abs=5e-4)


def paper_v(run, P):
    """V = 1/2 z^T (M kron P) z with M = L^-1, at every frame."""
    graph, rows = run.graph, list(run.graph.followers)
    A = adjacency(graph.agents, graph.edges, graph.weights)
    M = np.linalg.inv(laplacian(graph.agents, graph.edges, graph.weights)[np.ix_(rows, rows)])
    z = np.array([disagreements(A, x, run.formation.offsets)[rows] for x in run.states])
    return 0.5 * np.einsum("tia,ij,ab,tjb->t", z, M, P, z)


class Pushed(ech.ControlAffine):
    """A reach without friction and a speed with it, pushed by one input."""

    state_names = ("reach", "speed")
    input_names = ("push",)

    def drift(self, x):
        return jnp.stack([jnp.zeros_like(x[0]), -0.5 * jnp.tanh(x[1]) - 0.1 * x[1]])

    def input_map(self, x):
        return jnp.array([[1.0], [1.0]], x.dtype)


MONOTONE = {
    # P A + A'P <= 0 for p' = v, v' = -v: P = [[1, 1], [1, 2]] gives diag(0, -2).
    "double integrator": (DoubleIntegrator(1, drag=1.0), [[1.0, 1.0], [1.0, 2.0]]),
    "nonlinear": (Pushed(), [[1.0, 0.0], [0.0, 2.0]]),
    "oscillator": (Linear([[0.0, 1.0], [-4.0, 0.0]], [[0.0], [1.0]]), [[4.0, 0.0], [0.0, 1.0]]),
}


@pytest.mark.parametrize("name", MONOTONE)
def test_v_never_rises_where_the_drift_is_monotone_for_p(name):
    model, P = MONOTONE[name]
    graph = Graph([(0, 1, 1.0), (1, 2, 0.5), (1, 3, 2.0), (2, 3, 1.0)])
    starts, times = dict.fromkeys(model.state_names, 1.0), {"horizon": 60.0, "dt": 0.01}
    law = consensus(model, graph, FixedGain(P=P))
    run = closed(model, graph, law, initial=starts, store_every=5, **times)
    V = paper_v(run, np.array(P))
    assert (np.diff(V) <= 1e-9 * V[:-1] + 1e-22 * V[0]).all()
    # Every state enters the input sooner or later (detectability), so V does not only not rise.
    assert V[-1] <= 1e-6 * V[0]


def test_frames_are_those_of_a_run_that_stores_every_step():
    every, some = carts(horizon=1.0), carts(horizon=1.0, store_every=7)
    # 100 steps: frames at 0, 7, ..., 98, and the last one at 100.
    places = [*range(0, 100, 7), 100]
    assert len(every.times) == 101
    assert some.times == pytest.approx(every.times[places], abs=0.0)
    assert np.abs(some.states - every.states[places]).max() <= 1e-14
    assert np.abs(some.inputs - every.inputs[places]).max() <= 1e-14
    assert some.reference == pytest.approx(every.reference[places], abs=1e-14)
    assert some.saturated == pytest.approx(every.saturated)


@pytest.mark.parametrize(
    ("horizon", "every", "frames"),
    [(1.0, 1, 11), (1.0, 3, 5), (1.0, 10, 2), (1.0, 1000, 2), (0.1, 1, 2), (0.3, 1, 4)],
)
def test_the_last_state_is_stored_whatever_divides(horizon, every, frames):
    run = alone(SingleIntegrator(1), [1.0], horizon=horizon, dt=0.1, store_every=every)
    assert len(run.times) == len(run.states) == len(run.inputs) == frames
    assert run.times[0] == 0.0 and run.times[-1] == pytest.approx(horizon)
    assert run.outcome is Outcome.COMPLETED


def test_a_run_says_what_ran_and_holds_float64():
    run = carts(horizon=0.1, seed=3)
    assert run.settings == Settings(0.1, 0.01, seed=3)
    assert run.graph is TREE and run.wall_time > 0.0 and run.warnings == ()
    assert run.message == "The run reached its horizon."
    arrays = [run.times, run.states, run.inputs, run.reference, run.saturated, run.errors]
    assert {(type(a), a.dtype) for a in arrays} == {(np.ndarray, np.dtype(np.float64))}
    assert (run.states.shape, run.inputs.shape) == ((11, 4, 4), (11, 4, 2))
    assert run.measured == (0, 1) and run.unit == "m"
    assert run.errors == pytest.approx(
        (run.states - run.formation.offsets) - (run.states[:, :1] - run.formation.offsets[:1])
    )


def test_starts_are_goals_plus_a_spread_that_the_seed_draws():
    model, graph, leader = (
        DoubleIntegrator(2),
        Graph.star(200),
        Tracking(Line((1, 2, 0), (0.5, 0, 0))),
    )
    row = {k: (k, 0.0) for k in range(200)}

    def start(initial, **more):
        more |= {"initial": initial, "horizon": 0.1, "dt": 0.1}
        return closed(model, graph, TrimInput(), leader, row, **more).states[0]

    goal = np.array([1.0, 2.0, 0.5, 0.0]) + np.arange(200.0)[:, None] * [1.0, 0.0, 0.0, 0.0]
    assert start(None) == pytest.approx(goal)
    off = start({"position": 2.0, "y": 0.5, "vx": 0.1}) - goal
    assert not off[0].any() and not off[:, 3].any()
    assert np.abs(off).max(axis=0) == pytest.approx([2.0, 0.5, 0.1, 0.0], rel=0.05)
    assert np.abs(off.mean(axis=0)).max() < 0.2
    # The same seed draws the same deviations, whatever the spreads are.
    assert start({"position": 2.0, "y": 0.5, "vx": 0.1}) - goal == pytest.approx(off)
    assert start({"position": 4.0, "y": 1.0, "vx": 0.2}) - goal == pytest.approx(2.0 * off)
    assert np.abs(start({"position": 2.0}, seed=1) - goal - off).max() > 0.5
    moved = start(None, start_error={"position": 0.25, "vx": -1.0})
    assert moved == pytest.approx(goal + [0.25, 0.25, -1.0, 0.0])


def test_states_may_be_given_by_agent_with_a_start_error_and_the_rest_stay_on_their_goals():
    run = carts(start={1: [1, 2, 3, 4], "position": 0.5}, horizon=0.1)
    assert run.states[0, 1].tolist() == [1.0, 2.0, 3.0, 4.0]
    again = carts(start={"position": 0.5}, horizon=0.1)
    assert np.array_equal(run.states[0, [0, 2, 3]], again.states[0, [0, 2, 3]])
    run = carts(start=np.zeros((4, 4)), horizon=0.1, start_error={"x": 0.5})
    assert run.states[0, 0].tolist() == [0.5, 0.0, 0.0, 0.0]
    assert not run.states[0, 1:].any()


def test_limits_act_and_are_counted_agent_by_agent():
    model, graph, start = ech.models.PlanarQuadrotor(), Graph.path(3), np.zeros((3, 6))
    start[1, 0] = 8.0
    settings = {"initial": start, "horizon": 0.5, "dt": 0.005}
    law = consensus(model, graph)
    held, free = (closed(model, graph, law, limits=limits, **settings) for limits in (True, False))
    thrusts = held.inputs[..., :1] / 2 + held.inputs[..., 1:] / (2 * 0.0325) * [1.0, -1.0]
    assert thrusts.min() >= -1e-12 and thrusts.max() <= model.motor_thrust + 1e-12
    assert held.saturated[0] == 0.0 and 0.0 < held.saturated[1] <= 1.0
    wild = free.inputs[..., :1] / 2 + free.inputs[..., 1:] / (2 * 0.0325) * [1.0, -1.0]
    assert wild.max() > 2.0 * model.motor_thrust and not free.saturated.any()


def test_one_limited_input_of_several_is_enough_to_be_counted():
    class Boxed(SingleIntegrator):
        input_limits = ech.models.Limits(np.eye(2), -np.ones(2), np.ones(2))

    model, graph = Boxed(2), Graph.star(4)
    # Behind a leader at rest at 0, each asks for so much of either input.
    asked = np.array([[0.0, 0.0], [0.5, 0.5], [5.0, 0.5], [5.0, -5.0]])
    law = consensus(model, graph, FixedGain(coupling=1.0), "relay")
    run = closed(model, graph, law, initial=-asked, horizon=0.1, dt=0.1)
    assert run.inputs[0].tolist() == np.clip(asked, -1.0, 1.0).tolist()
    assert run.saturated.tolist() == [0.0, 0.0, 1.0, 1.0]


def test_what_is_relayed_is_the_leader_s_input_after_its_limits():
    model, graph, start = ech.models.PlanarQuadrotor(), Graph.path(2), np.zeros((2, 6))
    start[:, 0] = 8.0
    law, leader = consensus(model, graph, feedforward="relay"), Tracking(Hover((0, 0, 0)))
    run = closed(model, graph, law, leader, initial=start, horizon=0.5, dt=0.005)
    # The leader saturates; a follower that starts beside it is told what it did, and does it too.
    assert run.saturated[0] > 0.0
    assert np.abs(run.states[:, 0] - run.states[:, 1]).max() <= 1e-12


def test_float32_by_choice_is_close_and_no_closer():
    single, double = carts(precision="float32"), carts()
    gap = np.abs(single.states - double.states).max()
    assert 1e-9 < gap < 1e-4
    assert single.settings.precision == "float32" and single.states.dtype == np.float64
    assert np.array_equal(single.states, single.states.astype(np.float32))


FRESH = """
import json, sys
import jax
before = jax.config.jax_enable_x64
sys.path[:0] = sys.argv[1:]
from test_simulate import carts

run = carts()
after = jax.config.jax_enable_x64
print(json.dumps({
    "flags": [bool(before), bool(after)],
    "jax": str(jax.numpy.zeros(1).dtype),
    "P": run.drive.gain.P.tolist(), "states": run.states.tolist(), "inputs": run.inputs.tolist(),
}))
"""


def test_everything_is_float64_whatever_the_flags_of_the_process():
    """In fresh processes, one without any flag of JAX and one with its 64-bit flag."""
    plain = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", FRESH, *map(str, Path(__file__).parents[:2])],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=plain | flags,
        )
        for flags in ({}, {"JAX_ENABLE_X64": "1"})
    ]
    told = []
    for process in processes:
        out, errors = process.communicate(timeout=240)
        assert process.returncode == 0, errors
        told.append(json.loads(out.splitlines()[-1]))
    unset, wide = told
    assert unset["flags"] == [False, False] and unset["jax"] == "float32"
    assert wide["flags"] == [True, True] and wide["jax"] == "float64"
    here = carts()
    for other in told:
        assert np.abs(np.array(other["states"]) - here.states).max() <= 1e-13
        assert np.abs(np.array(other["inputs"]) - here.inputs).max() <= 1e-13
        assert np.array(other["P"]) == pytest.approx(here.drive.gain.P, abs=1e-13)
    assert unset["states"] == wide["states"]


def test_a_run_on_its_way_tells_the_steps_states_and_numbers_that_the_whole_run_has():
    heard, done = [], []

    def look(run):
        heard.append((run.time, run.states, run.result()))
        done.append((run.done, run.steps))

    whole = carts(horizon=3.0, progress=look)
    assert 2 < len(heard) <= 101 and done == sorted(done) and done[-1] == (300, 300)
    assert {steps for _, steps in done} == {300}
    for time, states, result in heard[:-1]:
        count = len(result.times)
        assert count < len(whole.times) and result.message.startswith("The run goes on")
        np.testing.assert_array_equal(result.states, whole.states[:count])
        np.testing.assert_array_equal(states, whole.states[count - 1])
        assert time >= result.times[-1] and result.sums.steps[0] == pytest.approx(time / 0.01)
    last = metrics(heard[-1][2])
    assert last == metrics(whole) and heard[-1][2].outcome is whole.outcome


def test_an_interrupt_keeps_what_was_computed_be_it_nothing(
    monkeypatch,
):
    def stop(run):
        if run.done >= 100:
            raise KeyboardInterrupt

    whole = carts(horizon=3.0)
    run = carts(horizon=3.0, progress=stop)
    assert run.outcome is Outcome.INTERRUPTED and run.outcome.exit_code == 130
    assert 100 <= len(run.times) < 301
    assert np.array_equal(run.states, whole.states[: len(run.times)])
    assert run.reference.shape == (len(run.times), 4) and len(run.inputs) == len(run.times)
    last = run.times[-1]
    assert run.message == f"The run was interrupted at t = {last:.6g} s; what was computed is kept."

    def stop_at_once(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(jax_stepper, "advance", stop_at_once)
    run = carts()
    assert run.outcome is Outcome.INTERRUPTED
    assert run.states.shape == (0, 4, 4) == run.errors.shape and run.inputs.shape == (0, 4, 2)
    assert run.message == "The run was interrupted at t = 0 s; what was computed is kept."


def test_who_keeps_a_run_may_end_it_with_a_reason():
    def refuse(stretch):
        raise Stopped("its folder is full,")

    laws, still = ech.Laws(TrimInput(), Agreement()), Formation(np.zeros((2, 2)))
    parts = ech.Parts(SingleIntegrator(), Graph.path(2), still, laws, initial={"position": 1.0})
    run = ech.simulate(parts, Settings(horizon=1.0, dt=0.1), keep=refuse)
    assert run.message == (
        "The run was stopped, since its folder is full, at t = 1 s; what was computed is kept."
    )
    assert run.outcome is Outcome.INTERRUPTED and len(run.times) == 11


def test_a_run_that_diverges_names_time_and_agent_and_keeps_finite_data():
    model, graph = Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]), Graph.path(3)
    law = consensus(model, graph, FixedGain(P=[1e3, 1e3], coupling=50.0))
    settings = {"horizon": 200.0, "dt": 0.1, "integrator": "euler"}
    run = closed(model, graph, law, initial={"x1": 1.0, "x2": 1.0}, **settings)
    assert run.outcome is Outcome.DIVERGED and run.outcome.exit_code == 3
    assert 2 < len(run.times) < 2001 and not run.saturated.any()
    assert np.isfinite(run.states).all() and np.isfinite(run.inputs).all()
    assert np.isfinite(run.errors).all()
    assert np.abs(run.states).max() > 1e100
    when = run.times[-1] + 0.1
    start = "The state of follower "
    assert run.message.startswith(start) and run.message[len(start)] in "12"
    assert run.message.endswith(f" stopped being finite by t = {when:.6g} s.")


def test_a_leader_that_diverges_is_called_the_leader():
    run = alone(
        Linear([[50.0]], [[1.0]]), [1.0], horizon=200.0, dt=1.0, integrator="euler", store_every=3
    )
    assert run.outcome is Outcome.DIVERGED
    assert run.message.startswith("The state of leader 0 stopped being finite by t = ")


def test_agents_with_one_goal_are_warned_of_and_synchronization_is_not():
    offsets, settings = {1: [1.0], 2: [1.0]}, {"horizon": 0.1, "dt": 0.1}
    run = closed(SingleIntegrator(1), Graph.path(3), Agreement(), Agreement(), offsets, **settings)
    assert run.warnings == ("agents 1 and 2 have the same goal, and would collide there.",)
    assert alone(Pendulum(), [0.0, 0.0], **settings).warnings == ()
