"""The errors of runs beside the paper's Table II, over its 10 s and by its measure."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from echelon.experiments.results.table_two import (
    HORIZON,
    PRINTED,
    SAMPLES,
    TableTwo,
    missing,
    table_two,
)
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from rich.console import Console

ROUNDING = (
    "The paper's 1e-17 m is the rounding of constant offsets, not an error of a closed loop: all "
    "its samples are multiples of 2^-53."
)
_MEASURES = (
    "The paper's errors of followers are of distances between agents, and stand below ours. The "
    "vector from each follower to its goal is stricter, and not in the paper."
)
_PLANS = "OptimalTracking"
_LEADER = (
    "The paper's leader follows a plan of least tracking error, as under `optimal-tracking` in "
    "`echelon compare paper`."
)


def print_beside_paper(console: "Console", runs: Mapping[str, Result], name: str) -> None:
    """Print the errors of some runs over the paper's 10 s above the paper's, a row each.

    Args:
        console: of rich.
        runs: by their labels.
        name: of the scenario.
    """
    from rich import box
    from rich.table import Table

    found = {label: table_two(run) for label, run in runs.items()}
    known = [errors for errors in found.values() if errors is not None]
    if not known:
        return
    title = f"{name} beside the paper's Table II: RMSE of the first {HORIZON:g} s, m"
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False, padding=0)
    table.show_edge = False
    width = max(len(f"printed, {method}") for method in PRINTED)
    table.add_column("", no_wrap=True, min_width=width)
    for column in _columns(known[0]):
        table.add_column(column, justify="right", overflow="fold")
    for label, errors in found.items():
        table.add_row(label, *_cells(errors))
    for method, values in PRINTED.items():
        table.add_row(f"printed, {method}", *(f"{value:.4g}" for value in values))
    console.print(table)


def remarks(runs: Sequence[Result]) -> Iterator[str]:
    """Yield how the errors of runs compare with the paper's, in sentences."""
    found = [errors for errors in map(table_two, runs) if errors is not None]
    if not found:
        reason = next(filter(None, map(missing, runs)))
        yield f"Nothing is beside the paper's Table II, which is of {HORIZON:g} s: {reason}."
        return
    yield _over(found)
    leaders = {type(getattr(run.drive, "leader", None)).__name__ for run in runs}
    yield from () if _PLANS in leaders else (_LEADER,)
    yield _MEASURES
    yield ROUNDING


def _over(found: Sequence[TableTwo]) -> str:
    errors = found[0]
    text = f"The errors beside the paper's are over all {errors.frames} steps"
    if not errors.every:
        text = (
            f"The errors beside the paper's are over {errors.frames} stored frames; "
            "`simulation.store_every: 1` stores all steps"
        )
    if len(found) > 1 or errors.sampled is None:
        return f"{text}."
    return f"{text}. At the paper's {SAMPLES} samples the leader's is {errors.sampled:.3g} m."


def _columns(errors: TableTwo) -> Iterator[str]:
    yield "leader"
    followers = range(1, len(errors.distances) + 1)
    for k, other in zip(followers, errors.measured, strict=True):
        yield f"distance\nF{k} to {f'F{other}' if other else 'L'}"
    yield from (f"vector\nF{k}" for k in followers)


def _cells(errors: TableTwo | None) -> Iterator[str]:
    if errors is None:
        return
    for value in (errors.leader, *errors.distances, *errors.vectors):
        yield "-" if value is None else f"{value:.4g}"
