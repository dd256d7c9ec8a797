"""Independent check of the motor thrusts guaranteed under the law `stopping-point` (T5).

The certificate encloses time slices in rational arithmetic. Here responses are evaluated at
thousands of times in floats; then random motions within the bounds are inverted with the equations
of the model, and none may need more thrust. No code of the certificate is used.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.quadrotor import Quadrotor
from echelon.core.numerics import precision
from echelon.core.types import Array, JsonObject
from echelon.guarantees.verifier.findings import Finding, decide

_CELLS = 6000
_SLACK = 2e-8
"""N and rad: quadrature error in a cell in which a response changes its sign."""
_TIMES, _MOTIONS = 24, 4000
"""Times of random motions (the least thrust of each interval), and motions per time."""


def motor_findings(claims: JsonObject) -> Iterator[Finding]:
    """Yield a finding for each claim about the motors."""
    motion = _Motion.of(claims)
    demands = [_demands(motion, _start_bounds(start)) for start in claims["starts"]]
    ranges = [_range(claims["airframe"], item) for item in demands]
    least, largest = (f(r[k] for r in ranges) for k, f in ((0, _least), (1, _most)))
    stored = float(claims["least"])
    fine = 0.0 < stored <= least + _SLACK
    yield decide("least thrust of a motor", fine, stored, least, "evaluated over time")
    limit = float(claims["airframe"]["motor_thrust"])
    yield decide("limit of a motor", claims["most"] == limit, claims["most"], limit, "airframe")
    stored = float(claims["largest"])
    fine = largest - _SLACK <= stored < limit
    yield decide("largest thrust of a motor", fine, stored, largest, "evaluated over time")
    tilt = max(float(r[2].max()) for r in ranges)
    yield decide("steepest tilt", claims["tilt"] >= tilt - _SLACK, claims["tilt"], tilt)
    low, high = _random_motions(claims["airframe"], demands[0], ranges[0])
    fine = claims["least"] <= low and high <= claims["largest"]
    text = f"{_TIMES * _MOTIONS} motions within the bounds"
    yield decide("motors in random motions", fine, claims["least"], low, text)
    yield from _check_single_starts(claims, motion)


def _least(values: Iterator[Array]) -> float:
    return min(float(v.min()) for v in values)


def _most(values: Iterator[Array]) -> float:
    return max(float(v.max()) for v in values)


def _start_bounds(start: JsonObject) -> Array:
    """Return bounds (3, 3) of v, v', v'': horizontal, vertical, and of the yaw rate."""
    rows = [start["sideways"], start["upward"], start["turn"]]
    return np.stack([np.pad(np.asarray(row, float), (0, 3 - len(row))) for row in rows])


class _Motion(NamedTuple):
    """Bounds at T times on agents that start like their leader.

    Attributes:
        free, first: responses (orders, starts, T) with all roots, and with the first root only.
        base: (9, T) horizontal acceleration, jerk, snap; least and largest vertical
            acceleration; vertical jerk, snap; yaw rate and yaw acceleration.
    """

    free: Array
    first: Array
    base: Array

    @classmethod
    def of(cls, claims: JsonObject) -> "_Motion":
        """Return the bounds for the stored claims."""
        rho = np.asarray(claims["roots"], float)
        times = np.linspace(0.0, 30.0 / rho.min(), _CELLS)
        (free, integrals), (first, turn_integral) = (
            _responses(rho, times),
            _responses(rho[:1], times),
        )
        path = np.asarray(claims["path"], float)
        rows = path[np.searchsorted(path[:, 0], times, side="right") - 1, 1:].T
        leader, speeds = claims["leader"], np.add(claims["speeds"], claims["leader"]["speeds"])
        base = _path_demands(rows, speeds[:, None, None], integrals, turn_integral)
        return cls(free, first, base + _start_demands(_start_bounds(leader), free, first))


def _responses(rho: Array, times: Array) -> tuple[Array, Array]:
    """Return |v^(l)| from unit starts (p + 1, p, T) and integrals of |h^(l)| up to t (p + 1, T)."""
    p = len(rho)
    orders = np.arange(p + 1)
    modes = np.linalg.inv(np.vander(-rho, increasing=True).T)
    decays = np.exp(-np.outer(rho, times))
    powers = (-rho) ** orders[:, None]
    free = np.abs(np.einsum("lr,rk,rt->lkt", powers, modes, decays))
    differences = [np.prod([b - a for j, b in enumerate(rho) if j != i]) for i, a in enumerate(rho)]
    kernel = powers * np.prod(rho) / np.array(differences)
    step = times[1]
    ends = np.abs(kernel @ decays)
    middles = np.abs(kernel @ np.exp(-np.outer(rho, times[:-1] + 0.5 * step)))
    cells = step / 6.0 * (ends[:, :-1] + 4.0 * middles + ends[:, 1:])
    integrals = np.concatenate([np.zeros((p + 1, 1)), np.cumsum(cells, axis=1)], axis=1)
    integrals[p] += np.prod(rho)
    return free, integrals


def _path_demands(rows: Array, speeds: Array, integrals: Array, turn_integral: Array) -> Array:
    """Return the bounds (9, T) for a path and agents driven at `speeds`."""
    along, up, around = speeds[:, 0, 0]
    upward = up * integrals[1]
    return rows + np.stack(
        [
            *(along * integrals[1:]),
            -upward,
            upward,
            *(up * integrals[2:]),
            *(around * turn_integral),
        ]
    )


