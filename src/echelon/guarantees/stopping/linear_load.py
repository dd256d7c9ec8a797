"""What is asked of the inputs of agents that are linear in their flat coordinates (T5, T10).

Such an input is u = u_0 + sum_k T_k y^(k), of motion and no place: a row of its limits is bounded
by the tube of y', .., y^(r), term by term.
"""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.chains import flat_output
from echelon.agents.models.declarations import is_by_user
from echelon.agents.models.model import ControlAffine
from echelon.core.digits import about
from echelon.core.numerics import precision
from echelon.core.rational import float_above
from echelon.core.statement import Hypothesis, Statement, holds
from echelon.core.types import Array
from echelon.core.words import Kind
from echelon.guarantees.promises.leaders import own_run
from echelon.guarantees.stopping.chain_response import slices_of
from echelon.guarantees.stopping.path_bounds import Pieces, pieces_of
from echelon.guarantees.stopping.stopping_run import StoppingRun
from echelon_ranges.jaxpr import used_leaves

_ROUNDED = Fraction(1, 10**6)
"""Of a start in flat coordinates: a thousand times what floats leave of it."""
_SAME = 1e-9
"""Relative; what floats leave between `flat` and the equations."""
_ZERO = Fraction(0)


def linear_limits(run: StoppingRun) -> Statement | None:
    """Return that no limit acts from the starts of a run; None where that is not shown."""
    model, chains = run.parts.model, run.law.ready.chains
    limits, slopes = model.input_limits, _input_slopes(model, chains.outputs)
    other = is_by_user(model, "limit") or run.parts.formation.motion is not None
    if limits is None or slopes is None or other:
        return None
    (trim, T), held = slopes, _held_inputs(run)
    fastest = max(run.speed(k) for k in range(len(chains.outputs)))
    if held is None or T[0].any() or np.isinf(fastest):
        return None
    pieces = pieces_of(run.leader, model, run.settings.horizon, chains.outputs, max(chains.degrees))
    rooms = list[tuple[float, str]]()
    for row, least, most in zip(*(np.asarray(part, float) for part in limits), strict=True):
        bottom, top = _range_of(run, pieces, trim @ row, np.einsum("kmi,m->ki", T, row), held @ row)
        room = min(float(most) - top, bottom - float(least))
        rooms.append((room, model.input_names[int(np.abs(row).argmax())]))
    worst, name = min(rooms, default=(np.inf, ""))
    if not worst > 0.0:
        return None
    text = f"no limit acts from these starts; `{name}` keeps {about(worst)} of its unit"
    return holds(Hypothesis.LIMITS, Kind.PROOF, text, worst, f"{about(worst)} left")


def _held_inputs(run: StoppingRun) -> Array | None:
    """Return what leaders that run alone ask for in held steps, (T L, m); None where they diverge.

    The path is one of continuous time: a leader that holds its inputs asks for others.
    """
    leads = list(run.parts.graph.leaders)
    starts = run.states[leads] - run.parts.formation.offsets[leads]
    alone = own_run(run.parts, run.settings, starts)
    if alone is None:
        return None
    return alone.inputs[:, : len(leads)].reshape(-1, alone.inputs.shape[-1])


def _input_slopes(model: ControlAffine, outputs: tuple[str, ...]) -> tuple[Array, Array] | None:
    """Return u_0 (m,) and T (r + 1, m, outputs); None of an input that is not linear in them.

    Laws invert the equations: a `flat` that agrees with them in linear terms alone is used.
    """
    if tuple(model.flat_outputs) != outputs:
        return None
    zero = jnp.zeros((model.flat_order + 2, len(outputs)))

    def asked(y: jax.Array) -> tuple[jax.Array, ...]:
        (x, u), (rate, _) = jax.jvp(model.flat, (y[:-1],), (y[1:],))
        return u, model.velocity(x, u) - rate, flat_output(model, outputs, x) - y[0]

    with precision("float64"):
        slopes = jax.jacfwd(asked)
        if any(used_leaves(slopes, zero)):
            return None
        (u, *off), (T, *bent) = (map(np.asarray, part(zero)) for part in (asked, slopes))
    most = max(float(np.abs(part).max()) for part in (*off, *bent))
    if not most <= _SAME * (1.0 + np.abs(u).max() + np.abs(T).max()):
        return None
    return u, np.moveaxis(T, 0, 1)[:-1]


def _range_of(
    run: StoppingRun, pieces: Pieces, at_rest: float, T: Array, held: Array
) -> tuple[float, float]:
    """Return between what a row of limits stays, given its slopes T (r + 1, outputs).

    `held` (K,) is what the leaders ask of it in held steps.
    """
    chains, low, high = run.law.ready.chains, Fraction(float(at_rest)), Fraction(float(at_rest))
    rows, behind = pieces.between(_ZERO, None), _ZERO
    for k, degree in enumerate(chains.degrees):
        led, followed = _pushes(run, k, degree)
        for order in range(1, degree + 1):
            slope = Fraction(float(T[order, k])) if order < len(T) else _ZERO
            if not slope:
                continue
            ends = [slope * end for row in rows for end in (row[order][k].lo, row[order][k].hi)]
            low += min(ends) - abs(slope) * led[order - 1]
            high += max(ends) + abs(slope) * led[order - 1]
            behind += abs(slope) * followed[order - 1]
    low, high = min(low, Fraction(float(held.min()))), max(high, Fraction(float(held.max())))
    return -float_above(behind - low), float_above(high + behind)


def _pushes(run: StoppingRun, output: int, degree: int) -> list[list[Fraction]]:
    """Return bounds of how far y', .., y^(r) of an output are off, in all time.

    The first are of the leaders, off their path, the others of followers, off their leader.
    """
    graph, chain = run.parts.graph, run.chain(output)
    leaders, followers = list(graph.leaders), list(graph.followers)
    off = run.flat[leaders] - run.ahead
    away = (run.flat - run.flat[list(graph.nearest_leader())])[followers]
    found = list[list[Fraction]]()
    for starts, speed in ((off, run.own_speed(output)), (away, run.speed(output))):
        sizes = [
            Fraction(float(np.abs(starts[:, j, output]).max())) + _ROUNDED for j in range(1, degree)
        ]
        most, parts = Fraction(speed), slices_of(chain) if chain.powers else ()
        each = (max(p.whole.of(order, sizes, most) for p in parts) for order in range(degree))
        found.append([*each] if parts else [most] * degree)
    return found
