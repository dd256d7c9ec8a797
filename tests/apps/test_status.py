"""What the program says while it works: at once, in one line of a terminal, and in a log."""

import io
import re
import subprocess
import sys
import threading
import time

import pytest

from echelon.apps.cli import status, streams
from echelon.apps.cli.app import _COMMANDS
from echelon.apps.cli.status import STATUS

FIRST_WORDS = """
import sys
from echelon.apps.cli import app
from echelon.apps.cli.status import STATUS

class Said(BaseException):
    pass

def loaded():
    return sorted({"jax", "scipy", "matplotlib", "casadi", "xarray"} & {*sys.modules})

def say(text, log=True):
    raise Said(text)

STATUS.begin = say
for line in sys.stdin.read().splitlines():
    sys.argv = ["echelon", *line.split()]
    try:
        app.main()
    except Said as said:
        print(f"{line}: {said}", loaded())
    except SystemExit:
        print(f"{line}: complete", loaded())
"""
"""Runs commands up to what each says first, and prints that and what heavy is loaded by then."""

QUICK = {
    "list": "-q list",
    "explain": "-q explain margin",
    "schema": "-q schema",
    "init": "-q init mine",
}
"""Commands that load no library which takes seconds, and end at once."""


def test_every_command_says_what_it_does_before_heavy_libraries_are_loaded(here):
    (here / "run.nc").write_bytes(b"")
    lines = {
        **{name: f"{name} paper" for name in ("run", "path", "sweep", "live", "check", "design")},
        "compare": "compare paper",
        "doctor": "doctor",
        "fly": "fly paper --all",
        "verify": "verify run.nc",
        **{name: f"{name} run.nc" for name in ("view", "plot", "report")},
        "video": "video run.nc a.gif",
        "export": "export run.nc --to csv",
    }
    lines["sweep"] += " --over seed=0..3"
    names = {command.__name__.rstrip("_") for command in _COMMANDS}
    lines |= QUICK
    assert set(lines) == names
    done = subprocess.run(
        [sys.executable, "-c", FIRST_WORDS],
        input="\n".join(lines.values()),
        capture_output=True,
        text=True,
    )
    said = dict(line.split(": ", 1) for line in done.stdout.splitlines())
    assert set(said) == set(lines.values()), done.stderr
    assert all(text.endswith(" []") for text in said.values()), said


class Terminal(io.StringIO):
    def isatty(self):
        return True


def shown(screen, monkeypatch, *actions):
    """What a screen gets while something is done."""
    monkeypatch.setattr(sys, "stderr", screen)
    with streams.outlive_readers():
        for action in actions:
            action()
    return screen.getvalue()


def printed(text):
    return lambda: print(text, file=sys.stderr)


def test_a_terminal_has_one_line_that_other_output_replaces(monkeypatch):
    monkeypatch.setattr(status, "_DRAWN", 0.0)
    text = shown(
        Terminal(),
        monkeypatch,
        lambda: STATUS.begin("checking paper"),
        printed("first"),
        printed("second"),
        lambda: STATUS.count(1, 4, "runs"),
        lambda: STATUS.count(2, 4, "runs"),
    )
    assert text.startswith("\r\x1b[Kechelon: checking paper ...\r\x1b[Kfirst\nsecond\n\r\x1b[K")
    assert "checking paper: 1 of 4 runs ..." in text
    assert re.search(r"2 of 4 runs, 1 s left \.\.\.\r\x1b\[K$", text)


def test_a_log_has_plain_lines_and_not_many(monkeypatch):
    counted = [lambda k=k: STATUS.count(k, 100, "steps") for k in range(100)]
    text = shown(
        io.StringIO(), monkeypatch, lambda: STATUS.begin("simulating"), *counted, printed("done")
    )
    assert text == "echelon: simulating ...\ndone\n"
    monkeypatch.setattr(status, "_PLAIN", 0.0)
    text = shown(io.StringIO(), monkeypatch, lambda: STATUS.begin("simulating"), *counted[:3])
    assert "\x1b" not in text and "\r" not in text
    assert text.splitlines()[2] == "echelon: simulating: 1 of 100 steps, 1 s left ..."


def test_the_time_that_is_left_is_shown_once_it_is_known(monkeypatch):
    monkeypatch.setattr(status, "_DRAWN", 0.0)
    counted = [lambda k=k: STATUS.count(k, 3000, "steps") for k in (0, 1, 29, 30)]
    text = shown(Terminal(), monkeypatch, lambda: STATUS.begin("comparing"), *counted)
    assert "29 of 3000 steps ..." in text and "30 of 3000 steps, 1 s left ..." in text


def test_what_is_for_programs_has_no_lines_in_a_log(monkeypatch):
    assert shown(io.StringIO(), monkeypatch, lambda: STATUS.begin("x", log=False)) == ""
    assert "echelon: x" in shown(Terminal(), monkeypatch, lambda: STATUS.begin("x", log=False))
    quiet = (STATUS.silence, lambda: STATUS.begin("x"), lambda: STATUS.count(1, 2, "runs"))
    assert shown(io.StringIO(), monkeypatch, *quiet) == ""


def test_a_terminal_shows_that_the_program_loads(monkeypatch):
    monkeypatch.setattr(status, "_SOON", 0.01)
    monkeypatch.setattr(status, "_TICK", 60.0)
    screen = Terminal()

    def wait():
        end = time.monotonic() + 10.0
        while not screen.getvalue() and time.monotonic() < end:
            time.sleep(0.01)

    text = shown(screen, monkeypatch, wait, printed("first"))
    assert text == "\r\x1b[Kechelon: loading ...\r\x1b[Kfirst\n"
    monkeypatch.setattr(status, "_SOON", 60.0)
    assert shown(Terminal(), monkeypatch, printed("at once")) == "at once\n"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "1 s"), (59.4, "59 s"), (125.0, "2 min 5 s"), (7500.0, "2 h 5 min")],
)
def test_a_time_is_said_in_words(seconds, text):
    assert status.duration(seconds) == text


def test_native_code_that_there_is_not_is_refused_before_a_run_begins(here, echelon, monkeypatch):
    begun = []
    monkeypatch.setattr(STATUS, "begin", lambda text, log=True: begun.append(text))
    native = ["--set", "network={rate: 20, prediction: packet}"]
    native += ["--set", "simulation.engine=native"]
    code, _, err = echelon("run", "integrators", *native, "--out", "o")
    assert code == 2 and "no native code for a network that is not ideal" in err
    assert begun == ["preparing integrators"] and not (here / "o").exists()


def test_a_time_that_is_over_is_not_repeated(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(status.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(status, "_SILENT", 1e-3)
    log = io.StringIO()

    def late():
        clock[0] = 25.0
        while "2 of 4 parts ..." not in log.getvalue():
            threading.Event().wait(1e-3)

    def half():
        clock[0] = 10.0
        STATUS.count(2, 4, "parts")

    begun = [lambda: STATUS.begin("preparing"), lambda: STATUS.count(0, 4, "parts")]
    text = shown(log, monkeypatch, *begun, half, late)
    assert "2 of 4 parts, 10 s left ..." in text
    assert text.endswith("preparing: 2 of 4 parts ...\n")
