"""`echelon verify`: a second opinion on a gain file."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.console import JsonOption

if TYPE_CHECKING:
    from echelon.agents.models.model import ControlAffine

_EXIT_CODES = {"verified": 0, "refused": 1, "incomplete": 5}


def verify(
    gain: Annotated[
        Path, typer.Argument(help="The folder of a run, or a gain file, as `design` writes it.")
    ],
    scenario: Annotated[
        str | None,
        typer.Option(help="A scenario or run whose model, not a bundled one, the agents are."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Recompute what a run's gain promises, or a saved one, from its file alone.

    Exit code 0 if all of it holds, 1 if a claim does not, 5 if one could not be checked.
    """
    from echelon.guarantees.verifier.verify import verify as recompute
    from echelon.output.archive.open_folder import promise_file

    found = recompute(promise_file(gain), None if scenario is None else _model(scenario))
    if as_json:
        lines = [each._asdict() for each in found.findings]
        told = {
            "verdict": found.verdict,
            "holds": found.holds,
            "sentence": found.sentence,
            "findings": lines,
        }
        print(json.dumps(told, indent=2))
    else:
        console = tables.console()
        titles = ("claim", "stored", "recomputed", "verdict", "how, or why not")
        whole = not console.is_terminal
        console.print(tables.plain_table(titles, found.findings), soft_wrap=whole)
        console.print(found.sentence, highlight=False, markup=False, soft_wrap=whole)
    raise typer.Exit(_EXIT_CODES[found.verdict])


def _model(scenario: str) -> "ControlAffine":
    from echelon.experiments.scenario.build import build
    from echelon.experiments.scenario.scenario import load_scenario

    return build(load_scenario(scenario, [])).parts.model
