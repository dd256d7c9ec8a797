"""The report of a comparison: tables of errors and costs, and a paragraph on who wins."""

import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from echelon.core.digits import at_most
from echelon.core.errors import Outcome
from echelon.core.types import JsonObject
from echelon.core.words import amount
from echelon.experiments.results.metrics import RunNumbers
from echelon.experiments.results.run_numbers import (
    AGENT_NUMBERS,
    ERROR,
    RUN_NUMBERS,
    Appearance,
    settling_bound,
    shown_in,
)
from echelon.experiments.results.table_two import PRINTED, is_papers_experiment, table_two
from echelon.experiments.studies.compare import LABELS, Comparison, ComparisonRow
from echelon.experiments.studies.seed_comparison import SeedComparison
from echelon.guarantees.promises.promise import Guarantee
from echelon.output.reports.beside_paper import print_beside_paper, remarks
from echelon.output.reports.run_report import say
from echelon.output.reports.seed_report import print_seeds, seed_mapping
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_NAMED = 4
"""With more followers than this the table shows only the worst one."""
_ROUNDING_LEVEL = 1e-12
"""Steady errors below this are rounding errors, and count as equal."""

_ALIKE = 1.5
"""Computing times within this factor count as equal: the machine is shared."""


def comparison_report(comparison: Comparison | SeedComparison, width: int = 200) -> str:
    """Return a comparison as plain text."""
    from rich.console import Console

    text = io.StringIO()
    console = Console(file=text, width=width, color_system=None)
    print_comparison(console, comparison)
    return text.getvalue().rstrip("\n")


def print_comparison(console: "Console", comparison: Comparison | SeedComparison) -> None:
    """Print a comparison on a rich console: tables, remarks, and the verdict on one seed."""
    if isinstance(comparison, SeedComparison):
        print_seeds(console, comparison)
        return
    runs = _papers_runs(comparison)
    if runs:
        print_beside_paper(console, runs, comparison.scenario)
    console.print(_errors_table(comparison))
    console.print(_costs_table(comparison))
    for row in comparison.rows:
        for sentence in _remarks(row):
            say(console, f"{row.label}: {sentence}")
    say(console, " ".join(verdict(comparison)))
    for sentence in remarks([*runs.values()]) if runs else ():
        say(console, sentence)


def _papers_runs(comparison: Comparison) -> dict[str, Result]:
    """Return the runs of each method where they are of the paper's experiment."""
    runs = {row.label: row.flight.result for row in comparison.rows if row.flight is not None}
    some = next(iter(runs.values()), None)
    if some is None:
        return {}
    model, agents = type(some.model).__name__, some.graph.agents
    return runs if is_papers_experiment(comparison.scenario, model, agents) else {}


# ---- tables -------------------------------------------------------------------------------------


def _errors_table(comparison: Comparison) -> "Table":
    """Return the errors, one row per method: over the whole run and the steady ones."""
    graphs = [row.flight.result.graph for row in comparison.rows if row.flight is not None]
    followers = graphs[0].followers if graphs and len(graphs[0].followers) <= _NAMED else ()
    whole, last = f"{comparison.horizon:.3g} s", f"last {comparison.steady_window:.3g} s"
    heads = ["leader", *(f"F{k}" for k in followers)] if followers else ["leader", "worst F"]
    title = ", ".join([comparison.scenario, f"{whole}: RMSE", *comparison.conditions])
    columns = [f"{head}\n{whole}" for head in heads] + [f"{head}\n{last}" for head in heads]
    settled = settling_bound(_unit(comparison.rows))
    within = AGENT_NUMBERS["settling_time"].column.format(settled=settled)
    table = _table(title, [*columns, within])
    for row in comparison.rows:
        table.add_row(row.label, *_errors(row, bool(followers)))
    return table


def _unit(rows: Sequence[ComparisonRow]) -> str:
    units = (row.flight.result.length_unit for row in rows if row.flight is not None)
    return next(units, "")


