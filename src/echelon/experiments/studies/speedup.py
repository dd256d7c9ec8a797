"""The time constant of the slowest disagreement, and leaders or edges that would reduce it."""

from typing import NamedTuple

from echelon.agents.models.linearization import linearize
from echelon.agents.models.model import ControlAffine
from echelon.agents.network.graph import Graph
from echelon.agents.network.topology import recommend_edges, recommend_leaders
from echelon.core.digits import at_least
from echelon.synthesis.certificates.certificate import certify
from echelon.synthesis.gains.gain import Gain


class Speedup(NamedTuple):
    """The time constant of the slowest disagreement, 1/|abscissa| in s, and what would reduce it.

    Attributes:
        now: on the present graph; infinite where a disagreement does not decay.
        leaders: agents to make leaders, with the time constant `with_leaders`.
        edges: pairs to link with weight 1, with the time constant `with_edges`.
    """

    now: float
    leaders: tuple[int, ...]
    with_leaders: float
    edges: tuple[tuple[int, int], ...]
    with_edges: float

    def sentence(self) -> str:
        """Return it as a sentence."""
        parts = [f"The slowest disagreement decays with a time constant of {at_least(self.now)} s"]
        if self.leaders:
            names = ", ".join(map(str, self.leaders))
            role = f"agent {names} as a" if len(self.leaders) == 1 else f"agents {names} as"
            roles = "leader" if len(self.leaders) == 1 else "leaders"
            parts.append(f"{at_least(self.with_leaders)} s with {role} further {roles}")
        if self.edges:
            names = ", ".join(f"{i}-{j}" for i, j in self.edges)
            edges = "a further edge" if len(self.edges) == 1 else "further edges"
            parts.append(f"{at_least(self.with_edges)} s with {edges} {names}")
        return f"{'; '.join(parts)}."


def speedup(
    model: ControlAffine, graph: Graph, gain: Gain, leaders: int = 1, edges: int = 1
) -> Speedup:
    """Return the time constant of a gain's slowest disagreement, and what would reduce it.

    The coupling is not changed, which suits an inner loop: it is stable on any graph. Leaders or
    edges that do not reduce the time constant are left out; this happens because the slowest mode
    need not be that of lambda_min.

    Raises:
        GraphError: there are fewer followers than `leaders`, or fewer pairs than `edges`.
    """
    more_leaders, more_edges = recommend_leaders(graph, leaders), recommend_edges(graph, edges)
    now = time_constant(model, graph, gain)
    with_leaders = time_constant(model, graph.with_leaders(more_leaders), gain)
    with_edges = time_constant(model, graph.with_edges(more_edges), gain)
    # Infinity is not below infinity: an unstable loop has no speedup.
    if not with_leaders < now:
        more_leaders, with_leaders = (), now
    if not with_edges < now:
        more_edges, with_edges = (), now
    return Speedup(now, more_leaders, with_leaders, more_edges, with_edges)


def time_constant(model: ControlAffine, graph: Graph, gain: Gain) -> float:
    """Return 1/|abscissa| of a gain on a graph, in s.

    The slowest disagreement decays to 1/e in this time; it is infinite where one does not decay.
    """
    closed = linearize(model).with_inner(gain.inner)
    spectrum = graph.spectrum()
    abscissa = certify(closed, spectrum, gain.P, gain.R, gain.coupling, None).abscissa
    return -1.0 / abscissa if abscissa < 0.0 else float("inf")
