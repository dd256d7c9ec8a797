"""A zoo of awkward agents, each promised something or refused: no promise may be false.

Run `python benchmarks/zoo.py` (2,000 specimens) or `--specimens 100`; `--family NAME` draws those
that aim at one rule, of the other files `zoo_*.py`. A specimen is written once, for any array
module, so that NumPy flies what JAX promises of, from the edge of what is promised, by an
integrator that is not the engine's. The other fault is counted too: what in truth holds and is
refused, since silence is no honesty.
"""

import argparse
import json
import multiprocessing
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from zoo_changes import CHANGED
from zoo_limits import LIMITS
from zoo_linear import LINEAR, Family, Finding
from zoo_models import MODELS
from zoo_paths import PATHS
from zoo_subclasses import SUBCLASSES

import echelon as ech
from echelon.core.words import Theorem

REPORT = Path(__file__).resolve().parent / "zoo.json"
_STARTS, _STEPS = 6, 1500


@dataclass(frozen=True)
class Kind:
    """A term of the drift of one state: (array module, state, size) -> value, and what it does.

    `smooth` is False for what bends or jumps at the origin; `honest` is False where JAX's
    derivative is none.
    """

    term: Callable[[Any, Any, float], Any]
    honest: bool = True


def _hidden(xp: Any, value: Any) -> Any:
    return jax.lax.stop_gradient(value) if xp is jnp else value


KINDS: dict[str, Kind] = {
    "none": Kind(lambda xp, x, a: 0.0 * x),
    "linear": Kind(lambda xp, x, a: 0.3 * a * x),
    "sine": Kind(lambda xp, x, a: a * xp.sin(x)),
    "cubic": Kind(lambda xp, x, a: -abs(a) * x**3),
    "drag": Kind(lambda xp, x, a: -abs(a) * xp.abs(x) * x),
    "max": Kind(lambda xp, x, a: a * xp.maximum(x, 0.5)),
    "two maxima": Kind(lambda xp, x, a: a * (xp.maximum(x, -x) - xp.maximum(0.3 * x, 0.1))),
    "max of the state": Kind(lambda xp, x, a: a * xp.maximum(x, 0.0)),
    "clip": Kind(lambda xp, x, a: a * xp.clip(x, -0.3, 0.4)),
    "abs": Kind(lambda xp, x, a: a * xp.abs(x)),
    "where": Kind(lambda xp, x, a: a * xp.where(x > 0.2, x - 0.2, 0.0)),
    "dead zone": Kind(lambda xp, x, a: a * (x - xp.clip(x, -0.1, 0.1))),
    "step": Kind(lambda xp, x, a: abs(a) * xp.where(x > 1e-3, 1.0, 0.0)),
    "sign": Kind(lambda xp, x, a: a * xp.sign(x)),
    "floor": Kind(lambda xp, x, a: a * xp.floor(4.0 * x)),
    "stopped": Kind(lambda xp, x, a: abs(a) * 3.0 * _hidden(xp, x), honest=False),
    "fence": Kind(lambda xp, x, a: -abs(a) * xp.maximum(x - 1.1, 0.0)),
}
INPUT_MAPS = ["constant", "varies", "jumps", "bends", "weak"]
METHODS = ["riccati", "robust-lqr", "contraction", "monotone", "inner-loop", "given"]


@dataclass(frozen=True)
class Specimen:
    """A model in any array module, a graph, offsets, leaders' starts and a domain."""

    kind: str
    second: str
    input_map: str
    size: float
    A: np.ndarray
    B: np.ndarray
    edges: list[tuple[int, int, float]]
    leaders: tuple[int, ...]
    offsets: np.ndarray
    apart: float
    domain: dict[str, float]
    method: str
    feedforward: str
    limits: tuple[float, float] | None = None

    def drift(self, xp: Any, x: Any) -> Any:
        """Return f of states (..., n)."""
        bent = [KINDS[self.kind].term(xp, x[..., -1], self.size)]
        if x.shape[-1] > 1:
            bent.append(KINDS[self.second].term(xp, x[..., 0], 0.3 * self.size))
        at_rest = [KINDS[k].term(np, np.zeros(()), s) for k, s in self._terms()]
        rows = [bent[0] - at_rest[0]]
        if x.shape[-1] > 1:
            rows[0] = rows[0] + bent[1] - at_rest[1]
        zero = 0.0 * x[..., :1]
        more = xp.concatenate([*[zero] * (x.shape[-1] - 1), rows[0][..., None]], axis=-1)
        return x @ self.A.T + more

    def _terms(self) -> list[tuple[str, float]]:
        return [(self.kind, self.size), (self.second, 0.3 * self.size)]

    def map(self, xp: Any, x: Any) -> Any:
        """Return g of states (..., n), (..., n, m)."""
        s = x[..., -1]
        factor = {
            "constant": 1.0 + 0.0 * s,
            "weak": 1e-3 + 0.0 * s,
            "varies": 1.0 + 0.3 * xp.sin(s),
            "bends": 1.0 + 0.3 * xp.abs(s),
            "jumps": xp.where(s > 0.3, 0.0, 1.0),
        }[self.input_map]
        return factor[..., None, None] * self.B


