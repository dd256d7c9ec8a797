"""Carts on a tree behind a leader on a circle, for tests of single agents beside whole runs."""

import echelon as ech

CARTS = ech.models.DoubleIntegrator()
CIRCLE = ech.references.Circle(radius=1.0, rate=0.5)
TREE = ech.Graph([(0, 1, 0.7), (1, 2), (1, 3, 2.0)])
APART = ech.Safety(radii=(0.085, 0.085, 0.085))


def carts(law, network=None, feedforward="relay", **more):
    """Parts of carts under a law: `consensus`, `stopping-point`, or that with `safety`."""
    if law == "consensus":
        gain = ech.synthesize(CARTS, TREE, ech.gains.Riccati())
        follower = ech.laws.Consensus(gain, feedforward=feedforward)
        drive = ech.Laws(ech.laws.Tracking(CIRCLE), follower)
    else:
        follower = ech.laws.StoppingPoint(safety=APART if law == "safety" else None)
        drive = ech.Laws(ech.laws.StoppingLeader(reference=CIRCLE), follower)
    offsets = {1: (1.0, 0.0), 2: (1.0, 0.8), 3: (1.0, -0.8)}
    places = ech.Formation.from_offsets(CARTS, TREE, offsets)
    return ech.Parts(CARTS, TREE, places, drive, world=ech.World(network=network), **more)
