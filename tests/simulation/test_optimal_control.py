"""Optimal plans against closed forms, other solvers, and simulation."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from runs import simulate
from scipy.integrate import solve_bvp

import echelon as ech
from echelon.agents.models import Limits
from echelon.agents.references.flatness import (
    demand,
    flat_inputs,
    reference_demand,
    reference_warnings,
)
from echelon.core.errors import ModelError, PlanError
from echelon.core.numerics import precision

CART = ech.models.DoubleIntegrator(1)
PUSH = Limits(((1.0,),), (-1.0,), (1.0,))
REST = ech.optimal.Constraint("rest", lambda x, p: x[1], 0.0, 0.0, end=True)
ARRIVAL = ech.optimal.Constraint("arrival", lambda x, p: x - p, 0.0, 0.0, end=True)
both_transcriptions = pytest.mark.parametrize("transcription", ["shooting", "collocation"])


def effort(x, u, p):
    return u @ u


def transfer(steps, **changes):
    """A cart from rest to rest with the least effort; p is where it shall arrive."""
    parts = {"model": CART, "stage": effort, "constraints": (ARRIVAL,), "limits": False}
    parts |= {"horizon": 1.0, "steps": steps, "parameters": 2}
    return ech.optimal.OptimalControl(**parts | changes)


@both_transcriptions
def test_least_effort_moves_a_cart_as_the_calculus_of_variations_says(transcription):
    # u = 6 - 12 t and the effort 12, which the grid approaches in proportion to dt^2.
    costs, slopes = [], []
    for steps in (10, 20, 40):
        found = ech.optimal.solve(transfer(steps, transcription=transcription), [0, 0], [1, 0])
        t = found.times if transcription == "collocation" else found.times[:-1] + 0.5 / steps
        costs.append(found.cost - 12.0)
        # The trapezoidal rule's first and last input stand for half a step, and lag by as much.
        slope, level = np.polyfit(t[1:-1] - 0.5, found.inputs[1:-1, 0], 1)
        slopes.append(slope + 12.0)
        assert level == pytest.approx(0.0, abs=1e-7)
        assert found.solved and found.violations == ()
        assert found.states[[0, -1]] == pytest.approx(np.array([[0, 0], [1, 0]]), abs=1e-9)
    for misses in (costs, slopes):
        assert np.abs(misses[:-1]) / np.abs(misses[1:]) == pytest.approx(4.0, rel=0.1)


@both_transcriptions
@pytest.mark.parametrize("top", [1.0, 0.25])
def test_a_cart_with_limits_gets_as_far_as_full_push_and_full_brake_take_it(transcription, top):
    costs = {"stage": lambda x, u, p: 0.0 * u[0], "terminal": lambda x, p: -x[0]}
    limits = Limits(((2.0,),), (-2.0 * top,), (2.0 * top,))
    how = {"constraints": (REST,), "limits": limits, "transcription": transcription}
    found = ech.optimal.solve(transfer(20, **costs, **how), [0, 0], [0, 0])
    assert found.solved
    assert np.abs(found.inputs).max() <= top * (1 + 1e-7)
    # By collocation the input cannot jump, so the switch takes a step.
    loss = 1e-6 if transcription == "shooting" else 0.02 * top
    assert top / 4.0 - loss <= found.states[-1, 0] <= top / 4.0 + 1e-7


def test_a_plan_meets_pontryagin_s_conditions_to_the_order_of_the_grid():
    model, T, x0 = ech.models.VanDerPol(1.0), 2.0, np.array([1.5, -0.5])

    def conditions(t, y):
        x, v, a, b = y
        u = -b / 2.0
        return np.stack(
            [v, (1 - x**2) * v - x + u, -2 * x + b * (2 * x * v + 1), -2 * v - a - b * (1 - x**2)]
        )

    def ends(start, end):
        return np.array([*(start[:2] - x0), *end[2:]])

    t = np.linspace(0.0, T, 200)
    exact = solve_bvp(conditions, ends, t, np.zeros((4, 200)), tol=1e-10, max_nodes=100000)
    assert exact.success
    misses = []
    for steps in (20, 40, 80):
        problem = ech.optimal.OptimalControl(
            model, T, steps, lambda x, u, p: x @ x + u @ u, transcription="collocation"
        )
        found = ech.optimal.solve(problem, x0)
        misses.append(np.abs(found.states - exact.sol(found.times)[:2].T).max())
    orders = np.log2(np.array(misses[:-1]) / misses[1:])
    assert orders == pytest.approx(2.0, abs=0.3)


class Played(ech.laws.Law):
    """A law that plays an input held over each step of a plan."""

    inputs: np.ndarray
    step: float

    def update(self, model, view, memory):
        place = jnp.floor(view.t / self.step + 1e-6).astype(int)
        return jnp.asarray(self.inputs, view.x.dtype)[place], memory


def test_a_plan_is_flown_by_the_simulation_as_planned():
    model, start = ech.models.Quadrotor.crazyflie(), np.array([0.5, -0.2, 0.3] + [0.0] * 9)
    size = jnp.array([0.3, 1e-4, 1e-4, 1e-4])

    def cost(x, u, p):
        return x[:3] @ x[:3] + 0.01 * (x[3:] @ x[3:] + jnp.sum((u / size) ** 2))

    problem = ech.optimal.OptimalControl(model, 1.0, 20, cost, substeps=5)
    found = ech.optimal.solve(problem, start)
    assert found.solved
    laws = {"leader": Played(found.inputs, problem.dt), "follower": ech.laws.TrimInput()}
    still, starts = ech.Formation(np.zeros((2, 12))), np.stack([start, start])
    times = {"horizon": 1.0, "dt": 0.01, "store_every": 5}
    flown = simulate(model, ech.Graph.path(2), still, **laws, initial=starts, **times)
    assert flown.saturated[0] == pytest.approx(0.0, abs=0.2)
    assert flown.states[:, 0] == pytest.approx(found.states, abs=1e-6)


@pytest.mark.parametrize("solver", ["fatrop", "sqpmethod"])
def test_solvers_agree(solver):
    problem = transfer(15, stage=lambda x, u, p: u @ u + x @ x + x[0] ** 4, limits=PUSH)
    first = ech.optimal.solve(problem, [0.1, 0.0], [0.2, 0.1])
    quiet = {"fatrop": {}, "sqpmethod": {"qpsol": "qrqp"}}[solver]
    second = ech.optimal.solve(problem, [0.1, 0.0], [0.2, 0.1], solver=solver, options=quiet)
    assert first.solved and second.solved
    assert second.message == f"{solver} solved the problem: it reached its tolerance."
    assert second.states == pytest.approx(first.states, abs=1e-5)
    assert second.cost == pytest.approx(first.cost, rel=1e-6)


def test_a_planner_solves_other_data_as_a_fresh_one_would():
    planner = ech.optimal.Solver(transfer(20))
    first = planner.solve([0, 0], [1, 0])
    for guess in (None, first, (first.states, first.inputs)):
        again = planner.solve([0.3, -0.1], [2, 0], guess)
        fresh = ech.optimal.solve(transfer(20), [0.3, -0.1], [2, 0])
        assert again.states == pytest.approx(fresh.states, abs=1e-7)
        assert again.cost == pytest.approx(fresh.cost)


def test_parameters_belong_to_their_times():
    path = np.cumsum(np.random.default_rng(0).normal(0.0, 0.1, (21, 1)), axis=0)
    reached = ech.optimal.Constraint("path", lambda x, p: x - p, 0.0, 0.0)
    how = {"model": ech.models.SingleIntegrator(1), "parameters": 1}
    problem = transfer(20, **how, stage=lambda x, u, p: 0.0 * u[0], constraints=(reached,))
    found = ech.optimal.solve(problem, path[0], path)
    assert found.states == pytest.approx(path, abs=1e-7)
    # The cost too: with the cost |x - p|^2 alone the plan follows the same path at no cost.
    costs = {"stage": lambda x, u, p: jnp.sum((x - p) ** 2)}
    costs["terminal"] = lambda x, p: jnp.sum((x - p) ** 2)
    found = ech.optimal.solve(transfer(20, **how, **costs, constraints=()), path[0], path)
    assert found.states == pytest.approx(path, abs=1e-5)
    assert found.cost == pytest.approx(0.0, abs=1e-9)


def test_scaled_units_give_the_same_plan():
    # The same cart with its force in micronewtons: solvers must not notice.
    class Micro(ech.ControlAffine):
        state_names = ("x", "v")
        input_names = ("force",)
        input_scale = ((1e6,),)

        def drift(self, x):
            return jnp.stack([x[1], jnp.zeros((), x.dtype)])

        def input_map(self, x):
            return jnp.array([[0.0], [1e-6]], x.dtype)

    def solved(model, unit):
        limits = Limits(((1.0,),), (-4.0 * unit,), (4.0 * unit,))
        cost = {"stage": lambda x, u, p: u @ u / unit**2}
        return ech.optimal.solve(transfer(20, model=model, limits=limits, **cost), [0, 0], [0.9, 0])

    plain, micro = solved(CART, 1.0), solved(Micro(), 1e6)
    assert micro.states == pytest.approx(plain.states, abs=1e-8)
    assert micro.inputs == pytest.approx(1e6 * plain.inputs, rel=1e-6, abs=1.0)
    assert np.abs(plain.inputs).max() == pytest.approx(4.0, abs=1e-6)


def test_an_infeasible_problem_names_what_must_be_missed_and_by_how_much():
    # In one second full push and full brake carry the cart 1/4 m, and it has 5 m to go.
    found = ech.optimal.solve(transfer(20, limits=PUSH), [5.0, 0.0], [0.0, 0.0])
    assert not found.solved
    [missed] = found.violations
    assert (missed.name, missed.time) == ("arrival", 1.0)
    assert missed.amount == pytest.approx(4.75, abs=1e-5)
    assert found.message == (
        "ipopt failed to solve the problem: it found that the constraints contradict each other "
        "nearby; smallest possible violations: `arrival` by 4.75 at 1 s."
    )
    # The limits themselves may contradict each other.
    both = Limits(((1.0,), (1.0,)), (-1.0, 2.0), (1.0, 3.0))
    found = ech.optimal.solve(transfer(5, limits=both, constraints=()), [0.0, 0.0], [0.0, 0.0])
    assert not found.solved
    assert {v.name for v in found.violations} <= {"actuator limit 1", "actuator limit 2"}
    assert sum(v.amount for v in found.violations) >= 1.0 - 1e-6


@pytest.mark.parametrize(
    ("stage", "start", "told"),
    [
        (lambda x, u, p: u[0], 0.0, "its variables grew without bound, as where the cost has no m"),
        (lambda x, u, p: jnp.log(x[0]) + u @ u, -1.0, "not a finite number"),
    ],
)
def test_a_cost_without_a_minimum_or_a_finite_number_is_told(stage, start, told):
    problem = transfer(5, constraints=(), stage=stage)
    options = {"ipopt.max_iter": 500}
    found = ech.optimal.solve(problem, [start, 0.0], [0.0, 0.0], options=options)
    assert not found.solved and told in found.message
    assert found.message.startswith("ipopt failed to solve the problem: ")


def test_a_solver_that_stops_early_says_so_and_what_its_plan_misses():
    # With no iteration the plan is the guess, whose misses are worked out by hand.
    rng = np.random.default_rng(5)
    steps, states, inputs = 4, rng.normal(size=(5, 2)), 3.0 * rng.normal(size=(4, 1))
    wall = ech.optimal.Constraint("wall", lambda x, p: x[0], high=-3.0)
    problem = transfer(steps, limits=PUSH, constraints=(wall, ARRIVAL))
    options = {"ipopt.max_iter": 0}
    found = ech.optimal.solve(
        problem, [7.0, 0.0], [9.0, 0.0], guess=(states, inputs), options=options
    )
    dt = 0.25
    moved = np.stack(
        [
            states[:-1, 0] + dt * states[:-1, 1] + 0.5 * dt**2 * inputs[:, 0],
            states[:-1, 1] + dt * inputs[:, 0],
        ],
        axis=1,
    )
    assert found.states == pytest.approx(states) and found.inputs == pytest.approx(inputs)
    assert not found.solved and found.iterations == 0
    start = "ipopt failed to solve the problem: it used up its iterations; largest violations: "
    assert found.message.startswith(start)

    def worst(amounts, times):
        place = int(np.argmax(amounts))
        return pytest.approx((amounts[place], times[place]), abs=1e-9)

    got = {v.name: (v.amount, v.time) for v in found.violations}
    t = dt * np.arange(5)
    gaps = np.abs(states[1:] - moved)
    assert got.pop("motion of x") == worst(gaps[:, 0], t)
    assert got.pop("motion of vx") == worst(gaps[:, 1], t)
    assert got.pop("start of x") == worst([7.0 - states[0, 0]], t)
    assert got.pop("start of vx") == worst([abs(states[0, 1])], t)
    assert got.pop("actuator limit 1") == worst(np.abs(inputs[:, 0]) - 1.0, t)
    assert got.pop("wall") == worst(states[1:, 0] + 3.0, t[1:])
    assert got.pop("arrival") == worst([np.abs(states[-1] - [9.0, 0.0]).max()], t[-1:])
    assert not got
    amounts = [v.amount for v in found.violations]
    assert amounts == sorted(amounts, reverse=True)


def search(x, u, p):
    return jax.lax.while_loop(lambda y: y > 1.0, lambda y: 0.5 * y, u[0])


WIDE, NONE = Limits(((1.0, 0.0),), (-1.0,), (1.0,)), Limits(((1.0,),), (2.0,), (1.0,))
GUESS = np.zeros((3, 2)), np.zeros((5, 1))
MALFORMED = [
    ({"steps": 0}, "`steps` is 0, and must be a whole number from 1 on; the horizon must hold at"),
    ({"steps": 2.5}, "`steps` is 2.5, and must be a whole number from 1 on; the horizon must"),
    ({"horizon": -1.0}, "`horizon` is -1.0, and must be a positive finite number of seconds."),
    ({"horizon": np.nan}, "`horizon` is nan, and must be a positive finite number of seconds."),
    ({"substeps": 0}, "`substeps` is 0, and must be a whole number from 1 on."),
    ({"parameters": -1}, "`parameters` is -1, and must be a whole number from 0 on."),
    ({"transcription": "euler"}, "`transcription` is `euler`, allowed are `shooting`, `colloc"),
    ({"model": 3}, "the model is 3, and must be an instance of a `ControlAffine` class."),
    ({"limits": WIDE}, "the input limits have shapes (1, 2), (1,) and (1,), and must have (k, 1)"),
    ({"limits": NONE}, "the input limits [2.0] to [1.0] hold no number."),
    ({"stage": lambda x, u, p: u @ u * x}, "`stage` returns 2 numbers, and must return one: a"),
    ({"terminal": lambda x, p: x}, "`terminal` returns 2 numbers, and must return one: a cost."),
    ({"constraints": (REST._replace(low=1.0),)}, "the bounds of the constraint `rest` are 1.0"),
    (
        {"constraints": (REST._replace(low=(1.0, 2.0)),)},
        "the bounds of the constraint `rest` are",
    ),
    ({"stage": search}, "`stage` uses `while`, which has no expression"),
    ({"solver": "newton"}, "`solver` is `newton`, which CasADi lacks; try `ipopt`"),
    ({"options": {"coffee": 1}}, "`ipopt` refuses the problem or its options: Unknown option: cof"),
    ({"data": ([0.0],)}, "`start` is [0.0], and must be numbers of shape (2,)."),
    ({"data": (["a", 0.0],)}, "`start` is ['a', 0.0], and must be numbers of shape (2,)."),
    ({"data": ([0.0, np.inf],)}, "`start` holds a number that is not finite."),
    ({"data": ([0, 0],)}, "`parameters` is None, and must be numbers of shape (6, 2)."),
    ({"data": ([0, 0], [[1, 0]] * 3)}, "`parameters` is [[1, 0], [1, 0], [1, 0]], and must be"),
    (
        {"data": ([0, 0], [1, 0], GUESS)},
        "`guess.states` is of shape (3, 2), and must be numbers",
    ),
]


@pytest.mark.parametrize(("changes", "said"), MALFORMED)
def test_a_malformed_problem_and_data_that_does_not_fit_are_told(changes, said):
    own = {name: changes[name] for name in ("solver", "options") if name in changes}
    parts = {name: part for name, part in changes.items() if name not in ("data", *own)}
    with pytest.raises((PlanError, ModelError)) as caught:
        solver = ech.optimal.Solver(transfer(**{"steps": 5} | parts), **own)
        solver.solve(*changes.get("data", ([0, 0], [1, 0])))
    assert str(caught.value).startswith(said)


class Clipped(ech.models.SingleIntegrator):
    def limit(self, u):
        return jnp.clip(u, -1.0, 1.0)


def test_a_model_whose_limits_no_solver_can_read_is_told():
    said = "`Clipped` has a `limit`, and plans need it as `input_limits` too; add them to the model"

    def bounds_of(model, **limits):
        return ech.optimal.OptimalControl(model, 1.0, 5, effort, **limits).bounds

    with pytest.raises(PlanError, match=f"^{said}, or give `limits`.$"):
        bounds_of(Clipped(1))
    assert bounds_of(Clipped(1), limits=False) is bounds_of(CART) is None
    assert bounds_of(Clipped(1), limits=PUSH) == PUSH


FIGURE = ech.references.FigureEight(rate=6.0)


@pytest.mark.parametrize("model", [ech.models.Quadrotor.crazyflie(), ech.models.PlanarQuadrotor()])
def test_the_demand_is_how_far_the_input_goes_towards_the_limit(model):
    inputs = flat_inputs(model, FIGURE, np.linspace(0.1, 0.9, 50))
    hover = np.array(model.trim[1])
    with precision("float64"):
        for u, ratio in zip(inputs, demand(model, inputs), strict=True):
            inside = jnp.asarray(hover + (u - hover) / ratio * 0.999)
            outside = jnp.asarray(hover + (u - hover) / ratio * 1.001)
            assert (model.limit(inside) == inside).all()
            assert not (model.limit(outside) == outside).all()


def test_room_is_counted_from_the_trim_to_either_limit():
    class Leaning(ech.models.SingleIntegrator):
        trim = ((0.0,), (2.0,))
        input_limits = ech.models.Limits(np.eye(1), np.array([-1.0]), np.array([3.0]))

    inputs = np.array([[2.0], [2.5], [3.0], [4.0], [0.5], [-1.0], [-4.0]])
    # One up and three down.
    assert demand(Leaning(1), inputs).tolist() == [0.0, 0.5, 1.0, 2.0, 0.5, 1.0, 2.0]


def test_a_reference_beyond_the_limits_is_warned_of_with_the_ratio():
    model = ech.models.Quadrotor.crazyflie()
    [told] = reference_warnings(model, FIGURE, 4.0)
    times = np.linspace(0.0, 4.0, 1000)
    worst = demand(model, flat_inputs(model, FIGURE, times)).max()
    assert re.fullmatch(
        r"the reference `FigureEight` is too fast for `Quadrotor`: at t = [\d.]+ s it needs "
        + re.escape(f"{worst:.3g}")
        + r" times the range of the actuators beyond the trim \(thrust [\d.]+ N, torque_x .*\).",
        told,
    )
    assert reference_warnings(model, ech.references.FigureEight(rate=0.3), 10.0) == ()
    assert reference_warnings(ech.models.DoubleIntegrator(3), FIGURE, 10.0) == ()
    # So is the leader of a run, before it flies.
    drive, graph = ech.Laws(ech.laws.Tracking(FIGURE), ech.laws.TrimInput()), ech.Graph.path(2)
    settings = ech.Settings(4.0, 0.01)
    assert drive.warnings(model, graph, settings) == (told,)
    assert drive.warnings(model, graph, settings._replace(limits=False)) == ()


def test_a_circle_asks_for_its_speed_and_its_centripetal_acceleration():
    circle = ech.references.Circle(radius=2.0, rate=1.5)
    for model in (ech.models.Quadrotor.crazyflie(), ech.models.Unicycle()):
        found = reference_demand(model, circle, 5.0)
        assert found.speed == pytest.approx(3.0, rel=1e-5)
        assert found.acceleration == pytest.approx(4.5, rel=1e-5)
        assert found.defect < 1e-5 and found.feasible
    # Nothing of a motion without a position is metres.
    path = ech.references.StatePath([0.0, 1.0], [[0.0, 0.0]] * 2, [[0.0]] * 2)
    assert reference_demand(ech.models.Pendulum(), path, 1.0)[:3] == (None, None, 0.0)
