"""Measure what echelon promises of its gains and write `docs/certificates.md`.

Run `python benchmarks/certificates.py` (about five minutes on two cores). `--faults` plants all
faults (else those of small agents), `--large` checks 100,000 agents, `--thirty` flies the line of
30 followers, `--all` does all of it. The attack on random systems is `python benchmarks/attack.py`,
whose report is read here; `--attack 100` makes a new one of 100 systems.
"""

import argparse
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import planted_faults

import echelon as ech
from echelon.core.files import versions

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs" / "certificates.md"
LINE = ech.Graph.path(4)
DEG = np.pi / 180.0
Row = tuple[str, str, str]


def timed(act: Callable[[], Any]) -> tuple[Any, float]:
    """Return what a call gives, and its seconds."""
    start = time.perf_counter()
    return act(), time.perf_counter() - start


def refusal(act: Callable[[], Any]) -> str:
    """Return the sentence of a refusal, or that there is none."""
    try:
        act()
    except ech.EchelonError as told:
        return str(told)
    return "no refusal"


def tilted(tilt: float, yaw: float, thrust: float) -> dict[str, float]:
    """Return a domain of angles in degrees and thrust in m/s^2."""
    return {"roll": tilt * DEG, "pitch": tilt * DEG, "yaw": yaw * DEG, "thrust": thrust}


# ---- no false certificate ----


def attacked(systems: int) -> tuple[list[Row], str]:
    """Return the figures of the attack, from its report or of a new one."""
    file = HERE / "attack.json"
    if systems:
        file = Path(tempfile.mkdtemp()) / "attack.json"
        command = [sys.executable, str(HERE / "attack.py"), "--systems", str(systems)]
        subprocess.run([*command, "--out", str(file)], check=True, stdout=subprocess.DEVNULL)
    told = json.loads(file.read_text("utf-8"))
    promises = told["promises"].values()
    rows = [
        ("random systems", f"{told['systems']}", "2,000"),
        ("gains asked for, two methods a system", f"{told['syntheses']}", "-"),
        ("promises by proof or vertices, attacked", f"{sum(p['attacked'] for p in promises)}", "-"),
        ("states tried by the gradient search", f"{told['points']}", "-"),
        ("runs behind resting and moving leaders", f"{told['runs']}", "-"),
        ("promises violated", f"{told['violations']}", "0"),
    ]
    return rows, _by_kind(told)


def _by_kind(told: dict[str, Any]) -> str:
    """Return the tables of promises by kind, methods and refusals."""
    lines = [
        "| promise | attacked | smallest margin, 1/s | in simulation, 1/s | violations |",
        "|---|---|---|---|---|",
    ]
    for name, figures in told["promises"].items():
        margin, run = (
            figures["smallest margin, 1/s"],
            figures["smallest margin seen in simulation, 1/s"],
        )
        lines.append(
            f"| {name} | {figures['attacked']} | {margin:.1e} | {run:.1e} | "
            f"{figures['violations']} |"
        )
    lines += ["", "| method | asked | gains | promises on a domain |", "|---|---|---|---|"]
    for name, count in told["by_method"].items():
        lines.append(f"| {name} | {count['tried']} | {count['gains']} | {count['promises']} |")
    lines += ["", "| refused since | times |", "|---|---|"]
    lines += [f"| {reason} | {count} |" for reason, count in told["refusals"].items()]
    return "\n".join(lines)


def planted(all_faults: bool) -> list[Row]:
    """Plant faults in saved gains and count what the independent checker refuses."""
    cases = planted_faults.SMALL | (planted_faults.LARGE if all_faults else {})
    count, caught, fine = 0, 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case in cases.values():
            told, model = planted_faults.saved(case, folder), planted_faults.own_model(case)
            fine += not planted_faults.refused(told, folder, model)
            verdicts = [
                planted_faults.refused(faulty, folder, model)
                for _, _, faulty in planted_faults.planted(told)
            ]
            count, caught = count + len(verdicts), caught + sum(verdicts)
    return [
        ("planted faults that `echelon verify` refuses", f"{caught} of {count}", "200 of 200"),
        ("untouched files that it accepts", f"{fine} of {len(cases)}", "all"),
    ]


# ---- the Crazyflie ----


