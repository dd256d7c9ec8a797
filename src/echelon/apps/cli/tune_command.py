"""`echelon tune`: the weights of a gain, optimized for the cost of a run."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from echelon.apps.cli import options, tables
from echelon.apps.cli.terminal import STATUS
from echelon.core.words import amount
from echelon.output.archive.folder import claim_design

if TYPE_CHECKING:
    from echelon.core.types import JsonObject
    from echelon.experiments.scenario.scenario import Scenario
    from echelon.experiments.studies.tune import TuneResult, TuneTrial
    from echelon.guarantees.promises.promise import Promise


def tune(
    scenario: options.ScenarioArgument,
    set_: options.SetOption = None,
    params: Annotated[
        str, typer.Option(metavar="KEY,KEY", help="Keys to tune; follower.gain.coupling too.")
    ] = "follower.gain.Q,follower.gain.R",
    cost: Annotated[
        str, typer.Option(help="Cost to minimize: a sum of formation, effort and spacing.")
    ] = "formation + 0.01*effort",
    rounds: Annotated[int, typer.Option(min=1, help="Maximum number of search rounds.")] = 30,
    out: options.GainFileOption = None,
    force: options.OverwriteOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Tune a Riccati gain by the gradient of a run's cost; print what is guaranteed with it."""
    from echelon.experiments.scenario.scenario import load_scenario

    loaded = load_scenario(scenario, set_ or [])
    STATUS.begin(f"tuning {loaded.name}", not as_json)
    from echelon.experiments.scenario.self_contained import files_of

    claim_design(out, None, force, files_of(loaded))
    from echelon.experiments.studies.tune import tune as study

    names = [name.strip() for name in params.split(",") if name.strip()]

    def show(trial: int, lowest: float) -> None:
        STATUS.count(min(trial, rounds), rounds, f"rounds at most, lowest cost {lowest:.6g}")

    tuned = study(loaded, names, cost, rounds, show)
    if out is not None:
        _save(tuned, loaded, out)
    summary = _as_mapping(tuned, names)
    if as_json:
        print(json.dumps(summary, indent=2))
    else:
        _print(summary)
    raise typer.Exit(0 if tuned.promised_after.promised else 1)


def _save(tuned: "TuneResult", scenario: "Scenario", out: Path) -> None:
    from echelon.experiments.scenario.build import build
    from echelon.synthesis.gains.gain_file import save_gain

    parts = build(scenario).parts
    save_gain(tuned.after.gain, parts.model, parts.graph, out)


def _as_mapping(tuned: "TuneResult", names: list[str]) -> "JsonObject":
    import numpy as np

    def row(trial: "TuneTrial", promise: "Promise") -> "JsonObject":
        values = {name: np.asarray(trial.values[name]).tolist() for name in names}
        return {"cost": trial.cost, **values, "promise": promise.as_mapping()}

    return {
        "before": row(tuned.before, tuned.promised_before),
        "after": row(tuned.after, tuned.promised_after),
        "costs": list(tuned.costs),
    }


def _print(summary: "JsonObject") -> None:
    from rich.table import Table

    table = Table("", "before", "after", box=None)
    for name in summary["before"]:
        if name != "promise":
            table.add_row(name, *(_numbers(summary[when][name]) for when in ("before", "after")))
    tables.console().print(table)
    trials = len(summary["costs"])
    print(f"{amount(trials, 'trial')}. {summary['after']['promise']['sentence']}")


def _numbers(value: float | list[float]) -> str:
    return ", ".join(f"{x:.4g}" for x in (value if isinstance(value, list) else [value]))
