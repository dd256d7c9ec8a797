"""The report of a run: a table of its errors, and sentences that explain it.

The whole report adds the conditions of the guarantee, the scenario, versions, and how to cite.
"""

import io
import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Bool

from echelon import __version__
from echelon.agents.models.model import ControlAffine
from echelon.agents.models.unlike import group_of, title_of
from echelon.agents.network.hearing import who_hears_whom
from echelon.core.digits import at_least
from echelon.core.errors import Outcome
from echelon.core.statement import Hypothesis
from echelon.core.types import JsonObject
from echelon.core.words import amount
from echelon.experiments.results.event_outcomes import event_outcomes
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.results.metrics import avoidance, metrics
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
from echelon.experiments.results.table_two import is_of_the_paper
from echelon.guarantees.promises.coverage import coverage
from echelon.guarantees.promises.promise import Guarantee, guarantee
from echelon.output.reports.beside_paper import print_beside_paper, remarks
from echelon.output.reports.guarantee_text import (
    UNWRAPPED,
    WIDTH,
    guarantee_lines,
    through_event,
)
from echelon.simulation.engine.result import Result
from echelon.simulation.step.meter import SETTLED

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_WIDTH = 100
_WARNING = "Warning: "
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
_SETTLES = float(np.log(100.0))
"""Time constants in which an error of 1 m decays to 1 cm."""
_CHATTERS = 20
"""Alternations of an input between its limits that are reported; a start has a few."""
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
    """Return the numbers of a run, its guarantee with all conditions, and where it is from."""
    message, stated = str(run.attributes["message"]), run.guarantee
    flown = str(run.attributes.get("flight_report", ""))
    facts = f"{run.agents} agents, {run.model}; {run.horizon:g} s in steps of {run.dt:g} s"
    versions = {k[8:]: v for k, v in run.attributes.items() if k.startswith("version_")}
    sections = {
        f"{run.name}: {facts}": numbers.rstrip() or flown or _known(message, stated),
        "Conditions of the guarantee": _wrapped(*map(_condition, stated.get("conditions", ()))),
        "Scenario": str(run.attributes.get("scenario_text", "")).rstrip(),
        "Versions": "\n".join(f"{name} {version}" for name, version in versions.items()),
        "Citation": _CITATION,
    }
    some = (f"{title}\n{'-' * len(title)}\n{text}" for title, text in sections.items() if text)
    return "\n\n".join(some)


def _wrapped(*sentences: str) -> str:
    fill = textwrap.TextWrapper(_WIDTH, initial_indent="- ", subsequent_indent="  ").fill
    return "\n".join(map(fill, filter(None, sentences)))


def _known(message: str, stated: JsonObject) -> str:
    return "\n".join([_wrapped(message), *(guarantee_lines(stated) if stated else ())])


def _condition(line: JsonObject) -> str:
    text = f"{line['name']}: {line['verdict']}"
    text += f" ({line['shown']})" if line["shown"] else ""
    text += f"; {line['text']}" if line["text"] else ""
    return text + (f"; to change: {line['remedy']}" if line["remedy"] else "")


def print_report(console: "Console", result: Result, numbers: Metrics) -> None:
    """Print the report of a run on a rich console."""
    printed = is_of_the_paper(result)
    if printed:
        print_beside_paper(console, {"this run": result}, result.provenance["scenario"])
    console.print(_table(result, numbers))
    sentences = [*explain(result, numbers), *(f"{_WARNING}{text}" for text in result.warnings)]
    print_guarantee(console, guarantee(result.parts, result.settings))
    for sentence in [*sentences, *remarks([result])] if printed else sentences:
        say(console, sentence)


def print_guarantee(
    console: "Console", stated: Guarantee | JsonObject, brief: bool = False
) -> None:
    """Print a guarantee, each row on one line where the output is no terminal."""
    for line in guarantee_lines(stated, _width(console), brief):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _width(console: "Console") -> int:
    return WIDTH if console.is_terminal else UNWRAPPED


_FEW = 3
"""Sentences on what was observed that fit on a screen."""


def print_screen(console: "Console", result: Result, numbers: Metrics) -> None:
    """Print what fits on a screen: tables, outcome, guarantee, and a little of what was observed.

    The whole report, which `echelon report` prints, says the rest.
    """
    stated = guarantee(result.parts, result.settings)
    if is_of_the_paper(result):
        print_beside_paper(console, {"this run": result}, result.provenance["scenario"])
    console.print(_table(result, numbers))
    outcome = list(_outcome(result, numbers, stated))
    complete = result.outcome is Outcome.COMPLETED and len(outcome) > 1
    for sentence in outcome[complete:]:
        say(console, sentence)
    print_guarantee(console, stated, brief=True)
    for sentence in _told(result, numbers, stated):
        say(console, sentence)


