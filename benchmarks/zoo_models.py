"""Families of models for the zoo: differences of any period, any units, leaders' inputs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from zoo_linear import Family, Finding, consensus_parts, silent

import echelon as ech
from echelon.core.words import Theorem

_STEPS = 1500


def integrate(
    rate: Callable[[float, np.ndarray], np.ndarray], x: np.ndarray, end: float, steps: int = _STEPS
) -> np.ndarray:
    """Return the path (steps + 1, ...) by Runge and Kutta's method."""
    h, path = end / steps, [x]
    with np.errstate(all="ignore"):
        for k in range(steps):
            t = k * h
            k1 = rate(t, x)
            k2 = rate(t + 0.5 * h, x + 0.5 * h * k1)
            k3 = rate(t + 0.5 * h, x + 0.5 * h * k2)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rate(t + h, x + h * k3))
            path.append(x)
    return np.stack(path)


def drawn_graph(rng: np.random.Generator, most: int = 7) -> tuple[ech.Graph, np.ndarray]:
    """Return a drawn tree or ring led by agent 0, and its Laplacian (N, N) with row 0 empty."""
    agents = int(rng.integers(2, most))
    edges = [
        (int(rng.integers(0, k)), k, float(10.0 ** rng.uniform(-0.5, 0.5)))
        for k in range(1, agents)
    ]
    if agents > 3 and rng.random() < 0.5:
        edges = [(min(k, (k + 1) % agents), max(k, (k + 1) % agents), 1.0) for k in range(agents)]
    L = np.zeros((agents, agents))
    for i, j, weight in edges:
        L[i, j] -= weight
        L[j, i] -= weight
    L -= np.diag(L.sum(axis=1))
    L[0] = 0.0
    return ech.Graph(edges, agents=agents), L


# ---- differences of any period -------------------------------------------------------------------


@dataclass(frozen=True)
class Dials:
    """Agents with a state of any period, and perhaps an open one, in any array module."""

    period: float | None
    slope: float
    bend: float
    order: int
    nearest: bool

    def drift(self, xp: Any, x: Any) -> Any:
        """Return f of states (..., n)."""
        wave = 2.0 * np.pi / (self.period or 10.0)
        push = self.bend / wave * xp.sin(wave * x[..., 0]) - self.slope * x[..., -1]
        rows = [push] if self.order == 1 else [x[..., 1], push]
        return xp.stack(rows, axis=-1)

    def difference(self, xp: Any, x: Any, y: Any) -> Any:
        """Return the first state's shorter way, and the rest plainly."""
        d, T = x - y, self.period
        if T is None:
            return d
        first = d[..., :1]
        turn = first - T * xp.round(first / T)
        turn = turn if self.nearest else (first + 0.5 * T) % T - 0.5 * T
        return xp.concatenate([turn, d[..., 1:]], axis=-1)

    def model(self) -> ech.ControlAffine:
        """Return it for echelon."""
        dials = self

        class Dial(ech.ControlAffine):
            state_names = ("angle", "rate")[: dials.order]
            input_names = ("push",)

            def drift(self, x: jax.Array) -> jax.Array:
                return dials.drift(jnp, x)

            def input_map(self, x: jax.Array) -> jax.Array:
                return jnp.eye(dials.order, dtype=x.dtype)[:, -1:]

            def difference(self, x: jax.Array, y: jax.Array) -> jax.Array:
                return dials.difference(jnp, x, y)

        return Dial()

    def rate(self, L: np.ndarray, gain: ech.Gain) -> Callable[[float, np.ndarray], np.ndarray]:
        """Return xdot of all agents (S, N, n) under the law."""
        K = gain.coupling * np.linalg.solve(gain.R, gain.P[-1:])

        def moved(t: float, x: np.ndarray) -> np.ndarray:
            pairs = self.difference(np, x[:, :, None], x[:, None])
            z = np.einsum("ij,sijn->sin", -L + np.diag(L.diagonal()), pairs)
            push = np.zeros_like(x)
            push[..., -1:] = -z @ K.T
            return self.drift(np, x) + push

        return moved


