"""Write docs/assets/paper.html, the replay of a run that the documentation shows.

`python3 dev.py docs` runs it; it takes some seconds.
"""

from pathlib import Path

import echelon as ech
from echelon.experiments.results.dataset import recording_of
from echelon.output.viewer.replay import replay_page

FILE = Path(__file__).resolve().parent / "assets" / "paper.html"
SHORT = ("simulation.horizon=20", "simulation.store_every=4")

if __name__ == "__main__":
    run = ech.run(ech.load_scenario("paper", SHORT))
    FILE.write_text(replay_page(recording_of(run)), "utf-8")
