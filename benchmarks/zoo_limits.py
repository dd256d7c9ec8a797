"""A family of the zoo: agents whose inputs have limits, flown with limits that act.

What is guaranteed is false if a limit acts where none may, and if the agents do not converge. It is
counted too how often something is guaranteed at half of the region of attraction with limits.
"""

from dataclasses import dataclass, fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from held_loops import drawn_graphs
from zoo_linear import Family, Finding, silent
from zoo_paths import Cart

import echelon as ech
from echelon.core.words import GuaranteeVerdict, Theorem

_MOST = 1200
"""Steps of a flight."""
_CLOSE = 1e-9
"""Relative; a limit that acts by less is one of rounding."""
_LOCAL = None, Theorem.T2
"""What speaks of small errors alone: nothing is said of how small."""


# ---- agents in any array module -----------------------------------------------------------------


@dataclass(frozen=True)
class Plant:
    """An agent x' = f(x) + g(x) u with low <= G u <= high, in the units D of states, E of inputs.

    Attributes:
        kind: what bends; `linear` for nothing.
        size: of what bends.
        rest: the input at rest.
    """

    kind: str
    A: np.ndarray
    B: np.ndarray
    size: np.ndarray
    rest: tuple[float, ...]
    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray
    D: np.ndarray
    E: np.ndarray

    def drift(self, xp: Any, x: Any) -> Any:
        """Return f of states (..., n), without what the input at rest adds."""
        y = x / self.D
        if self.kind == "planar quadrotor":
            lost = 0.0 * y[..., 2]
            parts = y[..., 3], y[..., 4], y[..., 5], lost, lost - 9.81, lost
            return self.D * xp.stack(parts, axis=-1)
        bend = {"pendulum": xp.sin(y) - y, "cubic": -(y**3)}
        place = -1 if self.kind == "cubic" else 0
        more = xp.concatenate([0.0 * y[..., 1:], bend.get(self.kind, 0.0 * y)[..., [place]]], -1)
        held = self.map_of(xp, 0.0 * x) @ xp.asarray(self.rest)
        return self.D * (y @ self.A.T + self.size * more) - held

    def map(self, xp: Any, x: Any) -> Any:
        """Return g of states (..., n), (..., n, m)."""
        y, G = x / self.D, self.B / self.E[None]
        if self.kind == "planar quadrotor":
            tilt, one = y[..., 2], 0.0 * y[..., 2] + 1.0
            lift = xp.stack([0 * one, 0 * one, 0 * one, -xp.sin(tilt), xp.cos(tilt), 0 * one], -1)
            turn = 0.0 * y + self.B[:, 1]
            return self.D[:, None] * xp.stack([lift, turn], axis=-1) / self.E[None]
        factor = 1.0 + 0.3 * xp.sin(y[..., 0]) if self.kind == "varying" else 1.0 + 0.0 * y[..., 0]
        return factor[..., None, None] * (self.D[:, None] * G)

    map_of = map

    def clip(self, u: np.ndarray) -> np.ndarray:
        """Return what limits leave of inputs (..., m)."""
        rows = u @ self.rows.T
        held = np.clip(rows, self.low, self.high)
        return np.where((rows == held).all(-1, keepdims=True), u, held @ np.linalg.inv(self.rows).T)

    def room(self, u: np.ndarray) -> np.ndarray:
        """Return by how much inputs (..., m) are within their limits, relative to the range."""
        rows = u @ self.rows.T
        wide = np.where(np.isfinite(self.high - self.low), self.high - self.low, 1.0)
        return (np.minimum(self.high - rows, rows - self.low) / wide).min(axis=-1)

    def model(self) -> ech.ControlAffine:
        """Return it for echelon."""
        return Limited(**{field.name: getattr(self, field.name) for field in fields(self)})


