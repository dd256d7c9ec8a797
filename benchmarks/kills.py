"""End runs by SIGKILL at random times, let each go on, and compare the bits: `kills.py [KILLS]`.

A run of the paper's scenario, longer than the paper's, is made once unbroken and then again and
again, ended at a drawn moment between its folder's appearance and its end; every third is ended
once more while it goes on. `echelon run --resume` must leave the same files in the folder, and in
them the same bits; the time that it took is all that may differ.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from echelon.experiments.results.labelled import read_labelled

RUN = ["run", "paper", "--set", "simulation.horizon=300.0", "--no-figures", "--out"]
STEP = 0.002
"""Seconds between two looks for a folder."""


def start(*words: str) -> subprocess.Popen[bytes]:
    """Start the command line in a process of its own."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen([sys.executable, "-m", "echelon", *words], **quiet)


def killed(process: subprocess.Popen[bytes], seconds: float) -> bool:
    """End a process after so many seconds, and tell whether it was still there."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
    return process.wait() == -signal.SIGKILL


def begun(process: subprocess.Popen[bytes], folder: Path) -> None:
    """Wait until a run has its folder."""
    while not (folder / "chunks" / "begun.json").exists() and process.poll() is None:
        time.sleep(STEP)


def content(folder: Path) -> dict[str, Any]:
    """Return the names of a folder's files, and all bits of the run."""
    data = read_labelled(folder / "run.nc").arrays()
    arrays = {f"run.nc {name}": values for name, values in data.items()}
    told = json.loads((folder / "summary.json").read_text("utf-8"))
    told.pop("wall_time_s")
    # The commit of a checkout that is worked in meanwhile.
    told["versions"].pop("git", None)
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
    bits = {name: (array.dtype.str, array.tobytes()) for name, array in arrays.items()}
    return bits | {"files": names} | {f"summary.json {key}": told[key] for key in told}


def go_on(folder: Path) -> bool:
    """Let a run go on, and tell whether it ended well."""
    return start("run", "--resume", str(folder), "--no-figures").wait() == 0


def main() -> int:
    """Break runs, and tell whether one is not what the unbroken one is."""
    parser = argparse.ArgumentParser(prog="kills", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kills", nargs="?", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng, broken, differ = random.Random(given.seed), 0, 0
    with tempfile.TemporaryDirectory() as text:
        os.chdir(text)
        os.environ["ECHELON_CACHE"] = str(Path(text) / "cache")
        # Once to compile, and once more for the time that it takes.
        for name in ("first", "whole"):
            process = start(*RUN, name)
            begun(process, Path(name))
            since = time.monotonic()
            if process.wait():
                raise SystemExit("the unbroken run fails")
        seconds, wanted = time.monotonic() - since, content(Path("whole"))
        print(f"unbroken: {seconds:.1f} s after its folder appears, {len(wanted)} entries")
        for k in range(given.kills):
            folder = Path(f"run{k}")
            process = start(*RUN, folder.name)
            begun(process, folder)
            moment = rng.uniform(0.0, seconds)
            ended = killed(process, moment)
            chunks = len(list(folder.glob("chunks/*.npz")))
            if ended and k % 3 == 2:
                killed(start("run", "--resume", folder.name), rng.uniform(0.0, 1.5 * seconds))
            well = go_on(folder)
            found = content(folder) if well else {}
            wrong = [name for name in wanted | found if wanted.get(name) != found.get(name)]
            broken, differ = broken + ended, differ + bool(wrong)
            words = "the same" if not wrong else f"DIFFERS: {', '.join(wrong)}"
            state = f"{chunks} chunks" if ended else "it had ended"
            print(f"{k + 1:3d} at {moment:5.2f} s, {state}: {words}", flush=True)
    print(f"{broken} of {given.kills} runs were ended (seed {given.seed}), {differ} differ after")
    return int(differ > 0)


if __name__ == "__main__":
    sys.exit(main())