def _told(result: Result, numbers: Metrics, stated: Guarantee) -> Iterator[str]:
    """Yield a few sentences on what was observed, and all warnings."""
    seen = (
        *coverage(result, stated),
        *observations(result, numbers, stated),
        *(f"{x.sentence()} {through_event(x.guarantee)}" for x in event_outcomes(result)),
        *_closest(result, numbers),
        *_lag(result),
        *_lyapunov_trend(result, stated),
    )
    warnings = [text for text in seen if text.startswith(_WARNING)]
    others = [text for text in seen if not text.startswith(_WARNING)]
    yield from (*others[:_FEW], *warnings)
    yield from (f"{_WARNING}{text}" for text in result.warnings)


def say(console: "Console", sentence: str) -> None:
    """Print a sentence as an item of a list, on one line where the output is no terminal."""
    look = "bold red" if sentence.startswith(_WARNING) else None
    wrap = not console.is_terminal
    console.print(f"- {sentence}", style=look, highlight=False, markup=False, soft_wrap=wrap)


def _table(result: Result, numbers: Metrics) -> "Table":
    from rich import box
    from rich.table import Table

    texts = {
        "unit": result.length_unit and f", {result.length_unit}",
        "window": numbers.steady_window,
        "settled": settling_bound(result.length_unit),
    }
    columns = ["agent", *(quantity.column.format(**texts) for quantity in _COLUMNS.values())]
    agents = f"{result.graph.agents} x {title_of(result.model)}"
    name = result.provenance.get("scenario") or agents
    end = result.times[-1] if len(result.times) else 0.0
    part = "" if result.outcome.reached else f"{end:g} s of "
    title = f"{name}, {part}{result.settings.horizon:g} s, seed {result.settings.seed}"
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    table.show_edge = False
    for column in columns:
        table.add_column(column, justify="left" if column == "agent" else "right", no_wrap=True)
    for row in _rows(numbers, result.model):
        table.add_row(*row)
    return table


def _rows(numbers: Metrics, model: ControlAffine) -> list[list[str]]:
    leaders, followers = numbers.leaders, numbers.followers
    # A single leader needs no number, as in the paper's table.
    names = ["leader"] if len(leaders) == 1 else None
    agents = [*labelled("leader", leaders, names), *labelled("follower", followers)]
    rows = list[list[str]]()
    for label, own in agents:
        group = group_of(model, own.agent)
        cells = (_cell(own, name) for name in _COLUMNS)
        rows.append([f"{label}, {group}" if group else label, *cells])
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
    if not hasattr(agent, name):
        return ""
    value: float | None = getattr(agent, name)
    return "-" if value is None and agent.rmse is None else _COLUMNS[name].cell(value)


# ---- sentences ----------------------------------------------------------------------------------


def explain(result: Result, numbers: Metrics) -> tuple[str, ...]:
    """Return the sentences of a report: outcome, what was observed, world, coverage, V."""
    stated = guarantee(result.parts, result.settings)
    return (
        *_outcome(result, numbers, stated),
        *_closest(result, numbers),
        *(f"{x.sentence()} {through_event(x.guarantee)}" for x in event_outcomes(result)),
        *_lag(result),
        *observations(result, numbers, stated),
        *_world(result),
        *_reach(result, stated),
        *_lyapunov_trend(result, stated),
    )


def _outcome(result: Result, numbers: Metrics, guarantee: Guarantee) -> Iterator[str]:
    yield result.message
    if result.outcome is Outcome.DIVERGED or len(result.times) < 2:
        return
    unit = f" {result.length_unit}".rstrip()
    if grows(result, guarantee):
        first, last = sizes(result)
        yield (
            f"The formation error grows: {first:.3g}{unit} at the start, "
            f"{last:.4g}{unit} at {result.times[-1]:g} s."
        )
        return
    here = np.ones(result.graph.agents, bool) if result.presence is None else result.presence[-1]
    there = " that are there" * (not here.all())
    times = [follower.settling_time for follower in numbers.followers if here[follower.agent]]
    settled = [time for time in times if time is not None]
    count, late = len(times), len(times) - len(settled)
    if not count:
        yield "No follower is there at the end."
    elif not late:
        who = "The follower stays" if count == 1 else f"All {count} followers{there} stay"
        goals = "its goal" if count == 1 else "their goals"
        yield f"{who} within 0.01{unit} of {goals} from {max(settled):.3g} s on."
    else:
        who = "The follower" if count == 1 else f"{late} of {count} followers{there}"
        verb = "has" if late == 1 else "have"
        yield f"{who} {verb} not settled to 0.01{unit} by {result.times[-1]:g} s."