def _start_demands(sizes: Array, free: Array, first: Array) -> Array:
    """Return the contribution (9, T) of starts (3, 3)."""
    along, up = (np.einsum("k,lkt->lt", sizes[k], free)[1:] for k in (0, 1))
    around = sizes[2, 0] * first[:, 0]
    return np.stack([*along, -up[0], up[0], *up[1:], *around])


def _demands(motion: _Motion, start: Array) -> Array:
    return motion.base + _start_demands(start, motion.free, motion.first)


def _range(frame: JsonObject, demands: Array) -> tuple[Array, Array, Array]:
    """Return the least and largest motor thrust and the tilt at all times, (T,) each."""
    a, j, s, low, high, jz, sz, turn, turning = demands
    g, mass, arm, drag = (frame[k] for k in ("gravity", "mass", "arm", "torque_per_thrust"))
    Jx, Jy, Jz = frame["inertia"]
    least, most = g + low, np.hypot(g + high, a)
    tilt = np.where(least > 0.0, np.arctan2(a, least), np.pi / 2)
    cosine, sine, tangent = np.cos(tilt), np.sin(tilt), np.tan(tilt)
    jerk, snap = np.hypot(j, jz), np.hypot(s, sz)
    w = jerk / least
    bend = (snap + jerk * w) / least
    r = turn / cosine + tangent * w
    spin = turning / cosine + tangent * bend
    spin += (2.0 * turn * w * sine + 2.0 * (1.0 - cosine) * turn**2) / cosine**2
    spin += (1.0 / cosine**2 - 0.5) * w**2
    roll = max(Jx, Jy) * bend + (Jz + abs(Jx - Jy)) * w * r
    more = np.sqrt(0.125) * roll / arm
    more += (Jz * spin + 0.5 * abs(Jx - Jy) * w**2) / (4.0 * drag)
    bad = least <= 0.0
    quarter = 0.25 * mass
    lowest = np.where(bad, -np.inf, quarter * least - more)
    return lowest, np.where(bad, np.inf, quarter * most + more), tilt


def _random_motions(
    frame: JsonObject, demands: Array, ranges: tuple[Array, Array, Array]
) -> tuple[float, float]:
    """Return the least and largest motor thrust of random motions at the hardest times."""
    cells = np.array_split(np.arange(demands.shape[1]), _TIMES)
    hardest = [cell[ranges[0][cell].argmin()] for cell in cells]
    draw = np.random.default_rng(0)
    bounds = np.repeat(demands[:, hardest], _MOTIONS, axis=1)
    paths = np.zeros((bounds.shape[1], 5, 4))
    # On the boundary of each bound, since thrusts are largest there.
    angles = draw.uniform(-np.pi, np.pi, (3, bounds.shape[1]))
    for k in range(3):
        paths[:, k + 2, 0] = bounds[k] * np.cos(angles[k])
        paths[:, k + 2, 1] = bounds[k] * np.sin(angles[k])
    signs = draw.choice([-1.0, 1.0], (5, bounds.shape[1]))
    paths[:, 2, 2] = np.where(signs[0] > 0.0, bounds[4], bounds[3])
    paths[:, 3, 2], paths[:, 4, 2] = signs[1] * bounds[5], signs[2] * bounds[6]
    paths[:, 0, 3] = draw.uniform(-np.pi, np.pi, bounds.shape[1])
    paths[:, 1, 3], paths[:, 2, 3] = signs[3] * bounds[7], signs[4] * bounds[8]
    model = Quadrotor(**{**frame, "inertia": tuple(frame["inertia"])})
    with precision("float64"):
        inputs = np.asarray(jax.jit(jax.vmap(lambda d: model.flat(d)[1]))(jnp.asarray(paths)))
    thrusts = inputs @ np.asarray(model.input_limits.matrix).T
    return float(thrusts.min()), float(thrusts.max())


def _check_single_starts(claims: JsonObject, motion: _Motion) -> Iterator[Finding]:
    """Yield a finding for each other start from which the motors are claimed to suffice."""
    alone, ahead, most = claims["alone"], claims["ahead"], float(claims["most"])
    if alone is None:
        return
    v, a, j, rise, turn = (float(ahead[k]) for k in ("speed", "push", "jerk", "rise", "turn"))
    lift, climb = float(ahead["lift"]), float(ahead["climb"])
    t = np.tan(alone["tilt"])
    starts = {
        "tilt": ([0.0, lift * t + a, climb * t + j], 0.0),
        "sideways": ([alone["sideways"], 0.0, 0.0], 0.0),
        "upward": ([0.0, 0.0, 0.0], alone["upward"]),
        "rate": ([0.0, a, j + lift * alone["rate"]], 0.0),
    }
    if alone["rest"]:
        starts["rest"] = ([v, a, j], rise)
    for name, (sideways, upward) in starts.items():
        start = np.array([sideways, [upward, 0.0, 0.0], [turn, 0.0, 0.0]])
        low, high, _ = _range(claims["airframe"], _demands(motion, start))
        fine = bool(low.min() > -_SLACK and high.max() < most + _SLACK)
        yield decide(f"motors from the start `{name}`", fine, alone[name], float(low.min()), "N")
