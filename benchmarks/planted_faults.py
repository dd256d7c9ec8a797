"""Plant faults in saved gains and count how many of them `verify` refuses.

Run `python benchmarks/planted_faults.py` (a few minutes on two cores); `--quick` leaves the
quadrotors out. Every untouched file must be accepted and every fault refused, or it exits with 1.

A fault is a file that promises more than holds, or whose parts do not belong together. Where one
change would be given away by another number, a cunning version puts that number right as well.
"""

import argparse
import collections
import copy
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import echelon as ech

Told = dict[str, Any]
Random = np.random.Generator
DEG = np.pi / 180.0
LINE = ech.Graph.path(4)
TREE = ech.Graph.from_edges([(0, 1, 1.0), (1, 2, 2.0), (1, 3, 1.0), (2, 3, 0.5)])


class Soft(ech.ControlAffine):
    """A mass on a spring that gives way, by a function without enclosure: its gain is sampled."""

    state_names = ("place", "speed")
    input_names = ("force",)

    def drift(self, x: jax.Array) -> jax.Array:
        """Return f(x)."""
        spring = 2.0 * jax.scipy.special.erf(x[0])
        return jnp.stack([x[1], -spring - 0.3 * x[1]])

    def input_map(self, x: jax.Array) -> jax.Array:
        """Return g."""
        return jnp.array([[0.0], [1.0]], x.dtype)


Case = tuple[ech.ControlAffine, ech.Graph, ech.gains.Method]

SMALL: dict[str, Case] = {
    "riccati, pendulum": (ech.models.Pendulum(), LINE, ech.gains.Riccati()),
    "given, linear": (
        ech.models.Linear([[0.0, 1.0], [-1.0, -0.2]], [[0.0], [1.0]]),
        TREE,
        ech.gains.FixedGain(P=[[2.0, 0.3], [0.3, 1.0]], coupling=2.0),
    ),
    "inner loop, double integrator": (ech.models.DoubleIntegrator(2), TREE, ech.gains.InnerLoop()),
    "monotone, pendulum": (ech.models.Pendulum(), LINE, ech.gains.Monotone({"angle": 0.6})),
    "robust LQR, pendulum, proof": (
        ech.models.Pendulum(),
        LINE,
        ech.gains.RobustLQR({"angle": (-0.6, 0.8)}, exact=True),
    ),
    "contraction, pendulum, proof": (
        ech.models.Pendulum(),
        TREE,
        ech.gains.Contraction({"angle": 1.0}, rate=0.5),
    ),
    "contraction, Van der Pol": (
        ech.models.VanDerPol(),
        LINE,
        ech.gains.Contraction({"position": 1.0, "velocity": 1.0}, rate=0.3, exact=False),
    ),
    "robust LQR, spring, samples": (Soft(), LINE, ech.gains.RobustLQR({"place": 1.0})),
    "robust LQR, planar quadrotor, T2": (
        ech.models.PlanarQuadrotor(),
        LINE,
        ech.gains.RobustLQR({"roll": 0.2, "thrust": 1.0}),
    ),
}

LARGE: dict[str, Case] = {
    "riccati, quadrotor": (ech.models.Quadrotor.crazyflie(), LINE, ech.gains.Riccati()),
    "inner loop, quadrotor": (ech.models.Quadrotor.crazyflie(), TREE, ech.gains.InnerLoop()),
    "robust LQR, quadrotor with thrust, proof": (
        ech.models.QuadrotorThrust(),
        LINE,
        ech.gains.RobustLQR(
            {"roll": 20 * DEG, "pitch": 20 * DEG, "yaw": 10 * DEG, "thrust": 2.0}, exact=True
        ),
    ),
    "robust LQR, quadrotor in Euler rates, T2": (
        ech.models.QuadrotorEuler(),
        LINE,
        ech.gains.RobustLQR({"roll": 10 * DEG, "pitch": 10 * DEG, "yaw": 10 * DEG, "thrust": 1.0}),
    ),
}


