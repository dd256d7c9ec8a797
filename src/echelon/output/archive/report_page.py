"""The HTML report of a run: guarantee, text report, figures, scenario, versions, citation."""

from html import escape
from pathlib import Path

from echelon import __version__
from echelon.experiments.results.dataset import recording_of
from echelon.experiments.results.recording import Recording
from echelon.experiments.scenario.scenario import SCENARIO_FILE
from echelon.output.plots.figure_files import html_image
from echelon.output.plots.run_figures import DEFAULT, figures
from echelon.simulation.engine.result import Result

_STYLE = """
body { max-width: 62rem; margin: 2rem auto; padding: 0 1.2rem; color: #1c2128; background: #fff;
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { margin: 0; font-size: 1.7rem; } h2 { margin: 2.4rem 0 .6rem; font-size: 1.15rem; }
.facts { color: #5c6773; margin: .2rem 0 1.4rem; }
.promise { border-left: 4px solid #c8322b; background: #f7f8fa; padding: .7rem 1rem; }
.promise.holds { border-color: #00805c; }
pre { background: #f7f8fa; padding: .9rem 1rem; overflow-x: auto; font-size: 12px; line-height: 1.4;
  border-radius: 6px; }
figure { margin: 0 0 1.4rem; } img { max-width: 100%; height: auto; }
figcaption { color: #5c6773; font-size: 13px; }
table { border-collapse: collapse; } td { padding: .15rem 1.2rem .15rem 0; vertical-align: top; }
td.fails { color: #c8322b; }
@media print { h2 { break-after: avoid; } figure { break-inside: avoid; } }
"""
_CAPTIONS = {
    "leader_3d": "Paths of the leaders and their references.",
    "trajectories": "Paths of all agents, with the graph at a few times.",
    "tracking": "Tracking errors of the leaders.",
    "formation": "Distances of the followers from their goals, with the guaranteed rate.",
    "inputs": "Actuator loads and their limits.",
    "lyapunov": "Lyapunov function V and its derivative.",
    "avoidance": "Smallest scaled distance of agents that keep apart, and those held back.",
    "ages": "Age of the oldest message of each follower.",
}


def report_page(run: Result | Recording, folder: Path | None) -> str:
    """Return the page, with the report and the scenario from the run's folder.

    Args:
        run: to report.
        folder: of the run; None of a dataset without one.
    """
    run = recording_of(run)
    scenario = _text(folder, SCENARIO_FILE) or str(run.attributes.get("scenario_text", ""))
    text = _text(folder, "report.txt") or str(run.attributes["message"])
    facts = f"{run.agents} agents, {run.model}; {run.horizon:g} s in steps of {run.dt:g} s; "
    parts = [
        f"<h1>{escape(run.name)}</h1>",
        f'<p class="facts">{escape(facts + run.attributes["message"])}</p>',
        _promise(run),
        _section("Results", _pre(text)),
        _section("Figures", "".join(_figures(run))),
        _section("Conditions of the guarantee", _hypotheses(run)),
        _section("Scenario", _pre(scenario)) if scenario else "",
        _section("Versions", _versions(run)),
        _section("Citation", _pre(citation())),
    ]
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(run.name)}</title>'
    view = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    return f"{head}{view}<style>{_STYLE}</style><body>{''.join(parts)}</body></html>\n"


def citation() -> str:
    """Return the BibTeX entries of echelon and of the paper that it builds on."""
    return (
        "@software{echelon,\n"
        "  title = {echelon: leader-follower formation tracking for control-affine nonlinear "
        "agents},\n"
        f"  author = {{{{The echelon developers}}}},\n  version = {{{__version__}}}\n}}\n"
        "@inproceedings{enwerem2023consensus,\n"
        "  title = {Consensus-Based Leader-Follower Formation Tracking for Control-Affine "
        "Nonlinear Multiagent Systems},\n"
        "  author = {Enwerem, Clinton and Baras, John S.},\n"
        "  booktitle = {9th International Conference on Control, Decision and Information "
        "Technologies (CoDIT)},\n  year = {2023},\n  note = {arXiv:2309.09156}\n}"
    )


def _promise(run: Recording) -> str:
    state = " holds" if run.promise["promised"] else ""
    return f'<p class="promise{state}">{escape(run.promise["sentence"])}</p>'


def _section(title: str, content: str) -> str:
    return f"<h2>{escape(title)}</h2>{content}"


def _pre(text: str) -> str:
    return f"<pre>{escape(text.rstrip())}</pre>"


def _text(folder: Path | None, name: str) -> str:
    file = None if folder is None else folder / name
    return file.read_text("utf-8", "replace") if file is not None and file.is_file() else ""


def _figures(run: Recording) -> list[str]:
    drawings = ((_CAPTIONS[name], figure) for name, figure in figures(run, DEFAULT).items())
    return [
        f"<figure>{html_image(figure, text, 140)}<figcaption>{text}</figcaption></figure>"
        for text, figure in drawings
    ]


def _hypotheses(run: Recording) -> str:
    rows = [
        f"<tr><td>{escape(row['statement'])}</td>"
        f'<td class="{row["verdict"].replace(" ", "-")}">{escape(row["verdict"])}</td>'
        f"<td>{escape(row['text'])}</td></tr>"
        for row in run.promise["hypotheses"]
    ]
    return f"<table>{''.join(rows)}</table>"


def _versions(run: Recording) -> str:
    rows = [
        f"<tr><td>{escape(key[8:])}</td><td>{escape(str(text))}</td></tr>"
        for key, text in run.attributes.items()
        if str(key).startswith("version_")
    ]
    return f"<table>{''.join(rows)}</table>"