def _closest(result: Result, numbers: Metrics) -> Iterator[str]:
    if numbers.closest is not None and result.outcome is not Outcome.DIVERGED:
        yield numbers.closest.sentence(result.radius, result.length_unit)
    kept = avoidance(result)
    yield from () if kept is None else (kept.sentence(),)


def _lag(result: Result) -> Iterator[str]:
    late = np.flatnonzero(result.times >= result.settings.horizon - result.settings.window)
    if result.formation.motion is None or not result.drive.lags or not len(late):
        return
    largest = float(result.goal_distances(late)[:, list(result.graph.followers)].max())
    frames = "in the stored frames " * (result.settings.store_every > 1)
    yield (
        f"Followers lag behind places that change with time: observed {largest:.3g} "
        f"{result.unit} at most {frames}from {result.times[late[0]]:.4g} s on."
    )


def _world(result: Result) -> Iterator[str]:
    for part in result.world.all_parts:
        yield part.sentences(result)


def _reach(result: Result, guarantee: Guarantee) -> Iterator[str]:
    yield from coverage(result, guarantee)
    if len(result.graph.leaders) > 1:
        yield f"Leaders: {who_hears_whom(result.graph)}; goals are relative to the nearest leader."
    information = "; ".join(result.parts.information.follower) or "nothing from others"
    yield f"Information used by each follower: {information}."


def _lyapunov_trend(result: Result, guarantee: Guarantee) -> Iterator[str]:
    v = lyapunov(result)
    if v is None or len(v.value) < 2 or not np.isfinite(v.value).all():
        return
    increases, forbidden = int(v.rises().sum()), int(v.forbidden().sum())
    # V' <= 0 is proved for the undisturbed loop that decays only.
    unstable = guarantee.hypotheses[Hypothesis.DISAGREEMENT_DECAY].fails
    unstable = unstable and not (guarantee.governed and guarantee.loop.every)
    if forbidden and not (unstable or not result.world.ideal):
        when = result.times[int(np.argmax(v.forbidden()))]
        yield (
            f"Warning: V increased at {forbidden} of {len(v.value)} stored steps (first at "
            f"{when:.4g} s) although V' <= 0 there."
        )
    elif increases:
        yield f"V increased in {increases} of {amount(len(v.value) - 1, 'frame')}."
    else:
        every = "V never increased"
        if result.settings.store_every > 1:
            every = f"V did not increase between the {len(v.value)} stored times"
        yield f"{every}: {v.value[0]:.3g} at the start, {v.value[-1]:.3g} at the end."


# ---- what was observed in a poor run -------------------------------------------------------------


def observations(result: Result, numbers: Metrics, guarantee: Guarantee) -> Iterator[str]:
    """Yield what was observed of large errors, in sentences; no cause, since none was tried."""
    alone, text = _alone(result)
    yield from (text,) if text else ()
    if len(result.times):
        settled = all(follower.settling_time is not None for follower in numbers.followers)
        if grows(result, guarantee):
            yield from beyond(float(result.saturated.max()), guarantee)
        else:
            yield from () if settled else _slow(result, guarantee)
    yield from _offset(result, numbers)
    yield from _chatter(result, alone)


def _alone(result: Result) -> tuple[tuple[int, ...], str]:
    """Return which followers lost their way while nobody was linked to them, and that in words."""
    away = result.formation_errors
    spans: dict[int, tuple[float, float]] = {}
    for agent, start, end in _silences(result):
        frames = np.flatnonzero((result.times >= start) & (result.times <= end))
        errors = away[frames, agent]
        lost = len(frames) and not errors[-1] <= max(SETTLED, errors[0])
        before = spans.get(agent, (0.0, 0.0))
        if lost and end - start > before[1] - before[0]:
            spans[agent] = start, end
    if not spans:
        return (), ""
    worst = max(spans, key=lambda agent: spans[agent][1] - spans[agent][0])
    more = f"; so did {amount(len(spans) - 1, 'other agent')} at some time" * (len(spans) > 1)
    start, end = spans[worst]
    text = f"Agent {worst} received nothing from {start:g} s to {end:g} s, since no link led to it"
    return tuple(spans), f"{text}, and its error grew{more}."


def _silences(result: Result) -> Iterator[tuple[int, float, float]]:
    """Nothing of a graph that never switches, in which everybody has a path from a leader."""
    schedule, dt = result.schedule, result.settings.dt
    if schedule is None or not len(result.times):
        return
    last = float(result.times[-1])
    steps, rows = schedule.switches(dt, last)
    within = steps * dt < last
    starts, ends = steps[within] * dt, np.append(steps[within][1:] * dt, last)
    silent = _silent(result)[rows[within]]
    for agent in np.flatnonzero(silent.any(axis=0)).tolist():
        edges = np.diff(np.concatenate([[0], silent[:, agent].astype(np.int8), [0]]))
        for first, beyond in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
            yield agent, float(starts[first]), float(ends[beyond - 1])