def saved(case: Case, folder: Path) -> Told:
    """Return the file of a gain, as JSON reads it."""
    model, graph, method = case
    ech.save_gain(ech.synthesize(model, graph, method), model, graph, folder / "gain.json")
    return json.loads((folder / "gain.json").read_text("utf-8"))


# Each fault changes a file in place, and returns False where the file has nothing to change.
Fault = Callable[[Told, Random], bool]
FAULTS: dict[str, dict[str, Fault]] = collections.defaultdict(dict)


def fault(kind: str, *sizes: float) -> Callable[[Callable[..., bool]], Callable[..., bool]]:
    """List a fault under its kind, once for each size."""

    def listed(plant: Callable[..., bool]) -> Callable[..., bool]:
        if not sizes:
            FAULTS[kind][plant.__name__] = plant
        for size in sizes:
            FAULTS[kind][f"{plant.__name__} {size:g}"] = lambda told, random, size=size: plant(
                told, random, size
            )
        return plant

    return listed


def region_of(told: Told) -> Told | None:
    """Return the promise on a domain."""
    return told["certificate"]["region"]


def strength_put_right(told: Told) -> None:
    """Let the strength follow the coupling and the graph."""
    region = region_of(told)
    if region is not None and region["theorem"] != "A5":
        region["strength"] = 2.0 * told["coupling"] * told["certificate"]["lambda_min"]


def abscissa_put_right(told: Told) -> None:
    """Let the slowest mode follow everything else."""
    model = told["model"]
    A, B, P, R = (np.array(part) for part in (model["A"], model["B"], told["P"], told["R"]))
    A = A if told["inner"] is None else A - B @ np.array(told["inner"])
    K = told["coupling"] * B @ np.linalg.solve(R, B.T @ P)
    modes = [np.linalg.eigvals(A - value * K).real.max() for value in told["graph"]["spectrum"]]
    told["certificate"]["abscissa"] = float(max(modes))


def radius_put_right(told: Told) -> None:
    """Let the radius follow the metric and the domain."""
    region = region_of(told)
    if region is not None and region["radius"] is not None:
        bounds = [(region["domain"][end]) for end in ("lower", "upper")]
        W = np.diag(np.linalg.inv(np.array(told["P"])))
        pairs = [(min(-a, b), w) for a, b, w in zip(*bounds, W, strict=True) if a is not None]
        region["radius"] = float(np.sqrt(min(m**2 / w for m, w in pairs)))


