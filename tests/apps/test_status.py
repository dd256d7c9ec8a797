"""What the program says while it works: at once, in one line of a terminal, and in a log."""

import io
import re
import subprocess
import sys

from echelon.apps.cli import terminal
from echelon.apps.cli.app import COMMANDS
from echelon.apps.cli.terminal import STATUS

FIRST_WORDS = """
import sys
from echelon.apps.cli import app
from echelon.apps.cli.terminal import STATUS

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
        **{name: f"{name} paper" for name in ("causes", "compare")},
        "doctor": "doctor",
        "fly": "fly paper --all",
        "verify": "verify run.nc",
        **{name: f"{name} run.nc" for name in ("view", "plot", "report")},
        "video": "video run.nc a.gif",
        "export": "export run.nc --to csv",
    }
    lines["sweep"] += " --over seed=0..3"
    names = {command.__name__.rstrip("_") for command in COMMANDS}
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
    """What a screen gets while something is done, each thing a second after the other."""
    clock = [10.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(sys, "stderr", screen)
    with terminal.outlive_readers():
        for action in actions:
            action()
            clock[0] += 1.0
    return screen.getvalue()


def begin(text, log=True):
    return lambda: STATUS.begin(text, log)


def counted(done, total, unit):
    return lambda: STATUS.count(done, total, unit)


def printed(text):
    return lambda: print(text, file=sys.stderr)


def test_a_terminal_has_one_line_that_other_output_replaces(monkeypatch):
    counts = [counted(k, 4, "runs") for k in (1, 2)]
    actions = begin("checking paper"), printed("first"), printed("second"), *counts
    text = shown(Terminal(), monkeypatch, *actions)
    assert text.startswith("\r\x1b[Kechelon: checking paper ...\r\x1b[Kfirst\nsecond\n\r\x1b[K")
    assert "checking paper: 1 of 4 runs ..." in text
    assert re.search(r"2 of 4 runs, 2 s left \.\.\.\r\x1b\[K$", text)


def test_the_time_that_is_left_is_shown_once_it_is_known(monkeypatch):
    counts = [counted(k, 3000, "steps") for k in (0, 1, 29, 30)]
    text = shown(Terminal(), monkeypatch, begin("comparing"), *counts)
    assert "29 of 3000 steps ..." in text
    assert "30 of 3000 steps, 4 min 57 s left ..." in text


def test_a_log_has_plain_lines_and_not_many(monkeypatch):
    counts = [counted(k, 100, "steps") for k in range(100)]
    text = shown(io.StringIO(), monkeypatch, begin("simulating"), *counts, printed("done"))
    lines = text.splitlines()
    assert lines[0] == "echelon: simulating ..." and lines[-1] == "done" and len(lines) == 22
    assert lines[1] == "echelon: simulating: 4 of 100 steps, 1 min 36 s left ..."


def test_what_is_for_programs_has_no_lines_in_a_log(monkeypatch):
    assert shown(io.StringIO(), monkeypatch, begin("x", log=False)) == ""
    assert "echelon: x" in shown(Terminal(), monkeypatch, begin("x", log=False))
    quiet = STATUS.silence, begin("x"), counted(1, 2, "runs")
    assert shown(io.StringIO(), monkeypatch, *quiet) == ""


def test_a_time_is_said_in_words():
    times = {0.2: "1 s", 59.4: "59 s", 125.0: "2 min 5 s", 7500.0: "2 h 5 min"}
    assert {seconds: terminal.duration(seconds) for seconds in times} == times


def test_native_code_that_there_is_not_is_refused_before_a_run_begins(here, echelon, monkeypatch):
    begun = []
    monkeypatch.setattr(STATUS, "begin", lambda text, log=True: begun.append(text))
    native = ["--set", "simulation.engine=native"]
    code, _, err = echelon("run", "crossing", *native, "--out", "o")
    assert code == 2 and "no native code for agents that keep away" in err
    assert begun == ["preparing crossing"] and not (here / "o").exists()
