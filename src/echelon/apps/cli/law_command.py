"""`echelon law`: the law of one agent as Python and C."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.apps.cli import options
from echelon.apps.cli.status import STATUS
from echelon.output.archive.folder import check_empty


def law(
    scenario: options.ScenarioArgument,
    agent: Annotated[int, typer.Option(help="The number of the agent.")],
    set_: options.SetOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder (default: law-AGENT).")
    ] = None,
) -> None:
    """Write the law of one agent as Python and C, without echelon, for its own computer."""
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"writing the law of agent {agent} of {loaded.name}")
    folder = Path(f"law-{agent}") if out is None else out
    check_empty(folder)
    from echelon.experiments.scenario.build import build
    from echelon.experiments.scenario.self_contained import content_of_files
    from echelon.output.archive.law_folder import law_files, save_law

    files = law_files(*build(loaded), agent, content_of_files(loaded))
    save_law(files, folder)
    print(f"- Written to {folder}: {', '.join(files)}.")
