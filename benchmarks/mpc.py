"""Time the solvers that CasADi brings on one agent's receding horizon.

Run `OMP_NUM_THREADS=1 python benchmarks/mpc.py` (a few minutes). A quadrotor 1 m and 0.3 rad off
the paper's lemniscate plans 1 s ahead at 50 Hz, 50 steps of 20 ms within its motors' limits. Times
are those of the process, which other work on the machine disturbs less than those of the clock.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import echelon as ech
from echelon.agents.references.flatness import reference_targets
from echelon.core.errors import PlanError
from echelon.simulation.optimal.horizon import Course, Horizon

MODEL = ech.models.Quadrotor.crazyflie()
STEPS, DT = 50, 0.02
Step = Callable[[np.ndarray, Course, Course], tuple[Course | None, int]]

QUADRATIC = ("piqp", "proxqp", "osqp", "qrqp")
NONLINEAR: dict[str, dict[str, Any]] = {
    "ipopt": {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-4, "ipopt.tol": 1e-6},
    "fatrop": {"fatrop.tol": 1e-6, "fatrop.mu_init": 1e-3},
    "sqpmethod": {
        "qpsol": "osqp",
        "qpsol_options": {"osqp": {"verbose": False}, "error_on_fail": False},
        "max_iter": 10,
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "convexify_strategy": "regularize",
    },
    "sqpmethod+qrqp": {
        "qpsol": "qrqp",
        "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
        "max_iter": 10,
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "convexify_strategy": "regularize",
    },
}


def real_time(solver: str) -> Step:
    """Return one linearization and one quadratic program a period."""
    horizon = Horizon(MODEL, ech.optimal.MPC(solver=solver), STEPS, DT, limits=True)

    def step(start: np.ndarray, targets: Course, near: Course) -> tuple[Course | None, int]:
        return horizon.solve(start, targets, near).course, 1

    return step


def nonlinear(solver: str) -> Step:
    """Return the same problem solved as a nonlinear program from the shifted solution."""
    Q, R = (jnp.asarray(w) for w in ech.optimal.MPC().weights(MODEL))
    weight = Horizon(MODEL, ech.optimal.MPC(), 1, DT, limits=False)._weight.toarray()[-12:, -12:]

    def stage(x: Any, u: Any, p: Any) -> Any:
        e, w = x - p[:12], MODEL.normalized(u) - p[12:]
        return jnp.sum(Q * e * e) + jnp.sum(R * w * w)

    problem = ech.optimal.OptimalControl(
        MODEL,
        STEPS * DT,
        STEPS,
        stage,
        lambda x, p: (x - p[:12]) @ jnp.asarray(weight) @ (x - p[:12]),
        parameters=16,
    )
    planner = ech.optimal.Solver(problem, solver.split("+")[0], NONLINEAR[solver])

    def step(start: np.ndarray, targets: Course, near: Course) -> tuple[Course | None, int]:
        v = np.vstack([targets.inputs, targets.inputs[-1:]])
        guess = (np.vstack([start, near.states[1:]]), MODEL.physical(near.inputs))
        plan = planner.solve(start, np.hstack([targets.states, v]), guess)
        if plan.violations and max(v.amount for v in plan.violations) > 1e-2:
            return None, plan.iterations
        return Course(plan.states, MODEL.normalized(plan.inputs)), plan.iterations

    return step


def fly(step: Step, periods: int) -> tuple[np.ndarray, np.ndarray, int, float]:
    """Return milliseconds and iterations of each period, failures, and the last error, m."""
    times = DT * np.arange(periods + STEPS + 1)
    every = reference_targets(MODEL, ech.references.Lemniscate(), times)
    rng = np.random.default_rng(0)
    x = every.states[0].copy()
    x[:3] += rng.uniform(-1.0, 1.0, 3)
    x[6:9] += 0.3 * rng.uniform(-1.0, 1.0, 3)
    helper = Horizon(MODEL, ech.optimal.MPC(), STEPS, DT, limits=True)
    near = Course(every.states[: STEPS + 1], every.inputs[:STEPS])
    took, counts, failures = [], [], 0
    for k in range(periods):
        targets = Course(every.states[k : k + STEPS + 1], every.inputs[k : k + STEPS])
        began = time.process_time()
        found, count = step(x, targets, near)
        took.append(1e3 * (time.process_time() - began))
        counts.append(count)
        failures += found is None
        near = near if found is None else found
        x = np.array(helper._flow(x, near.inputs[0])).ravel()
        near = helper.shift(near, targets.inputs[-1])
    off = float(np.linalg.norm((x - every.states[periods])[:3]))
    return np.array(took), np.array(counts), failures, off


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--periods", type=int, default=150)
    parser.add_argument("solvers", nargs="*", default=[*QUADRATIC, *NONLINEAR])
    asked = parser.parse_args()
    print("| solver | median ms | p99 ms | worst ms | iterations | failures | last error, m |")
    print("|---|---|---|---|---|---|---|")
    for name in asked.solvers:
        kind = "one linearization, " if name in QUADRATIC else "nonlinear, "
        try:
            step = real_time(name) if name in QUADRATIC else nonlinear(name)
            took, counts, failures, off = fly(step, asked.periods)
        except PlanError as error:
            print(f"| {kind}{name} | {error} |")
            continue
        print(
            f"| {kind}{name} | {np.median(took):.1f} | {np.percentile(took, 99):.1f} | "
            f"{took.max():.1f} | {np.median(counts):.0f} (most {counts.max()}) | {failures} | "
            f"{off:.1e} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