def crazyflie() -> list[Row]:
    """Time the gains and the check of the Crazyflie."""
    model = ech.models.Quadrotor.crazyflie()
    _, first = timed(lambda: ech.synthesize(model, LINE, ech.gains.Riccati()))
    begun = time.process_time()
    again = [timed(lambda: ech.synthesize(model, LINE, ech.gains.Riccati()))[1] for _ in range(50)]
    busy = (time.process_time() - begun) / len(again)
    command, before = [sys.executable, "-m", "echelon", "check", "paper"], _children()
    done, seconds = timed(lambda: subprocess.run(command, capture_output=True, text=True))
    assert done.returncode == 0, done.stderr
    return [
        (
            "Riccati gain, certificate included (the first compiles)",
            f"{1e3 * np.median(again):.0f} ms, of CPU {1e3 * busy:.0f} ms ({first:.1f} s)",
            "20 ms",
        ),
        (
            "`echelon check paper`, Python's start and imports included",
            f"{seconds:.1f} s, of CPU {_children() - before:.1f} s",
            "5 s",
        ),
        *euler(),
        *thrust(),
    ]


def _children() -> float:
    """Return the CPU seconds of processes that were started and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def euler() -> list[Row]:
    """Measure the 12 states in Euler rates, whose thrust turns with the vehicle."""
    model, bounds = ech.models.QuadrotorEuler(), tilted(20.0, 10.0, 2.0)
    gain, seconds = timed(lambda: ech.synthesize(model, LINE, ech.gains.RobustLQR(bounds)))
    low = LINE.spectrum().low
    at_edge = ech.gains.RobustLQR(bounds, coupling=0.5 / low)
    return [
        (
            "robust LQR, 12 states, tilt 20, yaw 10 deg, +-2 m/s^2: promise; at the edge of the "
            "coupling, half of it; condition of P; time",
            f"{guarantee(gain)}; {guarantee(ech.synthesize(model, LINE, at_edge))}; "
            f"{np.linalg.cond(gain.P):.0f}; {seconds:.1f} s",
            "0.2 1/s; -; 500; 60 s",
        )
    ]


def thrust() -> list[Row]:
    """Measure the 13 states, whose input map is constant: proofs in exact arithmetic."""
    model, rows = ech.models.QuadrotorThrust(), list[Row]()
    for bounds, where in (
        (tilted(20.0, 10.0, 2.0), "tilt 20, yaw 10 deg, +-2 m/s^2"),
        (tilted(30.0, 20.0, 3.0), "tilt 30, yaw 20 deg, +-3 m/s^2"),
    ):
        for name, method in (
            ("robust LQR", ech.gains.RobustLQR(bounds, exact=True)),
            ("contraction at 0.095 1/s", ech.gains.Contraction(bounds, rate=0.095)),
        ):
            gain, seconds = timed(lambda method=method: ech.synthesize(model, LINE, method))
            rows.append(
                (
                    f"{name}, 13 states, {where}: promise, condition of P, coupling, time in all",
                    f"{guarantee(gain)}, {np.linalg.cond(gain.P):.0f}, {gain.coupling:.3g}, "
                    f"{seconds:.1f} s",
                    "proof, 60 s",
                )
            )
    return rows


def guarantee(gain: ech.Gain) -> str:
    """Return what a gain promises on its domain, in words."""
    region = gain.certificate.region
    return "none" if region is None else f"{region.rate:.3f} 1/s ({region.kind}, {region.theorem})"


# ---- the inner loop ----


def inner_loops(lengths: Sequence[tuple[int, float]]) -> list[Row]:
    """Fly lines of quadrotors by the inner-loop gain: one coupling and one step for all."""
    model, rows = ech.models.Quadrotor.crazyflie(), list[Row]()
    for followers, horizon in lengths:
        graph = ech.Graph.path(followers + 1)
        gain = ech.synthesize(model, graph, ech.gains.InnerLoop())
        result = ech.simulate(
            ech.Parts(
                model,
                graph,
                ech.Formation.line(model, graph, 0.5),
                ech.Laws(
                    ech.laws.Tracking(ech.references.FigureEight()),
                    ech.laws.Consensus(gain, feedforward="relay"),
                ),
                initial={"position": 1.0, "attitude": 0.3},
            ),
            ech.Settings(horizon=horizon, dt=0.005, store_every=100, steady_window=0.1 * horizon),
        )
        errors = result.formation_errors[:, 1:]
        above = np.flatnonzero(errors.max(axis=1) > 1e-9)
        steady = ech.metrics(result).worst_steady
        reached = result.times[min(above[-1] + 1, len(errors) - 1)] if len(above) else 0.0
        rows.append(
            (
                f"line of {followers} followers, c = {gain.coupling:g}, dt 5 ms: time to 1e-9 m, "
                "then steady RMSE of the worst",
                f"{reached:.1f} s, {steady:.1e} m",
                "1e-9 m",
            )
        )
    return rows


def growth() -> str:
    """Return the table of time constants over lengths."""
    model = ech.models.Quadrotor.crazyflie()
    lines = [
        "| followers in a line | time constant, inner loop at c = 3 | plain Riccati: coupling that "
        "it needs |",
        "|---|---|---|",
    ]
    for followers in (3, 10, 30, 100):
        graph = ech.Graph.path(followers + 1)
        gain = ech.synthesize(model, graph, ech.gains.InnerLoop())
        constant = -1.0 / gain.certificate.abscissa
        needed = 0.5 / graph.spectrum().low
        lines.append(f"| {followers} | {constant:.3g} s | {needed:.3g} |")
    return "\n".join(lines)


# ---- Assumption 5 ----


def assumption_five() -> list[Row]:
    """Time the refusals, and find the edges of the pendulum."""
    rows = list[Row]()
    for name, model, bounds in (
        ("double integrator", ech.models.DoubleIntegrator(3), {}),
        (
            "drag-free quadrotor as printed",
            ech.models.PrintedQuadrotor(),
            {"attitude": 0.2, "rate": 0.5},
        ),
    ):

        def refused(model: ech.ControlAffine = model, bounds: dict[str, float] = bounds) -> str:
            return refusal(lambda: ech.synthesize(model, LINE, ech.gains.Monotone(bounds)))

        timed(refused)
        told, seconds = timed(refused)
        why = re.search(r"has (.*?);", told)
        rows.append(
            (
                f"`Monotone` of the {name}: {why[1] if why else told}",
                f"infeasible, {seconds:.2f} s",
                "infeasible, 1 s",
            )
        )
    soft = ech.models.Pendulum(damping=0.5, stiffness=1.0)
    metric = ech.synthesize(soft, LINE, ech.gains.Monotone({"angle": 1.0}))
    beyond = refusal(lambda: ech.synthesize(soft, LINE, ech.gains.Monotone({"angle": 1.6})))
    low, high = _edge(ech.models.Pendulum(damping=0.5, stiffness=9.81))
    return [
        *rows,
        (
            "pendulum (x2, -sin x1 - 0.5 x2) to 1 rad: condition of P",
            f"{np.linalg.cond(metric.P):.2f}",
            "3",
        ),
        (
            "the same to 1.6 rad",
            "infeasible" if beyond.startswith("no ") else beyond,
            "infeasible",
        ),
        (
            "with gravity 9.81: feasible to, infeasible from",
            f"{low:.4f}, {high:.4f} rad",
            "0.787 rad",
        ),
    ]


def _edge(model: ech.ControlAffine) -> tuple[float, float]:
    """Return angles within 1e-4 rad between which the metric is lost."""
    low, high = 0.5, 1.2
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        method = ech.gains.Monotone({"angle": middle})
        feasible = refusal(lambda method=method: ech.synthesize(model, LINE, method))
        low, high = (middle, high) if feasible == "no refusal" else (low, middle)
    return low, high


# ---- large graphs, and certified against observed ----


def large() -> list[Row]:
    """Check a scenario of 100,000 agents, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(HERE / "check_large.py")]
        told = subprocess.run(command, cwd=folder, capture_output=True, text=True).stdout
    seconds = re.search(r"([\d.]+) s of wall time", told)
    memory = re.search(r"peak ([\d.]+) GB", told)
    return [
        (
            "`echelon check` on a geometric graph of 100,000 agents",
            f"{seconds[1] if seconds else '?'} s, {memory[1] if memory else '?'} GB",
            "30 s, 4 GB",
        )
    ]