def _errors(row: ComparisonRow, named: bool) -> Iterator[str]:
    if row.flight is None:
        return
    for name in ("rmse", "steady_rmse"):
        cell, numbers = AGENT_NUMBERS[name].cell, row.flight.metrics
        followers = [getattr(follower, name) for follower in numbers.followers]
        errors = followers if named else [row.number(f"worst_{name}")]
        for error in [getattr(numbers.leader, name), *errors]:
            yield cell(error, 3)
    yield _cell(row.flight, "worst_settling_time")


def _costs_table(comparison: Comparison) -> "Table":
    runs = [row.flight for row in comparison.rows if row.flight is not None]
    # In the ideal network no run has ages of messages.
    costs = {
        name: quantity.column
        for name, quantity in shown_in(RUN_NUMBERS, Appearance.COMPARISON).items()
        if quantity.column
        and (quantity.absent != "-" or any(run.number(name) is not None for run in runs))
    }
    heads = [*costs.values(), RUN_NUMBERS["promise_rate"].column, "information"]
    table = _table("costs", heads)
    table.columns[-1].justify = "left"
    table.columns[-1].no_wrap = False
    for row in comparison.rows:
        if row.flight is None:
            table.add_row(row.label)
            continue
        table.add_row(
            row.label,
            *(_cell(row.flight, name) for name in costs),
            _guaranteed(row.flight.promise),
            ", ".join(row.flight.result.parts.information.follower) or "none",
        )
    return table


def _cell(run: RunNumbers, name: str) -> str:
    return RUN_NUMBERS[name].cell(run.number(name), 3)


def _table(title: str, columns: Sequence[str]) -> "Table":
    """Return a table whose row labels are not truncated on a narrow terminal."""
    from rich import box
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    table.add_column("method", no_wrap=True, min_width=max(map(len, LABELS)))
    for column in columns:
        table.add_column(column, justify="right", overflow="fold")
    return table


def _guaranteed(promise: Guarantee) -> str:
    if promise.rate is None:
        return "none"
    if not promise.promised:
        return f"while {promise.conditions[0]} ({promise.theorem})"
    source = "" if promise.theorem is None else f" ({promise.kind}, {promise.theorem})"
    return f"{at_most(promise.rate)}{source}"


def _remarks(row: ComparisonRow) -> Iterator[str]:
    if row.flight is None:
        yield row.reason
        return
    result = row.flight.result
    if result.outcome is not Outcome.COMPLETED:
        yield result.message
    if (work := result.work) is not None:
        yield (
            f"{work.solver} computed {amount(work.solves, 'plan')} with "
            f"{amount(work.failures, 'failure')}, in {work.median_ms:.3g} ms (median; 99th "
            f"percentile {work.p99_ms:.3g}, worst {work.worst_ms:.3g}) each; iterations: "
            f"median {work.iterations_median:.3g}, worst {work.iterations_worst}."
        )
    yield from result.warnings


# ---- the paragraph ------------------------------------------------------------------------------


def verdict(comparison: Comparison) -> tuple[str, ...]:
    """Return which method wins by which number, one sentence each."""
    runs = [row for row in comparison.rows if row.flight is not None]
    if not runs:
        return ("No method ran.",)
    settled = [row for row in runs if row.number("worst_settling_time") is not None]
    some = 0 < len(settled) < len(runs)
    # Among others that do not settle, one alone is compared with nothing.
    ranked = [] if some and len(settled) == 1 else settled
    some = some and bool(ranked)
    return tuple(
        sentence
        for sentence in (
            _unsettled(runs, settled),
            _among_settled(some, _closest(ranked or runs)),
            _best(settled, "settles first" if ranked else "settles", "worst_settling_time"),
            _best(runs, "has the smallest error over the whole run", "worst_rmse"),
            _leader(runs),
            _among_settled(some, _best(ranked, "has the smallest effort", "effort")),
            _among_settled(some, _cheapest(ranked)),
        )
        if sentence
    )


def _among_settled(some: bool, sentence: str) -> str:
    if not some or not sentence:
        return sentence
    return f"Of those that settle, {sentence.replace('All ', 'all ', 1)}"


def _unsettled(runs: Sequence[ComparisonRow], settled: Sequence[ComparisonRow]) -> str:
    labels = [row.label for row in runs if row not in settled]
    within = settling_bound(_unit(runs))
    if not labels:
        who = f"All {len(runs)} methods bring" if len(runs) > 1 else f"{runs[0].label} brings"
        return f"{who} every follower within {within}."
    verb = "does" if len(labels) == 1 else "do"
    return f"{_listed(labels)} {verb} not bring every follower within {within}."


