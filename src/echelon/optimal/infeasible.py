"""Why a problem has no plan: by how little its constraints can be missed when all else is met."""

from typing import Any, NamedTuple

import numpy as np

from echelon.core.types import Matrix
from echelon.optimal.casadi import casadi
from echelon.optimal.transcription import Program

FELT = 1e-6
"""A constraint that is missed by less than this counts as met."""


class Violation(NamedTuple):
    """By how much a constraint is missed at most, in its own units, and when (s)."""

    name: str
    amount: float
    time: float


def violations(program: Program, g: Matrix) -> tuple[Violation, ...]:
    """Return by how much each kind of constraint is missed at most, the largest first."""
    sizes = np.array([row.size for row in program.rows])
    amounts = sizes * np.maximum(program.low - g, g - program.high)
    worst: dict[str, Violation] = {}
    for k in np.flatnonzero(~(amounts <= FELT * sizes)):
        name, amount = program.rows[k].name, float(amounts[k])
        if name not in worst or not amount <= worst[name].amount:
            worst[name] = Violation(name, amount, program.rows[k].time)
    return tuple(sorted(worst.values(), key=lambda v: -v.amount))


def least_violations(program: Program, w: Matrix, p: Matrix) -> tuple[Violation, ...]:
    """Return what is missed where the sum of all misses of the problem's own constraints is least.

    The motion, the start and the actuators' limits are kept. Where these alone contradict each
    other, or no such point is found, nothing is returned.

    Args:
        program: has no feasible point.
        w: where to begin.
        p: the program's data.
    """
    ca = casadi()
    own = np.flatnonzero([row.own for row in program.rows])
    if not len(own):
        return ()
    above, below = ca.MX.sym("a", len(own)), ca.MX.sym("b", len(own))
    place = ca.DM(np.eye(len(program.rows))[:, own])
    elastic = {
        "x": ca.vertcat(program.problem["x"], above, below),
        "f": ca.sum1(above) + ca.sum1(below),
        "g": program.problem["g"] + ca.mtimes(ca.sparsify(place), below - above),
        "p": program.problem["p"],
    }
    quiet = {"print_time": False, "error_on_fail": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    solver = ca.nlpsol("elastic", "ipopt", elastic, quiet)
    free, slack = np.full(len(w), np.inf), np.ones(2 * len(own))
    solution: dict[str, Any] = solver(
        x0=np.concatenate([w, slack]),
        lbx=np.concatenate([-free, 0.0 * slack]),
        lbg=program.low,
        ubg=program.high,
        p=p,
    )
    if not solver.stats()["success"]:
        return ()
    slacks = np.array(solution["x"]).ravel()[len(w) :]
    g = np.array(solution["g"]).ravel()
    g[own] -= slacks[len(own) :] - slacks[: len(own)]
    return violations(program, g)
