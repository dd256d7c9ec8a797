"""The command line: its commands in the order of `--help`, and the exit code of each error.

Heavy modules are imported inside each command, so that `--help` is quick.
"""

import contextlib
import errno
import functools
import gc
import logging
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final

import typer

from echelon import __version__
from echelon.apps.cli.export_command import export, path, report
from echelon.apps.cli.fly_command import fly
from echelon.apps.cli.list_command import doctor, explain, init, list_, schema
from echelon.apps.cli.options import EchelonCommand, EchelonGroup
from echelon.apps.cli.run_command import run, sweep
from echelon.apps.cli.show_command import live, plot, video, view
from echelon.apps.cli.study_command import causes, check, compare, design
from echelon.apps.cli.terminal import STATUS, on_signal, outlive_readers
from echelon.apps.cli.verify_command import verify
from echelon.core import cache
from echelon.core.errors import EchelonError, ModelError
from echelon_flight import FlightError

_EPILOG = (
    "Exit codes: 0 success; 1 nothing is guaranteed, verify or doctor refused, or an agent left "
    "the domain of its equations; 2 invalid input, or a file that cannot be written; 3 diverged; "
    "4 an optional dependency is missing; 5 verify could not check every claim; 70 internal error "
    "of echelon; 130 stopped by Ctrl-C and 143 by SIGTERM, with results saved; "
    "141 success, but the reader of the output closed it early. "
    "ECHELON_CACHE names the folder for compiled code and proofs of bundled parts; "
    "`off` disables it."
)

CRASHED: Final = 70
"""Exit code of an error in the program itself, as in BSD's `sysexits.h`."""

app = typer.Typer(
    cls=EchelonGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=_EPILOG,
    help="Leader-follower formation control by consensus: design gains, simulate swarms, "
    "compute guarantees.",
)


def main() -> None:
    """Run the command line; an error becomes one sentence and its exit code."""
    # Where the home folder is read-only, matplotlib prints two lines about its cache.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    # Matrices are small here: more threads of linear algebra wait for each other, and no digit may
    # depend on their number. NumPy reads this when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Traces are made of many objects that last: Python would look through all of them at each 700.
    gc.set_threshold(20_000)
    folder = cache.open_user_folder(os.environ)
    with cache.use_folder(folder), on_signal(signal.SIG_DFL), outlive_readers():
        try:
            try:
                app()
            finally:
                # Here, since a failure after `main` would get an exit code of Python.
                sys.stdout.flush()
        except (EchelonError, FlightError) as error:
            _leave(str(error), error.exit_code)
        except Exception as error:
            if isinstance(error, OSError) and error.errno == errno.ENOSPC:
                _leave(f"the output cannot be written: {error.strerror}.", EchelonError.exit_code)
            # JAX reads its variables when it is imported, which then fails as a whole.
            if isinstance(error, ValueError) and "jax" not in sys.modules and "JAX" in str(error):
                _leave(f"JAX refuses a setting: {error!s:.200}; unset the variable.", 2)
            _leave(note_crash(error), CRASHED)


def note_crash(error: Exception) -> str:
    """Write the details of an internal error to a file, and return the sentence that names it."""
    kind = type(error).__name__
    reason = (str(error).splitlines() or ["no message"])[0].rstrip(".")
    sentence = f"internal error of echelon (your input may be correct): {kind}: {reason}"
    details = "".join(traceback.format_exception(error))
    try:
        from echelon.core.files import versions

        head = f"{' '.join(sys.argv)}\n{versions()}\n\n"
        with tempfile.NamedTemporaryFile(
            "w", prefix="echelon-crash-", suffix=".txt", delete=False, encoding="utf-8"
        ) as file:
            file.write(head + details)
        return f"{sentence}. Please report it with `{Path(file.name)}`."
    except OSError:
        # No file can be written, so the details go to the terminal.
        print(details, file=sys.stderr)
        return f"{sentence}. Please report it with the details above."


def _leave(sentence: str, code: int) -> None:
    print(f"echelon: {sentence}", file=sys.stderr)
    raise SystemExit(code) from None


@app.callback(invoke_without_command=True)
def _about(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Print errors only.")] = False,
) -> None:
    if quiet:
        STATUS.silence()
        nowhere = context.with_resource(open(os.devnull, "w"))
        context.with_resource(contextlib.redirect_stdout(nowhere))
    if version:
        print(f"echelon {__version__}")
        raise typer.Exit()


def _guarded(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that a user's file cannot end by `sys.exit`."""

    @functools.wraps(command)
    def call(*args: object, **options: object) -> None:
        try:
            command(*args, **options)
        # Typer itself leaves by another exception.
        except SystemExit as error:
            raise ModelError(
                f"a file of the scenario calls `sys.exit({error.code!r})`; remove that call."
            ) from error

    return call


# Listed here instead of decorated in their files, so that the order is that of `--help`.
COMMANDS: tuple[Callable[..., None], ...] = (
    *(init, run, sweep, view, live, fly, plot, video, report, export, path),
    *(check, causes, design, compare, verify, list_, explain, doctor, schema),
)
for _command in COMMANDS:
    app.command(_command.__name__.rstrip("_"), cls=EchelonCommand)(_guarded(_command))