def any_difference(rng: np.random.Generator) -> Finding:
    """A `difference` of the user's of any period, beside open states."""
    periods = [None, 1.0, 2.0 * np.pi, 360.0, 24.0, float(10.0 ** rng.uniform(-3.0, 5.0))]
    dials = Dials(
        period=periods[rng.integers(6)],
        slope=float(rng.uniform(-0.3, 1.5)),
        bend=float(rng.normal() * (rng.random() < 0.4)),
        order=int(rng.integers(1, 3)),
        nearest=bool(rng.integers(2)),
    )
    size = dials.period or 10.0
    bounded = bool(dials.bend) or rng.random() < 0.5
    domain = {"angle": float(size * rng.uniform(0.05, 0.6))} if bounded else {}
    graph, L = drawn_graph(rng)
    methods = [ech.gains.RobustLQR(domain), ech.gains.Contraction(domain, rate=0.2)]
    method = [*methods, ech.gains.Riccati()][rng.integers(3)]
    model = dials.model()
    try:
        gain = ech.synthesize(model, graph, method)
        answer = ech.guarantee(consensus_parts(model, graph, gain), ech.Settings(1e-3, 1e-4))
    except ech.EchelonError as error:
        return silent(str(error))
    rate, n, N = dials.rate(L, gain), dials.order, graph.agents
    away = rng.normal(size=(6, N, n))
    away[:, 0] = 0.0
    fast = 2.0 + gain.coupling * np.abs(L).sum(axis=1).max() * np.abs(gain.P[-1]).max()
    fast = fast / float(gain.R[0, 0]) + abs(dials.slope) + abs(dials.bend)
    horizon = 0.5 * _STEPS / fast
    near = integrate(rate, 1e-6 * size * away, horizon)
    first, last = (float(np.abs(near[k]).max()) for k in (0, -1))
    decays = last < 1e-2 * first
    if not answer.promised:
        return silent((*answer.reasons, *answer.conditions)[0], bool(decays))
    stated, false = answer.rate or 0.0, list[str]()
    if not last <= first * (1e3 * np.exp(-0.5 * stated * horizon) + 1e-9):
        false.append(f"near: {first} became {last} in {horizon} s at {stated}")
    if answer.certified is not None and answer.certified.radius:
        false += _from_the_edge(dials, rate, gain, answer, away, horizon)
    return Finding(True, tuple(false), decays)


def _from_the_edge(
    dials: Dials, rate: Any, gain: ech.Gain, answer: ech.Guarantee, away: np.ndarray, horizon: float
) -> list[str]:
    assert answer.certified is not None
    radius, N = answer.certified.radius, away.shape[1]
    if np.isinf(radius):
        # Everywhere: from far, and twisted once where there is a period.
        starts = 50.0 * (dials.period or 10.0) * away
        if dials.period:
            starts[0] = 0.0
            starts[0, :, 0] = dials.period * np.arange(N) / N
        ends = integrate(rate, starts, horizon)[-1]
        first, last = (float(np.abs(x - x[:, :1]).max()) for x in (starts, ends))
        late = last > first * (1e3 * np.exp(-0.5 * (answer.rate or 0.0) * horizon) + 1e-9)
        return [f"everywhere: {first} became {last}"] if late else []
    V = np.einsum("sia,ab,sib->s", away, gain.P, away)
    # Short enough that the steps are much finer than the tolerance.
    horizon = min(horizon, 2.0 / max(answer.rate or 0.0, 1e-3))
    path = integrate(rate, radius * away / np.sqrt(V)[:, None, None], horizon)
    e = dials.difference(np, path, path[:, :, :1])
    v = np.einsum("tsia,ab,tsib->ts", e, gain.P, e)
    times = np.linspace(0.0, horizon, len(v))[:, None]
    share = 2.0 * (0.0 if answer.theorem is Theorem.A5 else answer.rate or 0.0)
    over = v > v[0] * np.exp(-share * times) * (1.0 + 1e-5) + 1e-9 * v[0]
    return [f"from the edge: {float((v / v[0]).max())} of V"] if over.any() else []


