"""Limits of the inputs inside certified sets, and sets of agents whose inputs are held.

In {sum_i w_i delta_i'P delta_i <= r^2} the input of follower j is u_0 + S (K delta_j - c R^-1 B'P
z_j), z_j = sum_i L_ji delta_i: a row h of its limits moves by at most r |a| in the set's norm.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from echelon.agents.models.declarations import is_by_user
from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.model_check import is_limited
from echelon.core.digits import about, at_least
from echelon.core.statement import NO_LIMIT, Hypothesis, Statement, holds, left_to_run, unneeded
from echelon.core.types import Array
from echelon.core.words import Kind, Theorem, Verdict
from echelon.guarantees.promises.leaders import Leaders, own_run
from echelon.simulation.engine.parts import Parts
from echelon.simulation.step.settings import Settings
from echelon.synthesis.certificates.certificate import RegionCertificate
from echelon.synthesis.certificates.jacobians import has_constant_input_map
from echelon.synthesis.gains.gain import Gain

_ROUNDING = 1e-12  # relative, of a norm
_WHOLE = 1500
"""Numbers of a formation on a directed graph up to which one matrix of all of them is made."""


class LimitRoom(NamedTuple):
    """How large a set may be in which no limit acts.

    Attributes:
        radius: r of {sum_i delta_i'P delta_i <= r^2}; infinite without limits, 0 for none.
        line: what is said of it.
    """

    radius: float
    line: Statement


def limit_room(
    parts: Parts, settings: Settings, leaders: Leaders, region: RegionCertificate
) -> LimitRoom:
    """Return in how large a set of a region's metric no input of a follower is at a limit."""
    name, kind = Hypothesis.LIMITS, Kind.PROOF
    if not (settings.limits and is_limited(parts.model)):
        return LimitRoom(np.inf, unneeded(name, kind, "the inputs have no limits"))
    unbounded = _unbounded(parts, leaders, region)
    if unbounded:
        return LimitRoom(np.inf, _at_limits(unbounded))
    led = _leaders_inputs(parts, settings, leaders)
    if led is None:
        return LimitRoom(0.0, _at_limits("the leader alone diverges"))
    rooms = _rooms(parts.model, led)
    least, what = min(rooms)
    kind = kind if leaders.rest else Kind.SAMPLES
    if not least > 0.0:
        text = f"the leader itself takes {what} to a limit"
        remedy = "slow the reference, or strengthen the actuators"
        return LimitRoom(0.0, _at_limits(text, 0.0, "no room", remedy, kind))
    if region.theorem is Theorem.T2:
        text = f"{what} has {about(least)} of its unit left where the leader is"
        return LimitRoom(np.inf, holds(name, kind, text, least, f"{about(least)} left"))
    radius = _radius(parts, np.array([room for room, _ in rooms]))
    text = f"no limit acts within {about(radius)} of the goals, in the metric of P"
    return LimitRoom(radius, holds(name, kind, text, radius, f"radius {about(radius)}"))


_at_limits = functools.partial(left_to_run, Hypothesis.LIMITS, NO_LIMIT)


def from_starts(line: Statement, starts: Statement) -> Statement:
    """Return the line on limits of a run from its starts: from outside the set one may act."""
    if line.verdict is not Verdict.HOLDS:
        return line
    if not starts.fails:
        # What a run enters is known by that run.
        return dataclasses.replace(line, kind=min(line.kind, starts.kind, key=lambda x: x.strength))
    text = "the starts are outside the certified set, where a limit may act"
    return _at_limits(text, starts.number, starts.number_text, starts.remedy, line.kind)


def _unbounded(parts: Parts, leaders: Leaders, region: RegionCertificate) -> str:
    """Return why rows of limits say nothing of a set; empty where they do."""
    if is_by_user(parts.model, "limit"):
        return f"`{type(parts.model).__name__}` has a `limit` of its own, which no rows describe"
    if parts.world.effects.limits:
        return parts.world.effects.limits
    if leaders.answer:
        return "the leader reacts to followers, and its inputs depend on them"
    if not has_constant_input_map(parts.model, region.domain) and region.theorem is not Theorem.T2:
        return "g varies, and the set is of another metric than its inputs"
    return ""


def _leaders_inputs(parts: Parts, settings: Settings, leaders: Leaders) -> Array | None:
    """Return the delivered inputs (T, m) of leaders in a run of their own, or at rest."""
    if leaders.rest:
        return np.asarray(parts.model.trim[1], float)[None]
    run = own_run(parts, settings, leaders.starts)
    if run is None:
        return None
    return run.inputs[:, : len(leaders.starts)].reshape(-1, run.inputs.shape[2])


def _rooms(model: ControlAffine, led: Array) -> list[tuple[float, str]]:
    """Return how far each row of the limits is from what leaders do, and its input."""
    assert model.input_limits is not None
    G, low, high = (np.asarray(part, float) for part in model.input_limits)
    rows = led @ G.T
    room = np.minimum((high - rows).min(axis=0), (rows - low).min(axis=0))
    names = [f"`{model.input_names[int(np.abs(row).argmax())]}`" for row in G]
    return [*zip(room.tolist(), names, strict=True)]


def _radius(parts: Parts, rooms: Array) -> float:
    """Return r of the set in which no limit of a follower acts, with rooms (R,) of the rows."""
    gain, model, spectrum = parts.drive.gain, parts.model, parts.graph.spectrum()
    assert isinstance(gain, Gain) and model.input_limits is not None
    L, B = sp.csr_array(parts.graph.grounded_laplacian()), linearize(model).B
    w = np.ones(len(parts.graph.followers)) if spectrum.sums is None else spectrum.sums
    h = np.asarray(model.input_limits.matrix, float) @ np.asarray(model.input_scale, float)
    back, q = np.linalg.inv(gain.P), gain.coupling * gain.P @ B @ gain.R_inverse @ h.T
    p = np.zeros_like(q) if gain.inner is None else -gain.inner.T @ h.T
    # |a|^2 of each follower (rows) and each row of the limits (columns).
    felt, own = np.asarray((L * L) @ (1.0 / w)), L.diagonal() / w
    size = felt[:, None] * _form(q, back, q) - 2.0 * own[:, None] * _form(q, back, p)
    size = np.sqrt(np.maximum(size + _form(p, back, p) / w[:, None], 0.0) * w.max())
    with np.errstate(divide="ignore"):
        return float(np.where(size > 0.0, rooms / size, np.inf).min()) * (1.0 - 1e-9)


def _form(a: Array, middle: Array, b: Array) -> Array:
    """Return a_k' middle b_k of the columns of a and b (n, R), (R,)."""
    return np.einsum("nk,nm,mk->k", a, middle, b)


# ---- inputs that are held ------------------------------------------------------------------------


def stays_when_held(parts: Parts, settings: Settings, region: RegionCertificate) -> bool | None:
    """Tell whether the sum that falls in continuous time does so in held steps too.

    The slopes of each corner of the hull are held over a step, which is exact where there is one.
    None where the formation is too large to say.
    """
    gain = parts.drive.gain
    assert isinstance(gain, Gain)
    n, linear, hull = len(gain.P), linearize(parts.model), region.hull
    varies = hull.shape[2] == 2 * n
    A, feels = hull[:, :, :n], linear.B @ gain.R_inverse @ linear.B.T
    W = hull[:, :, n:] if varies else np.broadcast_to(feels, A.shape)
    inner = np.zeros((n, n)) if gain.inner is None else linear.B @ gain.inner
    flow, held = _held_flow(A + inner, settings.dt)
    own, felt = flow - held @ inner, gain.coupling * held @ W @ gain.P
    root = np.linalg.cholesky(gain.P).T
    back = np.linalg.inv(root)
    own, felt = root @ own @ back, root @ felt @ back
    spectrum = parts.graph.spectrum()
    if spectrum.sums is None and spectrum.weakest is None:
        # The norm is convex in lambda, so that the extremes speak for all.
        ends = (own - k * felt for k in (spectrum.low, spectrum.high))
        most = max(float(np.linalg.norm(each, 2, (1, 2)).max()) for each in ends)
    else:
        L = parts.graph.grounded_laplacian().toarray()
        if parts.graph.schedule is not None or len(L) * n > _WHOLE:
            return None
        w = np.sqrt(np.ones(len(L)) if spectrum.sums is None else spectrum.sums)
        L, one = w[:, None] * L / w, np.eye(len(L))
        wholes = (np.kron(one, a) - np.kron(L, b) for a, b in zip(own, felt, strict=True))
        most = max(float(np.linalg.norm(each, 2)) for each in wholes)
    return most <= 1.0 + _ROUNDING * float(np.linalg.cond(root))


def _held_flow(A: Array, dt: float) -> tuple[Array, Array]:
    """Return exp(A dt) and its integral over dt of matrices (K, n, n)."""
    n = A.shape[1]
    block = np.zeros((len(A), 2 * n, 2 * n))
    block[:, :n, :n], block[:, :n, n:] = A, np.eye(n)
    flow = scipy.linalg.expm(block * dt)
    return flow[:, :n, :n], flow[:, :n, n:]


def held_line(parts: Parts, settings: Settings, region: RegionCertificate) -> Statement:
    """Return whether the sum of a theorem, which is of continuous time, falls in held steps too."""
    name, kind, dt = Hypothesis.HELD, Kind.VERTICES, f"{at_least(1e3 * settings.dt)} ms"
    stays = stays_when_held(parts, settings, region)
    if stays:
        text = "the sum of delta'P delta falls in held steps too, at each corner of the slopes"
        return holds(name, kind, text, settings.dt, dt)
    text = f"the sum of delta'P delta is not known to fall if inputs are held for {dt}"
    remedy, condition = "shorten `simulation.dt`, or lower the gain", "inputs act at every instant"
    return left_to_run(name, condition, text, settings.dt, dt, remedy, kind)
