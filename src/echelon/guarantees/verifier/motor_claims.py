"""A second opinion on what motors give under the law `stopping-point`, from what a run tells (T5).

The certificate goes by slices of time in rationals. Here responses are followed at thousands of
moments in floats, and then motions are drawn within the bounds and flown backwards through the
model's own equations, to see that none asks for more. Nothing of the certificate is used.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from echelon.agents.models.quadrotor import Quadrotor
from echelon.core.numerics import precision
from echelon.core.types import Array, JsonObject
from echelon.guarantees.verifier.findings import Finding, said

_CELLS = 6000
_SLACK = 2e-8
"""N and rad: what quadrature leaves where a response changes its sign within a cell."""
_TIMES, _DRAWN = 24, 4000
"""Moments at which motions are drawn, the hardest of stretches of time, and how many in each."""


def motor_findings(told: JsonObject) -> Iterator[Finding]:
    """Yield what is found of each claim of motors."""
    motion = _Motion.of(told)
    demands = [_asked(motion, _sizes(start)) for start in told["starts"]]
    ranges = [_range(told["airframe"], item) for item in demands]
    least, largest = (f(r[k] for r in ranges) for k, f in ((0, _least), (1, _most)))
    stored = float(told["least"])
    fine = 0.0 < stored <= least + _SLACK
    yield said("least thrust of a motor", fine, stored, least, "followed over time")
    stored = float(told["largest"])
    fine = largest - _SLACK <= stored < float(told["most"])
    yield said("largest thrust of a motor", fine, stored, largest, "followed over time")
    tilt = max(float(r[2].max()) for r in ranges)
    yield said("steepest tilt", told["tilt"] >= tilt - _SLACK, told["tilt"], tilt)
    low, high = _drawn(told["airframe"], demands[0], ranges[0])
    fine = told["least"] <= low and high <= told["largest"]
    text = f"{_TIMES * _DRAWN} motions within the bounds"
    yield said("motors of drawn motions", fine, told["least"], low, text)
    yield from _alone(told, motion)


def _least(values: Iterator[Array]) -> float:
    return min(float(v.min()) for v in values)


def _most(values: Iterator[Array]) -> float:
    return max(float(v.max()) for v in values)


def _sizes(start: JsonObject) -> Array:
    """Return (3, 3): of v, v', v'' along the ground, upward, and of the yaw's rate."""
    rows = [start["sideways"], start["upward"], start["turn"]]
    return np.stack([np.pad(np.asarray(row, float), (0, 3 - len(row))) for row in rows])


class _Motion(NamedTuple):
    """What agents do that start as their leader, at T times.

    Attributes:
        free, first: (orders, starts, T) of the chain with all roots, and with the first.
        base: (9, T) sideways a, j, s, least and largest upward a, upward j, s, turn and turning.
    """

    free: Array
    first: Array
    base: Array

    @classmethod
    def of(cls, told: JsonObject) -> "_Motion":
        """Return it of what is told."""
        rho = np.asarray(told["roots"], float)
        times = np.linspace(0.0, 30.0 / rho.min(), _CELLS)
        (free, grown), (first, rotated) = _responses(rho, times), _responses(rho[:1], times)
        path = np.asarray(told["path"], float)
        rows = path[np.searchsorted(path[:, 0], times, side="right") - 1, 1:].T
        led, speeds = told["leader"], np.add(told["speeds"], told["leader"]["speeds"])
        base = _added(rows, speeds[:, None, None], grown, rotated)
        return cls(free, first, base + _started(_sizes(led), free, first))


def _responses(rho: Array, times: Array) -> tuple[Array, Array]:
    """Return |v^(l)| of unit starts (p + 1, p, T), and integrals of |h^(l)| so far (p + 1, T)."""
    p = len(rho)
    orders = np.arange(p + 1)
    modes = np.linalg.inv(np.vander(-rho, increasing=True).T)
    falls = np.exp(-np.outer(rho, times))
    powers = (-rho) ** orders[:, None]
    free = np.abs(np.einsum("lr,rk,rt->lkt", powers, modes, falls))
    apart = [np.prod([b - a for j, b in enumerate(rho) if j != i]) for i, a in enumerate(rho)]
    kernel = powers * np.prod(rho) / np.array(apart)
    step = times[1]
    ends = np.abs(kernel @ falls)
    middles = np.abs(kernel @ np.exp(-np.outer(rho, times[:-1] + 0.5 * step)))
    cells = step / 6.0 * (ends[:, :-1] + 4.0 * middles + ends[:, 1:])
    grown = np.concatenate([np.zeros((p + 1, 1)), np.cumsum(cells, axis=1)], axis=1)
    grown[p] += np.prod(rho)
    return free, grown


def _added(rows: Array, speeds: Array, grown: Array, turned: Array) -> Array:
    """Return what a path (9, T) asks of agents that are driven at speeds."""
    along, up, around = speeds[:, 0, 0]
    upward = up * grown[1]
    return rows + np.stack(
        [*(along * grown[1:]), -upward, upward, *(up * grown[2:]), *(around * turned)]
    )


def _started(sizes: Array, free: Array, first: Array) -> Array:
    """Return what starts (3, 3) add, (9, T)."""
    along, up = (np.einsum("k,lkt->lt", sizes[k], free)[1:] for k in (0, 1))
    around = sizes[2, 0] * first[:, 0]
    return np.stack([*along, -up[0], up[0], *up[1:], *around])


def _asked(motion: _Motion, start: Array) -> Array:
    return motion.base + _started(start, motion.free, motion.first)


def _range(frame: JsonObject, asked: Array) -> tuple[Array, Array, Array]:
    """Return the least and the largest motor, and the tilt, at all times (T,)."""
    a, j, s, low, high, jz, sz, turn, turning = asked
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


def _drawn(
    frame: JsonObject, asked: Array, ranges: tuple[Array, Array, Array]
) -> tuple[float, float]:
    """Return the least and the largest motor of motions within the bounds, at the hardest times."""
    cells = np.array_split(np.arange(asked.shape[1]), _TIMES)
    hardest = [cell[ranges[0][cell].argmin()] for cell in cells]
    draw = np.random.default_rng(0)
    bounds = np.repeat(asked[:, hardest], _DRAWN, axis=1)
    paths = np.zeros((bounds.shape[1], 5, 4))
    # On the border of each bound: that is where motors give most.
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


def _alone(told: JsonObject, motion: _Motion) -> Iterator[Finding]:
    """Yield whether the motors suffice from the other starts that are claimed."""
    alone, ahead, most = told["alone"], told["ahead"], float(told["most"])
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
        low, high, _ = _range(told["airframe"], _asked(motion, start))
        fine = bool(low.min() > -_SLACK and high.max() < most + _SLACK)
        yield said(f"motors from the start `{name}`", fine, alone[name], float(low.min()), "N")
