"""Forge folders of runs at random places, and count those that `verify` calls verified.

Run `python benchmarks/forged_folders.py [--forged 60] [--honest 60] [--seed 0]`. Runs of a few
kinds are written: with and without a guarantee, over a radio, with an event. A forgery changes one
number or text of `summary.json`, numbers of an array of `run.nc`, an attribute of a variable or of
the file, a group or variable that echelon does not write, or one number of `report.txt`. What
`verify` leaves open of an honest run, such as the computing time, is not forged. Honest runs have
other seeds.
"""

import argparse
import json
import re
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

import h5py
import numpy as np

import echelon as ech

SMALL = {
    "model": {"name": "double-integrator", "parameters": {"dimension": 2}},
    "graph": {"edges": [[0, 1], [1, 2], [1, 3]]},
    "formation": {"offsets": {1: [1, 0], 2: [2, 0], 3: [1, 1]}},
    "reference": {"name": "circle", "radius": 2.0, "rate": 0.5},
    "initial": {"spread": {"position": 0.5}},
    "simulation": {"horizon": 1.0, "dt": 0.02},
}
STOPPING = {"leader": {"law": "stopping-point"}, "follower": {"law": "stopping-point"}}
KINDS = {
    "proved": STOPPING,
    "local": {"follower": {"gain": {"method": "riccati"}}},
    "radio": STOPPING | {"network": {"rate": 25.0, "delay": 0.02, "loss": 0.2}},
    "event": STOPPING | {"events": [{"at": 0.4, "lose": 3}]},
    "windy": STOPPING | {"disturbance": {"rms": {"velocity": 0.5}}},
    "growing": {"follower": {"gain": {"method": "riccati", "coupling": 2000.0}}},
}
LEFT_OPEN = {"wall_time_s", "versions", "engine"}
NUMBER = re.compile(r"\d+\.\d+(?:e[-+]\d+)?")


def written(kind: str, seed: int, folder: Path) -> Path:
    """Write a run of a kind, and return its folder."""
    return ech.save_run(
        ech.run({"name": kind, "seed": seed, **SMALL, **KINDS[kind]}), folder, figures=False
    )


def leaves(value: object, path: tuple = ()) -> list[tuple]:
    """Return the paths of all numbers and texts in nested lists and mappings."""
    if isinstance(value, dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return [x for k, v in pairs if k not in LEFT_OPEN for x in leaves(v, (*path, k))]
    plain = isinstance(value, int | float | str) and not isinstance(value, bool)
    return [path] if plain else []


def in_summary(folder: Path, rng: np.random.Generator) -> str:
    """Change one number by a third, or one text."""
    file = folder / "summary.json"
    document = json.loads(file.read_text())
    paths = leaves(document)
    *way, last = paths[rng.integers(len(paths))]
    place = document
    for key in way:
        place = place[key]
    old = place[last]
    place[last] = f"{old}s" if isinstance(old, str) else (old * 4 / 3 if old else 0.25)
    file.write_text(json.dumps(document))
    return f"summary.json: {'.'.join(map(str, (*way, last)))} {old!r} to {place[last]!r}"


def variables(data: h5py.File) -> list[h5py.Dataset]:
    """Return all numeric variables with numbers in them."""
    found = list[h5py.Dataset]()

    def look(_: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fi" and item.size:
            found.append(item)

    data.visititems(look)
    return [x for x in found if "CLASS" not in x.attrs or b"DIMENSION" not in x.attrs["CLASS"]]


def in_array(folder: Path, rng: np.random.Generator) -> str:
    """Change the largest number of an array by a third."""
    with h5py.File(folder / "run.nc", "r+") as data:
        some = variables(data)
        chosen = some[rng.integers(len(some))]
        values = chosen[...]
        place = np.unravel_index(np.argmax(np.abs(np.nan_to_num(values))), values.shape)
        old = values[place]
        values[place] = old * 4 / 3 if old and np.isfinite(old) else 0.25
        if values.dtype.kind == "i":
            values[place] = old + 1
        chosen[...] = values
        return f"run.nc: {chosen.name} {old} to {values[place]}"


def in_attributes(folder: Path, rng: np.random.Generator) -> str:
    """Add or change an attribute by which readers show something else."""
    names = "units", "long_name", "scale_factor", "add_offset", "comment", "valid_range"
    name = names[rng.integers(len(names))]
    with h5py.File(folder / "run.nc", "r+") as data:
        some = [data, *variables(data)]
        chosen = some[rng.integers(len(some))]
        chosen.attrs[name] = 1e-3 if name in ("scale_factor", "add_offset") else "of a flight"
        return f"run.nc: attribute {name} of {chosen.name}"


def more(folder: Path, rng: np.random.Generator) -> str:
    """Add a variable, in a group of its own or beside others."""
    name = ("flight/error", "measured", "inputs/flown")[rng.integers(3)]
    with h5py.File(folder / "run.nc", "r+") as data:
        data[name] = np.zeros(3)
    return f"run.nc: more, {name}"


def in_report(folder: Path, rng: np.random.Generator) -> str:
    """Change one number of the report by a half."""
    file = folder / "report.txt"
    text = file.read_text()
    found = [x for x in NUMBER.finditer(text) if float(x[0]) > 1e-6]
    chosen = found[rng.integers(len(found))]
    file.write_text(f"{text[: chosen.start()]}{0.5 * float(chosen[0]):.4g}{text[chosen.end() :]}")
    return f"report.txt: {chosen[0]}"


FORGERIES = (in_summary, in_summary, in_array, in_array, in_attributes, more, in_report)


def main() -> int:
    """Print each forgery that is verified and each honest run that is not, and return 1 if any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--forged", type=int, default=60)
    parser.add_argument("--honest", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng, kinds = np.random.default_rng(given.seed), list(KINDS)
    verdicts, wrong = {"forged": Counter(), "honest": Counter()}, 0
    with tempfile.TemporaryDirectory() as top:
        runs = {kind: written(kind, given.seed, Path(top) / kind) for kind in kinds}
        for k in range(given.forged):
            folder = shutil.copytree(runs[kinds[k % len(kinds)]], Path(top) / f"forged-{k}")
            what = FORGERIES[k % len(FORGERIES)](folder, rng)
            try:
                verdict = ech.verify(folder).verdict
            except ech.EchelonError:
                verdict = "refused"
            verdicts["forged"][verdict] += 1
            if verdict != "refused":
                wrong += verdict == "verified"
                print(f"{kinds[k % len(kinds)]}: {verdict}: {what}", flush=True)
        for k in range(given.honest):
            kind = kinds[k % len(kinds)]
            folder = written(kind, given.seed + 1 + k, Path(top) / f"honest-{k}")
            verdict = ech.verify(folder).verdict
            verdicts["honest"][verdict] += 1
            if verdict == "refused":
                wrong += 1
                print(f"{kind}, seed {given.seed + 1 + k}: honest and refused", flush=True)
    for name, counts in verdicts.items():
        print(f"{name}: {dict(counts)}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
