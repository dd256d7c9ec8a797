"""Bundled models of which a subclass changes one thing, for the zoo.

Inputs are those of agents of their own; their motion is integrated here.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from zoo_linear import Family, Finding, silent

import echelon as ech
from echelon.agents.models.model import Limits
from echelon.core.numerics import precision
from echelon.simulation.engine.prepare import prepare

_M = ech.models
_DT = 0.01
BASES: dict[str, tuple[Callable[[], Any], str]] = {
    "single": (lambda: _M.SingleIntegrator, "moving"),
    "double": (lambda: _M.DoubleIntegrator, "moving"),
    "pendulum": (lambda: _M.Pendulum, "rest"),
    "van der pol": (lambda: _M.VanDerPol, "rest"),
    "unicycle": (lambda: _M.Unicycle, "circle"),
    "quadrotor": (lambda: _M.Quadrotor, "hover"),
}
CHANGES = (
    "drift",
    "drift and declarations",
    "input map",
    "limit",
    "input limits",
    "parameters",
    "difference",
    "airframe",
    "flat bounds",
    "flat chains",
    "heading",
    "trim",
    "nothing",
)


def changed(base: Any, change: str, rng: np.random.Generator) -> Any:
    """Return an agent of a subclass that changes one thing."""
    size, n = float(rng.uniform(0.2, 3.0)), len(base().state_names)
    m, trim = len(base().input_names), [np.asarray(part, float) for part in base().trim]
    room = 10.0 ** rng.uniform(-1.5, 1.0)
    drag = {"drift": lambda self, x: base.drift(self, x).at[-1].add(-size * x[-1])}
    if n == 12:
        drag = {"drift": lambda self, x: base.drift(self, x).at[3:6].add(-size * x[3:6])}
    wide = room * (np.abs(trim[1]) + (not trim[1].any()))
    box = Limits(tuple(map(tuple, np.eye(m).tolist())), *(
        tuple((trim[1] + side * wide).tolist()) for side in (-1.0, 1.0)
    ))  # fmt: skip
    declared = {k: getattr(base, k) for k in ("flat_chains", "flat_bounds") if hasattr(base, k)}
    numbers = {k: getattr(base(), k) for k in ("damping", "mass", "drag") if hasattr(base(), k)}
    name, value = next(((k, v) for k, v in numbers.items() if isinstance(v, float)), ("none", 1.0))
    period = float(rng.choice([1.0, 2.0 * np.pi, 24.0]))
    body: dict[str, dict[str, Any]] = {
        "drift": drag,
        "drift and declarations": drag | declared,
        "input map": {"input_map": lambda self, x: size * base.input_map(self, x)},
        "limit": {"limit": lambda self, u: jnp.clip(u, box.low[0], box.high[0]) * 1.0},
        "input limits": {"input_limits": box},
        "parameters": {name: size * (value or 1.0)},
        "difference": {"difference": lambda self, x, y: _shorter(x - y, period)},
        "airframe": {"airframe": getattr(base(), "airframe", None)},
        "flat bounds": {k: v for k, v in declared.items() if k == "flat_bounds"},
        "flat chains": {k: v for k, v in declared.items() if k == "flat_chains"},
        "heading": {"heading": None},
        "trim": {"trim": ((0.5, *trim[0][1:].tolist()), tuple(trim[1].tolist()))},
        "nothing": {},
    }
    return type(base)("Changed", (base,), {"__module__": __name__, **body[change]})()


def _shorter(d: jax.Array, period: float) -> jax.Array:
    return d.at[0].set((d[0] + 0.5 * period) % period - 0.5 * period)


def fly(parts: ech.Parts, x: np.ndarray, horizon: float, limits: bool) -> np.ndarray:
    """Return the path (steps + 1, N, n) of agents that hold their inputs over steps."""
    agents = [ech.Agent(parts, k, _DT, limits) for k in range(len(x))]
    model, path = parts.model, [x]

    def one(x: jax.Array, u: jax.Array) -> jax.Array:
        k1 = model.velocity(x, u)
        k2 = model.velocity(x + 0.5 * _DT * k1, u)
        k3 = model.velocity(x + 0.5 * _DT * k2, u)
        return x + _DT / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + model.velocity(x + _DT * k3, u))

    move = jax.jit(jax.vmap(one))
    order = sorted(range(len(x)), key=lambda k: k not in parts.graph.leaders)
    for step in range(int(np.ceil(horizon / _DT))):
        greetings = [agent.hello(x[k]) for k, agent in enumerate(agents)]
        for agent in agents:
            for j in agent.neighbours:
                agent.receive(greetings[j])
        inputs = [np.zeros(0)] * len(x)
        for k in order:
            inputs[k], message = agents[k].step(step * _DT, x[k])
            if agents[k].leads:
                for j in order:
                    agents[j].receive(message)
        with precision("float64"):
            x = np.asarray(move(jnp.asarray(x), jnp.asarray(np.stack(inputs))))
        path.append(x)
    return np.stack(path)


_REFERENCES = {
    "rest": lambda: None,
    "hover": lambda: ech.references.Hover(),
    "moving": lambda: ech.references.Lemniscate(rate=0.4),
    "circle": lambda: ech.references.Circle(radius=2.0, rate=0.5),
}


def subclasses(rng: np.random.Generator) -> Finding:
    """A subclass that changes one thing, under stopping points or consensus at the trim."""
    weights = np.array([3.0, 6.0, 4.0, 3.0, 3.0, 4.0])
    name = str(rng.choice(list(BASES), p=weights / weights.sum()))
    base, way = BASES[name][0](), BASES[name][1]
    change = str(rng.choice(CHANGES))
    graph, stopping = ech.Graph([(0, 1), (1, 2)]), bool(rng.random() < 0.7)
    try:
        model = changed(base, change, rng)
        if stopping:
            leader = ech.laws.StoppingLeader(reference=_REFERENCES[way]())
            drive = ech.Laws(leader, ech.laws.StoppingPoint())
        else:
            gain = ech.synthesize(model, graph, ech.gains.Riccati())
            law = ech.laws.Consensus(gain, feedforward="relay")
            drive = ech.Laws(ech.laws.TrimInput(), law)
        goals = ech.Formation(np.zeros((3, len(model.state_names))))
        spread = (0.3 if stopping else 1e-4) * rng.uniform(0.2, 2.0)
        first = model.state_names[:2]
        parts = ech.Parts(model, graph, goals, drive, initial=dict.fromkeys(first, spread))
        settings = ech.Settings(10.0, _DT, seed=int(rng.integers(1000)))
        answer: Any = ech.guarantee(parts, settings)
    except ech.EchelonError as error:
        return silent(f"{name}, {change}: {error}")
    motors = stopping and answer.promised and answer.tube.motor_load is not None
    arrival = answer.tube.arrival if stopping and answer.promised else None
    horizon = min(8.0, 1.0 + (arrival or 4.0)) if stopping else 5.0
    x = np.asarray(prepare(parts, settings).problem.states, float)
    path = fly(parts, x, horizon, motors or not stopping)
    e = path - path[:, :1]
    e = e[..., : min(2, e.shape[-1])]
    sizes = np.linalg.norm(e, axis=2).max(axis=1)
    decays = bool(sizes[-1] < 0.1 * sizes[0])
    if not answer.promised:
        return silent(f"{name}, {change}: {answer.reasons[0]}", decays)
    false, about = list[str](), f"{name}, {change}, {'T5' if stopping else 'trim'}"
    rate = answer.rate or 0.0
    if not sizes[-1] <= sizes[0] * (30.0 * np.exp(-0.7 * rate * horizon) + 1e-6):
        false.append(f"{about}: {sizes[0]} became {sizes[-1]} in {horizon} s at {rate}")
    if arrival is not None and arrival < horizon:
        late = float(sizes[int(np.ceil(arrival / _DT)) :].max())
        if late > 0.0101:
            false.append(f"{about}: {late} m off after {arrival} s")
    return Finding(True, tuple(false), decays)


SUBCLASSES: dict[str, Family] = {"subclasses": subclasses}