# ---- the same system in other units --------------------------------------------------------------


def other_units(rng: np.random.Generator) -> Finding:
    """A system, perhaps with a kink, in the units of its own and in others from 1e-8 to 1e8."""
    n = int(rng.integers(2, 4))
    A = np.eye(n, k=1) - np.diag(rng.uniform(0.0, 1.5, n) * (rng.random(n) < 0.6))
    slow, bent = float(10.0 ** rng.uniform(-5.0, 3.0)), int(rng.integers(n))
    kink = float(rng.normal(scale=3.0)) * (rng.random() < 0.3)
    D = 10.0 ** rng.integers(-8, 9, n).astype(float) if rng.random() < 0.5 else np.full(n, 1.0)
    D = D * 10.0 ** float(rng.integers(-8, 9))

    def model(D: np.ndarray) -> ech.ControlAffine:
        class Scaled(ech.ControlAffine):
            state_names, input_names = tuple(f"x{k}" for k in range(n)), ("u",)
            # Weighted by a time in seconds, so that a slow system is the same one.
            weights = (tuple((slow / D**2).tolist()), (1.0 / slow,))

            def drift(self, x: jax.Array) -> jax.Array:
                y = x / D
                corner = kink * jnp.where(y[bent] > 0.0, y[bent], 0.0)
                return jnp.asarray(slow * D) * (jnp.asarray(A) @ y).at[-1].add(corner)

            def input_map(self, x: jax.Array) -> jax.Array:
                return jnp.asarray(D * np.eye(n)[-1])[:, None]

        return Scaled()

    graph, L = drawn_graph(rng, 5)
    dt = 1e-4 / slow

    def ask(D: np.ndarray) -> tuple[ech.Guarantee | None, Any]:
        try:
            gain = ech.synthesize(model(D), graph, ech.gains.Riccati())
        except ech.EchelonError as error:
            return None, str(error)
        return ech.guarantee(consensus_parts(model(D), graph, gain), ech.Settings(dt, dt)), gain

    (base, gain), (scaled, other) = ask(np.ones(n)), ask(D)
    if base is None:
        false = ("a gain in other units alone",) * (scaled is not None)
        return Finding(bool(false), false, why=str(gain)[:90])
    if scaled is None:
        return silent(f"no gain in other units: {other}", base.promised)
    K = gain.coupling / gain.R[0, 0] * gain.P[-1]

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        corner = kink * np.maximum(y[..., bent], 0.0)
        push = corner - (L @ y) @ K / slow
        return y @ A.T + push[..., None] * np.eye(n)[-1]

    starts = 1e-3 * rng.normal(size=(8, graph.agents, n))
    starts[:, 0] = 0.0
    starts[1::2] = -starts[::2]
    fast = np.abs(A).sum() + abs(kink) + np.abs(L).sum(axis=1).max() * np.abs(K).sum() / slow
    path = integrate(rate, starts, 0.5 * _STEPS / fast)
    first, last = (float(np.abs(path[k]).max()) for k in (0, -1))
    holds, false = bool(last < 1e-2 * first), list[str]()
    K_other = other.coupling / other.R[0, 0] * other.P[-1] * D * D[-1]
    if np.abs(K_other - K).max() > 1e-6 * np.abs(K).max():
        false.append(f"another gain in other units, {D}")
    if scaled.promised and not base.promised:
        false.append(f"guaranteed in other units alone, {D}")
    if base.promised and not scaled.promised:
        return silent(f"refused in other units: {scaled.reasons[0]}", holds)
    if base.promised and scaled.promised:
        # Rounding over decades is left.
        if abs((base.rate or 0.0) - (scaled.rate or 0.0)) > 1e-3 * (base.rate or 0.0):
            false.append(f"another rate in other units, {D}: {base.rate}, {scaled.rate}")
        decay = 1e3 * np.exp(-0.5 * (base.rate or 0.0) / slow * 0.5 * _STEPS / fast)
        if not last <= first * decay:
            false.append(f"{first} became {last}")
    if not (base.promised or scaled.promised):
        return silent(base.reasons[0], holds)
    return Finding(True, tuple(false), holds)