class Limited(ech.ControlAffine):
    """The same agent for echelon; numbers are arrays, so that agents of one shape compile once."""

    kind: str = eqx.field(static=True)
    A: Any
    B: Any
    size: Any
    rest: tuple[float, ...] = eqx.field(static=True)
    rows: Any
    low: Any
    high: Any
    D: Any
    E: Any

    drift_of, map_of = Plant.drift, Plant.map

    @property
    def state_names(self) -> tuple[str, ...]:
        """Numbered."""
        return tuple(f"x{k}" for k in range(self.B.shape[0]))

    @property
    def input_names(self) -> tuple[str, ...]:
        """Numbered."""
        return tuple(f"u{k}" for k in range(self.B.shape[1]))

    @property
    def trim(self) -> Any:
        """Return the origin, and the input that holds it."""
        return (0.0,) * self.B.shape[0], self.rest

    @property
    def weights(self) -> Any:
        """Return the same weights whatever the units."""
        return 1.0 / self.D**2, 1.0 / self.E**2

    @property
    def input_limits(self) -> Any:
        """Return its limits."""
        return ech.models.Limits(self.rows, self.low, self.high)

    def drift(self, x: jax.Array) -> jax.Array:
        """Return f."""
        return self.drift_of(jnp, x)

    def input_map(self, x: jax.Array) -> jax.Array:
        """Return g."""
        return self.map_of(jnp, x)


_KINDS = [*["linear"] * 3, *["chain"] * 4, "pendulum", "cubic", "varying", "planar quadrotor"]


def drawn_plant(rng: np.random.Generator) -> Plant:
    """Return an agent with limits: two-sided or one-sided, near the trim, of rows that couple."""
    kind = str(rng.choice(_KINDS))
    n, m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    if kind == "planar quadrotor":
        A, B = np.zeros((6, 6)), np.zeros((6, 2))
        A[:3, 3:], B[4, 0], B[5, 1] = np.eye(3), 1.0, float(rng.uniform(2.0, 10.0))
        A[3, 2] = -9.81
    elif kind != "linear":
        n = 2 + (kind == "chain" and rng.random() < 0.3)
        A, B = np.eye(n, k=1), np.eye(n)[:, -1:]
        A[-1, -1] = -rng.uniform(0.0, 1.0) * rng.integers(2)
        A[-1, 0] = -float(rng.uniform(0.5, 2.0)) * (kind == "pendulum")
    else:
        A = rng.normal(size=(n, n)) - float(rng.uniform(0.0, 1.5)) * np.eye(n)
        # Leaders that leave their trim by themselves are another matter.
        A -= max(float(np.linalg.eigvals(A).real.max()) + 0.02, 0.0) * np.eye(n)
        B = rng.normal(size=(n, m))
    size = rng.uniform(0.3, 1.5, 1) * (-A[-1, 0] if kind == "pendulum" else 1.0)
    n, m = B.shape
    rest = np.array([9.81, 0.0]) if kind == "planar quadrotor" else np.array([0.7, -0.4])[:m]
    rest = rest * (kind == "planar quadrotor" or rng.integers(2))
    rows = np.eye(m)
    if kind == "planar quadrotor":
        rows = np.array([[0.5, 0.5], [0.5, -0.5]])
    elif m > 1 and rng.integers(2):
        rows = rng.normal(size=(m, m)) + 2.0 * np.eye(m)
    # From a millionth of its size to all of it on either side of the trim.
    wide = 10.0 ** rng.uniform(-2.0, 1.0, (2, m)) * 10.0 ** (-4.0 * (rng.random() < 0.1))
    wide = np.where(rng.random((2, m)) < 0.15, np.inf, wide)
    low, high = rows @ rest - wide[0], rows @ rest + wide[1]
    D = 10.0 ** rng.integers(-3, 4, n).astype(float) if rng.random() < 0.4 else np.ones(n)
    E = float(10.0 ** rng.choice([-3, 3])) * np.ones(m) if rng.random() < 0.3 else np.ones(m)
    rows = rows / E
    return Plant(kind, A, B, size, tuple((rest * E).tolist()), rows, low, high, D, E)


# ---- a formation, flown with inputs that are held -----------------------------------------------


