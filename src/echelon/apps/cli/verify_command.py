"""`echelon verify`: independent recomputation of the claims in a gain file."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import JsonOption

if TYPE_CHECKING:
    from echelon.agents.models.model import ControlAffine

_EXIT_CODES = {"verified": 0, "refused": 1, "incomplete": 5}


def verify(
    gain: Annotated[
        Path, typer.Argument(help="The folder of a run, or a gain file written by `design`.")
    ],
    scenario: Annotated[
        str | None,
        typer.Option(help="The scenario or run with the agents' model, if it is not bundled."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Recompute all claims about a gain from its file alone.

    Exit code 0 if all claims hold, 1 if one does not, 5 if one could not be checked.
    """
    from echelon.guarantees.verifier.verify import verify as recompute
    from echelon.output.archive.open_folder import promise_file

    model = None if scenario is None else _model(scenario)
    verification = recompute(promise_file(gain), model)
    if as_json:
        text = {
            "verdict": verification.verdict,
            "holds": verification.holds,
            "sentence": verification.sentence,
            "findings": [finding.as_mapping() for finding in verification.findings],
        }
        print(json.dumps(text, indent=2))
    else:
        titles = ("claim", "stored", "recomputed", "verdict", "method or reason")
        table = tables.plain_table(titles, verification.findings)
        tables.print_table(table, verification.sentence)
    raise typer.Exit(_EXIT_CODES[verification.verdict])


def _model(scenario: str) -> "ControlAffine":
    from echelon.experiments.scenario.build import build
    from echelon.experiments.scenario.scenario import load_scenario

    return build(load_scenario(scenario, [])).parts.model
