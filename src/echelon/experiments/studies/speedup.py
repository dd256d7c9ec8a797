"""How long the slowest disagreement lives, and which leaders or edges would shorten it."""

from typing import NamedTuple

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.network.topology import (
    recommend_edges,
    recommend_leaders,
)
from echelon.synthesis.certificates.certificate import certify
from echelon.synthesis.gains.gain import Gain


class Speedup(NamedTuple):
    """How long the slowest disagreement lives, 1/|abscissa| in s, and what would shorten it.

    Attributes:
        now: on the graph as it is; infinite where a disagreement does not decay.
        leaders: agents to make leaders, and `with_leaders` the time with them.
        edges: pairs to link with weight 1, and `with_edges` the time with them.
    """

    now: float
    leaders: tuple[int, ...]
    with_leaders: float
    edges: tuple[tuple[int, int], ...]
    with_edges: float

    def sentence(self) -> str:
        """Return it as a sentence."""
        told = f"The slowest disagreement lives {self.now:.3g} s (1/lambda_min: N^2 on a line of N)"
        parts = []
        if self.leaders:
            named = ", ".join(map(str, self.leaders))
            as_ = "as a leader" if len(self.leaders) == 1 else "as leaders"
            agents = "agent" if len(self.leaders) == 1 else "agents"
            parts.append(f"{self.with_leaders:.3g} s with {agents} {named} {as_} too")
        if self.edges:
            named = ", ".join(f"{i}-{j}" for i, j in self.edges)
            edges = "edge" if len(self.edges) == 1 else "edges"
            parts.append(f"{self.with_edges:.3g} s with the {edges} {named} more")
        return f"{told}; {', '.join(parts)}." if parts else f"{told}."


def speedup(
    model: ControlAffine, graph: Graph, gain: Gain, leaders: int = 1, edges: int = 1
) -> Speedup:
    """Return the time constant of a gain's slowest disagreement, and what would shorten it.

    The coupling stays as it is, which suits an inner loop: any graph keeps it stable. What does not
    shorten it after all, since the slowest mode need not be that of lambda_min, is left out.

    Raises:
        GraphError: there are not so many followers to make leaders, or pairs to link.
    """
    led, linked = recommend_leaders(graph, leaders), recommend_edges(graph, edges)
    now = time_constant(model, graph, gain)
    with_leaders = time_constant(model, graph.with_leaders(led), gain)
    with_edges = time_constant(model, graph.with_edges(linked), gain)
    # Infinity is not below infinity: what stays unstable is no speedup.
    if not with_leaders < now:
        led, with_leaders = (), now
    if not with_edges < now:
        linked, with_edges = (), now
    return Speedup(now, led, with_leaders, linked, with_edges)


def time_constant(model: ControlAffine, graph: Graph, gain: Gain) -> float:
    """Return 1/|abscissa| of a gain on a graph, in s.

    In it the slowest disagreement falls to 1/e; it is infinite where one does not decay.
    """
    closed = linearize(model).with_inner(gain.inner)
    spectrum = graph.spectrum()
    abscissa = certify(closed, spectrum, gain.P, gain.R, gain.coupling, None).abscissa
    return -1.0 / abscissa if abscissa < 0.0 else float("inf")