@dataclass(frozen=True)
class Formation:
    """Agents under u = u_0 - c R^-1 g'P z, on a graph with the Laplacian L; leaders come first."""

    plant: Plant
    L: np.ndarray
    leaders: int
    gain: ech.Gain
    offsets: np.ndarray
    led: np.ndarray
    dt: float

    def asked(self, x: np.ndarray) -> np.ndarray:
        """Return the inputs (S, N, m) that agents ask for, of states (S, N, n)."""
        G = self.plant.map(np, x)
        z = self.L @ (x - self.offsets)
        pull = np.einsum("...im,...i->...m", G, z @ self.gain.P)
        return self.plant.rest - self.gain.coupling * pull @ np.linalg.inv(self.gain.R)

    def fly(self, away: np.ndarray, horizon: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the sizes of errors (steps + 1, S) from deviations (S, N, n), and rooms (S,)."""
        x, h = self.offsets + self.led + away, self.dt
        room, sizes = np.full(len(away), np.inf), [self.size(x)]
        with np.errstate(all="ignore"):
            for _ in range(min(int(horizon / self.dt), _MOST)):
                u = self.asked(x)
                room = np.minimum(room, self.plant.room(u[:, self.leaders :]).min(axis=1))
                u = self.plant.clip(u)
                a = self._rate(x, u)
                b = self._rate(x + 0.5 * h * a, u)
                c = self._rate(x + 0.5 * h * b, u)
                x = x + h / 6.0 * (a + 2.0 * b + 2.0 * c + self._rate(x + h * c, u))
                sizes.append(self.size(x))
        return np.stack(sizes), room

    def _rate(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return self.plant.drift(np, x) + np.einsum("...im,...m->...i", self.plant.map(np, x), u)

    def size(self, x: np.ndarray) -> np.ndarray:
        """Return the largest error (S,), in units of the plant."""
        e = x - self.offsets
        return np.abs((e - e[:, :1]) / self.plant.D).max(axis=(1, 2))

    def modes(self) -> np.ndarray:
        """Return the eigenvalues of the loop without limits, of errors to the first leader."""
        N, n = self.offsets.shape
        step, rest = 1e-6 * self.plant.D, np.zeros((1, N, n))
        columns = []
        for k in range(self.leaders * n, N * n):
            ends = []
            for side in (1.0, -1.0):
                x = rest.copy()
                x.reshape(-1)[k] += side * step[k % n]
                u = self.asked(self.offsets + x)
                ends.append(self._rate(x, u)[0, self.leaders :].reshape(-1))
            columns.append((ends[0] - ends[1]) / (2.0 * step[k % n]))
        return np.linalg.eigvals(np.array(columns).T)

    def horizon(self) -> float:
        """Return after how long errors are gone that shrink without limits, s."""
        slowest = max(-float(self.modes().real.max()), 1e-3)
        return 8.0 / slowest + 5.0

    def outcome(self, away: np.ndarray) -> tuple[list[bool | None], np.ndarray]:
        """Return of each start whether errors end, None where it is not decided, and rooms."""
        sizes, room = self.fly(away, 3.0 * self.horizon())
        first, last, before = sizes[0], sizes[-1], sizes[-1 - len(sizes) // 4]
        ends = last < 0.05 * first
        lost = ~(last < 0.9 * first) & ~(last < 0.99 * before)
        return [True if a else False if b else None for a, b in zip(ends, lost)], room

    def onset(self, away: np.ndarray) -> float:
        """Return by what factor a deviation (N, n) takes an input to its limit at the start."""
        scales = np.geomspace(1e-9, 1e9, 10_000)
        u = self.asked(self.offsets + self.led + scales[:, None, None] * away)[:, self.leaders :]
        beyond = np.flatnonzero(self.plant.room(u).min(axis=1) < 0.0)
        return float(scales[beyond[0]]) if len(beyond) else float("inf")


_SCALES = np.geomspace(0.25, 250.0, 24)


def attraction(formation: Formation, away: np.ndarray) -> float:
    """Return up to what factor of a deviation errors end; infinite if far beyond limits too."""
    scales = formation.onset(away) * _SCALES
    for first in (True, False):
        ends, _room = formation.outcome(scales[:, None, None] * away)
        if first and ends[0] is not True:
            return 0.0  # at the goals held inputs may swing between their limits
        # Where that is not decided the region is taken for larger.
        lost = [k for k, end in enumerate(ends) if end is False]
        if not lost:
            return float("inf")
        if not lost[0]:
            return 0.0
        scales = np.geomspace(scales[lost[0] - 1], scales[lost[0]], 12)
    return float(scales[max(lost[0] - 1, 0)]) if lost else float(scales[-1])


def limited_inputs(rng: np.random.Generator) -> Finding:
    """Formations with limits, from inside and outside of what is certified."""
    plant, directed = drawn_plant(rng), bool(rng.random() < 0.3)
    n, m = plant.B.shape
    [edges], [grounded], N = drawn_graphs(rng, directed, 1)
    while N not in (3, 5):
        [edges], [grounded], N = drawn_graphs(rng, directed, 1)
    L = np.zeros((N, N))
    L[1:, 1:] = grounded
    L[1:, 0] = -grounded.sum(axis=1)
    leaders, graph = 1, ech.Graph(edges, agents=N, directed=directed)
    if not directed and rng.random() < 0.2:
        leaders, graph = 2, ech.Graph(edges, (0, 1), N)
        L[1] = 0.0
    offsets = np.zeros((N, n))
    if not plant.A[:, 0].any() and plant.kind != "varying":
        offsets[:, 0] = plant.D[0] * rng.normal(size=N) * rng.integers(2)
    dt = float(rng.choice([0.02, 0.05, 0.1, 0.2]))
    # Leaders may move: all then start off the trim by as much.
    led = plant.D * rng.normal(size=n) * float(rng.choice([0.0, 0.0, 0.1, 1.0]))
    bounded = plant.kind not in ("linear", "chain") or rng.random() < 0.3
    wide = rng.uniform(0.3, 3.0, n) * plant.D
    domain = {f"x{k}": float(wide[k]) for k in range(n) if bounded}
    methods = ech.gains.RobustLQR, ech.gains.Contraction, ech.gains.Monotone
    method = methods[rng.choice(3, p=[0.5, 0.3, 0.2])](domain)
    model, settings = plant.model(), ech.Settings(dt * 200, dt)
    try:
        gain = ech.synthesize(model, graph, method)
        law = ech.laws.Consensus(gain, feedforward="relay")
        goals, drive = ech.Formation(offsets), ech.Laws(ech.laws.TrimInput(), law)
        parts = ech.Parts(model, graph, goals, drive, initial=offsets + led)
        answer = ech.guarantee(parts, settings)
    except ech.EchelonError as error:
        return silent(str(error))
    formation = Formation(plant, L, leaders, gain, offsets, led, dt)
    away = rng.normal(size=(N, n)) * plant.D
    away[:leaders] = 0.0
    # As long as what is flown, since a run may enter what is certified.
    long = settings._replace(horizon=dt * min(int(3.0 * formation.horizon() / dt), _MOST))

    def ask(away: np.ndarray) -> ech.Guarantee:
        return ech.guarantee(parts.replace(initial=offsets + led + away), long)

    size = float(np.sqrt(np.einsum("ia,ab,ib->", away, gain.P, away)))
    certified = answer.certified.radius if answer.certified is not None else 0.0
    inside = [away * share * certified / size for share in (0.5, 0.999) if certified < np.inf]
    inside += [worst * certified for worst in _worst(formation) if certified < np.inf]
    inside = [each for each in inside if each.any()]
    false, local = list[str](), list[str]()
    if answer.verdict is GuaranteeVerdict.GUARANTEED and inside:
        ends, room = formation.outcome(np.stack(inside))
        for k, (end, left) in enumerate(zip(ends, room)):
            if left < -_CLOSE:
                false.append(f"inside, start {k}: beyond a limit by {-left} of its range")
            if end is False and answer.theorem is not Theorem.A5:
                false.append(f"inside, start {k}: does not converge")
    scale, edge = formation.onset(away), float("inf")
    if np.isfinite(scale):
        factors = scale * np.array([0.9, 3.0, 30.0])
        ends, room = formation.outcome(factors[:, None, None] * away)
        for factor, end, left in zip(factors, ends, room):
            told = ask(factor * away) if end is False and left < -_CLOSE else None
            if told is not None and told.verdict is GuaranteeVerdict.GUARANTEED:
                what = (
                    f"{told.theorem}, {factor / scale:.2g} of what limits bear at the start: lost"
                )
                (local if told.theorem in _LOCAL else false).append(what)
        edge = attraction(formation, away)
    half = None
    if 0.0 < edge < np.inf:
        told = ask(0.5 * edge * away)
        half = "local" if told.promised and told.theorem in _LOCAL else str(told.verdict)
    why = "" if answer.promised else (*answer.reasons, *answer.conditions)[0][:90]
    return Finding(answer.promised, tuple(false), edge > 0.0, why, half, tuple(local))


def _worst(formation: Formation) -> list[np.ndarray]:
    """Return deviations (N, n) of size 1 that ask most of a row of limits of each follower."""
    found, plant, gain = list[np.ndarray](), formation.plant, formation.gain
    G = plant.map(np, np.zeros(len(plant.A)))
    K = gain.coupling * plant.rows @ np.linalg.inv(gain.R) @ G.T @ gain.P
    back = np.linalg.inv(gain.P)
    free = np.arange(len(formation.L)) >= formation.leaders
    for heard in formation.L[formation.leaders :] * free:
        for row in K:
            worst = np.outer(heard, back @ row)
            size = np.sqrt(np.einsum("ia,ab,ib->", worst, gain.P, worst))
            found += [0.999999 * worst / size, -0.999999 * worst / size] if size else []
    return found


# ---- linear chains under stopping points --------------------------------------------------------


class Crane(Cart):
    """A cart with limits, whose drag may be one that its `flat` knows nothing of."""

    rows: Any = None
    low: Any = None
    high: Any = None
    unsaid: float = 0.0

    @property
    def input_limits(self) -> Any:
        """Return its limits."""
        return ech.models.Limits(self.rows, self.low, self.high)

    def drift(self, x: jax.Array) -> jax.Array:
        """Return f."""
        return super().drift(x).at[2:].add(-self.unsaid * x[2:])


@dataclass(frozen=True)
class Chase:
    """Carts under stopping points, (N, 4), in steps of dt: held inputs, and paths by the hour."""

    mass: float
    drag: float
    L: np.ndarray
    offsets: np.ndarray
    numbers: tuple[float, float, float, float, float]
    wide: float
    rate: float
    along: float
    dt: float

    def path(self, t: float) -> np.ndarray:
        """Return the leader's place, velocity and acceleration (3, 2): a circle or a line."""
        if not self.wide:
            return np.array([[self.along * t, 0.0], [self.along, 0.0], [0.0, 0.0]])
        w, s, k = self.rate, np.sin(self.rate * t), np.cos(self.rate * t)
        return self.wide * np.array([[k, s], [-w * s, w * k], [-w * w * k, -w * w * s]])

    def asked(self, t: float, x: np.ndarray) -> np.ndarray:
        """Return the forces (N, 2)."""
        root, c, speed, own, own_speed = self.numbers
        r, v = self.path(t), x[:, 2:]
        zeta = x[:, :2] - self.offsets[:, :2] + v / root

        def bounded(pull: np.ndarray, most: float) -> np.ndarray:
            return pull / np.sqrt(1.0 + (pull / most) ** 2)

        led = r[1] + r[2] / root - bounded(own * (zeta[0] - r[0] - r[1] / root), own_speed)
        rates = led - bounded(c * self.L @ zeta, speed)
        return self.mass * (root * (rates - v) + self.drag * v + np.array([0.0, 9.81]))

    def fly(self, x: np.ndarray, end: float, plant: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the forces (steps, N, 2) that are asked for, and the errors (steps, N)."""
        forces, errors = [], []
        for k in range(int(end / self.dt)):
            u = self.asked(k * self.dt, x)
            forces.append(u)
            y = x[:, :2] - self.offsets[:, :2]
            errors.append(np.abs(y - y[0]).max(axis=1))
            u = u if plant is None else Plant.clip(plant, u)
            pull = u / self.mass - np.array([0.0, 9.81])
            for _ in range(20):
                h, v = self.dt / 20.0, x[:, 2:]
                half = v + 0.5 * h * (pull - self.drag * v)
                x = x + h * np.concatenate([half, pull - self.drag * half], axis=1)
        return np.array(forces), np.array(errors)


def limited_chains(rng: np.random.Generator) -> Finding:
    """Carts under stopping points with limits somewhat below or above of what their flight asks."""
    N, dt, root = int(rng.integers(3, 6)), float(rng.choice([0.01, 0.05, 0.1])), 2.0
    root = float(rng.choice([1.0, 2.0, 4.0]))
    edges = [(int(rng.integers(0, k)), k, float(rng.uniform(0.5, 2.0))) for k in range(1, N)]
    L = np.zeros((N, N))
    for i, j, weight in edges:
        L[i, j] = L[j, i] = -weight
    L -= np.diag(L.sum(axis=1))
    heavy = float(L.diagonal()[1:].max())
    L[0] = 0.0
    c = float(rng.uniform(0.1, 0.6)) * min(1.0 / (heavy * dt * (1.0 + root * dt)), 2.0)
    own, speed, own_speed = 0.5, float(rng.uniform(0.3, 3.0)), float(rng.uniform(0.3, 2.0))
    mass, drag = float(rng.uniform(0.5, 2.0)), float(rng.uniform(0.0, 2.0) * rng.integers(2))
    unsaid = float(rng.uniform(0.5, 3.0) * (rng.random() < 0.3))
    offsets = np.zeros((N, 4))
    offsets[:, :2] = rng.normal(size=(N, 2)) * rng.integers(2)
    wide = float(rng.uniform(0.3, 2.0) * rng.integers(2))
    pace, along = float(rng.uniform(0.1, 1.0)), float(rng.uniform(-2.0, 2.0))
    numbers = root, c, speed, own, own_speed
    chase = Chase(mass, drag + unsaid, L, offsets, numbers, wide, pace, along, dt)
    starts = offsets + rng.normal(size=(N, 4)) * [3.0, 3.0, 0.5, 0.5]
    starts[0] = offsets[0] + np.concatenate(chase.path(0.0)[:2])
    starts[0] += rng.normal(size=4) * rng.integers(2)
    end = 8.0 / min(root, c * 0.2) if c > 0.5 else 60.0
    forces, free = chase.fly(starts, min(end, 60.0))
    rows = rng.normal(size=(2, 2)) + 2.0 * np.eye(2) if rng.integers(2) else np.eye(2)
    used = forces @ rows.T
    low, high, rest = used.min(axis=(0, 1)), used.max(axis=(0, 1)), rows @ [0.0, 9.81 * mass]
    factor = float(rng.choice([0.999, 1.05, 1.5, 2.0, 3.0, 10.0]))
    low, high = rest + factor * (low - rest) - 1e-6, rest + factor * (high - rest) + 1e-6
    if rng.random() < 0.6:
        high = np.maximum(high, 2.0 * rest - low)
        low = np.minimum(low, 2.0 * rest - high) if rng.integers(2) else np.full(2, -np.inf)
    model = Crane(mass, drag, 9.81, rows, low, high, unsaid)
    shared: dict[str, Any] = {"roots": (root,), "observer": False}
    zero = {"center": (0.0, 0.0, 0.0), "radius": wide, "rate": pace}
    reference = ech.references.Circle(**zero) if wide else ech.references.Line(
        start=(0.0, 0.0, 0.0), velocity=(along, 0.0, 0.0)
    )  # fmt: skip
    drive = ech.Laws(
        ech.laws.StoppingLeader(reference=reference, coupling=own, speed=own_speed, **shared),
        ech.laws.StoppingPoint(coupling=c, speed=speed, **shared),
    )
    try:
        graph, goals = ech.Graph.from_edges(edges, (0,), N), ech.Formation(offsets)
        parts = ech.Parts(model, graph, goals, drive, initial=starts)
        answer = ech.guarantee(parts, ech.Settings(60.0, dt))
    except ech.EchelonError as error:
        return silent(str(error))
    forces, errors = chase.fly(starts, 60.0, model)
    asked = forces @ rows.T
    beyond = float(np.maximum(asked - high, low - asked).max() / np.abs(used - rest).max())
    lost = not errors[-1].max() < 0.05 * max(errors[0].max(), 0.1)
    false = []
    if answer.promised and beyond > _CLOSE:
        what = ", and lost" if lost else ""
        false = [f"{answer.theorem}: beyond a limit by {beyond} of what is asked{what}"]
    why = "" if answer.promised else (*answer.reasons, *answer.conditions)[0][:90]
    return Finding(answer.promised, tuple(false), beyond <= 0.0 and not lost, why)


LIMITS: dict[str, Family] = {"limits": limited_inputs, "limits of chains": limited_chains}