def draw(seed: int, number: int) -> Specimen:
    """Return a specimen; the same for the same seed and number."""
    rng = np.random.default_rng([seed, number])
    n, agents = int(rng.integers(1, 4)), int(rng.integers(2, 7))
    A = np.eye(n, k=1) + np.diag(-rng.uniform(0.0, 1.5, n) * (rng.random(n) < 0.6))
    if rng.random() < 0.3:
        A = A + 0.5 * rng.normal(size=(n, n))
    B = np.zeros((n, 1))
    B[-1] = 1.0
    if rng.random() < 0.1:
        B = np.concatenate([B, 1e-6 * np.ones((n, 1))], axis=1)
    if n > 1 and rng.random() < 0.15:
        A = _undamped(n, rng)
    decades = 8.0 if rng.random() < 0.2 else 0.3
    line = rng.random() < 0.1
    agents = int(rng.integers(20, 41)) if line else agents
    edges = [
        (
            k - 1 if line else int(rng.integers(0, k)),
            k,
            float(10.0 ** rng.uniform(-decades, decades)),
        )
        for k in range(1, agents)
    ]
    several = agents > 3 and rng.random() < 0.3
    more = rng.choice(np.arange(1, agents), int(rng.integers(1, 3)) if several else 0, False)
    leaders = (0, *sorted(more.tolist()))
    offsets = np.zeros((agents, n))
    if rng.random() < (0.5 if n > 1 and not A[:, 0].any() else 0.1):
        offsets[:, 0] = rng.uniform(-1.0, 1.0, agents)
    names = [f"x{k}" for k in range(n)]
    bounded = [k for k in range(n) if rng.random() < 0.85] or [n - 1]
    picked = rng.choice(list(KINDS), 2)
    return Specimen(
        kind=str(picked[0]),
        second=str(picked[1]) if rng.random() < 0.3 else "none",
        input_map=str(rng.choice(INPUT_MAPS, p=[0.6, 0.1, 0.1, 0.1, 0.1])),
        size=float(rng.normal()),
        A=A,
        B=B,
        edges=edges,
        leaders=leaders,
        offsets=offsets,
        apart=float(rng.uniform(0.1, 0.5)) if several and rng.random() < 0.5 else 0.0,
        domain={names[k]: float(rng.uniform(0.1, 2.0)) for k in bounded},
        method=str(rng.choice(METHODS)),
        feedforward=str(rng.choice(["none", "relay", "relay-velocity", "parent"])),
        limits=_LIMITS[int(rng.integers(0, 12))],
    )


_LIMITS = [(-0.5, 0.5), (0.0, 1.0), (0.2, 1.0), *[None] * 9]
"""About the trim, at its edge and off it: the last two hold no trim against an error."""


