"""`echelon check`: the paper's assumptions, tested on a scenario."""

import json

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.options import JsonOption, ScenarioArgument, SetOption
from echelon.apps.cli.status import STATUS


def check(scenario: ScenarioArgument, set_: SetOption = None, as_json: JsonOption = False) -> None:
    """Test the paper's assumptions on a scenario; exit code 0 if anything is guaranteed."""
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"checking {loaded.name}", not as_json)
    # Not above: an error in the file is reported without the wait for JAX.
    from echelon.experiments.scenario.build import build
    from echelon.experiments.studies.check import check as examine

    assumptions = examine(*build(loaded))
    promise = assumptions.promise
    if as_json:
        print(json.dumps(assumptions.as_mapping(), indent=2))
    else:
        tables.print_table(tables.statements_table(assumptions.lines), promise.sentence())
    raise typer.Exit(0 if assumptions.promised else 1)
