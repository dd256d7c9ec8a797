"""Attack every promise that echelon makes for random systems: none may be false.

Run `python benchmarks/attack.py` (2,000 systems, about 20 minutes on two idle cores), `--systems
100` is quicker. Each system is given to two gain methods. Every promise of kind `proof` or
`vertices` is attacked twice, by code that shares nothing with echelon (`attack_systems.Terms` has
its own calculus): a gradient search of the domain for a state that breaks the inequality, and
simulation from the boundary of the certified set, behind a resting and behind a moving leader.
"""

import argparse
import json
import multiprocessing
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from attack_systems import METHODS, Plant, System, random_method, random_system

import echelon as ech
from echelon.core.words import Kind, Theorem

REPORT = Path(__file__).resolve().parent / "attack.json"
EPS = float(np.finfo(float).eps)
_POINTS, _CLIMBS = 96, 30  # starts of the gradient search, and its steps
_STARTS, _STEPS = (
    8,
    100,
)  # simulations at a time, and their steps; each is run again with half the dt


@dataclass(frozen=True)
class Guarantee:
    """What a certificate says, in the words of the attack.

    `grounded` is the follower block of the Laplacian; bounds are those of deviations from the trim
    and of normalized inputs. `radius` is None where the domain bounds nothing.
    """

    kind: Kind
    theorem: Theorem
    rate: float
    radius: float | None
    P: np.ndarray
    R: np.ndarray
    coupling: float
    plant: Plant
    grounded: np.ndarray
    leaders: int
    low: np.ndarray
    high: np.ndarray
    input_low: np.ndarray
    input_high: np.ndarray

    @property
    def strength(self) -> float:
        """2 c lambda_min; 0 for the drift alone."""
        low = float(np.linalg.eigvalsh(self.grounded)[0])
        return 0.0 if self.theorem is Theorem.A5 else 2.0 * self.coupling * low

    def widened(self, factor: float) -> "Guarantee":
        """Return the false promise of the same on a wider domain."""
        names = ("low", "high", "input_low", "input_high")
        wide = {name: factor * getattr(self, name) for name in names}
        return replace(self, radius=self.radius and factor * self.radius, **wide)


@dataclass
class Outcome:
    """What an attack found: the least rate (1/s) above the promised one, and what is violated."""

    kind: str
    theorem: str
    margin: float
    tolerance: float
    simulated: float
    points: int
    runs: int
    violations: list[str] = field(default_factory=list)


def promise_of(system: System, gain: ech.Gain) -> Guarantee | None:
    """Return the promise on the system's domain that a gain carries, or None."""
    region, plant = gain.certificate.region, system.plant
    if region is None or region.kind not in (Kind.PROOF, Kind.VERTICES):
        return None
    return Guarantee(
        kind=region.kind,
        theorem=region.theorem,
        rate=region.rate,
        radius=region.radius,
        P=gain.P,
        R=gain.R,
        coupling=gain.coupling,
        plant=plant if gain.inner is None else plant.closed(gain.inner),
        grounded=system.grounded(),
        leaders=len(system.leaders),
        low=system.low,
        high=system.high,
        input_low=system.input_low,
        input_high=system.input_high,
    )


def attack(promise: Guarantee, rng: np.random.Generator) -> Outcome:
    """Search for a violation by gradients, then by simulation."""
    search = Search(promise)
    margin, tolerance, worst, points = search.run(rng)
    found = Outcome(str(promise.kind), str(promise.theorem), margin, tolerance, np.inf, points, 0)
    if margin < -tolerance:
        found.violations.append(
            f"state: rate {margin:.3g} 1/s below the promised {promise.rate:.3g}"
        )
    simulate(promise, worst, search.size, rng, found)
    return found


# ---- the gradient search ----