def _undamped(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return a rigid oscillator, and an integrator beside it where there is a third state."""
    A = np.zeros((n, n))
    A[-2, -1], A[-1, -2] = 1.0, -float(rng.uniform(0.5, 4.0))
    return A


def model_of(specimen: Specimen) -> ech.ControlAffine:
    """Return the specimen for echelon."""

    class Awkward(ech.ControlAffine):
        state_names = tuple(f"x{k}" for k in range(len(specimen.A)))
        input_names = tuple(f"u{k}" for k in range(specimen.B.shape[1]))
        input_limits = specimen.limits and _box(specimen.limits, specimen.B.shape[1])

        def drift(self, x: jax.Array) -> jax.Array:
            return specimen.drift(jnp, x)

        def input_map(self, x: jax.Array) -> jax.Array:
            return specimen.map(jnp, x)

    return Awkward()


def _box(limits: tuple[float, float], inputs: int) -> ech.models.Limits:
    low, high = ((limit,) * inputs for limit in limits)
    return ech.models.Limits(tuple(map(tuple, np.eye(inputs).tolist())), low, high)


def method_of(specimen: Specimen) -> ech.gains.Method:
    """Return its gain method."""
    if specimen.method in ("robust-lqr", "contraction", "monotone"):
        cls = {
            "robust-lqr": ech.gains.RobustLQR,
            "contraction": ech.gains.Contraction,
            "monotone": ech.gains.Monotone,
        }[specimen.method]
        return cls(specimen.domain)
    if specimen.method == "given":
        return ech.gains.FixedGain("identity", coupling=2.0)
    return ech.gains.Riccati() if specimen.method == "riccati" else ech.gains.InnerLoop()


# ---- flying it without echelon ------------------------------------------------------------------


class Flight:
    """The closed loop of a specimen under a gain, in NumPy."""

    def __init__(self, specimen: Specimen, gain: ech.Gain) -> None:
        """Keep what the law needs."""
        self.specimen, self.P, self.c = specimen, gain.P, gain.coupling
        self.R_inverse, self.inner = np.linalg.inv(gain.R), gain.inner
        self.clipped = False
        N = len(specimen.offsets)
        self.L = np.zeros((N, N))
        for i, j, weight in specimen.edges:
            self.L[i, j] -= weight
            self.L[j, i] -= weight
        self.L -= np.diag(self.L.sum(axis=1))
        # Free leaders hear nobody; and those at the trim send no input beyond it.
        self.L[list(specimen.leaders)] = 0.0
        self.before = self._parents() if specimen.feedforward == "parent" else []

    def _parents(self) -> list[tuple[int, int]]:
        """Return followers with the neighbour before each, the nearest to a leader first."""
        reached, pairs = list(self.specimen.leaders), list[tuple[int, int]]()
        ends = [{i, j} for i, j, _ in self.specimen.edges]
        for parent in reached:
            for pair in ends:
                for child in pair - {parent}:
                    if parent in pair and child not in reached:
                        reached.append(child)
                        pairs.append((child, parent))
        return pairs

    def rate(self, x: np.ndarray) -> np.ndarray:
        """Return xdot of all agents, (S, N, n)."""
        G = self.specimen.map(np, x)
        z = self.L @ (x - self.specimen.offsets)
        pull = np.einsum("...im,...i->...m", G, z @ self.P) @ (self.c * self.R_inverse)
        for child, parent in self.before:
            pull[..., child, :] += pull[..., parent, :]
        if self.inner is not None:
            pull = pull + x @ self.inner.T
        if self.specimen.limits is not None:
            held = -np.clip(-pull, *self.specimen.limits)
            self.clipped |= bool((held != pull).any())
            pull = held
        return self.specimen.drift(np, x) - np.einsum("...im,...m->...i", G, pull)

    def fly(self, x: np.ndarray, horizon: float, cut: int = 1) -> np.ndarray:
        """Return the path (steps + 1, S, N, n) by Runge and Kutta's method."""
        h, path = horizon / (_STEPS * cut), [x]
        for k in range(_STEPS * cut):
            k1 = self.rate(x)
            k2 = self.rate(x + 0.5 * h * k1)
            k3 = self.rate(x + 0.5 * h * k2)
            k4 = self.rate(x + h * k3)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            if (k + 1) % cut == 0:
                path.append(x)
        return np.stack(path)

    def fastest(self) -> float:
        """Return about the largest eigenvalue at the origin, 1/s, by differences."""
        N, n = self.specimen.offsets.shape
        at, h = self.specimen.offsets.reshape(-1), 1e-4
        moved = np.concatenate([at + h * np.eye(N * n), at - h * np.eye(N * n)])
        up, down = np.split(self.rate(moved.reshape(-1, N, n)).reshape(2 * N * n, -1), 2)
        return float(np.abs(np.linalg.eigvals((up - down).T / (2 * h))).max())


def errors(specimen: Specimen, path: np.ndarray) -> np.ndarray:
    """Return errors to the first leader (..., N, n), goals taken off."""
    y = path - specimen.offsets
    return y - y[..., specimen.leaders[0], :][..., None, :]


def study(seed: int, number: int) -> dict[str, Any]:
    """Ask for a promise of one specimen and try it; return what was found."""
    specimen = draw(seed, number)
    found: dict[str, Any] = {"number": number, "kind": specimen.kind, "method": specimen.method}
    rng = np.random.default_rng([seed, number, 1])
    starts = specimen.offsets.copy()
    for k, leader in enumerate(specimen.leaders[1:]):
        starts[leader, -1] += specimen.apart * (k + 1)
    try:
        graph = ech.Graph.from_edges(specimen.edges, specimen.leaders, len(starts))
        gain = ech.synthesize(model_of(specimen), graph, method_of(specimen))
        law = ech.laws.Consensus(gain, feedforward=specimen.feedforward)
        parts = ech.Parts(
            model_of(specimen),
            graph,
            ech.Formation(specimen.offsets),
            ech.Laws(ech.laws.TrimInput(), law),
            initial=starts,
        )
        flight = Flight(specimen, gain)
        # Flights know no held inputs: a step that no mode notices.
        dt = min(1e-4, 1e-3 / max(flight.fastest(), 1e-3))
        promise = ech.guarantee(parts, ech.Settings(horizon=dt, dt=dt))
    except ech.EchelonError as error:
        return {**found, "refused": str(error).split(";")[0][:90]}
    if not promise.promised:
        return {**found, "silent": promise.reasons[0][:90], "holds": holds(flight, specimen, rng)}
    found |= {"promised": str(promise.kind), "theorem": str(promise.theorem), "rate": promise.rate}
    return {**found, "violations": list(violations(flight, specimen, promise, rng))}


def near(specimen: Specimen, rng: np.random.Generator, size: float) -> np.ndarray:
    """Return starts (S, N, n) about the goals, leaders at the trim."""
    free = np.ones(len(specimen.offsets))
    free[list(specimen.leaders)] = 0.0
    away = rng.normal(size=(_STARTS, *specimen.offsets.shape)) * free[:, None]
    away[1::2] = -away[::2]
    return specimen.offsets + size * away


def holds(flight: Flight, specimen: Specimen, rng: np.random.Generator) -> bool | None:
    """Tell whether small errors shrink in truth, whatever was said; None where it is not known."""
    if specimen.apart or specimen.limits in _LIMITS[1:3]:
        return False
    fast = flight.fastest()
    with np.errstate(all="ignore"):
        path = errors(specimen, flight.fly(near(specimen, rng, 1e-5), 0.5 * _STEPS / fast))
    sizes = np.abs(path).max(axis=(1, 2, 3))
    return bool(sizes[-1] < 1e-3 * sizes[0])


def violations(
    flight: Flight, specimen: Specimen, promise: ech.Guarantee, rng: np.random.Generator
) -> Any:
    """Yield what runs show against a promise."""
    fast, rate = flight.fastest(), max(promise.rate or 0.0, 0.0)
    horizon = 0.5 * _STEPS / fast
    start, flight.clipped = near(specimen, rng, 1e-6), False
    with np.errstate(all="ignore"):
        path = errors(specimen, flight.fly(start, horizon))
    sizes = np.abs(path).max(axis=(1, 2, 3))
    if flight.clipped:
        # Limits, which heavy edges reach at once, make errors end later; lost is lost.
        if not sizes[-1] <= 10.0 * sizes[0]:
            yield f"behind limits: {sizes[0]:.2g} became {sizes[-1]:.2g} in {horizon:.3g} s"
        return
    grown = not sizes[-1] < 10.0 * np.exp(-0.5 * rate * horizon) * sizes[0] * 1e3 + 1e-12
    if rate and (grown or not sizes[-1] <= 1e3 * sizes[0]):
        yield f"near the goals: {sizes[0]:.2g} became {sizes[-1]:.2g} in {horizon:.3g} s"
    found = promise.certified
    if found is None or not found.radius or str(promise.kind) == "samples":
        return
    radius = min(found.radius, 10.0)
    begin = edge(specimen, flight.P, radius, rng)
    horizon = min(2.0 / max(rate, 1e-3), 0.25 * _STEPS / fast)
    flight.clipped = False
    with np.errstate(all="ignore"):
        rough, fine = (errors(specimen, flight.fly(begin, horizon, cut)) for cut in (1, 2))
        if not np.isfinite([rough, fine]).all():
            # Far from the goals a drift may be stiffer than at them.
            rough, fine = (errors(specimen, flight.fly(begin, horizon, cut)) for cut in (32, 64))
    if flight.clipped:
        yield "from the certified set an input reaches its limit"
        return
    v, other = (np.einsum("tsia,ab,tsib->ts", e, flight.P, e) for e in (fine, rough))
    times = np.linspace(0.0, horizon, len(v))[:, None]
    if promise.theorem is Theorem.A5:
        bound = v[0] * flight_spread(flight, specimen)
    else:
        bound = v[0] * np.exp(-2.0 * rate * times)
    over = ~(v <= bound * (1.0 + 1e-6) + 4.0 * np.abs(v - other) + 1e-12 * v[0])
    if over.any():
        worst = float(np.nanmax(v / bound))
        yield f"from the certified set: V is {worst:.9g} times its bound"


def flight_spread(flight: Flight, specimen: Specimen) -> float:
    """Return how far sum delta'P delta may rise under a drift that is only monotone."""
    rest = [k for k in range(len(flight.L)) if k not in specimen.leaders]
    values = np.linalg.eigvalsh(flight.L[np.ix_(rest, rest)])
    return float(values[-1] / values[0])


def edge(specimen: Specimen, P: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Return starts (S, N, n) with sum_i delta_i'P delta_i = radius^2, the leaders at the trim."""
    away = near(specimen, rng, 1.0) - specimen.offsets
    away[0] = np.abs(away[0])
    followers = np.abs(away).max(axis=2) > 0
    away[2] = np.where(followers[2][:, None], np.linalg.inv(P)[:, -1], 0.0)
    away[3] = -away[2]
    size = np.sqrt(np.einsum("sia,ab,sib->s", away, P, away))
    return specimen.offsets + radius * away / size[:, None, None]


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a study."""
    promised = [r for r in records if "promised" in r]
    silent = [r for r in records if "silent" in r]
    mute = [r for r in silent if r["holds"]]
    held = len(promised) + len(mute)
    return {
        "specimens": len(records),
        "refused": Counter(r["refused"] for r in records if "refused" in r).most_common(12),
        "promised": dict(Counter(f"{r['promised']}, {r['theorem']}" for r in promised)),
        "violations": [r for r in promised if r["violations"]],
        "silent": Counter(r["silent"] for r in silent).most_common(12),
        "silent though it holds": len(mute),
        "of those that hold": round(len(mute) / max(held, 1), 4),
        "why": Counter(r["silent"] for r in mute).most_common(8),
    }


def _task(pair: tuple[int, int]) -> dict[str, Any]:
    try:
        return study(*pair)
    except Exception as error:
        return {"number": pair[1], "promised": "crash", "theorem": "", "violations": [repr(error)]}


# ---- families that aim at one rule each ---------------------------------------------------------


FAMILIES: dict[str, Family] = {**LINEAR, **CHANGED, **MODELS, **PATHS, **SUBCLASSES, **LIMITS}


def judge(family: str, seed: int, number: int) -> Finding:
    """Return what came of one draw of a family; the same for the same seed and number."""
    return FAMILIES[family](np.random.default_rng([seed, number]))


def _judged(case: tuple[str, int, int]) -> Finding:
    try:
        return judge(*case)
    except Exception as error:
        return Finding(True, (f"crash: {error!r}",))


def family_summary(findings: list[Finding]) -> dict[str, Any]:
    """Return the counts of a family."""
    mute = [f for f in findings if not f.guaranteed and f.holds]
    true = sum(bool(f.guaranteed and not f.false) for f in findings) + len(mute)
    return {
        "drawn": len(findings),
        "guaranteed": sum(f.guaranteed for f in findings),
        "at the trim alone": sum(f.guaranteed and bool(f.why) for f in findings),
        "false": [[k, *f.false] for k, f in enumerate(findings) if f.false],
        "true but refused": len(mute),
        "of those that hold": round(len(mute) / max(true, 1), 4),
        "lost behind limits, local guarantee": sum(bool(f.local) for f in findings),
        "at half of the region of attraction": dict(Counter(f.half for f in findings if f.half)),
        "why": Counter(f.why for f in mute).most_common(6),
        "not known": Counter(
            f.why for f in findings if not f.guaranteed and f.holds is None
        ).most_common(6),
    }


def main() -> None:
    """Study the specimens, or a family, and write the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--specimens", type=int, default=2000, help="how many")
    parser.add_argument("--family", choices=[*FAMILIES, ""], default="", help="of one family")
    parser.add_argument("--seed", type=int, default=0, help="of the specimens")
    parser.add_argument("--processes", type=int, default=2, help="at a time")
    parser.add_argument("--out", type=Path, default=REPORT, help="where the report goes, as JSON")
    asked = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    numbers = range(asked.specimens)
    # What a process compiles for one specimen is of no use for the next.
    with context.Pool(asked.processes, maxtasksperchild=50) as pool:
        if asked.family:
            cases = [(asked.family, asked.seed, k) for k in numbers]
            counts = family_summary(list(pool.imap(_judged, cases, chunksize=5)))
        else:
            pairs = [(asked.seed, k) for k in numbers]
            counts = summary(list(pool.imap(_task, pairs, chunksize=5)))
    report = json.dumps(counts, indent=2)
    asked.out.write_text(report + "\n", "utf-8")
    print(report)


if __name__ == "__main__":
    main()
