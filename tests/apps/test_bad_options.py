"""An option that no input could satisfy is rejected at once: before JAX is loaded."""

import json
import subprocess
import sys

CALLS = """
import contextlib, io, json, sys
sys.modules["jax"] = None
from echelon.apps.cli.app import main

said = []
for line in json.load(sys.stdin):
    sys.argv = ["echelon", *line.split()]
    with contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            main()
        except SystemExit as end:
            said.append([end.code, err.getvalue()])
json.dump(said, sys.stdout)
"""
PORT = "`--port` is {}, and must be from 0 to 65535."
GONE = "`gone` does not exist; give the folder of a run, or its `run.nc`."
SCENARIO = "`wrong.yaml` is a scenario; run it first (`echelon run wrong.yaml --out FOLDER`), and"
KINDS = "`csv`, `parquet`, `npz`, `mat`, `nc`, `html`, `mcap`"


REFUSED = [
    ("live paper --port 99999", PORT.format(99999)),
    ("view . --port -1", PORT.format(-1)),
    ("view gone", GONE),
    ("plot gone", GONE),
    ("report gone", GONE),
    ("video gone out.mp4", GONE),
    ("video . out.avi", "`out.avi` ends in `.avi`, and must end in .mp4 or .gif."),
    ("export gone", GONE),
    ("export . --to xls", f"`--to` is `xls`, allowed are {KINDS}."),
    (
        "export . --to json",
        "the format `json` is gone; use `csv`, or `nc` with xarray; numbers are",
    ),
    ("export . --out run.json", "the format `json` is gone; use `csv`, or `nc` with xarray;"),
    ("report . --out a.html", "a report as `.html` is gone; use `.txt`, or `echelon view RUN"),
    ("export . --out run.xls", f"`run.xls` ends in `xls`, allowed are {KINDS}."),
    ("export . --to mat --out run.csv", "`--to` is `mat`, and `run.csv` ends in `.csv`; leave"),
    ("view wrong.yaml", SCENARIO),
    ("export wrong.yaml", SCENARIO),
    ("explain ringing", "the glossary has no term `ringing`"),
    ("plot . --what top_vieu", "the figure is `top_vieu`, allowed are"),
    (
        "sweep paper --over seed=0..3 --cluster tcp://127.0.0.1:1",
        "the cluster at `tcp://127.0.0.1:1` does not answer: Connection refused.",
    ),
    (
        "sweep paper --over seed=0..3 --cluster 127.0.0.1",
        "`--cluster` is `127.0.0.1`, and must be an address with a port, such as "
        "`tcp://host:8786`.",
    ),
]


def test_a_bad_option_is_rejected_before_anything_is_loaded(tmp_path):
    (tmp_path / "wrong.yaml").touch()
    lines = json.dumps([line for line, _ in REFUSED])
    done = subprocess.run(
        [sys.executable, "-c", CALLS],
        **{"cwd": tmp_path, "input": lines, "capture_output": True, "text": True, "timeout": 60},
    )
    said = json.loads(done.stdout)
    faults = [
        (line, code, err)
        for (line, sentence), (code, err) in zip(REFUSED, said, strict=True)
        if code != 2 or err.count("\n") != 1 or not err.startswith(f"echelon: {sentence}")
    ]
    assert faults == []
