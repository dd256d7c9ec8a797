"""`echelon check`: what is guaranteed of a scenario, and the paper's claims about it."""

import json
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import JsonOption, ScenarioArgument, SetOption
from echelon.apps.cli.status import STATUS

if TYPE_CHECKING:
    from echelon.experiments.studies.check import CheckResult


def check(
    scenario: ScenarioArgument,
    set_: SetOption = None,
    every: Annotated[
        bool, typer.Option("--all", help="Print every line, with its reason, as a table.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """State what is guaranteed of a scenario, and why; exit code 0 if anything is."""
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"checking {loaded.name}", not as_json)
    # Not above: an error in the file is reported without the wait for JAX.
    from echelon.experiments.scenario.build import build
    from echelon.experiments.studies.check import check as examine

    checked = examine(*build(loaded))
    if as_json:
        print(json.dumps(checked.as_mapping(), indent=2))
    else:
        _print(checked, every)
    raise typer.Exit(0 if checked.promised else 1)


def _print(result: "CheckResult", every: bool) -> None:
    from echelon.output.reports.check_report import check_report, check_sentences, grouped

    if every:
        tables.print_statements(grouped(result.lines), check_sentences(result))
    else:
        print(check_report(result))