def _closest(rows: Sequence[ComparisonRow]) -> str:
    """Return which method ends closest; errors at the level of rounding are a tie."""
    errors = _numbers(rows, "worst_steady_rmse")
    tied = [label for label, value in errors.items() if value <= _ROUNDING_LEVEL]
    if len(tied) > 1:
        return f"{_listed(tied)} end at the level of rounding errors."
    return _best(rows, "ends closest", "worst_steady_rmse")


def _numbers(rows: Sequence[ComparisonRow], name: str) -> dict[str, float]:
    values = {row.label: row.number(name) for row in rows}
    return {label: value for label, value in values.items() if value is not None}


def _best(rows: Sequence[ComparisonRow], claim: str, name: str) -> str:
    ranking = sorted((value, label) for label, value in _numbers(rows, name).items())
    if not ranking:
        return ""
    (least, label), *others = ranking
    unit = RUN_NUMBERS[name].unit.replace(ERROR, _unit(rows))
    text = f"{label} {claim} ({least:.3g} {unit}".rstrip()
    if others:
        text += f"; next {others[0][1]}, {others[0][0]:.3g}"
    return text + ")."


def _leader(rows: Sequence[ComparisonRow]) -> str:
    values = _numbers(rows, "leader_rmse")
    if not values:
        return ""
    least, most = min(values, key=values.__getitem__), max(values, key=values.__getitem__)
    unit = f" {_unit(rows)}".rstrip()
    # Most methods share the leader's law, so that its runs differ by rounding only.
    if values[most] <= 1.001 * values[least]:
        return f"The leader's error is the same under all methods, {values[least]:.3g}{unit}."
    return (
        f"The leader's error is smallest under {least}, {values[least]:.3g}{unit} against "
        f"{values[most]:.3g}{unit} under {most}."
    )


def _cheapest(rows: Sequence[ComparisonRow]) -> str:
    times = _numbers(rows, "computing")
    if len(times) < 2:
        return ""
    least, most = min(times, key=times.__getitem__), max(times, key=times.__getitem__)
    # A run of one chunk is counted as compilation, and its computing time is 0.
    ratio = times[most] / max(times[least], 1e-12)
    if ratio < _ALIKE:
        return "All take about the same computing time."
    return f"{least} takes the least computing time, {most} {ratio:.0f} times as much."


def _listed(labels: Sequence[str]) -> str:
    return labels[0] if len(labels) == 1 else f"{', '.join(labels[:-1])} and {labels[-1]}"


# ---- data ---------------------------------------------------------------------------------------


def comparison_mapping(comparison: Comparison | SeedComparison) -> JsonObject:
    """Return a comparison ready for JSON; missing numbers are None."""
    if isinstance(comparison, SeedComparison):
        return seed_mapping(comparison)
    papers = _papers_runs(comparison)
    return {
        "scenario": comparison.scenario,
        "horizon_s": comparison.horizon,
        "steady_window_s": comparison.steady_window,
        "conditions": list(comparison.conditions),
        "methods": {row.label: _row_mapping(row) for row in comparison.rows},
        "printed": {name: list(values) for name, values in PRINTED.items()} if papers else None,
        "beside_printed": {
            label: None if errors is None else errors.as_mapping()
            for label, errors in ((label, table_two(run)) for label, run in papers.items())
        }
        or None,
        "verdict": " ".join(verdict(comparison)),
    }


def _row_mapping(row: ComparisonRow) -> JsonObject:
    if row.flight is None:
        return {"reason": row.reason}
    result, followers = row.flight.result, row.flight.metrics.followers
    return {
        "outcome": result.outcome.name.lower(),
        **{
            f"follower_{name}": {str(f.agent): getattr(f, name) for f in followers}
            for name in ("rmse", "steady_rmse")
        },
        **row.flight.json(Appearance.COMPARISON),
        "guarantee": row.flight.promise.as_mapping(),
        "told": list(result.parts.information.follower),
        "solver": None if result.work is None else result.work._asdict(),
    }
