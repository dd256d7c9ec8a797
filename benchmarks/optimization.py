"""Measure the optimization-based method on the paper's agents: errors, the least possible, times.

Run `OMP_NUM_THREADS=1 python benchmarks/optimization.py` (some minutes); it prints a table.
"""

import dataclasses
import time
from collections.abc import Iterator, Sequence

import casadi as ca
import numpy as np

import echelon as ech
from echelon.agents.references.flatness import Targets, reference_targets, shifted_targets
from echelon.simulation.optimal.formation_plan import plan_tracking
from echelon.simulation.optimal.objectives import PlanTimes, TrackingOptions, coarse, grid, tracking
from echelon.simulation.optimal.problem import OptimalControl

MODEL, LOOP = ech.models.Quadrotor.crazyflie(), ech.references.Lemniscate()
TREE = ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)], leaders=[0])
OFFSETS = {1: (1, 0, 0), 2: (1, 0.8, 0), 3: (1, -0.8, 0)}
DRAWN = ech.Formation.from_offsets(MODEL, TREE, OFFSETS)
FLIGHT = ech.Settings(horizon=10.0, dt=0.005)
SHARP = TrackingOptions(interval=0.02, input_weight=3e-6)
"""For followers without limits, whose error shall be gone within a sample of the paper."""

Row = tuple[str, str, str]


def starts() -> np.ndarray:
    """Return the states (4, 12) of the paper's error figure: F1 0.193 m near, F3 0.180 m near."""
    leader = reference_targets(MODEL, LOOP, np.zeros(1)).states[0]
    states = leader + DRAWN.offsets
    states[:, :2] += -1.344, 0.530
    states[1:, 0] -= 0.193
    states[3, 1] += 0.180
    return states


def sampled(times: np.ndarray, error: np.ndarray) -> float:
    """Return the root mean square over the paper's 100 samples, 0.101 s apart."""
    return float(np.sqrt(np.mean(np.interp(0.101 * np.arange(100), times, error) ** 2)))


def whole(error: np.ndarray) -> float:
    """Return the root mean square over all frames."""
    return float(np.sqrt(np.mean(error**2)))


def off_reference(result: ech.Result) -> np.ndarray:
    """Return the leader's distance from its reference, (T,)."""
    assert result.reference is not None
    return np.linalg.norm((result.states[:, 0] - result.reference)[:, :3], axis=1)


def off_distance(result: ech.Result, i: int, j: int) -> np.ndarray:
    """Return by how much two agents' distance differs from the wanted one, (T,)."""
    apart = np.linalg.norm((result.states[:, i] - result.states[:, j])[:, :3], axis=1)
    return apart - np.linalg.norm(DRAWN.displacement(i, j)[:3])


def off_goal(result: ech.Result, i: int, j: int) -> np.ndarray:
    """Return the length of the error of agent i's offset from agent j, (T,)."""
    gap = result.states[:, i] - result.states[:, j] + DRAWN.displacement(i, j)
    return np.linalg.norm(gap[:, :3], axis=1)


# ---- the least possible --------------------------------------------------------------------------


def least(start: np.ndarray, targets: Targets, times: PlanTimes, seeds: Sequence[int]) -> float:
    """Return the smallest root-mean-square error found within the motors' limits.

    The input costs nothing, and the solver begins at the targets and at other motions.
    """
    planning = TrackingOptions(interval=times.interval, input_weight=0.0)
    problem: OptimalControl = tracking(MODEL, planning, times, limits=True, fine=False)
    problem = dataclasses.replace(problem, substeps=max(1, coarse(times)))
    planner = ech.optimal.Solver(problem, options={"ipopt.max_iter": 500})
    p = np.hstack([targets.outputs, targets.inputs, np.zeros((len(targets.inputs), 1))])
    found = []
    for seed in seeds:
        states, inputs = targets.states.copy(), MODEL.physical(targets.inputs[:-1])
        if seed:
            rng = np.random.default_rng(seed)
            fade = np.exp(-times.times / rng.uniform(0.2, 1.0))[:, None]
            states[:, :6] += fade * rng.normal(0.0, 0.5, 6)
            states[:, 6:8] += 0.3 * fade * rng.normal(0.0, 1.0, 2)
        states[0] = start
        plan = planner.solve(start, p, (states, inputs))
        if plan.solved:
            error = np.linalg.norm((plan.states - targets.states)[:, :3], axis=1)
            found.append(float(np.sqrt(np.trapezoid(error**2, times.times) / times.times[-1])))
    print(f"<!-- least found from {len(found)} starts: {sorted(np.round(found, 5).tolist())} -->")
    return min(found)


def bound(steps: int = 500) -> float:
    """Return an error that no flight can undercut: that of a point with the motors' whole thrust.

    The thrust points where it likes at once, so the problem is convex and has one solution.
    """
    h, top = 10.0 / steps, 4.0 * MODEL.motor_thrust / MODEL.mass
    x = reference_targets(MODEL, LOOP, h * np.arange(steps + 1)).states
    opti = ca.Opti()
    p, v, a = opti.variable(3, steps + 1), opti.variable(3, steps + 1), opti.variable(3, steps)
    up = ca.DM([0.0, 0.0, MODEL.gravity])
    for k in range(steps):
        opti.subject_to(p[:, k + 1] == p[:, k] + h * v[:, k] + h**2 / 2 * a[:, k])
        opti.subject_to(v[:, k + 1] == v[:, k] + h * a[:, k])
        opti.subject_to(ca.sumsqr(a[:, k] + up) <= top**2)
    opti.subject_to(p[:, 0] == x[0, :3] + np.array([-1.344, 0.530, 0.0]))
    opti.subject_to(v[:, 0] == x[0, 3:6])
    e = p - x[:, :3].T
    cost = h * (ca.sumsqr(e) - 0.5 * (ca.sumsqr(e[:, 0]) + ca.sumsqr(e[:, -1])))
    opti.minimize(cost)
    opti.set_initial(p, x[:, :3].T)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    return float(np.sqrt(opti.solve().value(cost) / 10.0))


