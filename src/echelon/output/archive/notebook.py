"""The HTML of a result in a notebook: outcome, a table of agents, and pictures; or its replay."""

import dataclasses
import html
from collections.abc import Iterator

from echelon.core.errors import OutputError
from echelon.experiments.results.dataset import STORED
from echelon.experiments.results.lyapunov import lyapunov
from echelon.experiments.results.metrics import metrics
from echelon.experiments.results.recording import Recording, empty_recording, recording_of
from echelon.experiments.results.run_numbers import AGENT_NUMBERS
from echelon.guarantees.promises.promise import guarantee
from echelon.output.plots.figure_files import html_image
from echelon.output.plots.run_figures import figures
from echelon.output.reports.html_report import html_table
from echelon.output.reports.run_report import ends_farther, grows, labelled, observations
from echelon.output.viewer.replay import replay_page
from echelon.simulation.engine.result import Result

_COLUMNS = ("start_error", "final_error", "saturated")
_PICTURES = ("trajectories", "formation")


def result_page(result: Result) -> str:
    """Return the outcome of a run, what was observed, a table of its agents, and pictures, as HTML.

    Of many agents the table has the best, the median and the worst, like the report.
    """
    head = f"<b>{html.escape(_name(result))}</b>: {html.escape(result.message)}"
    numbers = "" if result in STORED else f"{_observed(result)}{_table(result)}"
    drawings = figures(_recorded(result), _PICTURES) if len(result.times) else {}
    images = "".join(html_image(figure, name, 80) for name, figure in drawings.items())
    return f"<p>{head}</p>{numbers}{images}"


def _name(result: Result) -> str:
    # The parts of a run from disk are not built, which executes code, only to display it.
    if result in STORED:
        return recording_of(result).name
    return result.provenance.get("scenario") or type(result.model).__name__


def result_replay(result: Result) -> str:
    """Return the page of a run without its guarantee.

    Raises:
        OutputError: no frame is stored, or the run is too large for a page.
        MissingExtraError: the page's three.js is not built.
    """
    if not len(result.times):
        raise OutputError("the run has no stored frame; a page needs at least one.")
    if result in STORED:
        return replay_page(recording_of(result))
    V = lyapunov(result)
    return replay_page(dataclasses.replace(_recorded(result), lyapunov=V and V.value))


def _observed(result: Result) -> str:
    # A promise takes seconds to compute, so other runs do without.
    if not len(result.times) or not ends_farther(result):
        return ""
    stated = guarantee(result.parts, result.settings)
    if not grows(result, stated):
        return ""
    sentences = observations(result, metrics(result), stated)
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    return f"<ul>{items}</ul>" if items else ""


def _table(result: Result) -> str:
    unit = result.length_unit and f", {result.length_unit}"
    columns = (AGENT_NUMBERS[name].column.format(unit=unit) for name in _COLUMNS)
    heads = ("agent", *(column.replace("\n", " ") for column in columns))
    return html_table([heads, *_cells(result)])


def _cells(result: Result) -> Iterator[tuple[str, ...]]:
    numbers = metrics(result)
    errors = result.goal_distances([0, -1] if len(result.times) else [])
    saturated = AGENT_NUMBERS["saturated"]
    for label, row in labelled("leader", numbers.leaders):
        yield label, "", "", saturated.cell(row.saturated)
    for label, row in labelled("follower", numbers.followers):
        cells = [f"{size:.3g}" for size in errors[:, row.agent]] or ["", ""]
        yield label, *cells, saturated.cell(row.saturated)


def _recorded(result: Result) -> Recording:
    """Return the recording of a run, computed without its promise, which takes seconds."""
    if result in STORED:
        return recording_of(result)
    states, name = result.states, _name(result)
    run = empty_recording(result.parts, result.settings, states[0], name)
    ended = {"outcome": result.outcome.name.lower(), "message": result.message}
    return dataclasses.replace(
        run,
        attributes=run.attributes | ended,
        times=result.times,
        states=states,
        inputs=result.inputs,
        reference=result.reference,
    )
