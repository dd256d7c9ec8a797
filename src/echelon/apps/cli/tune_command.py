"""`echelon tune`: the weights of a gain chosen by the flight."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from echelon.apps.cli import tables
from echelon.apps.cli.console import JsonOption, ScenarioArgument

if TYPE_CHECKING:
    from echelon.experiments.studies.tune import TuneResult


def tune(
    scenario: ScenarioArgument,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value before tuning."),
    ] = None,
    params: Annotated[
        str, typer.Option(metavar="KEY,KEY", help="What is tuned; follower.gain.coupling too.")
    ] = "follower.gain.Q,follower.gain.R",
    cost: Annotated[
        str, typer.Option(help="What is lowered: a sum of formation, effort and spacing.")
    ] = "formation + 0.01*effort",
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of the search at most.")] = 30,
    out: Annotated[Path | None, typer.Option(help="Save the tuned gain to this file.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the gain in --out.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Tune a Riccati gain by the slope of a run's cost; say what is promised with it."""
    from echelon.experiments.scenario.scenario import load_scenario

    checked = load_scenario(scenario, set_ or [])
    from echelon.experiments.scenario.self_contained import files_of
    from echelon.output.archive.folder import claim_design

    claim_design(out, None, force, files_of(checked))
    from echelon.experiments.studies.tune import tune as study

    watched = sys.stderr.isatty() and not as_json
    names = [name.strip() for name in params.split(",") if name.strip()]
    found = study(checked, names, cost, rounds, _tell if watched else None)
    if out is not None:
        _save(found, checked, out)
    told = _as_mapping(found, names)
    if as_json:
        print(json.dumps(told, indent=2))
    else:
        _show(told)
    raise typer.Exit(0 if found.promised_after.promised else 1)


def _tell(trial: int, cost: float) -> None:
    print(f"\rtrial {trial}, least cost {cost:.6g} ", end="", file=sys.stderr, flush=True)


def _save(found: "TuneResult", scenario: Any, out: Path) -> None:
    from echelon.experiments.scenario.build import build
    from echelon.synthesis.gains.gain_file import save_gain

    parts = build(scenario).parts
    save_gain(found.after.gain, parts.model, parts.graph, out)


def _as_mapping(found: "TuneResult", names: list[str]) -> dict[str, Any]:
    import numpy as np

    def of(tried: Any, promise: Any) -> dict[str, Any]:
        values = {name: np.asarray(tried.values[name]).tolist() for name in names}
        return {"cost": tried.cost, **values, "promise": promise.as_mapping()}

    return {
        "before": of(found.before, found.promised_before),
        "after": of(found.after, found.promised_after),
        "costs": list(found.costs),
    }


def _show(told: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("", "before", "after", box=None)
    for name in told["before"]:
        if name != "promise":
            table.add_row(name, *(_in_words(told[when][name]) for when in ("before", "after")))
    console = tables.console()
    if sys.stderr.isatty():
        print(file=sys.stderr)
    console.print(table)
    trials = len(told["costs"])
    print(f"{trials} trial{'s' * (trials != 1)}. {told['after']['promise']['sentence']}")


def _in_words(value: Any) -> str:
    return ", ".join(f"{x:.4g}" for x in (value if isinstance(value, list) else [value]))
