"""Families of the zoo under stopping points: paths that bend or jump, and plants that differ."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from zoo_linear import Family, Finding, silent
from zoo_models import integrate

import echelon as ech
from echelon.agents.models.model import FlatChains

# ---- paths that bend or jump ---------------------------------------------------------------------


def _rough(name: str, p: np.ndarray) -> tuple[Any, Any]:
    """Return a path of t in any module and a number that changes sign where it is rough."""
    a, b, w = p
    at = 12.0 * b
    kinds: dict[str, tuple[Any, Any]] = {
        "where": (lambda xp, t: xp.where(t > at, a * t, 0.0 * t), lambda t: t - at),
        "floor": (lambda xp, t: a * xp.floor(t / at), lambda t: np.sin(np.pi * t / at)),
        "mod": (lambda xp, t: a * xp.mod(t, at), lambda t: np.sin(np.pi * t / at)),
        "clip": (lambda xp, t: xp.clip(t, -1.0, at), lambda t: t - at),
        "abs": (lambda xp, t: xp.abs(t - at), lambda t: t - at),
        "abs of a sine": (
            lambda xp, t: xp.abs(2.0 * b + xp.sin(w * t)),
            lambda t: 2.0 * b + np.sin(w * t),
        ),
        "maximum": (
            lambda xp, t: xp.maximum(xp.sin(w * t), 2.0 * b),
            lambda t: np.sin(w * t) - 2.0 * b,
        ),
        "atan2": (
            lambda xp, t: xp.arctan2(xp.sin(w * t), 2.0 * b + xp.cos(w * t)),
            # It jumps where its second argument is negative and the first one changes sign.
            lambda t: np.where(2.0 * b + np.cos(w * t) < 0.0, np.sin(w * t), 1.0),
        ),
        "interp": (lambda xp, t: xp.interp(t, at + np.arange(3.0), p), lambda t: t - at),
        "root": (lambda xp, t: xp.sqrt((t - at) ** 2), lambda t: t - at),
        "power": (lambda xp, t: xp.abs(t - at) ** 1.5, lambda t: t - at),
    }
    return kinds[name]


_ROUGH = ("where", "floor", "mod", "clip", "abs", "abs of a sine", "maximum", "atan2", "interp")
_SMOOTH: dict[str, Callable[[Any, Any, float], Any]] = {
    "sine": lambda xp, t, w: xp.sin(w * t),
    "product": lambda xp, t, w: xp.cos(w * t) / (1.0 + xp.sin(w * t) ** 2),
    "square": lambda xp, t, w: 0.1 * t * t,
    "exponential": lambda xp, t, w: xp.exp(-0.2 * w * t),
    "hyperbolic": lambda xp, t, w: xp.tanh(w * (t - 3.0)),
    "root": lambda xp, t, w: xp.sqrt(1.3 + xp.sin(w * t)),
}


def rough_paths(rng: np.random.Generator) -> Finding:
    """Paths with where, floor, mod, clip, abs, maximum, atan2 and interp, in or out of reach."""
    horizon = float(rng.uniform(2.0, 12.0))
    name = str(rng.choice([*_ROUGH, "root", "power"]))
    p = np.array([rng.normal(), rng.uniform(0.05, 1.1), rng.uniform(0.3, 3.0)])
    curve, guard = _rough(name, p)
    plain, scale = _SMOOTH[str(rng.choice(list(_SMOOTH)))], float(10.0 ** rng.uniform(-6.0, 1.0))

    class Drawn(ech.references.Reference):
        def __call__(self, t: jax.Array) -> jax.Array:
            x = plain(jnp, t, p[2]) + scale * curve(jnp, t)
            return jnp.stack([x, jnp.sin(t), 1.0 + 0.0 * t, 0.0 * t])

    signs = guard(np.linspace(1e-9, horizon, 100_001))
    rough = bool((signs[1:] * signs[:-1] < 0.0).any())
    # Whether what nearly touches a corner is rough is not asked.
    unclear = not rough and np.abs(signs).min() < 1e-3 and name not in ("floor", "mod")
    shared: dict[str, Any] = {"roots": (2.0,), "observer": False, "speed": 50.0}
    drive = ech.Laws(
        ech.laws.StoppingLeader(reference=Drawn(), **shared), ech.laws.StoppingPoint(**shared)
    )
    model, graph = ech.models.DoubleIntegrator(2), ech.Graph.path(3)
    parts = ech.Parts(model, graph, ech.Formation(np.zeros((3, 4))), drive, initial={"x": 0.1})
    try:
        answer = ech.guarantee(parts, ech.Settings(0.01 * np.ceil(100.0 * horizon), 0.01))
    except ech.EchelonError as error:
        return silent(str(error), None if rough or unclear else True)
    if not answer.promised:
        return silent(f"{name}: {answer.reasons[0]}", None if unclear else not rough)
    return Finding(True, (f"{name} with {p} until {horizon} s",) if rough else (), not rough)


# ---- plants heavier than the model, or with drag -------------------------------------------------


class Cart(ech.ControlAffine):
    """A body moved by forces along two axes, under gravity along the second."""

    mass: float = 1.0
    drag: float = 0.0
    gravity: float = 9.81

    state_names, input_names = ("x", "y", "vx", "vy"), ("fx", "fy")
    position = ("x", "y")
    flat_outputs = ("x", "y")
    flat_order = 2
    flat_chains, flat_bounds = FlatChains((2, 2), (0, 0)), ()

    @property
    def trim(self) -> Any:
        """Return rest at the origin, and the force that holds it."""
        return (0.0,) * 4, (0.0, self.mass * self.gravity)

    def drift(self, x: jax.Array) -> jax.Array:
        """Return f."""
        fall = -self.drag * x[2:] - jnp.array([0.0, self.gravity])
        return jnp.concatenate([x[2:], fall])

    def input_map(self, x: jax.Array) -> jax.Array:
        """Return g."""
        return jnp.concatenate([jnp.zeros((2, 2)), jnp.eye(2) / self.mass])

    def flat(self, derivatives: jax.Array) -> Any:
        """Return the state and the force on a path."""
        place, speed, pull = derivatives
        force = self.mass * (pull + self.drag * speed + jnp.array([0.0, self.gravity]))
        return jnp.concatenate([place, speed]), force


def other_plants(rng: np.random.Generator) -> Finding:
    """Plants heavier or lighter than the model, or with drag, behind paths, without observer."""
    model = Cart(float(rng.uniform(0.5, 2.0)), float(rng.uniform(0.0, 1.0)), 9.81)
    heavier = float(rng.uniform(0.6, 1.6)) if rng.random() < 0.7 else 1.0
    drag = model.drag + (float(rng.uniform(0.0, 1.5)) if rng.random() < 0.6 else 0.0)
    plant = Cart(model.mass * heavier, drag, 9.81)
    root, c = float(rng.integers(2, 12)) / 2.0, float(rng.uniform(0.3, 3.0))
    along = float(rng.uniform(-3.0, 3.0)) * (rng.random() < 0.7)
    w, wide = float(rng.uniform(0.3, 1.5)), float(rng.uniform(0.3, 2.0))
    line = rng.random() < 0.6
    reference = (
        ech.references.Line(start=(0.0, 0.0, 0.0), velocity=(along, 0.5 * along, 0.0))
        if line
        else ech.references.Circle(center=(0.0, 0.0, 0.0), radius=wide, rate=w)
    )
    # Forces with which the plant rests or follows, less those of the model, as accelerations.
    v = np.array([along, 0.5 * along]) if line else np.zeros(2)
    g = np.array([0.0, 9.81])
    lacks = np.abs((heavier * (g + drag * v) - g - model.drag * v) / root).max()
    speed = float(max(lacks, 0.1) * rng.choice([0.5, 0.93, 1.07, 2.0]))
    shared: dict[str, Any] = {
        "roots": (root,),
        "observer": False,
        "speed": speed,
        "coupling": c,
    }
    drive = ech.Laws(
        ech.laws.StoppingLeader(reference=reference, **shared), ech.laws.StoppingPoint(**shared)
    )
    graph = ech.Graph([(0, 1), (1, 2)])
    world = ech.World(plant=plant)
    goals = ech.Formation(np.zeros((3, 4)))
    parts = ech.Parts(model, graph, goals, drive, initial={"x": 0.5}, world=world)
    try:
        answer = ech.guarantee(parts, ech.Settings(60.0, 0.01, limits=False))
    except ech.EchelonError as error:
        return silent(str(error))

    def path(t: float) -> np.ndarray:
        if line:
            return np.stack([t * v, v, 0.0 * v])
        s, k = np.sin(w * t), np.cos(w * t)
        return wide * np.array([[k, s], [-w * s, w * k], [-w * w * k, -w * w * s]])

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        r, y, u = path(t), x[:2], x[2:]
        off = c * (y + u / root - r[0] - r[1] / root)
        asked = r[1] + r[2] / root - off / np.sqrt(1.0 + (off / speed) ** 2)
        force = model.mass * (root * (asked - u) + model.drag * u + g)
        return np.concatenate([u, force / plant.mass - plant.drag * u - g])

    def offs(end: float) -> list[float]:
        """Return how far it is off in two quarters of a flight, in which it may swing."""
        flown = integrate(rate, np.concatenate(path(0.0)[:2]), end, int(10.0 * end))
        times = np.linspace(0.0, end, len(flown))
        off = np.array([np.abs(x[:2] - path(t)[0]).max() for t, x in zip(times, flown)])
        return [
            float(off[(times > a * end) & (times <= a * end + 0.25 * end)].max())
            for a in (0.5, 0.75)
        ]

    # Near the least speed it may take minutes to where it stays.
    halves = offs(160.0)
    halves = halves if halves[1] - halves[0] < 0.08 else offs(1600.0)
    drifts = not halves[1] - halves[0] < 0.08
    share = speed / max(lacks, 1e-9)
    if not answer.promised:
        return silent(answer.reasons[0], not drifts)
    text = f"drifts by {halves}, at {share} of the speed that rest asks"
    return Finding(True, (text,) if drifts else (), not drifts)


PATHS: dict[str, Family] = {"paths": rough_paths, "plants": other_plants}