# ---- leaders' inputs outside of the domain -------------------------------------------------------


class Swing(ech.Law):
    """A leader with an input of its own, whatever it sees."""

    push: float = 0.9
    pace: float = 3.0

    def update(self, model: Any, view: Any, memory: Any) -> Any:
        """Return the input."""
        m = len(model.input_names)
        turns = self.pace * view.t + 0.5 * jnp.pi * jnp.arange(m)
        return self.push * jnp.sin(turns), memory


def leaders_inputs(rng: np.random.Generator) -> Finding:
    """Where g varies: leaders with inputs in and beyond what a domain states."""
    n, a, b = int(rng.integers(1, 3)), float(rng.uniform(0.0, 1.0)), float(rng.uniform(-0.6, 0.6))
    bend, pace = float(rng.normal() * rng.integers(2)), float(rng.uniform(0.5, 6.0))

    def drift(xp: Any, x: Any) -> Any:
        return -a * x + bend * (xp.sin(x) - x)

    class Growing(ech.ControlAffine):
        state_names, input_names = ("x", "y")[:n], ("vx", "vy")[:n]

        def drift(self, x: jax.Array) -> jax.Array:
            return drift(jnp, x)

        def input_map(self, x: jax.Array) -> jax.Array:
            return jnp.diag(1.0 + b * x)

    wide, push = float(rng.uniform(0.2, 1.0)), float(rng.uniform(0.05, 1.5))
    domain = dict.fromkeys(Growing.state_names, wide)
    for name in Growing.input_names:
        if rng.random() < 0.7:
            domain[name] = float(rng.uniform(0.3, 1.5))
    method = (ech.gains.RobustLQR, ech.gains.Contraction)[rng.integers(2)](domain)
    model, (graph, L) = Growing(), drawn_graph(rng, 5)
    horizon = 4.0
    try:
        gain = ech.synthesize(model, graph, method)
        law = ech.laws.Consensus(gain, feedforward="relay")
        goals = ech.Formation(np.zeros((graph.agents, n)))
        parts = ech.Parts(model, graph, goals, ech.Laws(Swing(push, pace), law))
        answer = ech.guarantee(parts, ech.Settings(horizon, 0.002))
    except ech.EchelonError as error:
        return silent(str(error))
    covered = answer.promised and answer.theorem in (Theorem.T1, Theorem.T2)

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        G = 1.0 + b * x
        u = push * np.sin(pace * t + 0.5 * np.pi * np.arange(n))
        pull = gain.coupling * (G * ((L @ x) @ gain.P)) @ np.linalg.inv(gain.R)
        return drift(np, x) + G * (u - pull)

    away = 1e-6 * rng.normal(size=(4, graph.agents, n))
    away[:, 0] = 0.0
    path = integrate(rate, away, horizon)
    e = path - path[:, :, :1]
    v = np.einsum("tsia,ab,tsib->ts", e, gain.P, e)
    holds = bool(v[-1].max() < 1e-2 * v[0].max())
    if not covered:
        # Guarantees at the trim say nothing of a leader that goes far.
        near = Finding(True, holds=holds, why="at the trim alone")
        return near if answer.promised else silent(answer.reasons[0], holds)
    times = np.linspace(0.0, horizon, len(v))[:, None]
    over = v > v[0] * np.exp(-2.0 * (answer.rate or 0.0) * times) * (1.0 + 1e-3)
    # What rounding leaves of errors of 1e-6 is nothing of the law's.
    over &= v > 1e-24
    text = f"V is {float((v / v[0]).max())} of its start behind inputs of {push}"
    return Finding(True, (text,) if over.any() else (), holds)


MODELS: dict[str, Family] = {
    "differences": any_difference,
    "units": other_units,
    "leaders' inputs": leaders_inputs,
}