# ---- the rows ------------------------------------------------------------------------------------


def leader(free: ech.Result, within: ech.Result) -> Iterator[Row]:
    """Yield the leader's errors beside the least possible."""
    e, f = off_reference(within), off_reference(free)
    yield (
        "leader, inputs unconstrained: RMSE of 100 samples / of the whole run",
        f"{sampled(free.times, f):.4f} / {whole(f):.4f} m",
        "0.186 m (100 samples)",
    )
    yield (
        "leader, motor limits: the same",
        f"{sampled(within.times, e):.4f} / {whole(e):.4f} m",
        "-",
    )
    times = grid(10.0, 0.005, 0.02)
    best = least(starts()[0], reference_targets(MODEL, LOOP, times.times), times, range(4))
    yield (
        "leader, motor limits: least whole-run RMSE found (4 starts), and excess over it",
        f"{best:.4f} m, {100 * (whole(e) / best - 1):.1f} %",
        "within 5 %",
    )
    yield (
        "no flight can undercut (a point that turns its whole thrust at once)",
        f"{bound():.4f} m",
        "-",
    )


def followers(free: ech.Result, within: ech.Result) -> Iterator[Row]:
    """Yield the followers' errors beside the least possible."""
    for agent, before, asked in ((1, 0, "0.0302"), (3, 1, "0.018")):
        for name, result in (("inputs unconstrained", free), ("motor limits", within)):
            d, e = (off(result, agent, before) for off in (off_distance, off_goal))
            yield (
                f"follower {agent}, {name}: RMSE of the distance, of the offset (100 samples); "
                "of both (whole run)",
                f"{sampled(result.times, d):.4f}, {sampled(result.times, e):.4f}; "
                f"{whole(d):.4f}, {whole(e):.4f} m",
                f"{asked} m" if result is free else "-",
            )
        times = grid(10.0, 0.005, 0.02)
        every = slice(None, None, times.hold)
        x = within.states[every, before] - DRAWN.displacement(agent, before)
        still = np.zeros((len(x), 4))
        targets = shifted_targets(MODEL, Targets(x, x, still), np.zeros(12))
        best = least(starts()[agent], targets, times, range(3))
        yield (
            f"follower {agent}, motor limits: least RMSE of the offset found, behind the same plan",
            f"{best:.4f} m",
            "-",
        )


def times_and_mpc() -> Iterator[Row]:
    """Yield what planning takes, and the receding horizon."""
    times = grid(10.0, 0.005, 0.1)
    targets = reference_targets(MODEL, LOOP, times.times)
    began = time.process_time()
    made = plan_tracking(MODEL, starts()[0], targets, times, TrackingOptions(interval=0.1), True)
    yield (
        "plan of one agent over 10 s in 100 steps: process time, solver made ready, both solutions",
        f"{time.process_time() - began:.1f} s ({'solved' if made.solved else made.message})",
        "5 s",
    )
    for limits in (True, False):
        result = ech.simulate(
            ech.Parts(MODEL, TREE, DRAWN, ech.optimal.RecedingHorizon(LOOP), initial=starts()),
            FLIGHT._replace(limits=limits),
        )
        figures, numbers = result.work, ech.metrics(result)
        assert figures is not None and numbers.worst_steady is not None
        name = "MPC, motor limits" if limits else "MPC, inputs unconstrained"
        e = off_reference(result)
        yield (
            f"{name}: steady RMSE of the worst follower",
            f"{numbers.worst_steady:.1e} m",
            "1e-3",
        )
        yield (
            f"{name}: leader RMSE of 100 samples / of the whole run",
            f"{sampled(result.times, e):.4f} / {whole(e):.4f} m",
            "-",
        )
        yield (
            f"{name}: a plan at 50 Hz over 1 s: median / 99 % / worst (the first one)",
            f"{figures.median_ms:.1f} / {figures.p99_ms:.1f} / {figures.worst_ms:.0f} ms",
            "20 ms (median)",
        )
        yield (f"{name}: failures", f"{figures.failures} of {figures.solves}", "-")


def rows() -> Iterator[Row]:
    """Yield all rows of the table."""
    initial = starts()
    within = ech.simulate(
        ech.Parts(MODEL, TREE, DRAWN, ech.optimal.Plans(LOOP), initial=initial), FLIGHT
    )
    free = ech.simulate(
        ech.Parts(MODEL, TREE, DRAWN, ech.optimal.Plans(LOOP), initial=initial),
        FLIGHT._replace(limits=False),
    )
    sharp = ech.simulate(
        ech.Parts(MODEL, TREE, DRAWN, ech.optimal.Plans(LOOP, options=SHARP), initial=initial),
        FLIGHT._replace(limits=False),
    )
    yield from leader(free, within)
    yield from followers(sharp, within)
    yield from times_and_mpc()


def main() -> None:
    """Print the table."""
    print("| what | measured | asked |\n|---|---|---|")
    for row in rows():
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
