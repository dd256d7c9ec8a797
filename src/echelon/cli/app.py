"""The command line. Heavy modules are imported inside each command, so that `--help` is quick."""

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from echelon.cli import tables as _tables
from echelon.core.errors import EchelonError

if TYPE_CHECKING:
    from echelon.engine.simulate import Progress
    from echelon.gains.gain import Gain
    from echelon.scenario.build import Parts

_EPILOG = (
    "Exit codes: 0 done, 1 checked and not promised, 2 bad input, 3 diverged, "
    "4 an optional part is not installed, 130 interrupted."
)
_INTERRUPTED: Final = 130

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    epilog=_EPILOG,
    help="Formation tracking by consensus: synthesize gains, simulate swarms, "
    "say what is promised.",
)

_Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]


def main() -> None:
    """Run the command line; an echelon error becomes one sentence and its exit code."""
    try:
        app()
    except EchelonError as error:
        print(f"echelon: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:
        print("echelon: interrupted before anything was computed.", file=sys.stderr)
        raise SystemExit(_INTERRUPTED) from None


@app.callback(invoke_without_command=True)
def _about(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and leave.")
    ] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        print(f"echelon {installed('echelon')}")
        raise typer.Exit()


@app.command()
def run(
    scenario: Annotated[str, typer.Argument(help="A bundled scenario's name, or a YAML file.")],
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change a value, as in simulation.horizon=10."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder; default runs/NAME-TIME.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier run in --out.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    as_json: _Json = False,
) -> None:
    """Simulate a scenario; write its table, figures and dataset."""
    from echelon.scenario.scenario import load_scenario

    checked = load_scenario(scenario, set_ or [])
    from echelon.cli import files as _output
    from echelon.reports import run as _report
    from echelon.results import metrics as _metrics
    from echelon.scenario import build as _build

    # Parts before the folder: a bad scenario must leave no empty folder behind.
    parts = _build.build(checked)
    folder = _output.claim_folder(checked.name, out, force)
    console = _tables.console()
    with _progress(quiet=as_json) as progress:
        result = _build.run(checked, progress, parts)
    _output.write_data(result, folder)
    numbers = _metrics.metrics(result, checked.report.steady_window)
    text = _report.report(result, checked.report.steady_window)
    told = _output.write_run(result, numbers, text, folder, figures)
    if as_json:
        print(json.dumps(told, indent=2))
    else:
        _report.print_report(console, result, numbers)
        _report.say(console, f"Written to {folder}: {_written(folder)}.")
    raise typer.Exit(result.outcome.exit_code)


@app.command()
def check(
    scenario: Annotated[str, typer.Argument(help="A bundled scenario's name, or a YAML file.")],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value before checking."),
    ] = None,
    as_json: _Json = False,
) -> None:
    """Walk through the paper's assumptions on a scenario; exit code 0 if something is promised."""
    from echelon.scenario.scenario import load_scenario

    checked = load_scenario(scenario, set_ or [])
    from echelon.scenario import build as _build
    from echelon.studies import check as _check

    found = _check.check(_build.build(checked))
    if as_json:
        lines = [line._asdict() for line in found.lines]
        print(
            json.dumps(
                {"promised": found.promised, "promise": found.promise, "lines": lines}, indent=2
            )
        )
    else:
        console = _tables.console()
        console.print(_tables.lines_table(found.lines), soft_wrap=not console.is_terminal)
        console.print(found.promise, highlight=False, soft_wrap=not console.is_terminal)
    raise typer.Exit(0 if found.promised else 1)


@app.command()
def design(
    scenario: Annotated[str, typer.Argument(help="A bundled scenario's name, or a YAML file.")],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value before designing."),
    ] = None,
    method: Annotated[str | None, typer.Option(help="Only this method.")] = None,
    out: Annotated[Path | None, typer.Option(help="Save the gain to this file.")] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Draw modes and certified set into this folder.")
    ] = None,
    slice_: Annotated[
        str | None, typer.Option("--slice", metavar="STATE,STATE", help="What the set is drawn in.")
    ] = None,
    as_json: _Json = False,
) -> None:
    """Try all gain methods on a scenario, recommend one, save its gain, draw what it promises."""
    from echelon.scenario.scenario import load_scenario

    checked = load_scenario(scenario, set_ or [])
    from echelon.gains import file as _gain_file
    from echelon.scenario import build as _build
    from echelon.studies import design as _design

    _known_method(method)
    parts = _build.build(checked)
    dt = checked.simulation.dt
    tried = _design.designs(checked, parts, method)
    best = _design.recommended(tried, dt)
    sentence = "No method gives a stable loop here."
    told: dict[str, Any] = {"recommended": None}
    if best is not None and best.gain is not None:
        sentence = _design.because(best, tried, dt)
        told = {"recommended": best.method, "because": sentence}
        if out is not None:
            _gain_file.save_gain(best.gain, parts.model, parts.graph, out)
        if figures is not None:
            radii = _design_figures(parts, best.gain, figures, slice_)
            sentence += f"\n{radii}" if radii else ""
            told["radii"] = radii
    told["methods"] = [_tables.design_row(each) for each in tried]
    if as_json:
        print(json.dumps(told, indent=2))
    else:
        _tables.print_designs(told["methods"], sentence)
    raise typer.Exit(0 if best is not None else 1)


