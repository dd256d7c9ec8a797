"""Measure both halves of the paper's comparison and write their part of `docs/results.md`.

Run `OMP_NUM_THREADS=1 python benchmarks/comparison.py` (about ten minutes on two cores).
"""

from collections.abc import Iterator, Sequence

import numpy as np
import optimization
from pages import write_part

import echelon as ech
from echelon.core.files import versions
from echelon.experiments.results.run_numbers import RUN_NUMBERS
from echelon.experiments.results.table_two import PRINTED, table_two
from echelon.experiments.studies.compare import ComparisonRow

CONDITIONS = {
    "as in the paper: no wind, no error of mass": [],
    "wind of 1 m/s^2 rms": ["disturbance={rms: {velocity: 1.0}}"],
    "mass 5 % above the model's": ["plant={scale: {mass: 1.05}}"],
}
HEADS = (
    *("method", "leader", "F1-L", "F2-F1", "F3-F1", "F1", "F2", "F3"),
    *("leader, last 2 s", "worst F, last 2 s", "within 1 cm from, s"),
    *("effort", "limited, % steps", "least distance", "ms per agent s"),
)


NAMES = (
    *("worst_steady_rmse", "worst_settling_time", "effort", "saturation_fraction"),
    *("minimum_distance", "computing"),
)


def number(value: float | None) -> str:
    """Return a number for the page, a dash where there is none."""
    return "-" if value is None else f"{value:.3g}"


def cells(row: ComparisonRow) -> list[str]:
    """Return one method's cells."""
    if row.flight is None:
        return [row.label, *["-"] * (len(HEADS) - 1)]
    early, leader = table_two(row.flight.result), row.flight.metrics.leader
    if early is None:
        return [f"`{row.label}`", *["-"] * (len(HEADS) - 1)]
    return [
        f"`{row.label}`",
        *map(number, (early.leader, *early.distances, *early.vectors)),
        number(leader.steady_rmse),
        *(RUN_NUMBERS[name].cell(row.number(name), 3) for name in NAMES),
    ]


def compared(title: str, changes: Sequence[str]) -> Iterator[str]:
    """Yield the part of one condition."""
    scenario = ech.load_scenario("paper", ["simulation.horizon=10", *changes])
    found = ech.compare(scenario)
    rows = [cells(row) for row in found.rows]
    for name, values in PRINTED.items() if not changes else ():
        rows.append(
            [f"printed, {name}", *(number(value) for value in values), *[""] * (len(HEADS) - 5)]
        )
    yield f"### {title.capitalize()}"
    yield table(HEADS, rows)


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows as a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def planar() -> Iterator[Sequence[str]]:
    """Yield the planar baseline, printed and repaired."""
    start = [-np.pi, 0.0, 0.0, 0.0, 0.0, 0.0]
    literal, repaired = ech.optimal.PlanarBaseline.literal, ech.optimal.PlanarBaseline.repaired
    for name, problem, known in (
        ("as printed, 100 steps", literal(steps=100), "0.480"),
        ("as printed, 400 steps", literal(steps=400), "0.467"),
        ("without the terminal cost, 100 steps", literal(steps=100, terminal="none"), "0.181"),
        ("terminal cost on the error, 100 steps", repaired(steps=100), "-"),
    ):
        found = ech.optimal.solve(problem.leader(), start, problem.reference)
        yield f"leader {name}: RMSE", f"{problem.tracking_rmse(found.states):.4f} m", known
    tree = ech.Graph.from_edges([(0, 1), (1, 2), (1, 3)])
    offsets = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.5, -0.5]])
    for name, problem in (("as printed", literal()), ("repaired", repaired())):
        plans = problem.plans(tree, offsets)
        gaps = [(plans[i].states - plans[j].states)[:, [0, 2]] for i, j in ((1, 0), (2, 1), (3, 1))]
        far = [f"{np.linalg.norm(gap, axis=1).max():.4g}" for gap in gaps]
        text = f"followers {name}: greatest distance from their neighbour, desired 0.5 m"
        yield text, ", ".join(far) + " m", "-"


def main() -> None:
    """Measure everything and write the part of the page."""
    told = {name: text for name, text in versions().items() if name != "git"}
    parts = [
        "## The two halves compared",
        "`echelon compare paper`: the same starts (seed 0), motor limits and wind for all methods, "
        "10 s, RMSE in m. F1-L, F2-F1 and F3-F1 are distances, the paper's measure; F1, F2 and F3 "
        "are vectors from each follower to its goal, which is stricter. `optimal-leader` is "
        "`riccati-relay` behind the paper's leader, which plans its path; `optimization` is "
        "planned once and flown open loop; `mpc` plans 1 s ahead 50 times a second. Computing is "
        "on one shared machine, compilation "
        f"apart. Versions: {', '.join(f'{name} {text}' for name, text in told.items())}.",
    ]
    for title, changes in CONDITIONS.items():
        parts += compared(title, changes)
    parts += [
        "## The optimization-based method on its own",
        "From the start of the paper's error figure: the leader 1.44 m off, F1 and F3 nearer to "
        "their neighbours by 0.193 and 0.180 m.",
        table(("what", "measured", "goal or known value"), list(optimization.rows())),
    ]
    parts += [
        "## The planar baseline",
        "The method's own source (arXiv:2301.05841), `PlanarBaseline`, with IPOPT.",
        table(("what", "measured", "known"), list(planar())),
    ]
    write_part("results.md", "comparison.py", "\n\n".join(parts))


if __name__ == "__main__":
    main()
