"""How fast rings of 4 to a million agents are stepped, and the picture of it in docs/assets.

`python benchmarks/rates.py --yardstick FOLDER` measures (five minutes; the folder is that of
`engine.py`), writes docs/assets/rates.json and draws docs/assets/rates.png; without a folder it
draws what was written.
"""

import argparse
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from echelon.output.plots import style as draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AGENTS = (4, 32, 250, 2_000, 16_000, 125_000, 1_000_000)
PLACE = Path(__file__).resolve().parents[1] / "docs" / "assets"
_TURNS = 3


def measured(agents: int, yardstick: Path) -> dict[str, float]:
    """Return the best rate of each way to step a ring, in millions of agent-steps a second."""
    import steppers as made

    import echelon as ech

    c, found = made.Yardstick(yardstick), dict[str, float]()
    fewer = max(2, min(2_000, 100_000 // agents))
    for bits in (32, 64):
        side = made.steppers(made.flock(ech.Graph.ring(agents)), bits)
        kernel = c.ring(agents, bits)
        # As many as a run takes between two looks at it, and for which there is a reference.
        steps = min(9_000, side.native.longest)
        ways = {
            "native": partial(made.rate, side.native, agents, [steps], side.reference, bits),
            "C": partial(c.rate, kernel, agents, steps),
        }
        if bits == 64:
            # One line of it is enough.
            jax = partial(made.rate, side.by_jax, agents, [fewer], side.reference, bits)
            jax()  # compiles
            ways["JAX"] = jax
        for _ in range(_TURNS):
            for way, turn in ways.items():
                name = f"{way}, float{bits}"
                found[name] = max(found.get(name, 0.0), round(turn() / 1e6, 4))
    return {"agents": agents, **found}


def drawn(rows: list[dict[str, float]]) -> "Figure":
    """Return the rates over the number of agents."""
    from matplotlib.figure import Figure

    with draw.style():
        figure = Figure(figsize=(7.0, 3.8), layout="constrained")
        axes = figure.add_subplot()
        colours = {"native": draw.COLOURS[0], "C": "0.5", "JAX": draw.COLOURS[1]}
        agents = [row["agents"] for row in rows]
        for name in [name for name in rows[0] if name != "agents"]:
            way, dashed = name.split(",")[0], name.endswith("64")
            axes.loglog(
                agents,
                [1e6 * row[name] for row in rows],
                "o--" if dashed else "o-",
                color=colours[way],
                label=name,
                markersize=3.0,
            )
        axes.set_xlabel("agents on a ring")
        axes.set_ylabel("steps of one agent a second, one core")
        axes.legend(ncols=3, loc="center", bbox_to_anchor=(0.5, 0.42))
    return figure


def main() -> None:
    """Measure where a yardstick is given, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--yardstick", type=Path, help="folder of the yardstick in C")
    asked, file = parser.parse_args(), PLACE / "rates.json"
    if asked.yardstick is not None:
        rows = []
        for agents in AGENTS:
            rows.append(measured(agents, asked.yardstick))
            print(json.dumps(rows[-1]), flush=True)
        file.write_text("[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n")
    with draw.style():
        drawn(json.loads(file.read_text())).savefig(PLACE / "rates.png")


if __name__ == "__main__":
    main()
