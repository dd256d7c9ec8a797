"""Draw the pictures of docs/gallery.md into docs/assets/gallery, from the scenarios on the pages.

Run it with `python docs/draw_gallery.py`, or with names of scenes; it takes two minutes. `--quick`
runs and draws a little of everything, for the tests, and `--out` says where.
"""

import argparse
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image

import echelon as ech
from echelon.experiments.results.recording import recording_of
from echelon.experiments.studies.compare import compare
from echelon.output.plots import figure_files
from echelon.output.plots.study_figures import comparison_figures, sweep_figures
from echelon.output.plots.video import save_video

DOCS = Path(__file__).resolve().parent
TITLED = re.compile(r'^```\w+ title="([^"]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)
PAGES = ("gallery.md", "start.md", "recipes.md")

RUNS: dict[str, dict[str, Any]] = {
    "paper": {
        "set": ("simulation.horizon=12",),
        "figures": {"trajectories": "space", "inputs": "motors"},
        "video": ("paper", 1.5),
    },
    "crossing": {
        "set": ("simulation.horizon=8",),
        "figures": {"avoidance": "near"},
        "video": ("crossing", 1.0),
    },
    "reshape": {"set": ("reference.amplitude=[1.0, 1.6]",), "video": ("reshape", 2.5)},
    "leader-lost": {"figures": {"trajectories": "backup"}, "video": ("backup", 1.5)},
    "paper-far": {"set": ("simulation.horizon=20",), "figures": {"trajectories": "far"}},
    "boats": {"set": ("simulation.horizon=10",), "figures": {"trajectories": "boats"}},
    "flock.yaml": {
        "figures": {
            "network": "network",
            "modes": "modes",
            "trajectories": "flock",
            "formation": "bands",
        },
        "video": ("flock", 4.0),
    },
    "oscillators.yaml": {"figures": {"trajectories": "phase"}, "video": ("oscillators", 2.5)},
    "carts.yaml": {
        "set": (
            "network={rate: 20, delay: 0.05, jitter: 0.05, bursts: {share: 0.2, length: 0.3}}",
            "simulation={horizon: 8, dt: 0.01}",
        ),
        "figures": {"ages": "ages"},
    },
    "ring.yaml": {"figures": {"formation": "van_der_pol", "lyapunov": "lyapunov"}},
    "blimps.yaml": {
        "set": ("simulation.horizon=30",),
        "figures": {"distances": "distances"},
        "video": ("blimps", 4.0),
    },
}
"""Of each scenario what is changed, its figures and their files, its video and how fast it goes."""
COUPLINGS, SPREADS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0), (0.5, 1.0, 2.0, 3.0, 4.0)
LAWS = ("riccati-relay", "riccati", "inner-loop", "stopping-point")


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw what is asked for, or everything."""
    scenes = [*RUNS, "sweep", "laws"]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=scenes, metavar="SCENE", help=str(scenes))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=DOCS / "assets" / "gallery")
    asked = parser.parse_args(arguments)
    asked.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        write_files(Path(folder))
        for scene in asked.scenes:
            others = {"sweep": draw_sweep, "laws": draw_laws}
            if scene in others:
                others[scene](asked.out, asked.quick)
            else:
                draw_run(scene, Path(folder), asked.out, asked.quick)


def write_files(folder: Path) -> None:
    """Write the files that stand on the pages."""
    for page in PAGES:
        for name, text in TITLED.findall((DOCS / page).read_text("utf-8")):
            (folder / name).write_text(text, "utf-8")


def draw_run(scene: str, folder: Path, out: Path, quick: bool) -> None:
    """Fly a scenario and draw its figures and its video."""
    told = RUNS[scene]
    short = ("simulation.horizon=0.1", "simulation.store_every=1", "report.steady_window=0.05")
    changes = (*told.get("set", ()), *(short if quick else ()))
    source = folder / scene if scene.endswith(".yaml") else scene
    run = recording_of(ech.run(ech.load_scenario(source, changes)))
    names = told.get("figures", {})
    save({names[name]: figure for name, figure in ech.figures(run, tuple(names)).items()}, out)
    if "video" in told:
        name, speed = told["video"]
        save_video(run, out / f"{name}.gif", 100.0 if quick else speed)


def draw_sweep(out: Path, quick: bool) -> None:
    """Draw how often oscillators settle over coupling and size of the starts."""
    small = 2 if quick else None
    over = {
        "seed": range(small or 20),
        "follower.gain.coupling": list(COUPLINGS[:small]),
        "initial.spread.position": list(SPREADS[:small]),
    }
    change = f"simulation.horizon={1 if quick else 20}"
    window = "report.steady_window=0.5"
    found = sweep_figures(ech.sweep(ech.load_scenario("van-der-pol", [change, window]), over))
    save({name: found[name] for name in ("region", "success")}, out)


def draw_laws(out: Path, quick: bool) -> None:
    """Draw the formation errors of laws from the same starts."""
    laws, horizon = (LAWS[:1], 0.1) if quick else (LAWS, 8)
    changes = [f"simulation.horizon={horizon}", f"report.steady_window={horizon / 2}"]
    found = compare(ech.load_scenario("planar-quadrotor", changes), only=laws)
    save({"laws": comparison_figures(found)["formation_error"]}, out)


def save(figures: dict[str, Any], out: Path) -> None:
    """Write figures as PNG of 128 colours, which is a third of the size."""
    for path in figure_files.save(figures, out, kinds=("png",), dpi=120):
        with Image.open(path) as picture:
            small = picture.convert("RGB").quantize(128, dither=Image.Dither.NONE)
        small.save(path, optimize=True)


if __name__ == "__main__":
    main()
