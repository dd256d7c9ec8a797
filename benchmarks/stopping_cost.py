"""Time a step of the law `stopping-point` beside one of the Riccati law, turn by turn.

Run `python benchmarks/stopping_cost.py` (a minute). Both drive the paper's quadrotors on a ring by
native code, all sums included; what is printed are ratios of processor time, the best of each law.
"""

import argparse
import time

import numpy as np

import echelon as ech
from echelon.core.numerics import precision
from echelon.simulation.engine.prepare import prepare
from echelon.simulation.engine.simulate import sample_reference

MODEL = ech.models.Quadrotor()


def experiment(law: str, agents: int, steps: int) -> tuple[ech.Parts, ech.Settings]:
    """Return a ring of quadrotors under a law."""
    graph = ech.Graph.ring(agents)
    path = ech.references.Lemniscate()
    if law == "riccati":
        gain = ech.synthesize(MODEL, graph, ech.gains.Riccati(coupling=2.0))
        drive = ech.Laws(ech.laws.Tracking(path), ech.laws.Consensus(gain))
    else:
        watched = law == "stopping-point"
        leader = ech.laws.StoppingLeader(reference=path, observer=watched)
        drive = ech.Laws(leader, ech.laws.StoppingPoint(observer=watched))
    formation = ech.Formation.line(MODEL, graph)
    parts = ech.Parts(MODEL, graph, formation, drive, initial={"position": 0.1})
    horizon = 0.005 * steps
    return parts, ech.Settings(horizon=horizon, dt=0.005, store_every=steps, engine="native")


class Steps:
    """The steps of a run, ready to be taken again and again."""

    def __init__(self, parts: ech.Parts, settings: ech.Settings) -> None:
        """Compile them, and take them once."""
        prepared = prepare(parts, settings)
        self.counts = np.array([1]), np.array([settings.steps - 1])
        with precision("float64"):
            self.stepper = prepared.parts.drive.stepper(prepared.problem)
            self.now = self.stepper.start()
        reference = sample_reference(prepared, 0, settings.steps + 1)
        assert reference is not None
        self.reference = reference
        self.spent()

    def spent(self) -> float:
        """Return the processor time that they take, s, without what is written before the first."""
        one, others = self.counts
        with precision("float64"):
            now = self.stepper.advance(self.now, one, self.reference).now
            began = time.process_time()
            self.stepper.advance(now, others, self.reference[1:])
        return time.process_time() - began


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agents", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--turns", type=int, default=100)
    asked = parser.parse_args()
    laws = ["riccati", "stopping-point, no observer", "stopping-point"]
    runs = {law: Steps(*experiment(law, asked.agents, asked.steps)) for law in laws}
    best = dict.fromkeys(laws, float("inf"))
    for _ in range(asked.turns):
        best = {law: min(best[law], run.spent()) for law, run in runs.items()}
    steps = asked.agents * asked.steps
    for law, seconds in best.items():
        rate, ratio = steps / seconds / 1e6, seconds / best["riccati"]
        print(f"{law}: {rate:.3g} M steps of an agent a second, {ratio:.3g} of the Riccati law's")


if __name__ == "__main__":
    main()