@fault("P perturbed", 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
def metric_changed(told: Told, random: Random, size: float) -> bool:
    """Change all entries of P a little."""
    P = np.array(told["P"])
    change = random.uniform(-1.0, 1.0, P.shape)
    told["P"] = (P * (1.0 + size * 0.5 * (change + change.T))).tolist()
    return True


@fault("P perturbed", 1e-2, 1e-6)
def metric_scaled(told: Told, random: Random, size: float) -> bool:
    """Scale P, which is to change the coupling."""
    told["P"] = (np.array(told["P"]) * (1.0 + size)).tolist()
    return True


@fault("P perturbed")
def metric_flipped(told: Told, random: Random) -> bool:
    """Make the smallest eigenvalue of P negative, and say nothing of it elsewhere."""
    values, vectors = np.linalg.eigh(np.array(told["P"]))
    values[0] *= -1.0
    P = vectors @ np.diag(values) @ vectors.T
    told["P"] = (0.5 * (P + P.T)).tolist()
    abscissa_put_right(told)
    return True


@fault("P perturbed")
def metric_skewed(told: Told, random: Random) -> bool:
    """Make P asymmetric."""
    told["P"][0][1] += 0.1 * told["P"][0][0]
    abscissa_put_right(told)
    return True


@fault("coupling shrunk", 0.5, 1e-1, 1e-3, 1e-6)
def coupling_shrunk(told: Told, random: Random, size: float) -> bool:
    """Weaken the law alone."""
    told["coupling"] *= 1.0 - size
    return True


@fault("coupling shrunk", 0.3)
def coupling_shrunk_with_care(told: Told, random: Random, size: float) -> bool:
    """Weaken the law, and put right the numbers that give it away; the rate no longer holds."""
    if region_of(told) is None or region_of(told)["theorem"] == "A5":
        return False
    told["coupling"] *= 1.0 - size
    strength_put_right(told)
    abscissa_put_right(told)
    return True


@fault("R changed", 2.0, 1e-6)
def weight_scaled(told: Told, random: Random, size: float) -> bool:
    """Weigh the input more, which weakens the law."""
    told["R"] = (np.array(told["R"]) * (1.0 + size)).tolist()
    return True


@fault("R changed")
def weights_swapped(told: Told, random: Random) -> bool:
    """Exchange the weights of two inputs."""
    R = np.array(told["R"])
    if len(R) < 2 or R[0, 0] == R[-1, -1]:
        return False
    order = [len(R) - 1, *range(1, len(R) - 1), 0]
    told["R"] = R[np.ix_(order, order)].tolist()
    return True


@fault("inner loop changed", 2.0, 1.0, 0.5, 1e-6)
def inner_weakened(told: Told, random: Random, size: float) -> bool:
    """Negate (2), remove (1) or weaken the inner loop."""
    if told["inner"] is None:
        return False
    told["inner"] = ((1.0 - size) * np.array(told["inner"])).tolist()
    return True


@fault("inner loop changed")
def inner_left_out(told: Told, random: Random) -> bool:
    """Forget the inner loop, and put the slowest mode right."""
    if told["inner"] is None:
        return False
    told["inner"] = None
    abscissa_put_right(told)
    return True


@fault("domain widened", 0.5, 0.1, 0.01)
def domain_widened(told: Told, random: Random, size: float) -> bool:
    """Widen all bounds, and let the radius follow."""
    region = region_of(told)
    if region is None:
        return False
    for end in ("lower", "upper"):
        old = region["domain"][end]
        region["domain"][end] = [None if x is None else x * (1.0 + size) for x in old]
    radius_put_right(told)
    return True


@fault("domain widened")
def domain_unbounded(told: Told, random: Random) -> bool:
    """Take all bounds away, with the radius that they gave."""
    region = region_of(told)
    if region is None:
        return False
    for end in ("lower", "upper"):
        region["domain"][end] = [None for _ in region["domain"][end]]
    region["radius"] = None
    return True


@fault("rate raised", 1.0, 1e-1, 1e-2, 1e-5)
def rate_raised(told: Told, random: Random, size: float) -> bool:
    """Promise to be faster."""
    region = region_of(told)
    if region is None:
        return False
    region["rate"] = region["rate"] * (1.0 + size) if region["rate"] else 0.1 * size
    return True


@fault("radius raised", 1.0, 1e-2, 1e-6)
def radius_raised(told: Told, random: Random, size: float) -> bool:
    """Promise a larger set."""
    region = region_of(told)
    if region is None or region["radius"] is None:
        return False
    region["radius"] *= 1.0 + size
    return True


@fault("radius raised")
def radius_invented(told: Told, random: Random) -> bool:
    """Promise a set where there is none, T2 being local."""
    region = region_of(told)
    if region is None or region["radius"] is not None:
        return False
    region["radius"] = 0.01
    return True


@fault("corners changed", 0.3, 0.1, 0.01)
def corners_drawn_in(told: Told, random: Random, size: float) -> bool:
    """Draw all corners towards their mean, so that Jacobians stick out."""
    region = region_of(told)
    if region is None:
        return False
    values = np.array(region["hull"]["values"])
    region["hull"]["values"] = (values + size * (values.mean(axis=0) - values)).tolist()
    return True


@fault("corners changed", 0.1, 1e-3)
def corner_moved(told: Told, random: Random, size: float) -> bool:
    """Draw the corner in that is farthest from the mean."""
    region = region_of(told)
    if region is None or region["kind"] == "samples":
        return False
    values = np.array(region["hull"]["values"])
    mean = values.mean(axis=0)
    far = needed_corner(values)
    values[far] += size * (mean - values[far])
    region["hull"]["values"] = values.tolist()
    return True


def needed_corner(values: np.ndarray) -> int:
    """Return a corner without which a Jacobian is outside: one that has the least of an entry."""
    return int(values[:, np.ptp(values, axis=0).argmax()].argmin())


@fault("corners removed", 0.5, 0.9)
def corners_removed(told: Told, random: Random, part: float) -> bool:
    """Remove the corners on one side."""
    region = region_of(told)
    if region is None or region["kind"] == "samples":
        return False
    values = np.array(region["hull"]["values"])
    entry = values[:, np.ptp(values, axis=0).argmax()]
    kept = np.argsort(entry)[: max(1, int(round(len(values) * (1.0 - part))))]
    region["hull"]["values"] = values[kept].tolist()
    return True


@fault("corners removed")
def slowest_side_removed(told: Told, random: Random) -> bool:
    """Remove the corners that have the least of an entry."""
    region = region_of(told)
    if region is None or region["kind"] == "samples":
        return False
    values = np.array(region["hull"]["values"])
    entry = values[:, np.ptp(values, axis=0).argmax()]
    region["hull"]["values"] = values[entry > entry.min()].tolist()
    return True


@fault("corners removed")
def only_the_trim_left(told: Told, random: Random) -> bool:
    """Let A at the trim stand for the domain, with the rate that it has."""
    region = region_of(told)
    if region is None or region["theorem"] == "T2":
        return False
    region["hull"] = {"base": told["model"]["A"], "places": [], "values": []}
    return True


@fault("error of the corners", 1.0, -1.0, 1e-3)
def error_changed(told: Told, random: Random, size: float) -> bool:
    """Say of the corners that they are less exact than the proof takes, or more than exact."""
    region = region_of(told)
    if region is None:
        return False
    largest = float(np.abs(np.array(region["hull"]["base"])).max())
    region["error"] = np.full(np.shape(region["error"]), size * largest).tolist()
    return True


@fault("graph changed", 1.0, 1e-2, 1e-6, -1e-6)
def edge_weighed(told: Told, random: Random, size: float) -> bool:
    """Change the weight of an edge."""
    edges = told["graph"]["edges"]
    edges[random.integers(len(edges))][2] *= 1.0 + size
    return True


@fault("graph changed")
def edge_removed(told: Told, random: Random) -> bool:
    """Leave an edge out."""
    told["graph"]["edges"].pop()
    return True


@fault("graph changed")
def edge_added(told: Told, random: Random) -> bool:
    """Link two agents more."""
    told["graph"]["edges"].append([0, 3, 1.0])
    return True


@fault("graph changed")
def edge_negated(told: Told, random: Random) -> bool:
    """Give an edge a negative weight."""
    told["graph"]["edges"][0][2] *= -1.0
    return True


@fault("graph changed")
def leader_added(told: Told, random: Random) -> bool:
    """Call a follower a leader."""
    told["graph"]["leaders"].append(2)
    return True


@fault("graph changed", 0.5, 1e-6)
def spectrum_raised(told: Told, random: Random, size: float) -> bool:
    """Claim a faster graph everywhere, the coupling's strength included."""
    graph, certificate = told["graph"], told["certificate"]
    graph["spectrum"] = [value * (1.0 + size) for value in graph["spectrum"]]
    certificate["lambda_min"], certificate["lambda_max"] = (
        graph["spectrum"][0],
        graph["spectrum"][-1],
    )
    strength_put_right(told)
    abscissa_put_right(told)
    return True


@fault("stronger kind")
def kind_proof(told: Told, random: Random) -> bool:
    """Call what eigenvalues showed a proof; of A5, which has room, it would be true."""
    region = region_of(told)
    if region is None or region["kind"] == "proof" or region["theorem"] == "A5":
        return False
    region["kind"] = "proof"
    return True


@fault("stronger kind")
def kind_vertices(told: Told, random: Random) -> bool:
    """Call samples the corners of a hull."""
    region = region_of(told)
    if region is None or region["kind"] != "samples":
        return False
    region["kind"] = "vertices"
    return True


@fault("stronger kind")
def mode_proved(told: Told, random: Random) -> bool:
    """Call the linearization a proof."""
    told["certificate"]["kind"] = "proof"
    return True


@fault("stronger theorem")
def theorem_nonlocal(told: Told, random: Random) -> bool:
    """Claim T1 where g varies: the corners without their input maps."""
    region = region_of(told)
    if region is None or region["theorem"] != "T2":
        return False
    n, hull = len(told["P"]), region["hull"]
    kept = [k for k, (_, column) in enumerate(hull["places"]) if column < n]
    region["theorem"] = "T1"
    region["error"] = [row[:n] for row in region["error"]]
    region["hull"] = {
        "base": [row[:n] for row in hull["base"]],
        "places": [hull["places"][k] for k in kept],
        "values": [[row[k] for k in kept] for row in hull["values"]],
    }
    return True


@fault("stronger theorem")
def theorem_drift_alone(told: Told, random: Random) -> bool:
    """Claim that the drift alone has the rate (A5)."""
    region = region_of(told)
    if region is None or region["theorem"] != "T1":
        return False
    region["theorem"], region["strength"] = "A5", 0.0
    return True


@fault("stronger theorem")
def theorem_with_feedback(told: Told, random: Random) -> bool:
    """Claim a rate under feedback where only the drift was looked at."""
    region = region_of(told)
    if region is None or region["theorem"] != "A5":
        return False
    region["theorem"], region["rate"] = "T1", 0.5
    strength_put_right(told)
    return True


@fault("number raised", 1e-1, 1e-6)
def mode_faster(told: Told, random: Random, size: float) -> bool:
    """Claim a faster slowest mode."""
    told["certificate"]["abscissa"] -= size * max(abs(told["certificate"]["abscissa"]), 1e-2)
    return True


@fault("number raised", 0.5, 1e-6)
def edge_lowered(told: Told, random: Random, size: float) -> bool:
    """Claim that a weaker coupling would do."""
    if told["method"] not in ("riccati", "robust-lqr"):
        return False
    told["certificate"]["edge"] *= 1.0 - size
    return True


@fault("number raised")
def edge_invented(told: Told, random: Random) -> bool:
    """Claim that every coupling will do, of a gain that has no edge or a positive one."""
    if told["certificate"]["edge"] == 0.0:
        return False
    told["certificate"]["edge"] = 0.0
    return told["method"] != "contraction"


@fault("number raised", 1, -1)
def rank_changed(told: Told, random: Random, step: float) -> bool:
    """Claim another rank of observability."""
    told["certificate"]["observable"] += int(step)
    return True


@fault("number raised")
def modes_changed(told: Told, random: Random) -> bool:
    """Claim to have looked at more eigenvalues."""
    told["certificate"]["modes"] += 1
    return True


@fault("number raised", 0.5, 1e-6)
def strength_raised(told: Told, random: Random, size: float) -> bool:
    """Claim a stronger feedback."""
    region = region_of(told)
    if region is None or region["theorem"] == "A5":
        return False
    region["strength"] *= 1.0 + size
    return True


@fault("method changed")
def method_changed(told: Told, random: Random) -> bool:
    """Claim another method, whose edge is another."""
    if told["method"] in ("contraction", "robust-lqr"):
        return False
    told["method"] = "riccati" if told["method"] != "riccati" else "inner-loop"
    return True


@fault("model changed", 0.1, 1e-6)
def parameter_changed(told: Told, random: Random, size: float) -> bool:
    """Name other parameters than those that A and B were made with."""
    parameters = told["model"]["parameters"]
    if not told["model"]["class"].startswith("echelon.agents.models."):
        return False
    used = ("damping", "mass", "gravity", "drag")
    name = next((key for key in used if key in parameters), None)
    if name is None:
        parameters["A"][1][0] *= 1.0 + size
    else:
        parameters[name] = parameters[name] * (1.0 + size) if parameters[name] else size
    return True


@fault("model changed", 0.1, 1e-6)
def slope_changed(told: Told, random: Random, size: float) -> bool:
    """Store another A than the model has, and put right what rests on it."""
    A = np.array(told["model"]["A"])
    A[tuple(np.argwhere(A)[-1])] *= 1.0 + size
    told["model"]["A"] = A.tolist()
    abscissa_put_right(told)
    return True


@fault("model changed")
def input_scaled(told: Told, random: Random) -> bool:
    """Store a stronger input than the model has."""
    told["model"]["B"] = (1.01 * np.array(told["model"]["B"])).tolist()
    abscissa_put_right(told)
    return True


@fault("model changed")
def trim_moved(told: Told, random: Random) -> bool:
    """Name a trim that is no equilibrium."""
    told["model"]["trim"][1][0] += 0.01
    return True


def planted(told: Told, seed: int = 0) -> Iterator[tuple[str, str, Told]]:
    """Yield the kind, the name and the file of every fault that a saved gain can have."""
    for kind, faults in FAULTS.items():
        for name, plant in faults.items():
            faulty = copy.deepcopy(told)
            if plant(faulty, np.random.default_rng(seed)):
                yield kind, name, faulty


def refused(told: Told, folder: Path, model: ech.ControlAffine | None) -> bool:
    """Tell whether `verify` refuses a file, as bad input or by what it recomputes."""
    file = folder / "faulty.json"
    file.write_text(json.dumps(told), "utf-8")
    try:
        return ech.verify(file, model).verdict == "refused"
    except ech.EchelonError:
        return True


def own_model(case: Case) -> ech.ControlAffine | None:
    """Return the model that a file cannot name, or None for a bundled one."""
    return case[0] if isinstance(case[0], Soft) else None


def study(cases: Mapping[str, Case], folder: Path) -> bool:
    """Print the counts by kind; return whether nothing went wrong."""
    counts: dict[str, list[int]] = collections.defaultdict(lambda: [0, 0])
    missed, fine, begun = [], 0, time.perf_counter()
    for name, case in cases.items():
        told, model = saved(case, folder), own_model(case)
        accepted = ech.verify(folder / "gain.json", model).holds
        fine += accepted
        print(f"{name}: untouched {'accepted' if accepted else 'REFUSED'}", flush=True)
        for kind, what, faulty in planted(told):
            caught = refused(faulty, folder, model)
            counts[kind][0] += 1
            counts[kind][1] += caught
            missed += [] if caught else [f"{name}: {what}"]
    print(f"\n{'kind of fault':<24}{'planted':>8}{'refused':>8}")
    for kind, (count, caught) in counts.items():
        print(f"{kind:<24}{count:>8}{caught:>8}")
    total, caught = (sum(pair[k] for pair in counts.values()) for k in (0, 1))
    print(f"{'all':<24}{total:>8}{caught:>8}")
    print(f"{fine} of {len(cases)} untouched files accepted; {time.perf_counter() - begun:.0f} s")
    for each in missed:
        print(f"missed: {each}")
    return not missed and fine == len(cases)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="leave the quadrotors out")
    cases = SMALL if parser.parse_args().quick else {**SMALL, **LARGE}
    with tempfile.TemporaryDirectory() as folder:
        raise SystemExit(0 if study(cases, Path(folder)) else 1)


if __name__ == "__main__":
    main()
