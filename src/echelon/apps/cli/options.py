"""Options and arguments that several commands share."""

from pathlib import Path
from typing import Annotated, Any, final

import typer
from typer.core import TyperCommand, TyperGroup

from echelon.core.errors import EchelonError, OutputError, ScenarioError
from echelon.core.gone import COMMANDS, gone
from echelon.output.archive.folder import check_exists


def _check_port(port: int | None) -> int | None:
    if port is not None and not 0 <= port <= 65535:
        raise OutputError(f"`--port` is {port}, and must be from 0 to 65535.")
    return port


def _check_run(run: Path | None) -> Path | None:
    return None if run is None else check_exists(run)


BrowserOption = Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser.")]
FiguresOption = Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the figures.")]
ResumedFiguresOption = Annotated[
    bool | None,
    typer.Option(
        "--figures/--no-figures",
        help="Draw the figures (default: yes; with --resume, as when the run began).",
        show_default=False,
    ),
]
FolderOption = Annotated[
    Path | None, typer.Option("--out", help="Output folder (default: a new folder in runs/).")
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace earlier output of echelon in --out.")
]
GainFileOption = Annotated[Path | None, typer.Option("--out", help="Save the gain to this file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
LatexOption = Annotated[bool, typer.Option("--latex", help="Print tables as LaTeX.")]
OverwriteOption = Annotated[bool, typer.Option("--force", help="Overwrite an existing file.")]
PortOption = Annotated[
    int | None,
    typer.Option("--port", help="Serve on this port or the next free one.", callback=_check_port),
]
ResumeOption = Annotated[
    Path | None,
    typer.Option("--resume", metavar="DIR", help="Continue the unfinished work in this folder."),
]
RunArgument = Annotated[
    Path,
    typer.Argument(
        metavar="RUN",
        help="The folder of a run or a flight, or its `run.nc`.",
        callback=check_exists,
    ),
]
BesideOption = Annotated[
    Path | None,
    typer.Option(
        "--beside", metavar="RUN", help="Compare a flight with this run.", callback=_check_run
    ),
]
ScenarioArgument = Annotated[
    str, typer.Argument(help="The name of a bundled scenario, or a YAML file.")
]
SecondsOption = Annotated[
    float,
    typer.Option(
        "--seconds", metavar="S", min=0.0, help="Try no further change after so many seconds."
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a value of the scenario, as in simulation.horizon=10.",
    ),
]


@final
class EchelonGroup(TyperGroup):
    """The commands, which name what to use instead of one that is gone."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the arguments name.

        Raises:
            EchelonError: an earlier version had it.
        """
        if ended := gone(COMMANDS, args[0]):
            raise EchelonError(f"the command `{args[0]}`{ended}")
        return super().resolve_command(ctx, args)


@final
class EchelonCommand(TyperCommand):
    """A command that names the scenario's key where an option is not one of its own."""

    # Typer's types of these are private, and differ between its versions.
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Return the remaining arguments.

        Raises:
            ScenarioError: an option is a key of the scenario, which `--set` changes.
        """
        words = [*args]
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            # Of all errors of an option, only that of an unknown one offers others.
            if hasattr(error, "possibilities") and any(each.name == "set_" for each in self.params):
                _name_key(str(getattr(error, "option_name", "")), words, str(self.name))
            raise


def _name_key(option: str, words: list[str], command: str) -> None:
    # Not above: pydantic takes long to load.
    from echelon.experiments.scenario.key_paths import places_of, sections_among
    from echelon.experiments.scenario.scenario import Scenario

    places = places_of((option.lstrip("-").replace("-", "_"),), Scenario)
    if not places:
        return
    text = " ".join(words).partition(option)[2]
    value = text[1:].split()[:1]
    shown = value[0] if value and not value[0].startswith("--") else "VALUE"
    keyed = set[str]() if shown.startswith("{") else sections_among(places, Scenario)
    inner = dict.fromkeys(keyed, ".KEY")
    keys = " or ".join(f"`--set {place}{inner.get(place, '')}={shown}`" for place in places[:2])
    raise ScenarioError(
        f"`{option}` is no option of `{command}`; use {keys}, which changes that key of the "
        "scenario."
    )