@app.command()
def compare(
    scenarios: Annotated[
        list[str],
        typer.Argument(help="Bundled scenarios' names, or YAML files.", metavar="SCENARIO..."),
    ],
    horizon: Annotated[float, typer.Option(help="Length of every run, s.")] = 10.0,
    method: Annotated[
        list[str] | None, typer.Option(help="Only this method; may be given several times.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a value in every scenario."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Output folder; default runs/compare-NAME-TIME.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an earlier comparison in --out.")
    ] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    as_json: _Json = False,
) -> None:
    """Fly the consensus laws and an optimization-based method from the same starts."""
    from echelon.scenario.scenario import load_scenario

    changes = [f"simulation.horizon={horizon!r}", *(set_ or [])]
    checked = [load_scenario(each, changes) for each in scenarios]
    from echelon.cli import files as _output
    from echelon.reports import comparison as _comparison_report
    from echelon.scenario import build as _build
    from echelon.studies import compare as _compare

    labels = _compare.known_labels(method)
    parts = [_build.build(each) for each in checked]
    folders = _output.claim_folders([each.name for each in checked], out, force)
    told = []
    for scenario, built, folder in zip(checked, parts, folders, strict=True):
        found = _compare.compare(scenario, built, labels, _announce(quiet=as_json))
        told.append(_comparison_report.comparison_mapping(found))
        text = _comparison_report.comparison_report(found)
        _output.write_comparison(found, told[-1], text, folder, figures)
        if not as_json:
            _comparison_report.print_comparison(_tables.console(), found)
            print(f"- Written to {folder}: {_written(folder)}.")
    if as_json:
        print(json.dumps(told[0] if len(told) == 1 else told, indent=2))


@app.command()
def verify(
    gain: Annotated[Path, typer.Argument(help="A gain file, as `design --out` writes it.")],
    as_json: _Json = False,
) -> None:
    """Recompute what a saved gain promises, from its file alone; exit code 0 if all of it holds."""
    from echelon.verifier import verify as _verify

    found = _verify.verify(gain)
    if as_json:
        lines = [each._asdict() for each in found.findings]
        told = {"holds": found.holds, "sentence": found.sentence, "findings": lines}
        print(json.dumps(told, indent=2))
    else:
        console = _tables.console()
        titles = ("claim", "stored", "recomputed", "verdict", "how, or why not")
        whole = not console.is_terminal
        console.print(_tables.lines_table(found.findings, titles), soft_wrap=whole)
        console.print(found.sentence, highlight=False, markup=False, soft_wrap=whole)
    raise typer.Exit(0 if found.holds else 1)


@app.command("list")
def list_(as_json: _Json = False) -> None:
    """List scenarios, models, references, laws, gain methods, graphs, formations, integrators."""
    from echelon.scenario import registry
    from echelon.scenario.scenario import bundled_scenarios

    families: dict[str, dict[str, str]] = {"scenarios": bundled_scenarios()}
    for title, entries in (
        ("models", registry.MODELS),
        ("references", registry.REFERENCES),
        ("leader laws", registry.LEADER_LAWS),
        ("follower laws", registry.FOLLOWER_LAWS),
        ("gain methods", registry.METHODS),
    ):
        families[title] = {name: entry.summary for name, entry in entries.items()}
    families |= {
        "graphs": registry.GRAPHS,
        "formations": registry.FORMATIONS,
        "integrators": registry.INTEGRATORS,
    }
    if as_json:
        print(json.dumps(families, indent=2))
        return
    width = max(len(name) for entries in families.values() for name in entries)
    for title, entries in families.items():
        print(f"{title}:")
        for name, text in entries.items():
            print(f"  {name:<{width}}  {text}")


@app.command()
def doctor(as_json: _Json = False) -> None:
    """Print versions and devices, and run the physics' self-checks."""
    from echelon.studies import doctor as _doctor

    facts, checks = _doctor.facts(), list(_doctor.checks())
    if as_json:
        print(
            json.dumps({"facts": facts, "checks": [check._asdict() for check in checks]}, indent=2)
        )
    else:
        console = _tables.console()
        console.print(_tables.pairs(facts))
        for check in checks:
            verdict = "[green]pass[/]" if check.holds else "[red]FAIL[/]"
            console.print(f"{verdict}  {check.claim} ({check.found})", highlight=False)
    if not all(check.holds for check in checks):
        raise typer.Exit(1)


@app.command()
def schema() -> None:
    """Print the JSON schema of the scenario file, for editors."""
    from echelon.scenario.scenario import json_schema

    print(json.dumps(json_schema(), indent=2))


def _design_figures(parts: "Parts", gain: "Gain", folder: Path, asked: str | None) -> str | None:
    """Draw a design's figures, and return a sentence on its radii if it has any."""
    from echelon.core.errors import OutputError
    from echelon.plots.design import save_design_figures
    from echelon.studies.design import with_gain

    try:
        _, radii = save_design_figures(with_gain(parts, gain), folder, asked)
    except OSError as error:
        raise OutputError(f"`{folder}` cannot be written: {error.strerror or error}.") from error
    return None if radii is None else radii.sentence()


def _known_method(method: str | None) -> None:
    from echelon.core.errors import GainError, did_you_mean, listing
    from echelon.scenario.registry import METHODS

    if method is not None and method not in METHODS:
        raise GainError(
            f"`--method` is `{method}`, allowed are {listing(METHODS)}"
            f"{did_you_mean(method, METHODS)}."
        )


@contextlib.contextmanager
def _progress(quiet: bool) -> "Iterator[Progress | None]":
    """Show steps and time left on standard error while a run lasts, where someone watches."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns: tuple[Any, ...] = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("steps, left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("simulating", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _announce(quiet: bool) -> "Callable[[str], None]":
    """Return what tells on standard error which method is flying, where someone watches."""
    if quiet or not sys.stderr.isatty():
        return lambda label: None
    return lambda label: print(f"flying {label} ...", file=sys.stderr)


def _written(folder: Path) -> str:
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir())
    return ", ".join(names)


if __name__ == "__main__":
    main()
