"""The network: communication graphs and formations."""

from echelon.agents.network.events import Cut, Join, Lose
from echelon.agents.network.formation import Formation
from echelon.agents.network.formation_motion import OffsetMotion, Reshape, Rotate, Scale
from echelon.agents.network.graph import Graph
from echelon.agents.network.spectrum import Spectrum
from echelon.agents.network.topology import recommend_edges, recommend_leaders

__all__ = [
    "Cut",
    "Formation",
    "Graph",
    "Join",
    "Lose",
    "OffsetMotion",
    "Reshape",
    "Rotate",
    "Scale",
    "Spectrum",
    "recommend_edges",
    "recommend_leaders",
]
