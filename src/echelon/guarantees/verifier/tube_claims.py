"""Independent check of a tube of T5 stored by a run or a check, with motors and distances."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from echelon.agents.models.quadrotor import Quadrotor
from echelon.core.digits import at_most
from echelon.core.numerics import precision
from echelon.core.types import Array, JsonObject
from echelon.guarantees.verifier.findings import ClaimCheck, compare, decide

# ---- thrusts of the motors -----------------------------------------------------------------------
# The certificate encloses time slices in rational arithmetic. Here responses are evaluated at
# thousands of times in floats; then random motions within the bounds are inverted with the
# equations of the model, and none may need more thrust. No code of the certificate is used.

_CELLS = 6000
_MOTOR_SLACK = 2e-8
"""N and rad: quadrature error in a cell in which a response changes its sign."""
_TIMES, _MOTIONS = 24, 4000
"""Times of random motions (the least thrust of each interval), and motions per time."""


def motor_findings(claims: JsonObject) -> Iterator[ClaimCheck]:
    """Yield a finding for each claim about the motors."""
    motion = _Motion.of(claims)
    demands = [_demands(motion, _start_bounds(start)) for start in claims["starts"]]
    ranges = [_range(claims["airframe"], item) for item in demands]
    least, largest = (f(r[k] for r in ranges) for k, f in ((0, _least), (1, _most)))
    stored = float(claims["least"])
    fine = 0.0 < stored <= least + _MOTOR_SLACK
    yield decide("least thrust of a motor", fine, stored, least, "evaluated over time")
    limit = float(claims["airframe"]["motor_thrust"])
    yield decide("limit of a motor", claims["most"] == limit, claims["most"], limit, "airframe")
    stored = float(claims["largest"])
    fine = largest - _MOTOR_SLACK <= stored < limit
    yield decide("largest thrust of a motor", fine, stored, largest, "evaluated over time")
    tilt = max(float(r[2].max()) for r in ranges)
    yield decide("steepest tilt", claims["tilt"] >= tilt - _MOTOR_SLACK, claims["tilt"], tilt)
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


def _check_single_starts(claims: JsonObject, motion: _Motion) -> Iterator[ClaimCheck]:
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
        fine = bool(low.min() > -_MOTOR_SLACK and high.max() < most + _MOTOR_SLACK)
        yield decide(f"motors from the start `{name}`", fine, alone[name], float(low.min()), "N")


# ---- offsets that change with time, by samples of Taylor series ----------------------------------

_CLOSE = 1e-6
"""Relative; by how much less than a bound samples of it may be."""
_BLEND = np.polynomial.Polynomial([0, 0, 0, 0, 0, 0, 462, -1980, 3465, -3080, 1386, -252])


def offset_findings(claim: JsonObject) -> Iterator[ClaimCheck]:
    """Yield whether the bounds of offsets and their derivatives are those of their motion."""
    if claim["sizes"] is None:
        return
    stored, value = np.array(claim["sizes"], float), _sizes(claim)
    fine = stored.shape == value.shape and bool((stored >= value * (1.0 - 1e-12)).all())
    fine &= bool((stored <= value * (1.0 + _CLOSE) + 1e-12).all()) if fine else False
    text = "by factorials of Taylor coefficients"
    yield decide("bounds of offsets", fine, stored.max(initial=0.0), value.max(initial=0.0), text)


def _sizes(claim: JsonObject) -> Array:
    """Return the bounds [order][coordinate] of a motion."""
    orders = np.arange(6)
    factorials = np.array([math.factorial(k) for k in orders], float)
    u = np.linspace(0.0, 1.0, 40_001)
    blends = [np.abs((_BLEND.deriv(k) if k else _BLEND)(u)).max() for k in orders]
    sizes = np.zeros((6, len(claim["lengths"])))
    for way, span in zip(claim["ways"], claim["over"], strict=True):
        each = np.outer(blends / np.array(span, float) ** orders, way)
        sizes = np.maximum(sizes, each)
    sizes[0] = claim["lengths"]
    # Coefficients of Taylor series, which multiply like polynomials.
    series = sizes / factorials[:, None]
    for motion in claim["motions"]:
        rate, scales = abs(motion["rate"]), motion["kind"] == "Scale"
        factor = rate**orders * (abs(motion["amplitude"]) if scales else 1.0) / factorials
        factor[0] += float(scales)
        for axis in range(series.shape[1] if scales else 2):
            series[:, axis] = np.convolve(series[:, axis], factor)[:6]
    return series * factorials[:, None]


# ---- distances (T10) -----------------------------------------------------------------------------

_SLACK = 1e-9


def separation_findings(claim: JsonObject) -> Iterator[ClaimCheck]:
    """Yield a finding for each condition of the theorem."""
    width, _, height = claim["radii"]
    scales = np.array([width / height if axis == "z" else 1.0 for axis in claim["axes"]])
    kept = 2.0 * width + claim["margin"]
    yield compare("distance of the hulls", claim["distance"], kept, _SLACK, "2 radius + margin")
    least = _distance(np.array(claim["gap"]) * scales)
    text = "by a plane between the nearest two"
    yield compare("distance at the start", claim["least"], least, _SLACK, text)
    yield decide("they start apart", least >= kept - _SLACK, kept, least)
    share = claim["gain"] * claim["step"]
    yield decide("gain times step", share <= 1.0 + _SLACK, "at most 1", share)
    speed = float(np.linalg.norm(scales * np.array(claim["speeds"])))
    needed = kept + 2.0 * speed / claim["gain"]
    fine = claim["reach"] >= needed - _SLACK
    yield decide("agents are regarded in time", fine, claim["reach"], needed)


def _distance(points: Array) -> float:
    """Return how far the hull of points (r, d) is from 0, by the plane that separates both."""
    # min |C'l| with l >= 0 and sum l = 1, the last as a heavy equation of least squares.
    heavy = 1e6 * max(1.0, float(np.abs(points).max()))
    target = np.append(np.zeros(points.shape[1]), heavy)
    shares = scipy.optimize.nnls(np.vstack([points.T, np.full(len(points), heavy)]), target)[0]
    nearest = shares @ points / shares.sum()
    size = float(np.linalg.norm(nearest))
    # What is proved: all points are beyond a plane so far from 0.
    return float((points @ nearest).min()) / size if size > 0.0 else 0.0


# ---- the tube ------------------------------------------------------------------------------------
# The certificate encloses polynomials by Bernstein coefficients. Here sign changes are isolated by
# Sturm sequences and the integrals between them computed by Gauss quadrature; the response to a
# start and a bounded disturbance is evaluated over time. No code of the certificate is used.

FORMAT = "echelon tube 1"
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(40)
_FINE = Fraction(1, 2**50)


def tube_of(stated: JsonObject) -> JsonObject | None:
    """Return the tube in a stored guarantee; None if there is none."""
    tube = stated.get("anywhere")
    return tube if isinstance(tube, dict) and tube.get("format") == FORMAT else None


def tube_findings(tube: JsonObject) -> Iterator[ClaimCheck]:
    """Yield a finding for each claim of a tube."""
    for border in tube["borders"]:
        roots = [Fraction(str(root)) for root in border["roots"]]
        name = ", ".join(f"`{output}`" for output in border["outputs"])
        for order, stored in enumerate(border["gains"]):
            result = _gain(roots, order)
            yield compare(
                f"gain {order} of {name}", stored, result, 1e-8, "quadrature between roots"
            )
        yield from _check_margin(border, roots, name)
    if tube.get("motors") is not None:
        yield from motor_findings(tube["motors"])
    if tube.get("offsets") is not None:
        yield from offset_findings(tube["offsets"])
    if tube.get("separation") is not None:
        yield from separation_findings(tube["separation"])


def _check_margin(border: JsonObject, roots: Sequence[Fraction], name: str) -> Iterator[ClaimCheck]:
    order = int(border["derivative"]) - 1
    allowed = float(border["path"]) - float(border["above"])
    total = float(border["speed"]) + float(border["leader_speed"])
    if len(border["outputs"]) > 1:
        left = min(allowed - _length(roots, order, np.array(s), total) for s in border["starts"])
    else:
        pairs = itertools.product(border["leader_starts"], border["starts"])
        both = [np.add(_pad_start(a, len(roots)), _pad_start(b, len(roots))) for a, b in pairs]
        left = min(allowed - _fall(roots, order, start, total) for start in both)
    stored = float(border["left"])
    fine = 0.0 < stored <= left + 1e-9
    yield decide(f"margin to {name}", fine, stored, left, "evaluated over time")
    steep = np.eye(len(roots))[0] * float(border["steepest"])
    worst = min(
        allowed - _fall(roots, order, sign * steep, float(border["speed"])) for sign in (-1.0, 1.0)
    )
    shown, text = f"{at_most(worst, 4)} left", "margin from this start"
    yield decide(f"steepest start of {name}", worst >= -1e-9, border["steepest"], shown, text)


def _pad_start(start: Sequence[float], size: int) -> Array:
    return np.pad(np.asarray(start, float), (0, size - len(start)))


# ---- by modes, in floats -------------------------------------------------------------------------


def _residues(roots: Sequence[Fraction]) -> Array:
    """Return c with h = sum c_i exp(-rho_i t) for k0 / q(s)."""
    rho = np.array([float(root) for root in roots])
    differences = [np.prod([b - a for j, b in enumerate(rho) if j != i]) for i, a in enumerate(rho)]
    return np.prod(rho) / np.array(differences)


def _fall(roots: Sequence[Fraction], order: int, start: Array, speed: float) -> float:
    """Return the largest decrease of v^(order) from a start under |w| <= speed, on a fine grid."""
    free, driven = _simulate_response(roots, order, start[None])
    return float((speed * driven - free[0]).max())


def _length(roots: Sequence[Fraction], order: int, starts: Array, speed: float) -> float:
    """Return the largest norm of v^(order) of m outputs from starts (m, p)."""
    free, driven = _simulate_response(roots, order, starts)
    return float((speed * driven + np.linalg.norm(free, axis=0)).max())


def _simulate_response(roots: Sequence[Fraction], order: int, starts: Array) -> tuple[Array, Array]:
    """Return the free response v^(order) from starts (m, p) and int_0^t |h^(order)| on a grid."""
    rho = np.array([float(root) for root in roots])
    times = np.linspace(0.0, 30.0 / rho.min(), _CELLS)
    modes = np.linalg.solve(np.vander(-rho, increasing=True).T, starts.T).T
    free = (modes * (-rho) ** order) @ np.exp(-np.outer(rho, times))
    kernel = _residues(roots) * (-rho) ** order
    # Simpson's rule: its error in smooth cells is far below `left + 1e-9`.
    step = times[1]
    ends = np.abs(kernel @ np.exp(-np.outer(rho, times)))
    middles = np.abs(kernel @ np.exp(-np.outer(rho, times[:-1] + 0.5 * step)))
    cells = step / 6.0 * (ends[:-1] + 4.0 * middles + ends[1:])
    return free, np.concatenate([[0.0], np.cumsum(cells)])


def _gain(roots: Sequence[Fraction], order: int) -> float:
    """Return the integral of |h^(order)| over all time, plus k0 at the highest order."""
    rho, c = np.array([float(root) for root in roots]), _residues(roots)
    kernel = c * (-rho) ** order
    # In s = exp(-unit t): dt = -ds / (unit s), and the powers are whole numbers.
    unit = _unit(roots)
    powers = [int(root / unit) for root in roots]
    exact = _modes(roots, order)
    cuts = [0.0, *map(float, _sign_changes(dict(zip(powers, exact, strict=True)))), 1.0]
    total = 0.0
    for a, b in itertools.pairwise(cuts):
        s = 0.5 * (b - a) * _NODES + 0.5 * (a + b)
        values = sum(k * s ** (n - 1) for k, n in zip(kernel, powers, strict=True)) / float(unit)
        total += abs(float(0.5 * (b - a) * (_WEIGHTS @ values)))
    return total + (float(np.prod(rho)) if order == len(roots) else 0.0)


def _modes(roots: Sequence[Fraction], order: int) -> list[Fraction]:
    """Return the exact coefficients of h^(order) in the modes exp(-root t)."""
    k0, result = Fraction(1), list[Fraction]()
    for root in roots:
        k0 *= root
    for root in roots:
        differences = Fraction(1)
        for other in roots:
            differences *= other - root if other != root else 1
        result.append(k0 / differences * (-root) ** order)
    return result


def _unit(roots: Sequence[Fraction]) -> Fraction:
    """Return the greatest common divisor of the roots (Euclid)."""
    unit = roots[0]
    for root in roots[1:]:
        a, b = unit, root
        while b:
            a, b = b, a % b
        unit = a
    return unit


# ---- sign changes by Sturm -----------------------------------------------------------------------


def _sign_changes(p: Mapping[int, Fraction]) -> list[Fraction]:
    """Return the roots of a polynomial in (0, 1), each to 2^-50 (Sturm's theorem)."""
    low = min(p)
    dense = [p.get(n, Fraction(0)) for n in range(low, max(p) + 1)]
    chain = _sturm(dense)
    result, pieces = list[Fraction](), [(Fraction(0), Fraction(1))]
    while pieces:
        a, b = pieces.pop()
        count = _variations(chain, a) - _variations(chain, b)
        if not count:
            continue
        if b - a <= _FINE:
            result.append((a + b) / 2)
            continue
        middle = (a + b) / 2
        pieces += [(a, middle), (middle, b)]
    return sorted(result)


def _sturm(p: list[Fraction]) -> list[list[Fraction]]:
    """Return the Sturm sequence of a polynomial; coefficients start at the lowest power."""
    chain = [p, [n * c for n, c in enumerate(p)][1:]]
    while len(chain[-1]) > 1:
        rest = [-c for c in _remainder(chain[-2], chain[-1])]
        if not any(rest):
            break
        chain.append(rest)
    return [part for part in chain if part]


def _remainder(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
    a = list(a)
    while len(a) >= len(b):
        share, gap = a[-1] / b[-1], len(a) - len(b)
        for k, c in enumerate(b):
            a[gap + k] -= share * c
        a.pop()
    while a and not a[-1]:
        a.pop()
    return a


def _variations(chain: list[list[Fraction]], x: Fraction) -> int:
    signs = []
    for part in chain:
        total = Fraction(0)
        for c in reversed(part):
            total = total * x + c
        if total:
            signs.append(total > 0)
    return sum(a != b for a, b in itertools.pairwise(signs))
