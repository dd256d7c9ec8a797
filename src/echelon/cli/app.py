"""The command line: its commands in the order of `--help`, and how errors leave it.

Heavy modules are imported inside each command, so that `--help` is quick.
"""

import os
import sys
from typing import Annotated, Final

import typer

from echelon import __version__
from echelon.cli.cache import keep_compiled_code
from echelon.cli.check import check
from echelon.cli.compare import compare
from echelon.cli.design import design
from echelon.cli.doctor import doctor
from echelon.cli.listing import list_, schema
from echelon.cli.run import run
from echelon.cli.verify import verify
from echelon.core.errors import EchelonError

_EPILOG = (
    "Exit codes: 0 done, 1 checked and not promised, 2 bad input, 3 diverged, "
    "4 an optional part is not installed, 5 verified as far as it could be checked, "
    "130 interrupted. "
    "ECHELON_CACHE names the folder where compiled code is kept between runs; `off` keeps none."
)
_INTERRUPTED: Final = 130

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=_EPILOG,
    help="Formation tracking by consensus: synthesize gains, simulate swarms, "
    "say what is promised.",
)


def main() -> None:
    """Run the command line; an echelon error becomes one sentence and its exit code."""
    keep_compiled_code(os.environ)
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
        print(f"echelon {__version__}")
        raise typer.Exit()


# Listed here and not decorated at home, so that a command's file knows nothing of the program.
for _command in (run, check, design, compare, verify, list_, doctor, schema):
    app.command(_command.__name__.rstrip("_"))(_command)
