"""A run as a notebook shows it: who is how far from its goal, and pictures of where all went."""

import base64
import dataclasses
import html
import io

import numpy as np

from echelon.engine.result import Result
from echelon.plots.run import figures
from echelon.results.foreseen import foreseen
from echelon.results.recording import Recording

_SHOWN = 12
"""Agents that the table names."""
_PICTURES = ("trajectories", "formation")


def result_page(result: Result) -> str:
    """Return how a run ended, its first agents as a table, and its pictures, as HTML."""
    title = result.provenance.get("scenario") or type(result.model).__name__
    told = f"<b>{html.escape(title)}</b>: {html.escape(result.message)}"
    return f"<p>{told}</p>{_table(result)}{_pictures(result)}"


def _table(result: Result) -> str:
    unit = " (m)" if result.unit == "m" else ""
    heads = ("agent", f"error at the start{unit}", f"at the end{unit}", "limited (% of steps)")
    rows = "".join(_row(cells) for cells in _cells(result))
    more = result.graph.agents - _SHOWN
    rest = f"<p>and {more} agents more</p>" if more > 0 else ""
    head = "".join(f"<th>{each}</th>" for each in heads)
    return f"<table><tr>{head}</tr>{rows}</table>{rest}"


def _cells(result: Result) -> list[tuple[str, ...]]:
    leads, found = {*result.graph.leaders}, []
    with np.errstate(over="ignore", invalid="ignore"):
        sizes = np.linalg.norm(result.errors[:, :_SHOWN, list(result.measured)], axis=2)
    for agent in range(sizes.shape[1]):
        role = "leader" if agent in leads else "follower"
        ends = () if agent in leads or not len(sizes) else sizes[[0, -1], agent]
        shown = [f"{each:.3g}" for each in ends] or ["", ""]
        found.append((f"{role} {agent}", *shown, f"{100.0 * result.saturated[agent]:.3g}"))
    return found


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