def certified_and_observed() -> list[Row]:
    """Push one follower out of place, as far as the promise reaches and as far as it comes back."""
    model, rows = ech.models.QuadrotorThrust(), list[Row]()
    gain = ech.synthesize(model, LINE, ech.gains.RobustLQR(tilted(20.0, 10.0, 2.0), exact=True))
    region = gain.certificate.region
    assert region is not None and region.radius is not None
    for name, unit, tries in (
        ("x", "m", (1.0, 4.0, 16.0, 64.0)),
        ("z", "m", (1.0, 4.0, 16.0, 64.0)),
        ("vx", "m/s", (1.0, 4.0, 16.0, 64.0)),
        ("roll", "rad", (0.3, 0.6, 0.9, 1.2, 1.5)),
        ("yaw", "rad", (0.3, 0.6, 0.9, 1.2, 1.5)),
    ):
        k = model.state_names.index(name)
        certified = region.radius / np.sqrt(gain.P[k, k])
        back = [size for size in tries if _comes_back(model, gain, name, size)]
        rows.append(
            (
                f"`{name}`: certified / observed",
                f"{certified:.3g} / {max(back, default=0.0):g} {unit}",
                f"tried {', '.join(f'{size:g}' for size in tries)}",
            )
        )
    return rows


def _comes_back(model: ech.ControlAffine, gain: ech.Gain, name: str, size: float) -> bool:
    """Tell whether followers off by a size to both sides end within a thousandth of it."""
    formation = ech.Formation.line(model, LINE, 0.5)
    for sign in (1.0, -1.0):
        states = formation.offsets + np.asarray(model.trim[0])
        states[1, model.state_names.index(name)] += sign * size
        result = ech.simulate(
            ech.Parts(
                model,
                LINE,
                formation,
                ech.Laws(ech.laws.TrimInput(), ech.laws.Consensus(gain, feedforward="relay")),
                initial=states,
            ),
            ech.Settings(horizon=60.0, dt=0.002, store_every=500),
        )
        end = np.abs(result.errors[-1]).max()
        if result.outcome is not ech.Outcome.COMPLETED or not end < 1e-3 * size:
            return False
    return True


