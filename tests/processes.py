"""Helpers that run the command line in a process of its own, and read its log."""

import contextlib
import re
import subprocess
import sys
import time


def without_status(text):
    """A log without the lines that say what the program is doing."""
    return re.sub(r"^echelon: [^\n]* \.\.\.( [^\n]*)?\n", "", text, flags=re.MULTILINE)


@contextlib.contextmanager
def started(code, *arguments):
    """Start Python code that is the command line, and end it whatever happens."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for(process, condition):
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