def _silent(result: Result) -> Bool[np.ndarray, "S N"]:
    schedule, agents = result.schedule, result.graph.agents
    assert schedule is not None
    heard = np.zeros((len(schedule.weights), agents), bool)
    row, edge = np.nonzero(schedule.weights > 0.0)
    for end in (0, 1):
        receives = result.parts.receives[edge, end]
        heard[row[receives], result.graph.edges[edge[receives], end]] = True
    here = True if schedule.present is None else np.asarray(schedule.present)
    leads = np.isin(np.arange(agents), result.graph.leaders)
    if schedule.nearest is not None:
        leads = schedule.nearest == np.arange(agents)
    return ~heard & here & ~leads


def beyond(saturated: float, guarantee: Guarantee) -> Iterator[str]:
    """Yield that a guarantee does not cover a run whose errors grow.

    `saturated` is the largest fraction of steps in which an agent's input was at a limit.
    """
    # With a theorem, `coverage` says more.
    ignored = " and ".join(guarantee.ignores)
    acts = ignored or saturated
    if not guarantee.promised or guarantee.theorem is not None or not acts:
        return
    text = "The guarantee does not cover this run"
    text += f": {ignored}" if ignored else ""
    limited = f"; inputs were at a limit in {100.0 * saturated:.3g} % of the steps"
    yield f"{text}{limited if saturated else ''}."


def _slow(result: Result, guarantee: Guarantee) -> Iterator[str]:
    by_mode = guarantee.slowest is not None
    rate = -guarantee.slowest if guarantee.slowest is not None else guarantee.rate
    if guarantee.promised and rate and result.settings.horizon * rate < _SETTLES:
        span = "1 m to 1 cm" if result.length_unit else "1 to 0.01"
        yield (
            f"{'The slowest mode' if by_mode else 'The guaranteed rate'} takes "
            f"{at_least(_SETTLES / rate)} s from {span}, and the horizon is "
            f"{result.settings.horizon:g} s."
        )


def _offset(result: Result, numbers: Metrics) -> Iterator[str]:
    steady = numbers.leader.steady_rmse
    if steady is None or steady <= SETTLED or _falls(result, steady):
        return
    unit = f" {result.length_unit}".rstrip()
    text = f"The leader has a steady error of {steady:.3g}{unit} from its reference"
    saturated = 100.0 * result.saturated[result.graph.leaders[0]]
    limited = f", with its inputs at a limit in {saturated:.3g} % of the steps"
    yield f"{text}{limited if saturated else ''}."


def _falls(result: Result, steady: float) -> bool:
    """Return whether the first leader was still approaching its reference at the end."""
    assert result.reference is not None
    first = result.graph.leaders[0]
    away = result.states[-1, first] - result.offsets_in([-1])[..., first, :] - result.reference[-1]
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.linalg.norm(away[..., list(result.measured)])) < 0.5 * steady


def _chatter(result: Result, alone: Sequence[int]) -> Iterator[str]:
    """Yield that inputs alternate between their limits, but of agents that tumbled `alone`."""
    agent = int(result.chatter.argmax())
    if agent not in alone and result.chatter[agent] > _CHATTERS:
        yield (
            f"The inputs of agent {agent} jumped from one limit to the opposite one "
            f"{result.chatter[agent]:.0f} times between two steps of {result.settings.dt:g} s."
        )


def sizes(result: Result) -> tuple[float, float]:
    """Return the root-mean-square error of the followers in the first and the last frame."""
    error = result.goal_distances([0, -1])[:, list(result.graph.followers)]
    with np.errstate(over="ignore"):
        first, last = (float(np.sqrt((row**2).mean())) for row in (error[0], error[-1]))
    return first, last


def grows(result: Result, guarantee: Guarantee) -> bool:
    """Return whether a run diverged, or its errors grew beyond what a guarantee allows for.

    Under one, errors that end below 1 cm are those of rounding and of inputs that are held.
    """
    if result.outcome is Outcome.DIVERGED or not guarantee.promised:
        return ends_farther(result)
    return ends_farther(result) and sizes(result)[1] >= SETTLED


def ends_farther(result: Result) -> bool:
    """Return whether a run diverged, or ends farther from its goals than it began."""
    if result.outcome is Outcome.DIVERGED:
        return True
    first, last = sizes(result)
    # Twice, since the last frame may be an overshoot; and after a start at the goals rounding
    # errors grow.
    return last > 2.0 * first + 1e-9
