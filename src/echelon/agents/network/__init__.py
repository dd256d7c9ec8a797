"""The network: communication graphs and formations."""

from echelon.agents.network.formation import Formation
from echelon.agents.network.graph import Graph
from echelon.agents.network.spectrum import Spectrum
from echelon.agents.network.topology import recommend_edges, recommend_leaders

__all__ = ["Formation", "Graph", "Spectrum", "recommend_edges", "recommend_leaders"]
