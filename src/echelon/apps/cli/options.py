"""Options and arguments that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from echelon.core.errors import OutputError
from echelon.output.archive.folder import check_exists


def _check_port(port: int | None) -> int | None:
    if port is not None and not 0 <= port <= 65535:
        raise OutputError(f"`--port` is {port}, and must be from 0 to 65535.")
    return port


BrowserOption = Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser.")]
FiguresOption = Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the figures.")]
FolderOption = Annotated[
    Path | None,
    typer.Option("--out", help="Output folder (default: a new folder in runs/)."),
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace earlier output of echelon in --out.")
]
GainFileOption = Annotated[Path | None, typer.Option("--out", help="Save the gain to this file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
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
        metavar="RUN", help="The folder of a run, or its `run.nc`.", callback=check_exists
    ),
]
ScenarioArgument = Annotated[
    str, typer.Argument(help="The name of a bundled scenario, or a YAML file.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a value of the scenario, as in simulation.horizon=10.",
    ),
]
