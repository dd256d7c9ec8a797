"""A run as a notebook shows it: who is how far from its goal, and pictures of where all went."""

import base64
import dataclasses
import html
import io
from collections.abc import Iterator

from echelon.experiments.results.foreseen import foreseen
from echelon.experiments.results.metrics import formation_errors, metrics
from echelon.experiments.results.recording import Recording
from echelon.guarantees.promises.promise import promise
from echelon.output.plots.run_figures import figures
from echelon.output.reports.causes import causes, grows
from echelon.output.reports.run_report import labelled
from echelon.simulation.engine.result import Result

_PICTURES = ("trajectories", "formation")


def result_page(result: Result) -> str:
    """Return how a run ended and why, its agents as a table, and its pictures, as HTML.

    Of many agents the table has the best, the median and the worst, as the report has.
    """
    title = result.provenance.get("scenario") or type(result.model).__name__
    told = f"<b>{html.escape(title)}</b>: {html.escape(result.message)}"
    return f"<p>{told}</p>{_causes(result)}{_table(result)}{_pictures(result)}"


def _causes(result: Result) -> str:
    """Return why a run was lost, or ends farther from its goals than it began."""
    # A promise takes seconds to be found, and a run that did well has nothing to explain.
    if not len(result.times) or not grows(result):
        return ""
    found = causes(result, metrics(result), promise(result.parts, result.settings))
    told = "".join(f"<li>{html.escape(each.sentence())}</li>" for each in found)
    return f"<ul>{told}</ul>" if told else ""


def _table(result: Result) -> str:
    unit = " (m)" if result.unit == "m" else ""
    heads = ("agent", f"error at the start{unit}", f"at the end{unit}", "limited (% of steps)")
    rows = "".join(_row(cells) for cells in _cells(result))
    head = "".join(f"<th>{each}</th>" for each in heads)
    return f"<table><tr>{head}</tr>{rows}</table>"


def _cells(result: Result) -> Iterator[tuple[str, ...]]:
    """Yield the leaders and the followers as the report names them."""
    numbers, errors = metrics(result), formation_errors(result)
    for label, each in labelled("leader", numbers.leaders):
        yield label, "", "", f"{100.0 * each.saturated:.3g}"
    for label, each in labelled("follower", numbers.followers):
        ends = errors[[0, -1], each.agent] if len(errors) else ()
        shown = [f"{size:.3g}" for size in ends] or ["", ""]
        yield label, *shown, f"{100.0 * each.saturated:.3g}"


def _row(cells: tuple[str, ...]) -> str:
    return f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in cells)}</tr>"


def _recorded(result: Result) -> Recording:
    """Return a run as it is drawn, but for its promise, which takes seconds to be found."""
    silent = {"promised": False, "rate": None, "theorem": None, "kind": "", "hypotheses": []}
    states, told = result.states, {**silent, "sentence": ""}
    return dataclasses.replace(
        foreseen(result.parts, result.settings, states[0], "", told),
        times=result.times,
        states=states,
        inputs=result.inputs,
        reference=result.reference,
        errors=result.errors,
    )


def _pictures(result: Result) -> str:
    found = list[str]()
    for name, figure in figures(_recorded(result), _PICTURES).items() if len(result.times) else ():
        content = io.BytesIO()
        figure.savefig(content, format="png", dpi=80)
        data = base64.b64encode(content.getvalue()).decode("ascii")
        found.append(f'<img alt="{name}" src="data:image/png;base64,{data}">')
    return "".join(found)