class Search:
    """The inequality P A + A'P - strength P g R^-1 g'P + 2 rate P <= 0 over the domain.

    The excess is the largest eigenvalue of the left side in coordinates where P = I; half of it is
    the rate that is missing.
    """

    def __init__(self, promise: Guarantee) -> None:
        """Prepare the derivatives of drift and input map."""
        p, self.promise = promise.plant, promise
        n, self.m = p.B.shape
        self.n = n
        self.f1, self.g1 = p.f.slope(n), p.g.slope(n)
        self.f2, self.g2 = self.f1.slope(n), self.g1.slope(n)
        self.L = np.linalg.inv(np.linalg.cholesky(promise.P))
        self.low = np.concatenate([np.maximum(promise.low, -3.0), promise.input_low])
        self.high = np.concatenate([np.minimum(promise.high, 3.0), promise.input_high])
        self.size = 0.0

    def jacobian(self, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return d(drift + input map w)/dx at points, (K, n, n)."""
        return self.promise.plant.A + self.f1.at(x) + np.einsum("kiaj,ka->kij", self.g1.at(x), w)

    def excess(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the excess (K,), its gradient (K, n + m) and the worst directions (K, n)."""
        p, (x, w) = self.promise, np.split(points, [self.n], axis=1)
        A, G = self.jacobian(x, w), p.plant.input_map(x)
        self.size = max(self.size, float(np.linalg.norm(A, 2, axis=(1, 2)).max()))
        PA, PG = p.P @ A, p.P @ G
        damping = p.strength * PG @ np.linalg.solve(p.R, PG.swapaxes(1, 2))
        X = self.L @ (PA + PA.swapaxes(1, 2) - damping) @ self.L.T
        values, vectors = np.linalg.eigh(0.5 * (X + X.swapaxes(1, 2)))
        y = vectors[:, :, -1] @ self.L
        return values[:, -1] + 2.0 * p.rate, self._gradient(x, w, PG, y), y

    def _gradient(self, x: np.ndarray, w: np.ndarray, PG: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return 2 y'P dA y - 2 strength (y'P dg) R^-1 (g'P y) along states and inputs."""
        p, g1 = self.promise, self.g1.at(x)
        Py = y @ p.P
        bend = self.f2.at(x) + np.einsum("kiajl,ka->kijl", self.g2.at(x), w)
        pull = np.einsum("kia,ki->ka", PG, y)
        along = np.einsum("ki,kijl,kj->kl", Py, bend, y)
        damped = np.einsum("ki,kial,ka->kl", Py, g1, np.linalg.solve(p.R, pull.T).T)
        inputs = np.einsum("ki,kiaj,kj->ka", Py, g1, y)
        return 2.0 * np.concatenate([along - p.strength * damped, inputs], axis=1)

    def tolerance(self, points: np.ndarray) -> float:
        """Bound what rounding makes of half the excess, here and in echelon, in 1/s.

        Products of n terms are off by n eps of their absolute values; the smallest eigenvalue of
        the graph is off by eps times the largest, and so is the strength.
        """
        p, (x, w) = self.promise, np.split(points, [self.n], axis=1)
        spectrum = np.linalg.eigvalsh(p.grounded)
        lost = EPS * len(spectrum) * spectrum[-1] / spectrum[0]
        A, PG = np.abs(self.jacobian(x, w)), np.abs(p.P) @ np.abs(p.plant.input_map(x))
        PA, inverse = np.abs(p.P) @ A, np.abs(np.linalg.inv(p.R))
        pull = p.strength * PG @ inverse @ PG.swapaxes(1, 2)
        drift = PA + PA.swapaxes(1, 2) + 2.0 * p.rate * np.abs(p.P)
        error = 8.0 * (self.n + self.m) * EPS * (drift + pull) + lost * pull
        L = np.abs(self.L)
        return 0.5 * float((L @ error @ L.T).sum(axis=2).max())

    def run(self, rng: np.random.Generator) -> tuple[float, float, np.ndarray, int]:
        """Return the least margin, its tolerance, the worst direction, and the points looked at."""
        width = self.high - self.low
        points = rng.uniform(self.low, self.high, (_POINTS, len(width)))
        ends = rng.random((_POINTS // 3, len(width))) < 0.5
        points[: len(ends)] = np.where(ends, self.low, self.high)
        points[-1] = 0.0
        value, slope, y = self.excess(points)
        flat = not (len(self.f1.weight) or len(self.g1.weight))
        step, count = np.full(len(points), 0.25), len(points)
        for _ in range(0 if flat else _CLIMBS):
            # Ascent in units of the domain's width, cut off at its sides; a step that fails halves.
            scaled = slope * width**2
            length = np.sqrt((slope**2 * width**2).sum(axis=1, keepdims=True)) + 1e-300
            tried = np.clip(points + step[:, None] * scaled / length, self.low, self.high)
            new, new_slope, new_y = self.excess(tried)
            better = new > value
            step = np.where(better, 1.5 * step, 0.5 * step)
            for old, now in ((points, tried), (value, new), (slope, new_slope), (y, new_y)):
                old[better] = now[better]
            count += len(points)
        worst = int(np.argmax(value))
        return -0.5 * float(value[worst]), self.tolerance(points), y[worst], count


# ---- simulation ----


def simulate(
    promise: Guarantee, worst: np.ndarray, size: float, rng: np.random.Generator, found: Outcome
) -> None:
    """Run the closed loop where the promise speaks of it, and note what it breaks."""
    if promise.theorem is Theorem.T2:
        _variational(promise, worst, size, rng, found)
    else:
        _resting(promise, worst, size, rng, found)
        if promise.leaders == 1 and promise.plant.constant:
            _moving(promise, worst, size, rng, found)


def _starts(promise: Guarantee, worst: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return deviations (S, N, n) with sum delta'P delta = 1, some of them the hardest known."""
    N, n = len(promise.grounded), len(promise.P)
    W, L = np.linalg.inv(promise.P), np.linalg.inv(np.linalg.cholesky(promise.P))
    slowest = np.linalg.eigh(promise.grounded)[1][:, 0]
    reach = np.minimum(promise.high, -promise.low) / np.sqrt(np.diag(W))
    touching = W[int(np.argmin(reach))] / np.sqrt(W[np.argmin(reach), np.argmin(reach)])
    one = np.eye(N)[rng.integers(N)]
    found = [np.outer(slowest, worst), np.outer(slowest, touching)]
    found += [np.outer(one, touching), np.outer(-one, touching), np.outer(one, worst)]
    found += [np.outer(np.ones(N), touching) / np.sqrt(N)]
    while len(found) < _STARTS:
        found.append(rng.normal(size=(N, n)) @ L)
    deltas = np.stack(found)
    return deltas / np.sqrt(_measure(deltas, promise.P))[:, None, None]


def _measure(delta: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return sum_i delta_i'P delta_i, (S,)."""
    return np.einsum("sia,ab,sib->s", delta, P, delta)


def _pace(promise: Guarantee, size: float) -> float:
    """Return a step that resolves the fastest mode, or a third of the slowest time constant."""
    p, G = promise, promise.plant.B
    feedback = np.abs(np.linalg.eigvals(G @ np.linalg.solve(p.R, G.T @ p.P))).max()
    fastest = size + abs(p.coupling) * np.linalg.eigvalsh(p.grounded)[-1] * feedback
    return min(0.25 / (fastest + 1e-9), 3.0 / (_STEPS * max(p.rate, 1e-3)))


Field = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _runge_kutta(
    field: Field, x: np.ndarray, inputs: np.ndarray, dt: float, cut: int
) -> np.ndarray:
    """Return the path (steps + 1, ...) with each input held over dt, in `cut` steps."""
    h, path = dt / cut, [x]
    for w in inputs:
        for _ in range(cut):
            k1 = field(x, w)
            k2 = field(x + 0.5 * h * k1, w)
            k3 = field(x + 0.5 * h * k2, w)
            k4 = field(x + h * k3, w)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        path.append(x)
    return np.stack(path)


def _loop(promise: Guarantee) -> Field:
    """Return xdot of leader and followers (S, 1 + N, n), the leader's input w (S, m) relayed."""
    p, plant, R_inverse = promise, promise.plant, np.linalg.inv(promise.R)
    L = np.zeros((len(p.grounded) + 1, len(p.grounded) + 1))
    L[1:, 1:] = p.grounded
    # The disagreement is that of deviations from the leader, whose own is none.
    L[1:, 0] = -p.grounded.sum(axis=1)
    fixed = p.coupling * p.P @ plant.B @ R_inverse @ plant.B.T

    def field(x: np.ndarray, w: np.ndarray) -> np.ndarray:
        flat, z = x.reshape(-1, x.shape[-1]), L @ x
        drift = plant.drift(flat).reshape(x.shape)
        if plant.constant:
            return drift - z @ fixed + (w @ plant.B.T)[:, None]
        G = plant.input_map(flat).reshape(*x.shape, -1)
        pull = ((z @ p.P)[..., None, :] @ G) @ (p.coupling * R_inverse)
        return drift + (G @ (w[:, None] - pull[..., 0, :])[..., None])[..., 0]

    return field


def _resting(
    p: Guarantee, worst: np.ndarray, size: float, rng: np.random.Generator, found: Outcome
) -> None:
    """Start on the boundary of the certified set, the leader at its trim."""
    start = (1.0 if p.radius is None else p.radius) * _starts(p, worst, rng)
    x = np.concatenate([np.zeros_like(start[:, :1]), start], axis=1)
    still = np.zeros((_STEPS, len(x), p.plant.B.shape[1]))
    _compare(p, x, still, _pace(p, size), found, stays=True)


def _moving(
    p: Guarantee, worst: np.ndarray, size: float, rng: np.random.Generator, found: Outcome
) -> None:
    """Start anywhere in the domain, the leader driven at random within the bounds of inputs."""
    low, high = np.maximum(p.low, -2.0), np.minimum(p.high, 2.0)
    x0 = 0.6 * rng.uniform(low, high, (_STARTS, 1, len(low)))
    delta = _starts(p, worst, rng)
    with np.errstate(divide="ignore"):
        room = np.where(delta > 0.0, (high - x0) / delta, (low - x0) / delta)
    room = np.where(delta == 0.0, np.inf, room).min(axis=(1, 2)) * rng.uniform(0.3, 1.0, _STARTS)
    x = np.concatenate([x0, x0 + room[:, None, None] * delta], axis=1)
    w = rng.uniform(p.input_low, p.input_high, (_STEPS // 5, _STARTS, len(p.input_low)))
    _compare(p, x, np.repeat(w, 5, axis=0), _pace(p, size), found, stays=False)


def _compare(
    p: Guarantee, x: np.ndarray, w: np.ndarray, dt: float, found: Outcome, stays: bool
) -> None:
    """Compare V along runs with the promise, while all agents are in the domain.

    Half the step shows the error of integration: it leaves a sixteenth of it, so the difference of
    the two runs bounds the error of the finer one.
    """
    with np.errstate(all="ignore"):
        rough, fine = (_runge_kutta(_loop(p), x, w, dt, cut) for cut in (1, 2))
    # A monotone drift promises the paper's V, whose weight is the grounded Laplacian.
    weight = np.eye(len(p.grounded))
    if p.theorem is Theorem.A5 and not p.plant.constant:
        weight = p.grounded
    rough_v, v = (_energy(path[:, :, 1:] - path[:, :, :1], weight, p.P) for path in (rough, fine))
    inside = ((fine >= p.low) & (fine <= p.high)).all(axis=(2, 3))
    if stays:
        # The set's own width comes of the inverse of P.
        slack = np.abs(fine - rough) + 64.0 * EPS * np.linalg.cond(p.P) * np.abs(x).max()
        left = ~((fine >= p.low - slack) & (fine <= p.high + slack)).all(axis=(2, 3))
        if p.radius is not None and left.any():
            found.violations.append("set: a run that began in the certified set left the domain")
    _decays(p, v, rough_v, dt, np.logical_and.accumulate(inside | stays), found)


def _energy(delta: np.ndarray, weight: np.ndarray, P: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):  # a run that leaves the domain may have no end
        return np.einsum("tsia,tsia->ts", np.einsum("ij,tsja->tsia", weight, delta), delta @ P)


def _decays(
    p: Guarantee,
    v: np.ndarray,
    rough: np.ndarray,
    dt: float,
    counts: np.ndarray,
    found: Outcome,
) -> None:
    """Note where V(t) > exp(-2 rate t) V(0) by more than the error of integration."""
    times = dt * np.arange(len(v))[:, None]
    # Near zero V is rounding of squares of states, eps of what it began with.
    slack = np.abs(v - rough) + 64.0 * EPS * len(p.grounded) * np.linalg.cond(p.P) ** 0.5 * v[0]
    bound = np.exp(-2.0 * p.rate * times) * v[0] * (1.0 + 64.0 * EPS * len(v))
    over = counts & ~(v <= bound + slack)
    found.runs += v.shape[1]
    with np.errstate(all="ignore"):
        seen = -0.5 * np.log((v - slack)[1:] / v[0]) / times[1:] - p.rate
    seen = seen[counts[1:] & np.isfinite(seen)]
    found.simulated = min(found.simulated, float(seen.min(initial=np.inf)))
    if over.any():
        found.violations.append(f"run: V above its bound at {int(over.sum())} samples")


def _variational(
    p: Guarantee, worst: np.ndarray, size: float, rng: np.random.Generator, found: Outcome
) -> None:
    """Integrate small errors behind a moving leader: what T2 speaks of."""
    low, high = np.maximum(p.low, -2.0), np.minimum(p.high, 2.0)
    x0 = rng.uniform(low, high, (_STARTS, 1, len(low)))
    x0[0] = 0.0
    w = np.repeat(rng.uniform(p.input_low, p.input_high, (_STEPS // 5, _STARTS, len(p.R))), 5, 0)
    search, plant = Search(p), p.plant

    def field(x: np.ndarray, w: np.ndarray) -> np.ndarray:
        leader, delta = x[:, 0], x[:, 1:]
        G = np.broadcast_to(plant.input_map(leader), (len(x), *plant.B.shape))
        A = search.jacobian(leader, w)
        z = np.einsum("ij,sja->sia", p.grounded, delta)
        K = np.linalg.solve(p.R, G.swapaxes(1, 2) @ p.P)
        motion = plant.drift(leader) + np.einsum("sam,sm->sa", G, w)
        slope = delta @ A.swapaxes(1, 2) - p.coupling * z @ (G @ K).swapaxes(1, 2)
        return np.concatenate([motion[:, None], slope], axis=1)

    x, dt = np.concatenate([x0, _starts(p, worst, rng)], axis=1), _pace(p, size)
    with np.errstate(all="ignore"):
        rough, fine = (_runge_kutta(field, x, w, dt, cut) for cut in (1, 2))
    inside = ((fine[:, :, 0] >= p.low) & (fine[:, :, 0] <= p.high)).all(axis=2)
    one = np.eye(len(p.grounded))
    v, rough_v = (_energy(path[:, :, 1:], one, p.P) for path in (fine, rough))
    _decays(p, v, rough_v, dt, np.logical_and.accumulate(inside), found)


# ---- the study ----


def study(seed: int, number: int, methods: int = 2) -> list[dict[str, Any]]:
    """Give a system to some methods and attack what they promise; one record a method."""
    system, rng = random_system(seed, number), np.random.default_rng([seed, number, 1])
    chances = np.array([3.0, 4.0, 4.0, 1.0, 1.0, 1.0]) / 14.0
    records = []
    for name in rng.choice(METHODS, methods, replace=False, p=chances):
        record: dict[str, Any] = {"number": number, "family": system.family, "method": str(name)}
        start = time.perf_counter()
        try:
            gain = ech.synthesize(system.model, system.graph, random_method(system, name, rng))
        except ech.EchelonError as refusal:
            records.append({**record, "refused": _reason(str(refusal))})
            continue
        promise = promise_of(system, gain)
        record["synthesis_s"] = time.perf_counter() - start
        if promise is not None:
            record |= asdict(attack(promise, rng)) | {"rate": promise.rate}
        else:
            region = gain.certificate.region
            record["kind"] = str(gain.certificate.kind if region is None else region.kind)
        records.append(record)
    return records


def _reason(told: str) -> str:
    """Return the kind of a refusal: its first clause, without the numbers and names in it."""
    first = re.split(r"[:;]|, and must", told)[0]
    return re.sub(r"`[^`]*`", "`...`", re.sub(r"-?\d[\d.e+-]*", "#", first))


def summary(records: list[dict[str, Any]], seed: int, systems: int) -> dict[str, Any]:
    """Return the study's figures."""
    made = [r for r in records if "refused" not in r]
    attacked = [r for r in made if "margin" in r]
    kinds = {
        f"{kind}, {theorem}": _figures([r for r in attacked if (r["kind"], r["theorem"]) == key])
        for key in sorted({(r["kind"], r["theorem"]) for r in attacked})
        for kind, theorem in [key]
    }
    return {
        "seed": seed,
        "systems": systems,
        "families": dict(Counter(r["family"] for r in attacked)),
        "syntheses": len(records),
        "by_method": {
            name: {
                "tried": sum(r["method"] == name for r in records),
                "gains": sum(r["method"] == name for r in made),
                "promises": sum(r["method"] == name for r in attacked),
            }
            for name in METHODS
        },
        "promises": kinds,
        "without a promise on a domain": dict(
            Counter(r["kind"] for r in made if "margin" not in r)
        ),
        "refusals": dict(Counter(r["refused"] for r in records if "refused" in r).most_common()),
        "points": sum(r["points"] for r in attacked),
        "runs": sum(r["runs"] for r in attacked),
        "violations": sum(bool(r["violations"]) for r in attacked),
        "violated": [r for r in attacked if r["violations"]],
    }


def _figures(attacked: list[dict[str, Any]]) -> dict[str, Any]:
    margin = min(r["margin"] for r in attacked)
    simulated = min(r["simulated"] for r in attacked)
    return {
        "attacked": len(attacked),
        "smallest margin, 1/s": margin,
        "smallest margin in units of its tolerance": min(
            r["margin"] / r["tolerance"] for r in attacked
        ),
        "smallest margin seen in simulation, 1/s": simulated,
        "violations": sum(bool(r["violations"]) for r in attacked),
    }


def _prepare(folder: str) -> None:
    # Systems of one size share what is compiled, between processes too.
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _task(arguments: tuple[int, int]) -> list[dict[str, Any]]:
    return study(*arguments)


def main() -> None:
    """Attack the promises for all systems and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--systems", type=int, default=2000, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="of the systems")
    parser.add_argument("--processes", type=int, default=2, help="at a time")
    parser.add_argument("--out", type=Path, default=REPORT, help="where the report goes, as JSON")
    asked, records, start = parser.parse_args(), [], time.perf_counter()
    numbers = [(asked.seed, k) for k in range(asked.systems)]
    with tempfile.TemporaryDirectory() as folder:
        context = multiprocessing.get_context("spawn")
        with context.Pool(asked.processes, _prepare, (folder,)) as pool:
            for done, found in enumerate(pool.imap(_task, numbers, chunksize=5), 1):
                records += found
                for record in found:
                    for told in record.get("violations", ()):
                        print(f"system {record['number']}, {record['method']}: {told}", flush=True)
                if done % 100 == 0:
                    print(f"{done} systems, {time.perf_counter() - start:.0f} s", flush=True)
    report = summary(records, asked.seed, asked.systems)
    report["seconds"] = round(time.perf_counter() - start)
    asked.out.write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
