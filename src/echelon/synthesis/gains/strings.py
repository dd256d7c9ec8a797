"""String stability: the amplification along a branch of a tree."""

import numpy as np

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.core.errors import GainError
from echelon.core.words import amount
from echelon.synthesis.certificates.margins import ClosedLoop, string_gain
from echelon.synthesis.gains.gain import Gain


def string_growth(gain: Gain, model: ControlAffine, graph: Graph) -> tuple[str, ...]:
    """Return a sentence on ||T||_inf along the branch that amplifies most (theory page, T4)."""
    A, B = linearize(model).with_inner(gain.inner)
    depth, parents = graph.depths(), graph.parents()
    i, j = graph.edges.T
    feedforward = "along arrows" if graph.directed else "with the parent's input fed forward"
    # An edge belongs to its end farther from the leaders; leaders are left out below.
    weight = np.ones(graph.agents)
    weight[j if graph.directed else np.where(depth[i] > depth[j], i, j)] = graph.weights
    used = np.unique(weight[list(graph.followers)])
    try:
        # Links of equal weight have equal gains, and each gain needs a sweep over frequencies.
        gains = [
            string_gain(ClosedLoop(A, B, gain.P, gain.R, gain.coupling * w, used)).gain
            for w in used
        ]
    except GainError:
        return (
            f"{feedforward}, coupling {gain.coupling:.4g} times an edge's "
            f"weight, {used[0]:.4g}, is too weak: a mode of the formation does not decay.",
        )
    growth = np.ones(graph.agents)
    # Outward, so that an agent's parent has its product before the agent does.
    for agent in np.argsort(depth, kind="stable"):
        if depth[agent]:
            growth[agent] = growth[parents[agent]] * gains[np.searchsorted(used, weight[agent])]
    worst = int(growth.argmax())
    return (
        f"{feedforward}, each agent of a branch amplifies a push by up to "
        f"||T|| = {max(gains):.3g}, and the {amount(depth[worst], 'agent')} up from agent {worst} "
        f"by up to {growth[worst]:.3g}; a stronger coupling brings ||T|| nearer to 1.",
    )