def table(rows: Sequence[Row]) -> str:
    """Return rows as a Markdown table."""
    lines = ["| what | measured | goal or known value |", "|---|---|---|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def pages(asked: argparse.Namespace) -> list[str]:
    """Measure everything and return the parts of the page."""
    told = ", ".join(f"{name} {text}" for name, text in versions().items() if name != "git")
    figures, by_kind = attacked(asked.attack)
    lengths = [(3, 40.0), (10, 120.0), *([(30, 700.0)] if asked.thirty else [])]
    return [
        "# Certificates",
        "Made by `python benchmarks/certificates.py`; rerun it to check (`--all` for every row). "
        f"Asked are the figures that the project set itself. Versions: {told}.",
        "## No false certificate",
        "Linear, polynomial and trigonometric agents of up to 6 states on random connected graphs"
        " of up to 30, with random domains, weights and couplings. Promises of kind `proof` or "
        "`vertices` are attacked, with equations of their own in NumPy, by a search for a state "
        "of the domain that breaks the inequality (gradients of its largest eigenvalue, many "
        "starts, corners) and by simulation from the boundary of the certified set, leaders at "
        "rest and driven at random. A margin is the rate found less the rate promised; a negative"
        " one within rounding is no violation.",
        table(figures),
        by_kind,
        "Faults are planted in saved gains, and `echelon verify` recomputes each file.",
        table(planted(asked.faults)),
        "## The Crazyflie",
        "On the line of three. In Euler rates the thrust turns with the vehicle, and the promise "
        "is local (T2). With the thrust as a 13th state the input map is constant, and proofs are"
        " nonlocal (T1).",
        table(crazyflie()),
        "## Certified and observed",
        "The 13 states by robust LQR (tilt 20, yaw 10 deg, +-2 m/s^2), the leader at its trim, "
        "one follower of three off: the largest deviation inside the certified set, and the "
        "largest tried from which all followers came back.",
        table(certified_and_observed()),
        "## The inner loop",
        "Gain `inner-loop` with relay, starts within 1 m and 0.3 rad (seed 0), the leader on a "
        "figure eight. The time constant of the slowest disagreement, 1/|abscissa|, grows like "
        "N^2, as the coupling of a plain Riccati gain must.",
        table(inner_loops(lengths)),
        growth(),
        "## Assumption 5",
        table(assumption_five()),
        *(["## Large graphs", table(large())] if asked.large else []),
    ]


def main() -> None:
    """Measure everything and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--attack", type=int, default=0, help="systems of a new attack")
    for name, what in (
        ("faults", "plant faults in gains of quadrotors too"),
        ("large", "check 100,000 agents"),
        ("thirty", "fly the line of 30 followers"),
        ("all", "the three of them"),
    ):
        parser.add_argument(f"--{name}", action="store_true", help=what)
    asked = parser.parse_args()
    if asked.all:
        asked.faults = asked.large = asked.thirty = True
    PAGE.write_text("\n\n".join(pages(asked)) + "\n", "utf-8")
    print(PAGE.read_text("utf-8"))


if __name__ == "__main__":
    main()
