"""The report of a run: a table like the paper's Table II, and sentences that explain it.

The whole report adds the conditions of the guarantee, the scenario, versions, and how to cite.
"""

import io
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar

from echelon import __version__
from echelon.core.types import JsonObject
from echelon.experiments.results.metrics import metrics
from echelon.experiments.results.recording import Recording
from echelon.experiments.results.run_numbers import (
    FollowerMetrics,
    LeaderMetrics,
    Metrics,
    quantities,
    representatives,
    settling_bound,
    steady_error,
)
from echelon.output.reports.explanation import explain
from echelon.output.reports.printed import PRINTED, ROUNDING, is_papers_experiment
from echelon.simulation.engine.result import Result

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_WIDTH = 100
_CITATION = f"""@software{{echelon,
  title = {{echelon: leader-follower formation tracking for control-affine nonlinear agents}},
  author = {{{{The echelon developers}}}},
  version = {{{__version__}}}
}}
@inproceedings{{enwerem2023consensus,
  title = {{Consensus-Based Leader-Follower Formation Tracking for Control-Affine Nonlinear
    Multiagent Systems}},
  author = {{Enwerem, Clinton and Baras, John S.}},
  booktitle = {{9th International Conference on Control, Decision and Information Technologies
    (CoDIT)}},
  year = {{2023}},
  note = {{arXiv:2309.09156}}
}}"""
# With more agents of a role the table shows the best, the median and the worst.
_MANY = 12
_COLUMNS = quantities(FollowerMetrics)


def report(result: Result) -> str:
    """Return the report of a run as plain text."""
    from rich.console import Console

    text = io.StringIO()
    # A forced terminal, so that sentences wrap; without colours the text stays plain.
    console = Console(file=text, width=_WIDTH, color_system=None, force_terminal=True)
    print_report(console, result, metrics(result))
    return text.getvalue().rstrip("\n")


def whole_report(run: Recording, numbers: str) -> str:
    """Return the numbers of a run, its guarantee with all conditions, and where it is from.

    Args:
        run: as it is stored.
        numbers: its `report`; empty where there is none.
    """
    message, promise = str(run.attributes["message"]), run.promise
    facts = f"{run.agents} agents, {run.model}; {run.horizon:g} s in steps of {run.dt:g} s"
    versions = {k[8:]: v for k, v in run.attributes.items() if k.startswith("version_")}
    sections = {
        f"{run.name}: {facts}": numbers.rstrip() or _wrapped(message, promise["sentence"]),
        "Conditions of the guarantee": _wrapped(*map(_condition, promise["hypotheses"])),
        "Scenario": str(run.attributes.get("scenario_text", "")).rstrip(),
        "Versions": "\n".join(f"{name} {version}" for name, version in versions.items()),
        "Citation": _CITATION,
    }
    some = (f"{title}\n{'-' * len(title)}\n{text}" for title, text in sections.items() if text)
    return "\n\n".join(some)


def _wrapped(*sentences: str) -> str:
    """Return sentences as the items of a list."""
    fill = textwrap.TextWrapper(_WIDTH, initial_indent="- ", subsequent_indent="  ").fill
    return "\n".join(map(fill, filter(None, sentences)))


def _condition(line: JsonObject) -> str:
    """Return a condition with its verdict, number, reason, and remedy if it fails."""
    text = f"{line['statement']}: {line['verdict']}"
    text += f" ({line['shown']})" if line["shown"] else ""
    text += f"; {line['text']}" if line["text"] else ""
    return text + (f"; to change: {line['remedy']}" if line["remedy"] else "")


def print_report(console: "Console", result: Result, numbers: Metrics) -> None:
    """Print the report of a run on a rich console."""
    scenario, model = result.provenance.get("scenario", ""), type(result.model).__name__
    printed = is_papers_experiment(scenario, model, result.graph.agents)
    console.print(_table(result, numbers, printed))
    sentences = [*explain(result, numbers), *(f"Warning: {text}" for text in result.warnings)]
    for sentence in [*sentences, ROUNDING] if printed else sentences:
        say(console, sentence)


def say(console: "Console", sentence: str) -> None:
    """Print a sentence as an item of a list, on one line where the output is no terminal."""
    look = "bold red" if sentence.startswith("Warning: ") else None
    wrap = not console.is_terminal
    console.print(f"- {sentence}", style=look, highlight=False, markup=False, soft_wrap=wrap)


def _table(result: Result, numbers: Metrics, printed: bool) -> "Table":
    from rich import box
    from rich.table import Table

    texts = {
        "unit": result.length_unit and f", {result.length_unit}",
        "window": numbers.steady_window,
        "settled": settling_bound(result.length_unit),
    }
    columns = ["agent", *(quantity.column.format(**texts) for quantity in _COLUMNS.values())]
    if printed:
        columns += ["printed,\nconsensus", "printed,\noptimiz."]
    agents = f"{result.graph.agents} x {type(result.model).__name__}"
    name = result.provenance.get("scenario") or agents
    title = f"{name}, {_length(result)}, seed {result.settings.seed}"
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for column in columns:
        table.add_column(column, justify="left" if column == "agent" else "right", no_wrap=True)
    for row in _rows(result, numbers, printed):
        table.add_row(*row)
    return table


def _length(result: Result) -> str:
    """Return the duration of the run, and the horizon if the run did not reach it."""
    horizon = f"{result.settings.horizon:g} s"
    if result.outcome.reached:
        return horizon
    return f"{result.times[-1] if len(result.times) else 0.0:g} s of {horizon}"


def _rows(result: Result, numbers: Metrics, printed: bool) -> list[list[str]]:
    leaders, followers = numbers.leaders, numbers.followers
    # A single leader needs no number, as in the paper's table.
    names = ["leader"] if len(leaders) == 1 else None
    agents = [*labelled("leader", leaders, names), *labelled("follower", followers)]
    rows = [[label, *(_cell(numbers, name) for name in _COLUMNS)] for label, numbers in agents]
    if printed:
        for k, row in enumerate(rows):
            row += [f"{PRINTED[method][k]:.4g}" for method in ("consensus", "optimization")]
    return rows


_Row = TypeVar("_Row", LeaderMetrics, FollowerMetrics)


def labelled(
    role: str, agents: Sequence[_Row], labels: list[str] | None = None
) -> Iterator[tuple[str, _Row]]:
    """Yield all agents of a role, or the best, the median and the worst, with their labels."""
    kinds, rows = [""] * len(agents), agents
    if len(agents) > _MANY:
        kinds, rows = ["best ", "median ", "worst "], representatives(agents, steady_error)
    names = labels or [f"{role} {row.agent}" for row in rows]
    for kind, name, row in zip(kinds, names, rows, strict=True):
        yield (f"{kind}({name})" if kind else name), row


def _cell(agent: LeaderMetrics | FollowerMetrics, name: str) -> str:
    """Return a cell of the table; empty if the agent's role has no such number."""
    if not hasattr(agent, name):
        return ""
    value: float | None = getattr(agent, name)
    return "-" if value is None and agent.rmse is None else _COLUMNS[name].cell(value)
